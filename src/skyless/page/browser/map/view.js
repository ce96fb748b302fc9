/**
 * The transformation from metres of the site to the canvas, with one scale for all axes: from above, y points up.
 *
 * The 3-D view is the same parallel projection from a direction that the user turns, so all layers are drawn alike.
 */

import { roundStep } from "../format.js";

/** The largest scale, pixels in a metre, and the smallest of a site that is small. */
const MAX_SCALE = 2000;
const SMALL_SCALE = 2;
/** The smallest scale: a site that is larger is seen whole, and half as large again. */
let min_scale = SMALL_SCALE;
const MARGIN = 20;
/** Limits of the 3-D view's elevation above the floor, and where it begins. */
const MIN_ELEVATION = Math.PI / 18;
const MAX_ELEVATION = Math.PI / 2;
const FIRST = { azimuth: -Math.PI / 7, elevation: Math.PI / 5.5 };

export const view = { width: 1, height: 1, ratio: 1, x_m: 0, y_m: 0, scale: 50, touched: false, spatial: false };

/** Direction of the view: of its right edge in x and y, and how much floor and heights are foreshortened. */
const turned = { azimuth: 0, elevation: Math.PI / 2, cos: 1, sin: 0, floor: 1, height: 0 };

/** Whether the map is as narrow as on a phone. */
export function isNarrow() {
  return view.width < 600;
}

/** Pixels (of CSS) from the left. */
export function toX(x_m, y_m) {
  return view.width / 2 + ((x_m - view.x_m) * turned.cos + (y_m - view.y_m) * turned.sin) * view.scale;
}

/** Pixels (of CSS) from the top. */
export function toY(x_m, y_m, z_m = 0) {
  const away_m = (y_m - view.y_m) * turned.cos - (x_m - view.x_m) * turned.sin;
  return view.height / 2 - (away_m * turned.floor + (z_m || 0) * turned.height) * view.scale;
}

/** Pixels from the left in the view from above, where x alone counts. */
export function px(x_m) {
  return view.width / 2 + (x_m - view.x_m) * view.scale;
}

/** Pixels from the top in the view from above, where y alone counts. */
export function py(y_m) {
  return view.height / 2 - (y_m - view.y_m) * view.scale;
}

/** Site coordinates of a pixel, in the 3-D view of its point at a height. */
export function toSite(x, y, z_m = 0) {
  const right_m = (x - view.width / 2) / view.scale;
  const away_m = ((view.height / 2 - y) / view.scale - z_m * turned.height) / turned.floor;
  return [
    view.x_m + right_m * turned.cos - away_m * turned.sin,
    view.y_m + right_m * turned.sin + away_m * turned.cos,
  ];
}

/** Let a context draw in metres on the floor at a height; `restore` it afterwards. */
export function drawInMetres(context, z_m) {
  const { cos, sin, floor } = turned;
  const k = view.scale;
  context.save();
  context.transform(k * cos, k * sin * floor, k * sin, -k * cos * floor, toX(0, 0), toY(0, 0, z_m));
}

/** A covariance on the floor as it is seen, in square metres: xx, xy and yy with y pointing up the screen. */
export function seenCovariance(xx, xy, yy) {
  const { cos, sin, floor } = turned;
  return [
    xx * cos * cos + 2 * xy * cos * sin + yy * sin * sin,
    floor * ((yy - xx) * cos * sin + xy * (cos * cos - sin * sin)),
    floor * floor * (xx * sin * sin - 2 * xy * cos * sin + yy * cos * cos),
  ];
}

/** How much a height and lengths on the floor up the screen are foreshortened, 0 to 1. */
export function foreshortening() {
  return { height: turned.height, floor: turned.floor };
}

/** Move the map by pixels. */
export function pan(dx, dy) {
  const [x_m, y_m] = toSite(view.width / 2 - dx, view.height / 2 - dy);
  view.x_m = x_m;
  view.y_m = y_m;
  view.touched = true;
}

/** Zoom about a pixel. */
export function zoom(factor, x = view.width / 2, y = view.height / 2) {
  const [x_m, y_m] = toSite(x, y);
  view.scale = Math.min(Math.max(view.scale * factor, min_scale), MAX_SCALE);
  const [now_x_m, now_y_m] = toSite(x, y);
  view.x_m += x_m - now_x_m;
  view.y_m += y_m - now_y_m;
  view.touched = true;
}

