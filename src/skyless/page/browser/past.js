/** The past that the map shows instead of the present: one tag's way or a heat map, and the moment that is played. */

import { changed, on, state } from "./store.js";

/** Speeds, multiples of real time. */
export const SPEEDS = [1, 4, 16, 60, 300, 1000];
/** Points are joined up to this time, as in the server's answers, or a multiple of their usual step: ways are thinned. */
const MIN_GAP_S = 15;
const GAP_STEPS = 3;

let lastFrame = 0;
/** Kept for the next way. */
const chosen = { speed: 16, colours: "time" };

/** Show a tag's way, a `Track` with at least one point; `title` says whose. */
export function showWay(track, title) {
  const times = Float64Array.from(track.points, ([unix_s]) => unix_s);
  const steps = times.slice(1).map((time, index) => time - times[index]).sort();
  const gap_s = Math.max(MIN_GAP_S, GAP_STEPS * (steps[steps.length >> 1] ?? 0));
  const way = { track, times, gap_s, start_s: times[0], duration_s: times.at(-1) - times[0], ...chosen };
  state.past = { kind: "way", title, ...way, fixes: spans(times, gap_s), at_s: times[0], playing: false };
  changed("past", "moment");
}

/** Show a heat map, a `Heatmap`. */
export function showHeat(map, title, span) {
  state.past = { kind: "heat", title, map, span };
  changed("past", "moment");
}

/** Show the present again. */
export function endPast() {
  if (!state.past) return;
  state.past = null;
  changed("past", "moment");
}

/** When there are fixes: begin and end of each time without a gap, in s since the first one. */
function spans(times, gap_s) {
  const found = [];
  times.forEach((time, index) => {
    const at = time - times[0];
    if (index && time - times[index - 1] <= gap_s) found.at(-1)[1] = at;
    else found.push([at, at]);
  });
  return found;
}

/** Index of the last point up to a moment; -1 before the first. */
function find(times, unix_s) {
  return times.findLastIndex((time) => time <= unix_s);
}

/** Where the tag was at the shown moment, interpolated: x, y, z in m, and the point before; null in a gap. */
export function placeNow({ track, times, gap_s, at_s }) {
  const index = find(times, at_s);
  if (index < 0) return null;
  const [time, x, y, z] = track.points[index];
  const next = track.points[index + 1];
  if (at_s === time) return { place: [x, y, z], point: track.points[index] };
  if (!next || next[0] - time > gap_s) return null;
  const share = (at_s - time) / (next[0] - time);
  return { place: [x, y, z].map((value, axis) => value + share * (next[axis + 1] - value)), point: track.points[index] };
}

/** Show the way at a moment. */
export function seekPast(unix_s) {
  const { past } = state;
  if (past?.kind !== "way") return;
  past.at_s = Math.min(Math.max(unix_s, past.start_s), past.start_s + past.duration_s);
  changed("moment");
}

/** Play or pause; at the end, from the start. */
export function togglePast() {
  const { past } = state;
  past.playing = !past.playing;
  lastFrame = 0;
  if (past.playing && past.at_s >= past.start_s + past.duration_s) past.at_s = past.start_s;
  changed("moment");
}

/** Set the speed, or what colours mean ("time" or "speed"): for this way and the next ones. */
export function setPast(values) {
  Object.assign(chosen, values);
  if (state.past) Object.assign(state.past, values);
  changed("past", "moment");
}

on(["moment"], () => {
  const { past } = state;
  const now = performance.now();
  const step_s = Math.min((now - (lastFrame || now)) / 1e3, 0.25);
  lastFrame = past?.playing ? now : 0;
  if (!past?.playing) return;
  const end_s = past.start_s + past.duration_s;
  past.at_s = Math.min(past.at_s + step_s * past.speed, end_s);
  if (!placeNow(past)) past.at_s = past.times[find(past.times, past.at_s) + 1] ?? end_s; // gaps are skipped
  if (past.at_s >= end_s) past.playing = false;
  changed("moment");
});
on(["mode"], () => state.mode !== "live" && endPast());
