/** The side panel: tabs by the pattern of the ARIA authoring guide, and on a phone a sheet of three heights. */

import { on, state } from "./store.js";
import { byId, h } from "./dom.js";
import * as anchors from "./panels/anchors.js";
import * as recordings from "./panels/recordings.js";
import * as tags from "./panels/tags.js";
import * as timing from "./panels/timing.js";
import * as zones from "./panels/zones.js";

const TABS = { tags, anchors, timing, zones, recordings };
const SHEET = ["low", "half", "high"];

/** Which tab is open; the others need not draw. */
export let current = "tags";

/** Build the panel. */
export function start() {
  for (const [key, tab] of Object.entries(TABS)) {
    const button = h(
      "button",
      {
        type: "button",
        role: "tab",
        id: `tab-${key}`,
        "aria-controls": `panel-${key}`,
        onclick: () => open(key),
      },
      tab.title,
    );
    const panel = h("div", {
      role: "tabpanel",
      id: `panel-${key}`,
      class: "tab-panel",
      "aria-labelledby": `tab-${key}`,
      tabindex: "0",
    });
    byId("tabs").append(button);
    byId("panels").append(panel);
    tab.start(panel, () => current === key && document.body.dataset.sheet !== "low");
  }
  byId("tabs").addEventListener("keydown", move);
  document.body.dataset.sheet = "half";
  byId("sheet").addEventListener("click", () => sheet(SHEET[(SHEET.indexOf(document.body.dataset.sheet) + 1) % 3]));
  open("tags");
  on(["mode"], () => state.mode === "replay" && matchMedia("(max-width: 760px)").matches && sheet("low"));
  on(["selection"], () => {
    const { tag, anchor, zone } = state.selection;
    if (tag !== null && current !== "timing") open("tags");
    else if (anchor !== null) open("anchors");
    else if (zone !== null) open("zones");
  });
}

/** Show a tab. */
export function open(key) {
  current = key;
  for (const name of Object.keys(TABS)) {
    const button = byId(`tab-${name}`);
    button.setAttribute("aria-selected", String(name === key));
    button.tabIndex = name === key ? 0 : -1;
    byId(`panel-${name}`).hidden = name !== key;
  }
  if (document.body.dataset.sheet === "low") sheet("half");
  TABS[key].show();
}

/** Show a list and a detail under it, each with its own scrolling; or the list alone. */
export function split(panel, list, on) {
  if (panel.classList.toggle("split", on) === list.classList.contains("short")) return;
  list.classList.toggle("short", on);
  list.querySelector(".selected")?.scrollIntoView({ block: "nearest" });
}

function sheet(height) {
  document.body.dataset.sheet = height;
  byId("sheet").setAttribute("aria-expanded", String(height !== "low"));
  TABS[current].show();
}

function move(event) {
  const keys = Object.keys(TABS);
  const at = keys.indexOf(current);
  const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: keys.length - 1 }[event.key];
  if (to === undefined) return;
  event.preventDefault();
  const key = keys[(to + keys.length) % keys.length];
  open(key);
  byId(`tab-${key}`).focus();
}
