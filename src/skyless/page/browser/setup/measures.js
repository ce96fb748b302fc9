/** Step 3: heights, tapes, known points, and what is known of the antenna delays. */

import { state } from "../store.js";
import { Rows, h, options, text } from "../dom.js";
import { length, metres } from "../format.js";
import { anchorIds, changeFacts, facts } from "../survey/model.js";
import { COORDINATE, DISTANCE, HEIGHT, anchorList, givenItem, lengthField } from "./fields.js";

export const title = "Heights, tapes, points";

/** A tape that is off by more than this against the ranges is pointed out. */
const MUCH_M = 0.5;
const DELAYS = [
  ["0", "known: the boards are calibrated"],
  ["0.07", "usual, about 7 cm"],
  ["0.15", "never calibrated, about 15 cm"],
];
const OLD_POSITIONS = [
  ["none", "are not used"],
  ["rough", "are rough, about 30 cm"],
  ["keep", "stay: only delays are found"],
];

let parts = null;

/** Build the step. */
export function start(body) {
  const tapes = makeTapes();
  const heights = makeHeights();
  const points = makePoints();
  const choices = makeChoices();
  parts = { tapes, heights, points, choices };
  body.append(heights.element, tapes.element, points.element, choices.element);
}

/** How it stands. */
export function summary() {
  const { tapes, points, heights_m } = facts();
  const given = [
    [Object.keys(heights_m).length, "height", "heights"],
    [tapes.length, "tape", "tapes"],
    [Object.keys(points).length, "point", "points"],
  ];
  const words = given.filter(([count]) => count).map(([count, one, more]) => `${count} ${count === 1 ? one : more}`);
  const asked = state.survey?.survey?.assumed_heights ? "heights are missing" : state.survey?.survey?.tapes.length ? "a tape is asked for" : "";
  return words.join(", ") || asked;
}

/** Bring the step up to date. */
export function show() {
  for (const part of Object.values(parts)) part.show();
}

function section(heading, ...children) {
  return h("section", { class: "measure", "aria-label": heading }, h("h3", {}, heading), ...children);
}

/** Distances between two anchors: those that would help most, those that were given, and a new one. */
function makeTapes() {
  const advice = h("ul", { class: "advice", id: "tape-advice" });
  const given = h("ul", { class: "given", id: "tapes" });
  const one = anchorList("From anchor", "choose");
  const other = anchorList("to anchor", "choose");
  const distance = lengthField({ label: "Distance", limits: DISTANCE, optional: false });
  const fault = h("p", { class: "fault", role: "alert", hidden: true });
  const add = async (event) => {
    event.preventDefault();
    const [a, b] = [one.read(), other.read()];
    const words = a === null || b === null ? "Choose two anchors." : a === b ? "Choose two different anchors." : "";
    text(fault, words);
    fault.hidden = !words;
    const distance_m = distance.read();
    if (words || distance_m === undefined) return;
    const [low, high] = a < b ? [a, b] : [b, a];
    const kept = facts().tapes.filter((tape) => !isPair(tape, a, b));
    if (await changeFacts({ tapes: [...kept, { a: low, b: high, distance_m, std_m: 0.005 }] })) distance.clear();
  };
  const button = h("button", { type: "submit", class: "primary" }, "Add");
  const form = h("form", { class: "fields", id: "tape-form", onsubmit: add }, one.element, other.element, distance.element, button);
  const use = (a, b) => {
    one.show(a);
    other.show(b);
    distance.input.focus();
  };
  const adviceRows = new Rows(advice, (_key, tape) => ({ element: adviceItem(tape, use) }));
  const givenRows = new Rows(given, (_key, tape) => tapeItem(tape));
  const intro = h("p", { class: "fine" }, "A distance between two anchors, by tape or laser, from antenna to antenna.");
  const show = () => {
    one.show();
    other.show();
    const { tapes } = facts();
    const asked = (state.survey?.survey?.tapes ?? []).filter((tape) => !tapes.some((known) => isPair(known, tape.a, tape.b)));
    adviceRows.show(asked.map((tape, index) => [JSON.stringify([index, tape]), { ...tape, index }]));
    givenRows.show(tapes.map((tape) => [JSON.stringify(tape), tape]));
  };
  return { element: section("Distances", intro, advice, given, form, fault), show };
}

/** The later ones help after the earlier ones. */
function adviceItem({ a, b, std_before_m, std_after_m, index }, use) {
  const [before, after] = [std_before_m, std_after_m].map((std_m) => (std_m === null ? "not determined" : length(std_m)));
  const words = h("span", {}, h("strong", {}, `${index ? "Then" : "Measure"} ${a}–${b}:`), ` ${before} → ${after}`);
  return h("li", {}, words, h("button", { type: "button", onclick: () => use(a, b), "aria-label": `Type ${a}–${b}` }, "Type it"));
}

/** A tape, with what the ranges say where that is far off. */
function tapeItem(tape) {
  const { a, b, distance_m } = tape;
  const remove = () => changeFacts({ tapes: facts().tapes.filter((one) => !isPair(one, a, b)) });
  const element = givenItem(`${a}–${b}: ${metres(distance_m, 3)} m`, `Remove the distance ${a}–${b}`, remove);
  const note = h("span", { class: "fault" });
  element.firstElementChild.append(note);
  const update = () => {
    const pair = (state.survey?.pairs ?? []).find((one) => isPair(one, a, b));
    const off = pair && Math.abs(pair.range_m - distance_m) > MUCH_M;
    text(note, off ? ` The radio measures ${metres(pair.range_m)} m: is it mistyped, or the way blocked?` : "");
  };
  return { element, update };
}

