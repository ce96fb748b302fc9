/** Overlays of dilution of precision and predicted σ: fetched and painted once. */

import { changed, on, state } from "../store.js";
import { overlay } from "../api.js";
import { liveSite } from "../live.js";
import { toast } from "../dom.js";

export const KINDS = {
  none: "None",
  hdop: "HDOP (dilution in x and y)",
  pdop: "PDOP (dilution in x, y and z)",
  sigma: "Predicted σ",
};

/** Eight colours of viridis (matplotlib's, CC0), perceptually uniform, also for colour-blind readers and in grey. */
const VIRIDIS = [
  [68, 1, 84],
  [70, 50, 127],
  [54, 92, 141],
  [39, 127, 142],
  [31, 161, 135],
  [74, 194, 109],
  [159, 218, 58],
  [253, 231, 37],
];
const MAX_POINTS = 10_000;
let serial = 0;

/** Colour at a fraction of the scale from 0 (good) to 1 (bad). */
export function colourAt(fraction) {
  const at = Math.min(Math.max(fraction, 0), 1) * (VIRIDIS.length - 1);
  const low = Math.min(Math.floor(at), VIRIDIS.length - 2);
  return VIRIDIS[low].map((value, part) => value + (at - low) * (VIRIDIS[low + 1][part] - value));
}

/** Show another overlay, or none. */
export async function choose(kind) {
  const mine = ++serial;
  state.options.overlay = kind;
  state.overlay = { data: null, picture: null, error: "" };
  changed("overlay", "options");
  if (kind === "none") return;
  if (state.mode === "replay" && JSON.stringify(liveSite()?.anchors) !== JSON.stringify(state.site?.anchors)) {
    toast("Overlays are computed for the live site; this recording has different anchors.");
    return choose("none");
  }
  try {
    const data = await overlay(kind, step());
    if (mine !== serial) return;
    state.overlay = { data, picture: paint(data), error: "" };
  } catch (error) {
    if (mine !== serial) return;
    state.overlay.error = error.message;
    toast(`No overlay: ${error.message}`, "bad");
  }
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
  const { good, bad } = data.levels;
  for (let line = 0; line < data.rows; line++) {
    for (let column = 0; column < data.columns; column++) {
      const value = data.values[(data.rows - 1 - line) * data.columns + column];
      if (value === null) continue;
      const [red, green, blue] = colourAt((value - good) / (bad - good));
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
