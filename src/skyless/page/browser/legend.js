/** The legend next to the map: marks of tags and anchors, switches for layers, floors, and saving; and the scale of an overlay. */

import { changed, on, saveSetting, savedSetting, select, state } from "./store.js";
import { byId, h, isPhone, offer, options, text, throttle, toast } from "./dom.js";
import { allGroups, labelOf } from "./assets/model.js";
import { DELAY_S, stillMotion, tracks } from "./clock.js";
import { length } from "./format.js";
import { CONDITIONS, anchorMark, siteMode, wordsOf } from "./map/anchors.js";
import { savePicture, savePositions } from "./map/export.js";
import { chooseFloor, floors, giveHeights, givenHeights } from "./map/floors.js";
import { tagMark, tagStyle } from "./map/marks.js";
import { KINDS, choose, fractionOf, writeValue } from "./map/overlay.js";
import { NAMED } from "./map/tags.js";
import { paintScale } from "./pictures.js";
import { DISTINCT } from "./theme.js";

const KEY = "skyless-legend";
const SWITCHES = {
  names: `Names (with more than ${NAMED} tags, only the selected one)`,
  ellipses: "Ellipse of 95 % of the errors, by the tag's reported σ",
  levels: "Protection level, a dashed circle: the tag is outside with at most the configured probability",
  truth: "True position, a faint ring (simulated sites)",
};
/** How much `tracks.js` and `player.js` keep. */
const KEPT = "What this page holds: of the live site the last 2048 fixes of each tag, of a recording about 90 s up to now";
const MASTER = "master: its clock is the site's time";

/** Fill the legend. */
export function start() {
  const overlays = h("label", { class: "choice" }, "Overlay", options({ id: "overlay" }, Object.entries(KINDS), choose));
  const sections = [
    ["Tags", tags(), groups()],
    ["Anchors", marks()],
    ["Layers", ...Object.entries(SWITCHES).map(switchFor), trails(), overlays],
    ["Floors", ...floorChoice()],
    ["Save", saving()],
  ];
  for (const [title, ...parts] of sections) {
    byId("legend-body").append(h("section", {}, h("h2", {}, title), ...parts));
  }
  byId("legend-body").append(note());
  on(["overlay", "options", "theme"], scale);
  setInterval(() => state.overlay.pendingSince !== null && scale(), 500);
  on(["site"], () => (byId("switch-truth").hidden = !state.simulated));
  byId("ramp-again").addEventListener("click", () => choose(state.options.overlay));
  byId("legend").open = savedSetting(KEY) === "open" && !isPhone();
  byId("legend").addEventListener("toggle", () => isPhone() || saveSetting(KEY, byId("legend").open ? "open" : "shut"));
}

/** An entry for each tag; with very many all have one mark, and the list next to the map has their names. */
function tags() {
  const list = h("ul", { class: "tag-marks" });
  const many = h("p", { class: "fine", hidden: true }, `With more than ${DISTINCT} tags all have one mark.`);
  let shown = "";
  const show = () => {
    const all = tracks().sorted;
    const key = JSON.stringify([state.selection.tag, all.map(({ name }, index) => [labelOf(name), tagStyle(index, all.length, name)])]);
    if (key === shown) return;
    shown = key;
    many.hidden = all.length <= DISTINCT || state.assets.size > 0;
    const rows = all.slice(0, DISTINCT).map(({ name }, index) => {
      const mark = tagMark(tagStyle(index, all.length, name));
      const button = h("button", { type: "button", class: "quiet", onclick: () => select("tag", name) }, mark, labelOf(name));
      button.setAttribute("aria-pressed", String(name === state.selection.tag));
      return h("li", {}, button);
    });
    list.replaceChildren(...(all.length > DISTINCT ? [] : rows));
    if (!all.length) list.replaceChildren(h("li", { class: "fine" }, "No tags yet."));
  };
  on(["tags", "health", "selection", "theme", "mode"], throttle(400, show));
  show();
  return h("div", {}, list, many);
}

/** The colours of groups; a click shows one group in the list and dims the others on the map. */
function groups() {
  const list = h("ul", { class: "tag-marks", "aria-label": "Groups" });
  on(["assets"], () => {
    const rows = [...allGroups()].map(([name, { colour }]) => {
      const pick = () => {
        state.filter.group = state.filter.group === name ? "" : name;
        changed("tags");
      };
      const mark = tagMark({ colour, shape: "circle" });
      return h("li", {}, h("button", { type: "button", class: "quiet", onclick: pick }, mark, `group ${name}`));
    });
    list.replaceChildren(...rows);
  });
  return list;
}

