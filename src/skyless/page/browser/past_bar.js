/** The bar below the map while it shows the past: the player of a way, or the scale of a heat map; and its mark. */

import { on, state } from "./store.js";
import { byId, h, options, text } from "./dom.js";
import { dateTime, metres, timeOfDay } from "./format.js";
import { heatScale, heatTicks, ramp, topSpeed } from "./map/past.js";
import { SPEEDS, endPast, placeNow, seekPast, setPast, togglePast } from "./past.js";
import { paintScale } from "./pictures.js";
import { playControls, runKey, showSpans } from "./replay_bar.js";
import { ALERTS } from "./tracks.js";

/** A step by J or L: a share of the way's time, and its least length in seconds. */
const STEP = 0.01;
const MIN_STEP_S = 5;

let parts = null;
let shown = null;

/** Build the bar. */
export function start() {
  const seek = (at_s) => seekPast(state.past.start_s + at_s);
  const actions = { toggle: togglePast, seek, setSpeed: (speed) => setPast({ speed }), speeds: SPEEDS };
  const controls = playControls("past-", "Time on the way", actions);
  const { button, slider, spans, time, speeds } = controls;
  const pairs = [["time", "Colour: time"], ["speed", "Colour: speed"]]; // prettier-ignore
  const colours = options({ id: "past-colours", "aria-label": "Colours of the way" }, pairs, (value) => setPast({ colours: value })); // prettier-ignore
  const way = [button, h("div", { class: "along" }, h("div", { class: "timeline" }, slider, spans), time), speeds];
  const words = h("span", { id: "past-scale" });
  const colourLine = h("canvas", { "aria-hidden": "true" });
  const ticks = h("div", { class: "ticks" });
  const scale = h("div", { class: "past-ramp" }, words, colourLine, ticks);
  const back = h("button", { type: "button", id: "past-end", class: "primary", onclick: endPast }, "Back to live");
  byId("past").append(...way, scale, colours, back);
  const mark = h("p", { id: "past-mark", hidden: true });
  byId("map").append(mark);
  parts = { controls, slider, spans, time, colours, way, words, ramp: colourLine, ticks, mark };
  addEventListener("keydown", playKey);
  on(["past", "theme"], show);
  on(["moment"], showMoment);
}

function show() {
  const { past } = state;
  byId("past").hidden = parts.mark.hidden = !past;
  document.body.classList.toggle("past", past !== null);
  if (!past) return;
  const isWay = past.kind === "way";
  for (const part of [...parts.way, parts.colours]) part.hidden = !isWay;
  if (!isWay) text(parts.mark, `Past · ${past.title} · ${range(past.span.from_unix_s, past.span.to_unix_s).join(" to ")}`);
  text(byId("announcement"), "The map shows the past.");
  if (isWay && shown !== past.track) {
    parts.slider.max = String(past.duration_s);
    parts.slider.step = past.duration_s > 3600 ? "1" : "0.1";
    showSpans(parts.spans, past);
  }
  shown = isWay ? past.track : null;
  parts.colours.value = past.colours;
  showScale(past);
  showMoment();
}

/** Two times in a few characters: within a day without the second date. */
function range(from_s, to_s) {
  const [from, to] = [dateTime(from_s).slice(5, 16), dateTime(to_s).slice(5, 16)];
  return [from, from.slice(0, 5) === to.slice(0, 5) ? to.slice(6) : to];
}

/** What the colours mean. */
function showScale(past) {
  const isHeat = past.kind === "heat";
  const range_s = isHeat ? [] : range(past.start_s, past.start_s + past.duration_s);
  const ends = past.colours === "speed" ? ["0", `${topSpeed(past).toFixed(1)} m/s`] : range_s;
  const ticks = isHeat ? heatTicks(heatScale(past.map)) : ends.map((words, at) => [at, words]);
  parts.words.hidden = !isHeat;
  text(parts.words, isHeat ? `Time in a cell of ${past.map.cell_m} m × ${past.map.cell_m} m, logarithmic` : "");
  paintScale(parts.ramp, ramp(), parts.ticks, ticks);
}

function showMoment() {
  const { past } = state;
  if (past?.kind !== "way") return;
  parts.controls.show(past, past.at_s - past.start_s, dateTime(past.at_s));
  const found = placeNow(past);
  const alert = ALERTS[found?.point[6]]?.grade ? ` · ${ALERTS[found.point[6]].words}` : "";
  const place = found ? `x ${metres(found.place[0])} m · y ${metres(found.place[1])} m${alert}` : "no position then";
  text(parts.time, `${timeOfDay(past.at_s)} · ${place}`);
  text(parts.mark, `Past · ${past.title} · ${dateTime(past.at_s)}`);
}

function playKey(event) {
  const { past } = state;
  if (past?.kind !== "way") return;
  const step_s = Math.max(STEP * past.duration_s, MIN_STEP_S);
  runKey(event, { k: togglePast, j: () => seekPast(past.at_s - step_s), l: () => seekPast(past.at_s + step_s) });
}
