/** Zones on the map, and the zone that is being drawn. */

import { state } from "../store.js";
import { faint, palette } from "../theme.js";
import { editor } from "./editor.js";
import { chosenFloor, groundHeight } from "./floors.js";
import { labelIfFree } from "./names.js";
import { toX, toY } from "./view.js";

/** Whether a zone is on the chosen floor, or on all. */
export function isOnFloor(zone) {
  const floor = chosenFloor()?.number;
  return floor === undefined || (zone.floor ?? floor) === floor;
}

/** A zone's colour; the page's where it has none or one that the browser does not know. */
export function zoneColour(zone) {
  return zone.colour && CSS.supports("color", zone.colour) ? zone.colour : palette.accent;
}

/** Zones that had an event within the last second and a half. */
const flashing = new Map();

/** Highlight a zone for a moment. */
export function flash(id) {
  flashing.set(id, performance.now() + 1500);
}

/** Draw all zones; returns whether one is flashing. */
export function drawZones(context) {
  const now = performance.now();
  for (const [id, until] of flashing) if (until < now) flashing.delete(id);
  for (const zone of state.zones.filter(isOnFloor)) {
    const chosen = state.selection.zone === zone.id;
    const colour = zoneColour(zone);
    outline(context, zone.polygon_m, true);
    context.globalAlpha = flashing.has(zone.id) ? 0.34 : chosen ? 0.2 : 0.11;
    context.fillStyle = colour;
    context.fill();
    context.globalAlpha = 1;
    context.strokeStyle = colour;
    context.lineWidth = chosen ? 2.5 : 1.5;
    context.stroke();
    if (chosen && state.mode === "live") corners(context, zone.polygon_m, colour);
  }
  return flashing.size > 0;
}

/** Write the names of the zones, beside the names that are written already; the selected zone's comes first. */
export function nameZones(context) {
  context.font = "600 12px system-ui, sans-serif";
  const first = (zone) => Number(state.selection.zone === zone.id);
  for (const zone of state.zones.filter(isOnFloor).sort((a, b) => first(b) - first(a))) {
    const [x, y] = middle(zone.polygon_m);
    const [left, top] = [toX(x, y), toY(x, y, groundHeight())];
    labelIfFree(context, zone.name, left, [0, -15, 15, -30, 30].map((down) => top + down));
  }
}

/** Draw the zone that is being drawn: its corners, the line to the cursor, and the cursor. */
export function drawDraft(context) {
  if (!editor.drawing) return;
  const points = editor.cursor ? [...editor.points, editor.cursor] : editor.points;
  outline(context, points, points.length > 2);
  context.fillStyle = faint(palette.accent, 0.15);
  context.fill();
  context.setLineDash([6, 4]);
  context.strokeStyle = palette.accent;
  context.lineWidth = 2;
  context.stroke();
  context.setLineDash([]);
  corners(context, editor.points, palette.accent);
  if (editor.cursor) crosshair(context, toX(...editor.cursor), toY(...editor.cursor));
}

function outline(context, points, closed) {
  context.beginPath();
  const ground = groundHeight();
  for (const [x, y] of points) context.lineTo(toX(x, y), toY(x, y, ground));
  if (closed) context.closePath();
}

function corners(context, points, colour) {
  context.fillStyle = palette.surface;
  context.strokeStyle = colour;
  context.lineWidth = 2;
  for (const [x, y] of points) {
    context.beginPath();
    context.arc(toX(x, y), toY(x, y, groundHeight()), 5, 0, 2 * Math.PI);
    context.fill();
    context.stroke();
  }
}

function crosshair(context, x, y) {
  context.strokeStyle = palette.text;
  context.lineWidth = 1.5;
  context.beginPath();
  for (const [dx, dy] of [
    [1, 0],
    [-1, 0],
    [0, 1],
    [0, -1],
  ]) {
    context.moveTo(x + 4 * dx, y + 4 * dy);
    context.lineTo(x + 14 * dx, y + 14 * dy);
  }
  context.stroke();
}

/** A point near the middle of a polygon: its centroid, or the corners' mean where it has no area. */
export function middle(points) {
  let area = 0;
  let sx = 0;
  let sy = 0;
  points.forEach(([x1, y1], index) => {
    const [x2, y2] = points[(index + 1) % points.length];
    const cross = x1 * y2 - x2 * y1;
    area += cross;
    sx += (x1 + x2) * cross;
    sy += (y1 + y2) * cross;
  });
  if (Math.abs(area) > 1e-9) return [sx / (3 * area), sy / (3 * area)];
  const mean = (column) => points.reduce((sum, point) => sum + point[column], 0) / points.length;
  return [mean(0), mean(1)];
}

/** Whether a point lies in a polygon. */
export function inside(points, x, y) {
  let within = false;
  for (let i = 0, j = points.length - 1; i < points.length; j = i++) {
    const [xi, yi] = points[i];
    const [xj, yj] = points[j];
    if (yi > y !== yj > y && x < ((xj - xi) * (y - yi)) / (yj - yi) + xi) within = !within;
  }
  return within;
}
