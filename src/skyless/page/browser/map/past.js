/** The past on the map: a heat map below the walls, a tag's way above the zones, and the tag at the shown moment. */

import { state } from "../store.js";
import { roundStep } from "../format.js";
import { placeNow } from "../past.js";
import { faint, isDark, palette } from "../theme.js";
import { DIMMED, label } from "./anchors.js";
import { groundHeight, otherFloor } from "./floors.js";
import { colourAt } from "./overlay.js";
import { drawInMetres, toX, toY, view } from "./view.js";

/** Viridis without the end that the page's background is like: what is more, or later, stands out more. */
const DARK_STOPS = ["#414487", "#355f8d", "#2a788e", "#21918c", "#22a884", "#44bf70", "#7ad151", "#bddf26", "#fde725"];
const LIGHT_STOPS = ["#7ad151", "#44bf70", "#22a884", "#21918c", "#2a788e", "#355f8d", "#414487", "#482475", "#440154"];
/** A way has so many colours, each drawn at once. */
const BINS = 24;
/** A scale that is wider than this is logarithmic, and it is at most as wide as the second. */
const LOG_FROM = 10;
const MAX_RATIO = 1000;
const HEAT_ALPHA = 0.85;

/** Red, green and blue at a position on the ramp, 0 to 1. */
export function rampColour(fraction) {
  return colourAt(fraction, { stops: isDark() ? DARK_STOPS : LIGHT_STOPS }).map(Math.round);
}

/** The scale of a heat map in s; null where no tag was anywhere. */
export function heatScale({ seconds }) {
  const sorted = Float64Array.from(seconds.filter((value) => value > 0)).sort();
  if (!sorted.length) return null;
  const high = sorted[Math.floor(0.99 * (sorted.length - 1))];
  const low = Math.max(sorted[Math.floor(0.01 * (sorted.length - 1))], high / MAX_RATIO);
  const log = high / low > LOG_FROM;
  return { low: log ? low : 0, high, log };
}

/** Where a value lies on a heat map's scale, 0 to 1. */
export function heatFraction(value, { low, high, log }) {
  if (value <= low) return 0;
  return Math.min(log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low), 1);
}

/** Round values on a heat map's scale, in minutes. */
export function heatTicks({ low, high, log }) {
  const [from, to] = [low / 60, high / 60];
  if (!log) {
    const step = roundStep(to / 3);
    return Array.from({ length: Math.floor(to / step) + 1 }, (_, n) => Number((n * step).toPrecision(6)));
  }
  const decades = Array.from({ length: 9 }, (_, n) => 10 ** (n - 4)).filter((value) => value >= from && value <= to);
  return decades.length > 1 ? decades : [from, Math.sqrt(from * to), to].map((value) => Number(value.toPrecision(1)));
}

/** Seconds that tags were at a position by the heat map that is shown; null without one, and outside it. */
export function secondsAt(x_m, y_m) {
  const { past } = state;
  if (past?.kind !== "heat") return null;
  const { x0_m, y0_m, cell_m, columns, rows, seconds } = past.map;
  const [column, row] = [Math.floor((x_m - x0_m) / cell_m), Math.floor((y_m - y0_m) / cell_m)];
  return column < 0 || row < 0 || column >= columns || row >= rows ? null : seconds[row * columns + column];
}

let painted = { key: null, dark: false, picture: null };

function heatPicture(map) {
  if (painted.key === map && painted.dark === isDark()) return painted.picture;
  const { columns, rows, seconds } = map;
  const scale = heatScale(map);
  const picture = document.createElement("canvas");
  picture.width = columns;
  picture.height = rows;
  const context = picture.getContext("2d");
  const image = context.createImageData(columns, rows);
  seconds.forEach((value, index) => {
    if (!(value > 0)) return;
    const at = (rows - 1 - Math.floor(index / columns)) * columns + (index % columns);
    image.data.set([...rampColour(heatFraction(value, scale)), 255], 4 * at);
  });
  context.putImageData(image, 0, 0);
  painted = { key: map, dark: isDark(), picture };
  return picture;
}

/** Draw the heat map, if one is shown. */
export function drawHeat(context) {
  if (state.past?.kind !== "heat" || !state.past.map.seconds.length) return;
  const { map } = state.past;
  context.globalAlpha = HEAT_ALPHA;
  drawInMetres(context, groundHeight());
  context.scale(1, -1); // pictures count downwards
  context.imageSmoothingEnabled = false;
  const [wide, high] = [map.columns * map.cell_m, map.rows * map.cell_m];
  context.drawImage(heatPicture(map), map.x0_m, -(map.y0_m + high), wide, high);
  context.restore();
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
  const of = speeds(past);
  const top = topSpeed(past);
  const other = otherFloor();
  const groups = new Map();
  for (let n = 0; n < of.length; n++) {
    if (Number.isNaN(of[n])) continue;
    const share = past.colours === "speed" ? of[n] / top : (points[n][0] - past.start_s) / (past.duration_s || 1);
    const key = Math.min(Math.floor(share * BINS), BINS - 1) + (other(points[n][3]) ? BINS : 0);
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push(n);
  }
  const stroke = (pieces) => {
    context.beginPath();
    for (const n of pieces) {
      context.moveTo(...pixel(points[n]));
      context.lineTo(...pixel(points[n + 1]));
    }
    context.stroke();
  };
  context.lineCap = context.lineJoin = "round";
  context.strokeStyle = faint(palette.surface, 0.8); // an edge keeps the way apart from what is below it
  context.lineWidth = 5;
  for (const [key, pieces] of groups) if (key < BINS) stroke(pieces);
  context.lineWidth = 2.5;
  for (const [key, pieces] of [...groups].sort(([a], [b]) => a - b)) {
    context.globalAlpha = key < BINS ? 1 : DIMMED;
    context.strokeStyle = `rgb(${rampColour((key % BINS) / (BINS - 1)).join(",")})`;
    stroke(pieces);
  }
  context.globalAlpha = 1;
  context.lineCap = "butt";
  context.lineJoin = "miter";
  const [x, y] = pixel(points[0]);
  context.fillStyle = palette.text;
  context.fillRect(x - 3, y - 3, 6, 6);
}

function pixel([, x_m, y_m, z_m]) {
  return [toX(x_m, y_m), toY(x_m, y_m, z_m)];
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
