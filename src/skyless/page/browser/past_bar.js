/** The bar below the map while it shows the past: the player of a way, or the scale of a heat map; and its mark. */

import { on, state } from "./store.js";
import { byId, h, options, s, text } from "./dom.js";
import { dateTime, metres, timeOfDay } from "./format.js";
import { heatScale, heatFraction, heatTicks, rampColour, topSpeed } from "./map/past.js";
import { SPEEDS, endPast, placeNow, seekPast, setPast, togglePast } from "./past.js";
import { ICONS, iconButton, showSpans } from "./replay_bar.js";
import { ALERTS } from "./tracks.js";

/** A step by J or L, a share of the way's time, and at least so many seconds. */
const STEP = 0.01;
const MIN_STEP_S = 5;

let parts = null;
let shown = null;

/** Build the bar. */
export function start() {
  const icon = s("path", { d: ICONS.play });
  const play = iconButton({ id: "past-play", onclick: togglePast }, icon);
  const slider = h("input", { type: "range", id: "past-slider", min: "0", "aria-label": "Time on the way" });
  slider.addEventListener("input", () => state.past && seekPast(state.past.start_s + Number(slider.value)));
  const spans = h("div", { class: "spans", "aria-hidden": "true" });
  const time = h("output", { id: "past-time" });
  const speed = options({ id: "past-speed", "aria-label": "Speed" }, SPEEDS.map((value) => [value, `${value} ×`]), (value) => setPast({ speed: Number(value) })); // prettier-ignore
  const pairs = [["time", "Colour: time"], ["speed", "Colour: speed"]]; // prettier-ignore
  const colours = options({ id: "past-colours", "aria-label": "Colours of the way" }, pairs, (value) => setPast({ colours: value })); // prettier-ignore
  const way = [play, h("div", { class: "along" }, h("div", { class: "timeline" }, slider, spans), time), speed];
  const words = h("span", { id: "past-scale" });
  const ramp = h("canvas", { width: 256, height: 1, "aria-hidden": "true" });
  const ticks = h("div", { class: "ticks" });
  const scale = h("div", { class: "past-ramp" }, words, ramp, ticks);
  const back = h("button", { type: "button", id: "past-end", class: "primary", onclick: endPast }, "Back to live");
  byId("past").append(...way, scale, colours, back);
  const mark = h("p", { id: "past-mark", hidden: true });
  byId("map").append(mark);
  parts = { icon, play, slider, spans, time, speed, colours, way, words, ramp, ticks, mark };
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
  parts.speed.value = String(past.speed);
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
  const scale = past.kind === "heat" ? heatScale(past.map) : null;
  parts.ramp.parentElement.hidden = past.kind === "heat" && !scale;
  const ends = past.colours === "speed" ? ["0", `${topSpeed(past).toFixed(1)} m/s`] : range(past.start_s, past.start_s + past.duration_s);
  const minutes = scale && heatTicks(scale).map((value) => [heatFraction(60 * value, scale), String(value)]);
  const cell = past.map?.cell_m;
  text(parts.words, scale ? `Minutes in a cell of ${cell} m × ${cell} m${scale.log ? ", logarithmic" : ""}` : "");
  parts.words.hidden = !scale;
  const context = parts.ramp.getContext("2d");
  const image = context.createImageData(256, 1);
  for (let x = 0; x < 256; x++) image.data.set([...rampColour(x / 255), 255], 4 * x);
  context.putImageData(image, 0, 0);
  const marks = (minutes ?? [[0, ends[0]], [1, ends[1]]]).map(([at, words]) => {
    const tick = h("span", {}, words);
    tick.style.left = `${100 * at}%`;
    tick.style.transform = `translateX(${-100 * at}%)`;
    return tick;
  }); // prettier-ignore
  parts.ticks.replaceChildren(...marks);
}

function showMoment() {
  const { past } = state;
  if (past?.kind !== "way") return;
  parts.play.setAttribute("aria-label", `${past.playing ? "Pause" : "Play"} (K)`);
  parts.icon.setAttribute("d", past.playing ? ICONS.pause : ICONS.play);
  parts.slider.value = String(past.at_s - past.start_s);
  parts.slider.setAttribute("aria-valuetext", dateTime(past.at_s));
  const found = placeNow(past);
  const alert = ALERTS[found?.point[6]]?.grade ? ` · ${ALERTS[found.point[6]].words}` : "";
  const place = found ? `x ${metres(found.place[0])} m · y ${metres(found.place[1])} m${alert}` : "no position then";
  text(parts.time, `${timeOfDay(past.at_s)} · ${place}`);
  text(parts.mark, `Past · ${past.title} · ${dateTime(past.at_s)}`);
}

function playKey(event) {
  const { past } = state;
  if (past?.kind !== "way" || event.ctrlKey || event.metaKey || event.altKey) return;
  const { target } = event;
  if (target.matches?.("input:not([type=range]), select, textarea")) return;
  const step_s = Math.max(STEP * past.duration_s, MIN_STEP_S);
  const key = event.key.toLowerCase();
  if (key === "k" || (key === " " && !target.closest?.("button, input, summary, a, [role=tab]"))) togglePast();
  else if (key === "j" || key === "l") seekPast(past.at_s + (key === "j" ? -step_s : step_s));
  else return;
  event.preventDefault();
}