/** The marks of anchors, with the words of the site's mode. */
function marks() {
  const list = h("ul", { class: "marks" });
  const show = () => {
    const rows = Object.keys(CONDITIONS).map((kind) => h("li", {}, anchorMark(kind), `anchor ${wordsOf(kind)}`));
    const master = siteMode() === "master" ? [h("li", {}, anchorMark("good", true), MASTER)] : [];
    list.replaceChildren(...rows, ...master);
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

/** The chosen floor, where the site has several, and the heights that the user gives. */
function floorChoice() {
  const list = options({ id: "floor" }, [["", "all"]], (value) => chooseFloor(value === "" ? null : Number(value)));
  const choice = h("label", { class: "choice" }, "Show", list);
  const heights = h("input", { type: "text", id: "floor-heights", placeholder: "0, 3.2" });
  const given = h("label", { class: "choice" }, "Floor heights (m)", heights);
  heights.addEventListener("change", () => {
    try {
      giveHeights(heights.value);
    } catch (error) {
      toast(`Floors: ${error.message}.`, "bad");
    }
    fill();
  });
  const fill = () => {
    const found = floors();
    choice.hidden = found.length < 2;
    offer(list, [["", "all"], ...found.map(({ name }, n) => [n, name])], state.options.floor ?? "");
    if (document.activeElement !== heights) heights.value = givenHeights().join(", ");
  };
  on(["site", "mode"], () => {
    if (state.options.floor !== null && !floors()[state.options.floor]) chooseFloor(null);
    fill();
  });
  fill();
  return [choice, given];
}

function saving() {
  return h(
    "div",
    { class: "saving" },
    h("button", { type: "button", id: "save-picture", onclick: savePicture }, "Map as a picture (PNG)"),
    h("button", { type: "button", id: "save-positions", title: KEPT, onclick: savePositions }, "Positions as a table (CSV)"),
  );
}

/** The overlay's scale: while it is computed, what it shows, or why there is none. */
function scale() {
  const { data, error, pendingSince } = state.overlay;
  const kind = state.options.overlay;
  const title = (KINDS[data?.kind ?? kind] ?? kind).split(" (")[0];
  byId("overlay").value = kind;
  byId("ramp-box").hidden = !data && !error && pendingSince === null;
  byId("ramp-box").classList.toggle("pending", pendingSince !== null);
  byId("ramp-again").hidden = !error;
  byId("ramp-shown").hidden = !data;
  text(byId("ramp-seconds"), pendingSince === null ? "" : `${Math.round((performance.now() - pendingSince) / 1e3)} s`);
  if (!data) {
    text(byId("ramp-title"), error ? `No overlay: ${error}` : `${title}: computing …`);
    return;
  }
  text(byId("ramp-title"), title + (data.unit === "m" ? " in cm or m" : ", a factor"));
  const words = (tick) => (data.unit === "m" ? length(tick).replace(/\.0+(?= )/, "") : String(tick));
  const ticks = data.scale.ticks.map((tick) => [fractionOf(tick, data.scale), words(tick)]);
  paintScale(byId("ramp"), data.scale, byId("ramp-ticks"), ticks);
  text(byId("ramp-good"), `least ${writeValue(data.least, data)}`);
  text(byId("ramp-bad"), `largest ${writeValue(data.most, data)}`);
  const height = Number.isFinite(data.height_m) ? ` for tags at ${Number(data.height_m.toFixed(2))} m` : "";
  text(byId("ramp-note"), `Dark is good. ${data.method ? `Method ${data.method}${height}. ` : ""}No colour: no fix.`);
}

function note() {
  const words = () =>
    (stillMotion.matches
      ? "Positions are the last fixes, not interpolated. "
      : `Live positions are shown ${DELAY_S} s late, interpolated linearly between fixes, never extrapolated. `) +
    "A tag whose fix is older than usual for it is hollow and grey; one that is silent for longer is only in the list.";
  const box = h("p", { class: "fine" }, words());
  stillMotion.addEventListener("change", () => text(box, words()));
  return box;
}
