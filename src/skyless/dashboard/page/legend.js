/** The meaning of the map's marks, and switches for its layers. */

import { changed, on, saveSetting, savedSetting, state } from "./store.js";
import { byId, h, options, text } from "./dom.js";
import { DELAY_S, GONE_S, GREY_S, stillMotion } from "./clock.js";
import { length, number } from "./format.js";
import { CONDITIONS, anchorMark, siteMode, wordsOf } from "./map/anchors.js";
import { KINDS, choose, colourAt } from "./map/overlay.js";
import { NAMED } from "./map/tags.js";

const KEY = "skyless-legend";
const SWITCHES = {
  names: `Names (with more than ${NAMED} tags, only the selected one)`,
  ellipses: "Ellipse of 95 % of the errors, by the tag's reported σ",
  levels: "Protection level, a dashed circle: the tag is outside with at most the configured probability",
  truth: "True position, a faint ring (simulated sites)",
};
/** Anchors with a frame, by the mode of the site. */
const LEADERS = {
  master: "master: its clock is the site's time",
  slots: "root: its clock leads the slot time of anchors linked to it",
};

/** Fill the legend. */
export function start() {
  const body = byId("legend-body");
  body.append(marks(), ...Object.entries(SWITCHES).map(switchFor), trails(), overlays(), note());
  on(["overlay", "options"], scale);
  on(["site"], () => (byId("switch-truth").hidden = !state.simulated));
  byId("legend").open = savedSetting(KEY) === "open";
  byId("legend").addEventListener("toggle", () => saveSetting(KEY, byId("legend").open ? "open" : "shut"));
}

/** The marks of anchors, with the words of the site's mode. */
function marks() {
  const list = h("ul", { class: "marks" });
  const show = () => {
    const rows = Object.keys(CONDITIONS).map((kind) => h("li", {}, anchorMark(kind), `anchor ${wordsOf(kind)}`));
    const leader = LEADERS[siteMode()];
    list.replaceChildren(...rows, ...(leader ? [h("li", {}, anchorMark("good", true), leader)] : []));
  };
  on(["site"], show);
  show();
  return list;
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
  const lengths = [0, 5, 15, 60].map((value) => [value, value ? `${value} s` : "off"]);
  const list = options({ id: "trail-length" }, lengths, (value) => {
    state.options.trails = Number(value);
    changed("options");
  });
  list.value = String(state.options.trails);
  return h("label", { class: "choice" }, "Trails", list);
}

function overlays() {
  return h("label", { class: "choice" }, "Overlay", options({ id: "overlay" }, Object.entries(KINDS), choose));
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
      : `Live positions are shown ${DELAY_S} s late, interpolated linearly between fixes, never extrapolated. `) +
    `Without a fix, a tag is hollow and grey after ${GREY_S} s and only in the list after ${GONE_S} s.`;
  const box = h("p", { class: "fine" }, words());
  stillMotion.addEventListener("change", () => text(box, words()));
  return box;
}
