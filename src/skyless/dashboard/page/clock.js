/** Time: the server's as seen from here, and the moment that the page shows. */

import { state } from "./store.js";
import { Tracks } from "./tracks.js";

/** Live positions are drawn this much late, so that there is a state on either side to interpolate between. */
export const DELAY_S = 0.15;
/** Without a fix for so long a tag turns grey; */
export const GREY_S = 1.0;
/** and for so long it leaves the map. */
export const GONE_S = 10.0;

export const live = new Tracks();
export const replayed = new Tracks();
export const stillMotion = matchMedia("(prefers-reduced-motion: reduce)");

/** `unix_s` less `performance.now()` of the quickest message lately; NaN before the first. */
let offset_s = NaN;

/** Take a message's time. The quickest message tells the offset best; a slow drift lets it follow the clocks. */
export function heard(unix_s) {
  const sample = unix_s - performance.now() / 1e3;
  if (!(Math.abs(sample - offset_s) < 2)) offset_s = sample;
  else if (sample > offset_s) offset_s = sample;
  else offset_s += 0.002 * (sample - offset_s);
}

/** Forget the offset; the next connection may lead to another server. */
export function newServer() {
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

/** The tags of what is shown. */
export function tracks() {
  return state.mode === "replay" ? replayed : live;
}

/** How a tag stands: "fresh", "stale" (grey), "gone" (only in the list) or "never". */
export function freshness(track, now = now_s(), shown = shown_s()) {
  const index = track.find(shown);
  if (index < 0) return track.count && state.mode === "live" ? "fresh" : "never";
  const last = state.mode === "live" ? track.lastTime : track.value(index, 14);
  const age = now - last;
  return age < GREY_S ? "fresh" : age < GONE_S ? "stale" : "gone";
}
