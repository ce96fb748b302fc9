/** The transformation from metres of the site to the canvas: y points up, with one scale for both axes. */

import { roundStep } from "../format.js";

/** Limits of the scale, pixels in a metre. */
const MIN_SCALE = 2;
const MAX_SCALE = 2000;

export const view = { width: 1, height: 1, ratio: 1, x_m: 0, y_m: 0, scale: 50, touched: false };

/** Whether the map is as narrow as on a phone. */
export function isNarrow() {
  return view.width < 600;
}

/** Pixels (of CSS) from the left. */
export function px(x_m) {
  return view.width / 2 + (x_m - view.x_m) * view.scale;
}

/** Pixels (of CSS) from the top. */
export function py(y_m) {
  return view.height / 2 - (y_m - view.y_m) * view.scale;
}

/** Site coordinates of a pixel. */
export function toSite(x, y) {
  return [view.x_m + (x - view.width / 2) / view.scale, view.y_m - (y - view.height / 2) / view.scale];
}

/** Move the map by pixels. */
export function pan(dx, dy) {
  view.x_m -= dx / view.scale;
  view.y_m += dy / view.scale;
  view.touched = true;
}

/** Zoom about a pixel. */
export function zoom(factor, x = view.width / 2, y = view.height / 2) {
  const [x_m, y_m] = toSite(x, y);
  view.scale = Math.min(Math.max(view.scale * factor, MIN_SCALE), MAX_SCALE);
  view.x_m = x_m - (x - view.width / 2) / view.scale;
  view.y_m = y_m + (y - view.height / 2) / view.scale;
  view.touched = true;
}

/** Show the whole site and some further corners, clear of the buttons. */
export function fit(site, zones, further) {
  view.touched = false;
  const corners = [...zones.flatMap((zone) => zone.polygon_m), ...further];
  for (const anchor of site?.anchors ?? []) corners.push([anchor.x_m, anchor.y_m]);
  for (const wall of site?.walls ?? []) corners.push([wall.x1_m, wall.y1_m], [wall.x2_m, wall.y2_m]);
  if (!corners.length) corners.push([-5, -4], [5, 4]);
  const xs = corners.map(([x]) => x);
  const ys = corners.map(([, y]) => y);
  const [left, right] = [Math.min(...xs), Math.max(...xs)];
  const [bottom, top] = [Math.min(...ys), Math.max(...ys)];
  const edge = isNarrow() ? { left: 34, right: 22, top: 62, bottom: 104 } : { left: 48, right: 64, top: 32, bottom: 104 };
  const across = (view.width - edge.left - edge.right) / Math.max(right - left, 1);
  const up = (view.height - edge.top - edge.bottom) / Math.max(top - bottom, 1);
  view.scale = Math.min(Math.max(Math.min(across, up), MIN_SCALE), MAX_SCALE);
  view.x_m = (left + right) / 2 + (edge.right - edge.left) / 2 / view.scale;
  view.y_m = (bottom + top) / 2 + (edge.top - edge.bottom) / 2 / view.scale;
}

/** A round length of at most as many pixels. */
export function roundLength(pixels) {
  return roundStep(pixels / view.scale);
}

/** Fit a canvas to its element and clear it; the context counts in pixels of CSS. */
export function prepare(canvas) {
  const context = canvas.getContext("2d");
  const width = Math.round(view.width * view.ratio);
  const height = Math.round(view.height * view.ratio);
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  context.setTransform(view.ratio, 0, 0, view.ratio, 0, 0);
  context.clearRect(0, 0, view.width, view.height);
  return context;
}
