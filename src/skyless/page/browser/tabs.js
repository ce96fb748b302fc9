/** The side panel: tabs by the pattern of the ARIA authoring guide, and on a phone a sheet of three heights. */

import { changed, isChangeable, on, state } from "./store.js";
import { byId, h, isPhone, throttle } from "./dom.js";
import { places } from "./map/places.js";
import { picking } from "./survey/picking.js";
import * as alarms from "./alarms/panel.js";
import * as anchors from "./panels/anchors.js";
import * as events from "./panels/events.js";
import * as history from "./panels/history.js";
import * as recordings from "./panels/recordings.js";
import * as tags from "./panels/tags.js";
import * as timing from "./panels/timing.js";
import * as zones from "./panels/zones.js";
import * as setup from "./setup/panel.js";

/**
 * In groups: what is watched, places and the past, engineering. Each has a title, the topics that it shows, the interval at
 * which it shows changes, `start(panel)` and `show()`; one that has nothing to show at some sites says so with `isIdle()`.
 */
const GROUPS = [{ tags, alarms, events }, { zones, history, recordings }, { anchors, timing, setup }];
const TABS = Object.assign({}, ...GROUPS);
const KEYS = Object.keys(TABS);
const SHEET = ["low", "half", "high"];

let current = "tags";
let offered = false;
let notLive = false;

/** Build the panel. */
export function start() {
  const groups = GROUPS.map((tabs) => ({ tabs, element: h("div", { role: "presentation", class: "tab-group" }) }));
  byId("tabs").append(...groups.map(({ element }) => element));
  for (const [key, tab] of Object.entries(TABS)) {
    const button = { type: "button", role: "tab", id: `tab-${key}`, "aria-controls": `panel-${key}` };
    groups.find((one) => key in one.tabs).element.append(h("button", { ...button, onclick: () => open(key) }, tab.title));
    const attributes = { role: "tabpanel", id: `panel-${key}`, class: "tab-panel", "aria-labelledby": `tab-${key}` };
    const panel = h("div", { ...attributes, tabindex: "0" });
    byId("panels").append(panel);
    tab.start(panel);
    on(
      tab.topics,
      throttle(tab.interval_ms, () => key === current && show()),
    );
  }
  byId("tabs").addEventListener("keydown", move);
  document.body.dataset.sheet = "half";
  byId("sheet").addEventListener("click", () => sheet(SHEET[(SHEET.indexOf(document.body.dataset.sheet) + 1) % 3]));
  open("tags");
  on(["log", "read"], showUnread);
  on(["site"], hideIdle);
  on(["site"], openWhereNothingIsPlaced);
  byId("legend").addEventListener("toggle", () => byId("legend").open && isPhone() && sheet("low"));
  on(["picking"], () => picking && isPhone() && sheet("half"));
  setInterval(() => TABS[current].changesWithTime && show(), 1000);
  on(["mode", "placing"], showMap);
  on(["selection"], () => {
    const { tag, anchor, zone } = state.selection;
    if (tag !== null && current !== "timing") open("tags");
    else if (anchor !== null && current !== "setup") open("anchors");
    else if (zone !== null) open("zones");
  });
}

/** Offer only tabs that have something to show at this site. */
function hideIdle() {
  for (const [key, tab] of Object.entries(TABS)) byId(`tab-${key}`).hidden = tab.isIdle?.() ?? false;
  if (TABS[current].isIdle?.()) open("tags");
}

/** Open the tab Set up at a site without any position, once: there is nothing else to see. */
function openWhereNothingIsPlaced() {
  if (offered || !isChangeable() || !state.site) return;
  offered = true;
  if (!state.site.anchors.length && current === "tags") open("setup");
}

/** The tab's title has the number of severe events that have not been read. */
function showUnread() {
  const count = events.unread();
  const button = byId("tab-events");
  const words = h("span", { class: "unseen" }, ` ${count === 1 ? "fault" : "faults"} not read`);
  if (button.dataset.unread === String(count)) return;
  button.dataset.unread = String(count);
  button.replaceChildren(events.title, ...(count ? [" ", h("span", { class: "unread" }, String(count), words)] : []));
}

/** On a phone the sheet makes room where the map begins to show a recording, the past or other places of anchors. */
function showMap() {
  const now = state.mode === "replay" || state.past !== null || places !== null;
  if (now && !notLive && isPhone()) sheet("low");
  notLive = now;
}

/** Bring the open tab up to date, if it is visible. */
function show() {
  if (document.body.dataset.sheet !== "low") TABS[current].show();
}

/** Open a tab. */
export function open(key) {
  current = key;
  if (state.setup.open !== (key === "setup")) {
    state.setup.open = key === "setup";
    changed("setup");
  }
  for (const name of KEYS) {
    const button = byId(`tab-${name}`);
    button.setAttribute("aria-selected", String(name === key));
    button.tabIndex = name === key ? 0 : -1;
    byId(`panel-${name}`).hidden = name !== key;
  }
  byId(`tab-${key}`).scrollIntoView({ block: "nearest", inline: "nearest" });
  if (document.body.dataset.sheet === "low") sheet("half");
  else show();
}

function sheet(height) {
  document.body.dataset.sheet = height;
  byId("sheet").setAttribute("aria-expanded", String(height !== "low"));
  show();
}

function move(event) {
  const keys = KEYS.filter((key) => byId(`tab-${key}`).checkVisibility());
  const at = keys.indexOf(current);
  const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: keys.length - 1 }[event.key];
  if (to === undefined) return;
  event.preventDefault();
  const key = keys[(to + keys.length) % keys.length];
  open(key);
  byId(`tab-${key}`).focus();
}