/** Turn the 3-D view by angles. */
export function orbit(azimuth, elevation) {
  turn(turned.azimuth + azimuth, turned.elevation + elevation);
}

/** Show the site in 3-D, or from above. */
export function setSpatial(spatial) {
  view.spatial = spatial;
  if (spatial) turn(FIRST.azimuth, FIRST.elevation);
  else turn(0, Math.PI / 2);
}

function turn(azimuth, elevation) {
  turned.azimuth = azimuth;
  turned.elevation = Math.min(Math.max(elevation, MIN_ELEVATION), MAX_ELEVATION);
  turned.cos = Math.cos(azimuth);
  turned.sin = Math.sin(azimuth);
  turned.floor = Math.sin(turned.elevation);
  turned.height = view.spatial ? Math.cos(turned.elevation) : 0;
}

/** The least and the largest of any number of values. */
function extent(values) {
  return values.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [Infinity, -Infinity]);
}

/** Whether a pixel is in the picture, or nearer to it than a margin. */
export function isSeen(x, y, margin = 20) {
  return x > -margin && y > -margin && x < view.width + margin && y < view.height + margin;
}

/** The part of the floor that is in the picture, with a margin: least x and y, largest x and y; in 3-D all of it. */
export function seenBox() {
  if (view.spatial) return null;
  const [x1, y1] = toSite(-MARGIN, view.height + MARGIN);
  const [x2, y2] = toSite(view.width + MARGIN, -MARGIN);
  return [x1, y1, x2, y2].map((value) => Number(value.toFixed(1)));
}

/** Show the whole site and some further corners, [x, y] or [x, y, z], clear of the buttons, of a scale of colours and of a replay's mark. */
export function fit(site, zones, further, scaleShown = true, replayed = false) {
  view.touched = false;
  const corners = [...zones.flatMap((zone) => zone.polygon_m), ...further];
  for (const anchor of site?.anchors ?? []) corners.push([anchor.x_m, anchor.y_m, anchor.z_m]);
  for (const wall of site?.walls ?? []) corners.push([wall.x1_m, wall.y1_m], [wall.x2_m, wall.y2_m]);
  corners.push(...(site?.outline_m ?? []));
  if (!corners.length) corners.push([-5, -4], [5, 4]);
  Object.assign(view, { x_m: 0, y_m: 0, scale: 1 });
  const [middle_x, middle_y] = [view.width / 2, view.height / 2];
  const across = corners.map(([x, y]) => toX(x, y) - middle_x);
  const up = corners.map(([x, y, z]) => middle_y - toY(x, y, z));
  const [left, right] = extent(across);
  const [bottom, top] = extent(up);
  const edge = isNarrow()
    ? { left: 34, right: 30, top: replayed ? 86 : 62, bottom: scaleShown ? 150 : Math.min(Math.max(0.23 * view.height, 66), 90) }
    : { left: 48, right: 64, top: replayed ? 54 : 32, bottom: scaleShown ? 168 : 104 };
  const wide = (view.width - edge.left - edge.right) / Math.max(right - left, 1);
  const high = (view.height - edge.top - edge.bottom) / Math.max(top - bottom, 1);
  view.scale = Math.min(wide, high, MAX_SCALE);
  min_scale = Math.min(SMALL_SCALE, view.scale / 2);
  const x = middle_x + ((left + right) / 2) * view.scale + (edge.right - edge.left) / 2;
  const y = middle_y - ((bottom + top) / 2) * view.scale - (edge.top - edge.bottom) / 2;
  [view.x_m, view.y_m] = toSite(x, y);
}

/** √5.991: half axes of the ellipse of 95 % in standard deviations, in two dimensions. */
const SIGMAS_95 = 2.4477;

/** Half axes in m of the ellipse that holds 95 % of the errors, and the angle of the long one from x. */
export function halfAxes(xx, xy, yy) {
  const middle = (xx + yy) / 2;
  const difference = Math.hypot((xx - yy) / 2, xy);
  const half = (variance) => SIGMAS_95 * Math.sqrt(Math.max(variance, 0));
  return [half(middle + difference), half(middle - difference), Math.atan2(2 * xy, xx - yy) / 2];
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
