/** The outline of the room: the site's, else walls that close, the floor plan, or the area between the anchors; named as what it is. */

import { state } from "../store.js";
import { faint, palette } from "../theme.js";
import { scaleBox } from "./floor.js";
import { labelIfFree } from "./names.js";
import { surveyShown } from "../survey/model.js";
import { toX, toY, view } from "./view.js";

/** Ends of walls nearer than this are one corner. */
const SAME_M = 0.05;
let known = { site: null, plan: null, outline: null };

/**
 * The outline and what it is.
 * @param {number[][]} plan the floor plan's two corners, or none
 * @returns {{kind: "room"|"plan"|"anchors", name: string, corners: number[][]}|null}
 */
export function roomOutline(plan = []) {
  const key = JSON.stringify(plan);
  if (known.site !== state.site || known.plan !== key) known = { site: state.site, plan: key, outline: find(plan) };
  return known.outline;
}

function find(plan) {
  const walls = state.site?.outline_m ?? closedWalls(state.site?.walls ?? []);
  if (walls) return { kind: "room", name: "room", corners: walls };
  if (plan.length === 2) {
    const [[x1, y1], [x2, y2]] = plan;
    return { kind: "plan", name: "floor plan", corners: [[x1, y1], [x2, y1], [x2, y2], [x1, y2]] }; // prettier-ignore
  }
  const corners = hull((state.site?.anchors ?? []).map(({ x_m, y_m }) => [x_m, y_m]));
  return corners.length > 2 ? { kind: "anchors", name: "area of the anchors", corners } : null;
}

/** The outer edge of walls that close around an area; null where they do not. */
export function closedWalls(walls) {
  const corners = [];
  const ends = [];
  const cornerAt = (x, y) => {
    let index = corners.findIndex(([a, b]) => Math.hypot(a - x, b - y) < SAME_M);
    if (index < 0) {
      index = corners.push([x, y]) - 1;
      ends.push(new Set());
    }
    return index;
  };
  for (const { x1_m, y1_m, x2_m, y2_m } of walls) {
    const [one, other] = [cornerAt(x1_m, y1_m), cornerAt(x2_m, y2_m)];
    if (one === other) continue;
    ends[one].add(other);
    ends[other].add(one);
  }
  for (let at = ends.findIndex((set) => set.size === 1); at >= 0; at = ends.findIndex((set) => set.size === 1)) {
    const [other] = ends[at]; // a wall that ends in the room encloses nothing
    ends[at].clear();
    ends[other].delete(at);
  }
  const left = corners.map((_, index) => index).filter((index) => ends[index].size);
  if (left.length < 3) return null;
  const first = left.reduce((best, index) => (before(corners[index], corners[best]) ? index : best));
  return around(corners, ends, first);
}

function before([x1, y1], [x2, y2]) {
  return x1 < x2 || (x1 === x2 && y1 < y2);
}

/** Walk along the outer edge: at each corner the wall that turns most to the right. */
function around(corners, ends, first) {
  const found = [];
  let at = first;
  let heading = -Math.PI / 2;
  do {
    found.push(corners[at]);
    const next = [...ends[at]]
      .map((to) => ({ to, angle: Math.atan2(corners[to][1] - corners[at][1], corners[to][0] - corners[at][0]) }))
      .map((one) => ({ ...one, turn: (one.angle - heading - Math.PI + 4 * Math.PI - 1e-9) % (2 * Math.PI) }))
      .sort((a, b) => a.turn - b.turn)[0];
    heading = next.angle;
    at = next.to;
    if (found.length > 2 * corners.length) return null;
  } while (at !== first);
  return found.length > 2 ? found : null;
}

/** The convex hull of points, in order. */
function hull(points) {
  const sorted = [...points].sort(([x1, y1], [x2, y2]) => x1 - x2 || y1 - y2);
  const half = (list) => {
    const chain = [];
    for (const point of list) {
      while (chain.length > 1 && cross(chain.at(-2), chain.at(-1), point) <= 0) chain.pop();
      chain.push(point);
    }
    return chain.slice(0, -1);
  };
  return sorted.length < 3 ? [] : [...half(sorted), ...half(sorted.reverse())];
}

function cross([x0, y0], [x1, y1], [x2, y2]) {
  return (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0);
}

/** Draw the area within the outline, unless a floor plan is drawn there. */
export function fillRoom(context, plan, ground_m) {
  const outline = surveyShown() ? null : roomOutline(plan);
  if (!outline || plan.length) return;
  trace(context, outline, ground_m);
  context.fillStyle = faint(palette.surface, 0.55);
  context.fill();
}

function trace(context, { corners }, ground_m) {
  context.beginPath();
  for (const [x, y] of corners) context.lineTo(toX(x, y), toY(x, y, ground_m));
  context.closePath();
}

/** Draw the outline. */
export function drawRoom(context, plan, ground_m) {
  const outline = surveyShown() ? null : roomOutline(plan);
  if (!outline) return;
  const walls = outline.kind === "room";
  trace(context, outline, ground_m);
  context.strokeStyle = palette.wall;
  context.lineWidth = walls ? 2 : 1.25;
  context.setLineDash(walls ? [] : [7, 5]);
  context.stroke();
  context.setLineDash([]);
}

/** Write below the outline what it is and its size, where there is room between other names; not in the 3-D view. */
export function nameRoom(context, plan) {
  const outline = surveyShown() || view.spatial ? null : roomOutline(plan);
  if (!outline) return;
  const [xs, ys] = [outline.corners.map(([x]) => x), outline.corners.map(([, y]) => y)];
  const size = [xs, ys].map((list) => `${(Math.max(...list) - Math.min(...list)).toFixed(1)} m`);
  context.font = "11px system-ui, sans-serif";
  const words = `${outline.name}, ${size.join(" × ")}`;
  const scale = scaleBox();
  const top = toY(Math.min(...xs), Math.min(...ys)) + 22;
  const covered = top + 20 > scale.top && top - 7 < scale.top + scale.height;
  const wide = context.measureText(words).width;
  const last = (covered ? scale.left : view.width) - wide - 6;
  const left = Math.max(4, Math.min(toX(Math.min(...xs), Math.min(...ys)), last));
  labelIfFree(context, words, left + wide / 2, [top, top + 13], palette.muted);
}
