/** What only the 3-D view has: the grid on the ground around the room, and a scale of heights. */

import { state } from "../store.js";
import { palette } from "../theme.js";
import { metres, roundStep } from "../format.js";
import { label } from "./names.js";
import { groundHeight } from "./floors.js";
import { roomOutline } from "./room.js";
import { foreshortening, isNarrow, toX, toY, view } from "./view.js";

/** About how many lines of the grid cross the longer side, and how many heights are named. */
const LINES = 12;
const HEIGHTS = 3;
/** Pixels from one name on the scale of heights to the next, at least. */
const NAME_HEIGHT = 12;
/** Above the highest anchor the scale of heights goes on this far. */
const ABOVE_M = 0.5;

/** The ground's box in whole steps of the grid, and the step. */
function ground(plan) {
  const corners = [...(roomOutline(plan)?.corners ?? []), ...(state.site?.anchors ?? []).map((a) => [a.x_m, a.y_m])];
  if (!corners.length) corners.push([-5, -4], [5, 4]);
  const [xs, ys] = [corners.map(([x]) => x), corners.map(([, y]) => y)];
  const longest = Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys), 1);
  const step = roundStep((longest / LINES) * 2);
  const down = (values) => Math.floor(Math.min(...values) / step + 1e-9) * step;
  const up = (values) => Math.ceil(Math.max(...values) / step - 1e-9) * step;
  return { x1: down(xs), x2: up(xs), y1: down(ys), y2: up(ys), step };
}

/** Corners of the ground and the highest height, for fitting the view. */
export function spaceCorners(plan) {
  const { x1, x2, y1, y2 } = ground(plan);
  const top = highest();
  return [[x1, y1], [x2, y1], [x2, y2], [x1, y2]].flatMap(([x, y]) => [[x, y, 0], [x, y, top]]); // prettier-ignore
}

function highest() {
  return Math.max(1, ...(state.site?.anchors ?? []).map((anchor) => anchor.z_m)) + ABOVE_M;
}

/** Draw the grid with coordinates along its near edges, and the scale of heights at its left corner. */
export function drawGround(context, plan) {
  const { x1, x2, y1, y2, step } = ground(plan);
  const z = groundHeight();
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  context.lineWidth = 1;
  context.strokeStyle = palette["grid-strong"];
  context.beginPath();
  const line = (xa, ya, xb, yb) => {
    context.moveTo(toX(xa, ya), toY(xa, ya, z));
    context.lineTo(toX(xb, yb), toY(xb, yb, z));
  };
  const across = Math.round((x2 - x1) / step);
  const up = Math.round((y2 - y1) / step);
  for (let n = 0; n <= across; n++) line(x1 + n * step, y1, x1 + n * step, y2);
  for (let n = 0; n <= up; n++) line(x1, y1 + n * step, x2, y1 + n * step);
  context.stroke();

  context.font = "10px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  const near_y = toY(x1, y1) > toY(x1, y2) ? y1 : y2;
  const near_x = toY(x1, y1) > toY(x2, y1) ? x1 : x2;
  const write = (words, x, y, from_x, from_y) => {
    const [ax, ay] = [toX(x, y), toY(x, y, z)];
    const [dx, dy] = [ax - toX(from_x, from_y), ay - toY(from_x, from_y, z)];
    const apart = Math.hypot(dx, dy) || 1;
    label(context, words, ax + (14 * dx) / apart, ay + (12 * dy) / apart, palette.muted);
  };
  const middle = [(x1 + x2) / 2, (y1 + y2) / 2];
  const half = Math.floor(across / 2);
  for (let n = 0; n <= across; n++) {
    const x = x1 + n * step;
    write(n === half ? "x in m" : metres(x, digits), x, near_y, x, middle[1]);
  }
  for (let n = 0; n <= up; n++) {
    const y = y1 + n * step;
    write(n === Math.floor(up / 2) ? "y in m" : metres(y, digits), near_x, y, middle[0], y);
  }
  nameHeight(context);
  heights(context, [[x1, y1], [x2, y1], [x2, y2], [x1, y2]]); // prettier-ignore
}

/** Where all tags move at one given height, say so once instead of at each tag. */
function nameHeight(context) {
  const height_m = state.site?.tags?.height_m;
  if (!Number.isFinite(height_m ?? NaN)) return;
  context.font = "12px system-ui, sans-serif";
  context.textAlign = "left";
  context.textBaseline = isNarrow() ? "bottom" : "top";
  label(context, `Tags: height ${height_m} m given`, 14, isNarrow() ? view.height - 8 : 12);
}

function heights(context, corners) {
  if (foreshortening().height < 0.1) return;
  const [x, y] = corners.reduce((best, corner) => (toX(...corner) < toX(...best) ? corner : best));
  const top = highest();
  const apart_m = NAME_HEIGHT / (foreshortening().height * view.scale);
  const step = Math.max(roundStep(top / HEIGHTS) || 1, roundStep(2.5 * apart_m)); // 1, 2, 5: at least apart_m
  const left = toX(x, y);
  context.strokeStyle = palette.wall;
  context.lineWidth = 1.25;
  context.beginPath();
  context.moveTo(left, toY(x, y, 0));
  context.lineTo(left, toY(x, y, top));
  context.stroke();
  context.textAlign = "right";
  for (let n = 1; n * step <= top; n++) {
    const at = toY(x, y, n * step);
    context.fillStyle = palette.wall;
    context.fillRect(left - 4, at - 0.5, 8, 1);
    label(context, `${Number((n * step).toFixed(2))} m`, left - 7, at, palette.muted);
  }
  context.textAlign = "center";
  label(context, "z", left, toY(x, y, top) - 9, palette.muted);
}
