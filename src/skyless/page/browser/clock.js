/** Time: the server's clock as estimated here, and the moment that the page shows. */

import { state } from "./store.js";
import { FRESH, GONE, SLEEP, TIME, Tracks } from "./tracks.js";

/** Live positions are drawn with this delay, so that there is a state on either side for interpolation. */
export const DELAY_S = 0.15;

export const live = new Tracks();
export const replayed = new Tracks();
export const stillMotion = matchMedia("(prefers-reduced-motion: reduce)");

/** `unix_s` less `performance.now()` of the quickest message lately; NaN before the first. */
let offset_s = NaN;

/** Update the offset from a message's time: the quickest message gives it best; a slow drift adapts to the clocks. */
export function updateOffset(unix_s) {
  const sample = unix_s - performance.now() / 1e3;
  if (!(Math.abs(sample - offset_s) < 2) || sample > offset_s) offset_s = sample;
  else offset_s += 0.002 * (sample - offset_s);
}

/** Discard the offset; the next connection may lead to another server. */
export function resetOffset() {
  offset_s = NaN;
}

/** The server's time, or the recording's moment. */
export function now_s() {
  if (state.mode === "replay") return state.player ? state.player.start_unix_s + state.player.at_s : 0;
  return performance.now() / 1e3 + offset_s;
}

/** The moment that the map shows. */
export function shown_s() {
  return state.mode === "replay" || stillMotion.matches ? now_s() : now_s() - DELAY_S;
}

/** The tags of the live site or of the recording, whichever is shown. */
export function tracks() {
  return state.mode === "replay" ? replayed : live;
}

/** State of a tag, by the times that the server gives: "fresh", "asleep" or "late" (grey), "gone" (only in the list) or "never". */
export function freshness(track, now = now_s(), shown = shown_s()) {
  const index = state.mode === "live" ? track.count - 1 : track.find(shown);
  if (index < 0) return "never";
  const age = Math.abs(now - track.value(index, TIME)); // a fix of later than now is of another clock
  if (age < track.value(index, FRESH)) return "fresh";
  if (age < track.value(index, SLEEP)) return "asleep";
  return age < track.value(index, GONE) ? "late" : "gone";
}
