/** Overlays of dilution of precision and predicted σ: fetched and painted once. */

import { changed, on, state } from "../store.js";
import { overlay } from "../api.js";
import { liveSite } from "../live.js";
import { toast } from "../dom.js";
import { length, number } from "../format.js";
import { movedAnchors } from "./places.js";

export const KINDS = {
  none: "None",
  hdop: "HDOP (x and y)",
  pdop: "PDOP (x, y and z)",
  sigma: "Predicted σ",
};

const MAX_POINTS = 10_000;
let serial = 0;

/**
 * Where a value lies on a scale, 0 (best) to 1 (worst): by the logarithm of its ratio to the lowest value.
 * The server gives the scale and its colours with each overlay: they are those of `skyless plan`'s pictures.
 */
export function fractionOf(value, { low, high }) {
  return value > low ? Math.min(Math.log(value / low) / Math.log(high / low), 1) : 0;
}

/** Red, green and blue, 0 to 255, at a position on a scale. */
export function colourAt(fraction, { stops }) {
  const at = Math.min(Math.max(fraction, 0), 1) * (stops.length - 1);
  const index = Math.min(Math.floor(at), stops.length - 2);
  const [one, other] = [parts(stops[index]), parts(stops[index + 1])];
  return one.map((value, part) => value + (at - index) * (other[part] - value));
}

function parts(stop) {
  return [1, 3, 5].map((at) => parseInt(stop.slice(at, at + 2), 16));
}

/** A value with its unit. */
export function writeValue(value, data = state.overlay.data) {
  return data.unit === "m" ? length(value) : number(value, 2);
}

/** Show another overlay, or none. */
export async function choose(kind) {
  const mine = ++serial;
  state.options.overlay = kind;
  state.overlay = { data: null, picture: null, error: "", pendingSince: null };
  changed("overlay", "options");
  if (kind === "none") return;
  if (state.mode === "replay" && JSON.stringify(liveSite()?.anchors) !== JSON.stringify(state.site?.anchors)) {
    toast("Overlays are computed for the live site; this recording has different anchors.");
    return choose("none");
  }
  state.overlay.pendingSince = performance.now();
  try {
    const data = await overlay(kind, step(), movedAnchors());
    if (mine !== serial) return;
    state.overlay = { data, picture: paint(data), error: "", pendingSince: null };
  } catch (error) {
    if (mine !== serial) return;
    state.overlay = { data: null, picture: null, error: error.message, pendingSince: null };
  }
  changed("overlay");
}

/**
 * Compute the overlay again, with anchors where the page tries them; the one before is shown until then. A coarse one has
 * a 25th of the points.
 */
export async function recompute(coarse) {
  const kind = state.options.overlay;
  if (kind === "none") return;
  const mine = ++serial;
  state.overlay.pendingSince = performance.now();
  changed("overlay");
  let next = { data: null, picture: null, error: "", pendingSince: null };
  try {
    const data = await overlay(kind, coarse ? 5 * step() : step(), movedAnchors());
    next = { ...next, data, picture: paint(data) };
  } catch (error) {
    next.error = error.message;
  }
  if (mine !== serial) return;
  state.overlay = next;
  changed("overlay");
}

/** A fine step for a small site, a coarse one for a large site. */
function step() {
  const anchors = state.site?.anchors ?? [];
  const extent = (key) => Math.max(...anchors.map((a) => a[key])) - Math.min(...anchors.map((a) => a[key]));
  const area = anchors.length ? (extent("x_m") + 2) * (extent("y_m") + 2) : 100;
  return [0.1, 0.25, 0.5, 1, 2, 5].find((step_m) => area / step_m ** 2 < MAX_POINTS) ?? 10;
}

function paint(data) {
  const picture = document.createElement("canvas");
  picture.width = data.columns;
  picture.height = data.rows;
  const context = picture.getContext("2d");
  const image = context.createImageData(data.columns, data.rows);
  for (let line = 0; line < data.rows; line++) {
    for (let column = 0; column < data.columns; column++) {
      const value = data.values[(data.rows - 1 - line) * data.columns + column];
      if (value === null) continue;
      const [red, green, blue] = colourAt(fractionOf(value, data.scale), data.scale);
      image.data.set([red, green, blue, 255], 4 * (line * data.columns + column));
    }
  }
  context.putImageData(image, 0, 0);
  return picture;
}

/** The overlay's value at a position, null where there is none. */
export function valueAt(x_m, y_m) {
  const data = state.overlay.data;
  if (!data) return null;
  const column = Math.round((x_m - data.x_m[0]) / data.step_m);
  const line = Math.round((y_m - data.y_m[0]) / data.step_m);
  if (column < 0 || line < 0 || column >= data.columns || line >= data.rows) return null;
  return data.values[line * data.columns + column];
}

let shownFor = null;
on(["site", "mode"], () => {
  const anchors = JSON.stringify(state.site?.anchors ?? null);
  if (anchors !== shownFor && state.site && state.options.overlay !== "none") {
    // the server computes for the live site only; a recording may be of another one
    const same = anchors === JSON.stringify(liveSite()?.anchors ?? null);
    choose(same ? state.options.overlay : "none");
  }
  shownFor = anchors;
});
