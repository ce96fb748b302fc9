/** Overlays of dilution of precision and predicted σ: fetched and painted once. */

import { changed, on, state } from "../store.js";
import { overlay } from "../api.js";
import { liveSite } from "../live.js";
import { toast } from "../dom.js";
import { length, number } from "../format.js";
import { colourAt, paintGrid } from "../pictures.js";
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

/** A value with its unit. */
export function writeValue(value, data = state.overlay.data) {
  return data.unit === "m" ? length(value) : number(value, 2);
}

/** Show another overlay, or none. */
export async function choose(kind) {
  serial++;
  state.options.overlay = kind;
  state.overlay = { data: null, picture: null, error: "", pendingSince: null };
  changed("overlay", "options");
  if (kind === "none") return;
  if (state.mode === "replay" && JSON.stringify(liveSite()?.anchors) !== JSON.stringify(state.site?.anchors)) {
    toast("Overlays are computed for the live site; this recording has different anchors.");
    return choose("none");
  }
  await recompute();
}

/**
 * Compute the overlay again, with anchors where the page tries them; the one before is shown until then. A coarse one has
 * a 25th of the points.
 */
export async function recompute(coarse = false) {
  const kind = state.options.overlay;
  if (kind === "none") return;
  const mine = ++serial;
  state.overlay.pendingSince = performance.now();
  changed("overlay");
  const found = await overlay(kind, coarse ? 5 * step() : step(), movedAnchors()).then(
    (data) => ({ data, picture: paint(data), error: "" }),
    (error) => ({ data: null, picture: null, error: error.message }),
  );
  if (mine !== serial) return;
  state.overlay = { ...found, pendingSince: null };
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
  const { scale } = data;
  return paintGrid(data, data.values, (value) => (value === null ? null : colourAt(fractionOf(value, scale), scale)));
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
