/** The past on the map: a heat map below the walls, a tag's way above the zones, and the tag at the shown moment. */

import { state } from "../store.js";
import { duration } from "../format.js";
import { colourAt, paintGrid } from "../pictures.js";
import { faint, isDark, palette } from "../theme.js";
import { DIMMED } from "./anchors.js";
import { label } from "./names.js";
import { drawPicture } from "./floor.js";
import { otherFloor } from "./floors.js";
import { fractionOf } from "./overlay.js";
import { toX, toY, view } from "./view.js";

/** Viridis without the end that the page's background is like: what is more, or later, stands out more. */
const DARK = { stops: ["#414487", "#355f8d", "#2a788e", "#21918c", "#22a884", "#44bf70", "#7ad151", "#bddf26", "#fde725"] };
const LIGHT = { stops: ["#7ad151", "#44bf70", "#22a884", "#21918c", "#2a788e", "#355f8d", "#414487", "#482475", "#440154"] };
/** The ratio of the ends of a heat map's scale, which is logarithmic, is between these. */
const MIN_RATIO = 10;
const MAX_RATIO = 1000;
const HEAT_ALPHA = 0.85;

/** The colours of the past, from less or earlier to more or later. */
export function ramp() {
  return isDark() ? DARK : LIGHT;
}

/** The scale of a heat map in s, logarithmic; null where no tag was anywhere. */
export function heatScale({ seconds }) {
  const sorted = Float64Array.from(seconds.filter((value) => value > 0)).sort();
  if (!sorted.length) return null;
  const high = sorted[Math.floor(0.99 * (sorted.length - 1))];
  const low = sorted[Math.floor(0.01 * (sorted.length - 1))];
  return { low: Math.min(Math.max(low, high / MAX_RATIO), high / MIN_RATIO), high };
}

/** Marks of a heat map's scale. */
export function heatTicks({ low, high }) {
  return [0, 0.5, 1].map((at) => [at, duration(low * (high / low) ** at)]);
}

/** Seconds that tags were at a position by the heat map that is shown; null without one, and outside it. */
export function secondsAt(x_m, y_m) {
  const { past } = state;
  if (past?.kind !== "heat") return null;
  const { x0_m, y0_m, cell_m, columns, rows, seconds } = past.map;
  const [column, row] = [Math.floor((x_m - x0_m) / cell_m), Math.floor((y_m - y0_m) / cell_m)];
  return column < 0 || row < 0 || column >= columns || row >= rows ? null : seconds[row * columns + column];
}

let painted = { of: null, colours: null, picture: null };

/** Draw the heat map, if one is shown. */
export function drawHeat(context) {
  const { past } = state;
  if (past?.kind !== "heat") return;
  const { map } = past;
  if (painted.of !== map || painted.colours !== ramp()) {
    const scale = heatScale(map);
    const picture = paintGrid(map, map.seconds, (value) => (value > 0 ? colourAt(fractionOf(value, scale), ramp()) : null));
    painted = { of: map, colours: ramp(), picture };
  }
  context.globalAlpha = HEAT_ALPHA;
  context.imageSmoothingEnabled = false;
  drawPicture(context, painted.picture, map.x0_m, map.y0_m, map.columns * map.cell_m, map.rows * map.cell_m);
  context.globalAlpha = 1;
}

/** Speed on the way from each point to the next, m/s; NaN over a gap. */
function speeds({ track: { points }, gap_s }) {
  return points.slice(1).map(([time, x, y], index) => {
    const [time0, x0, y0] = points[index];
    return time - time0 > gap_s ? NaN : Math.hypot(x - x0, y - y0) / (time - time0);
  });
}

/** The speed at the ramp's end: of 95 % of the way's pieces, at least 0.1 m/s. */
export function topSpeed(past) {
  const sorted = Float64Array.from(speeds(past).filter(Number.isFinite)).sort();
  return Math.max(sorted[Math.floor(0.95 * (sorted.length - 1))] ?? 0, 0.1);
}

/** Draw the tag's way, if one is shown: coloured by time or speed, gaps left open, on other floors fainter. */
export function drawWay(context) {
  const { past } = state;
  if (past?.kind !== "way") return;
  const { points } = past.track;
  const top = topSpeed(past);
  const other = otherFloor();
  const pieces = speeds(past).flatMap((speed, n) => {
    if (Number.isNaN(speed)) return [];
    const share = past.colours === "speed" ? speed / top : past.times[n] / (past.duration_s || 1);
    const path = new Path2D();
    path.moveTo(...pixel(points[n]));
    path.lineTo(...pixel(points[n + 1]));
    return [{ path, share, alpha: other(points[n][3]) ? DIMMED : 1 }];
  });
  context.save();
  context.lineCap = "round";
  context.strokeStyle = faint(palette.surface, 0.8); // an edge keeps the way apart from what is below it
  context.lineWidth = 5;
  for (const { path, alpha } of pieces) if (alpha === 1) context.stroke(path);
  context.lineWidth = 2.5;
  for (const { path, share, alpha } of pieces.toSorted((a, b) => b.alpha - a.alpha)) {
    context.globalAlpha = alpha;
    context.strokeStyle = `rgb(${colourAt(share, ramp()).join(",")})`;
    context.stroke(path);
  }
  context.restore();
  const [x, y] = pixel(points[0]);
  context.fillStyle = palette.text;
  context.fillRect(x - 3, y - 3, 6, 6);
}

function pixel([, x_m, y_m, z_m]) {
  return [toX(x_m, y_m), toY(x_m, y_m, z_m)];
}

/** Where a way's tag was at the shown moment, interpolated: x, y, z in m, and the alert of the point before; null in a gap. */
export function placeNow({ track: { points }, times, gap_s, at_s }) {
  const index = times.findLastIndex((time) => time <= at_s);
  const [point, next = point] = points.slice(index, index + 2);
  const [after_s, step_s] = [at_s - times[index], next[0] - point[0]];
  if (after_s && step_s > gap_s) return null;
  const share = after_s && after_s / step_s;
  return { place: [1, 2, 3].map((axis) => point[axis] + share * (next[axis] - point[axis])), alert: point[6] };
}

/** Draw the tag where it was at the shown moment; nothing in a gap. */
export function drawMoment(context) {
  const { past } = state;
  const found = past?.kind === "way" ? placeNow(past) : null;
  if (!found) return;
  const [x_m, y_m, z_m] = found.place;
  const [x, y] = [toX(x_m, y_m), toY(x_m, y_m, z_m)];
  context.beginPath();
  context.arc(x, y, 8, 0, 2 * Math.PI);
  context.fillStyle = palette.accent;
  context.fill();
  context.strokeStyle = palette.surface;
  context.lineWidth = 2.5;
  context.stroke();
  context.font = "600 12px system-ui, sans-serif";
  context.textAlign = x > view.width - 120 ? "right" : "left";
  context.textBaseline = "middle";
  label(context, past.title, x + (x > view.width - 120 ? -14 : 14), y, palette.text);
}