function isPair(one, a, b) {
  return (one.a === a && one.b === b) || (one.a === b && one.b === a);
}

/** Heights of the anchors. */
function makeHeights() {
  const body = h("div", { class: "heights", id: "heights" });
  const how = options({ "aria-label": "Heights" }, HEIGHTS, (value) => changeFacts({ dimensions: Number(value) }));
  const rows = new Rows(body, (id) => {
    const apply = (value) => changeFacts({ heights_m: withEntry(facts().heights_m, id, value) });
    const field = lengthField({ label: `Anchor ${id}`, limits: HEIGHT, apply });
    return { element: field.element, update: () => field.show(facts().heights_m[id]) };
  });
  const all = lengthField({ label: "All anchors at", limits: HEIGHT });
  const fill = h("button", { type: "button" }, "Set all");
  fill.addEventListener("click", () => {
    const value = all.read();
    if (value === undefined) return;
    const heights_m = value === null ? {} : Object.fromEntries(anchorIds().map((id) => [id, value]));
    changeFacts({ heights_m });
  });
  const note = h("p", { class: "fine" }, "Above the floor; to within 10 cm is enough for positions on the plan.");
  const show = () => {
    if (document.activeElement !== how) how.value = String(facts().dimensions);
    rows.show(anchorIds().map((id) => [id, id]));
  };
  const choice = h("label", { class: "choice" }, "Heights", how);
  const whole = h("div", { class: "fields" }, all.element, fill);
  return { element: section("Heights", choice, note, whole, body), show };
}

const HEIGHTS = [
  ["2", "are as typed here"],
  ["3", "are estimated too"],
];

/** A table with one entry replaced, or removed where the value is null. */
function withEntry(table, key, value) {
  const rest = Object.fromEntries(Object.entries(table).filter(([other]) => other !== String(key)));
  return value === null ? rest : { ...rest, [key]: value };
}

/** Anchors whose positions are known. */
function makePoints() {
  const given = h("ul", { class: "given", id: "points" });
  const anchor = anchorList("Anchor", "choose");
  const [x, y] = ["x", "y"].map((axis) => lengthField({ label: axis, limits: COORDINATE, optional: false }));
  const z = lengthField({ label: "z (if known)", limits: COORDINATE });
  const fault = h("p", { class: "fault", role: "alert", hidden: true });
  const add = async (event) => {
    event.preventDefault();
    const id = anchor.read();
    fault.hidden = id !== null;
    text(fault, id === null ? "Choose an anchor." : "");
    const point = [x.read(), y.read(), z.read()];
    if (id === null || point.includes(undefined)) return;
    if (!(await changeFacts({ points: { ...facts().points, [id]: point } }))) return;
    for (const field of [x, y, z]) field.clear();
  };
  const button = h("button", { type: "submit", class: "primary" }, "Add");
  const fields = [anchor.element, x.element, y.element, z.element, button];
  const form = h("form", { class: "fields", id: "point-form", onsubmit: add }, ...fields);
  const rows = new Rows(given, (_key, [id, point]) => {
    const remove = () => changeFacts({ points: withEntry(facts().points, id, null) });
    const words = point.map((value, n) => (value === null ? "" : `${"xyz"[n]} ${metres(value, 3)}`)).filter(Boolean);
    return { element: givenItem(`Anchor ${id}: ${words.join(", ")} m`, `Remove the point of anchor ${id}`, remove) };
  });
  const intro = h("p", { class: "fine" }, "Anchors whose coordinates were measured; two or more of them name the axes.");
  const show = () => {
    anchor.show();
    rows.show(Object.entries(facts().points).map((entry) => [JSON.stringify(entry), entry]));
  };
  return { element: section("Known points", intro, given, form, fault), show };
}

/** Antenna delays, and the positions of the present site file. */
function makeChoices() {
  const delays = options({ "aria-label": "Antenna delays" }, DELAYS, (value) =>
    changeFacts({ delay_std_m: Number(value) }),
  );
  const old = options({ "aria-label": "Positions of the site file" }, OLD_POSITIONS, (value) =>
    changeFacts({ keep_positions: value === "keep", sketch_m: value === "none" ? {} : sketch() }),
  );
  const oldChoice = h("label", { class: "choice" }, "Positions of the site file", old);
  const show = () => {
    const { delay_std_m, keep_positions, sketch_m } = facts();
    showChoice(delays, DELAYS, delay_std_m);
    const used = keep_positions ? "keep" : Object.keys(sketch_m).length ? "rough" : "none";
    if (document.activeElement !== old) old.value = used;
    oldChoice.hidden = !state.site?.anchors.length && used === "none";
  };
  const element = section("Antenna delays and old positions", h("label", { class: "choice" }, "Antenna delays", delays), oldChoice);
  return { element, show };
}

/** Show a value that may be none of the list's, as the program may have been started with it. */
function showChoice(list, pairs, value) {
  if (document.activeElement === list) return;
  if (!pairs.some(([known]) => Number(known) === value) && ![...list.options].some((one) => Number(one.value) === value)) {
    list.append(h("option", { value: String(value) }, `about ${length(value)}`));
  }
  list.value = [...list.options].find((one) => Number(one.value) === value)?.value ?? "";
}

function sketch() {
  return Object.fromEntries((state.site?.anchors ?? []).map(({ id, x_m, y_m, z_m }) => [id, [x_m, y_m, z_m ?? null]]));
}
