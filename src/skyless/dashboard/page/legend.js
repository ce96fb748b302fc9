/** What the map's marks mean, and switches for its layers. */

import { changed, on, state } from "./store.js";
import { remember, remembered } from "./browser.js";
import { byId, h, s, text } from "./dom.js";
import { DELAY_S, GONE_S, GREY_S, stillMotion } from "./clock.js";
import { length, number } from "./format.js";
import { CONDITIONS } from "./map/anchors.js";
import { KINDS, choose, colourAt } from "./map/overlay.js";
import { NAMED } from "./map/tags.js";

const KEY = "skyless-legend";
const SWITCHES = {
  names: `Names (in a crowd of more than ${NAMED}, the selected one)`,
  ellipses: "Ellipse that holds 95 % of the errors, as the tag states them",
  levels: "Protection level, a dashed circle: the tag is outside with the stated risk at most",
  truth: "True position, a faint ring (simulated)",
};

/** Fill the legend. */
export function start() {
  const body = byId("legend-body");
  body.append(marks(), ...Object.entries(SWITCHES).map(switchFor), trails(), overlays(), note());
  on(["overlay", "options"], scale);
  on(["site"], () => (byId("switch-truth").hidden = !state.simulated));
  byId("legend").open = remembered(KEY) === "open";
  byId("legend").addEventListener("toggle", () => remember(KEY, byId("legend").open ? "open" : "shut"));
}

function marks() {
  const rows = Object.entries(CONDITIONS).map(([kind, { words }]) => h("li", {}, anchorMark(kind), `anchor ${words}`));
  const master = h("li", {}, anchorMark("good", true), "the master: its clock is the site's time");
  return h("ul", { class: "marks" }, ...rows, master);
}

/** A condition's shape as a small picture. */
export function anchorMark(kind, master = false) {
  const shapes = {
    good: () => s("rect", { x: 5, y: 5, width: 8, height: 8 }),
    warn: () => s("path", { d: "M9 3.5 14.5 13.5H3.5z" }),
    bad: () => s("path", { class: "line", d: "M4.5 4.5 13.5 13.5M13.5 4.5 4.5 13.5" }),
    unknown: () => s("rect", { class: "line", x: 5, y: 5, width: 8, height: 8 }),
  };
  const picture = s("svg", { viewBox: "0 0 18 18", class: `mark ${kind}`, "aria-hidden": "true" }, shapes[kind]());
  if (master) picture.append(s("rect", { class: "line", x: 1.5, y: 1.5, width: 15, height: 15 }));
  return picture;
}

function switchFor([key, words]) {
  const box = h("input", { type: "checkbox", checked: state.options[key] });
  box.addEventListener("change", () => {
    state.options[key] = box.checked;
    changed("options");
  });
  return h("label", { class: "switch", id: `switch-${key}` }, box, words);
}

function trails() {
  const lengths = [0, 5, 15, 60];
  const list = h(
    "select",
    { id: "trail-length" },
    ...lengths.map((value) => h("option", { value }, value ? `${value} s` : "off")),
  );
  list.value = String(state.options.trails);
  list.addEventListener("change", () => {
    state.options.trails = Number(list.value);
    changed("options");
  });
  return h("label", { class: "choice" }, "Trails", list);
}

function overlays() {
  const list = h("select", { id: "overlay" });
  for (const [value, words] of Object.entries(KINDS)) list.append(h("option", { value }, words));
  list.addEventListener("change", () => choose(list.value));
  return h("label", { class: "choice" }, "Overlay", list);
}

function scale() {
  const data = state.overlay.data;
  byId("overlay").value = state.options.overlay;
  byId("ramp-box").hidden = !data;
  if (!data) return;
  const context = byId("ramp").getContext("2d");
  const image = context.createImageData(128, 1);
  for (let x = 0; x < 128; x++) image.data.set([...colourAt(x / 127), 255], 4 * x);
  context.putImageData(image, 0, 0);
  text(byId("ramp-title"), (KINDS[data.kind] ?? data.kind).split(" (")[0]);
  const write = (value) => (data.unit === "m" ? length(value) : number(value, 1));
  text(byId("ramp-good"), `${write(data.levels.good)} good`);
  text(byId("ramp-bad"), `${write(data.levels.bad)} bad`);
  text(byId("ramp-note"), `${data.method ? `Method ${data.method}. ` : ""}No colour: no fix there.`);
}

function note() {
  const words = () =>
    (stillMotion.matches
      ? "Positions are the last fixes, not interpolated. "
      : `Live motion is drawn ${DELAY_S} s late and interpolated in straight lines between fixes, never beyond the last one. `) +
    `A tag is hollow and grey after ${GREY_S} s without a fix, and only in the list after ${GONE_S} s.`;
  const box = h("p", { class: "fine" }, words());
  stillMotion.addEventListener("change", () => text(box, words()));
  return box;
}
