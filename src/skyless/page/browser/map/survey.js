/** The survey's picture: anchors with their ellipses, pairs as lines, and where anchors would be in other results. */

import { state } from "../store.js";
import { roundStep } from "../format.js";
import { facts, surveyShown } from "../survey/model.js";
import { faint, palette } from "../theme.js";
import { ring } from "./anchors.js";
import { label } from "./names.js";
import { halfAxes, isNarrow, px, py, toSite, toX, toY, view } from "./view.js";

const MARK = 6;
/** The largest ellipse is enlarged to about this half axis in pixels. */
const ELLIPSE = 34;
/** Anchors without any position stand in rows from here, in pixels; clear of the buttons and of the set-up's bar. */
const TRAY = { wide: { x: 20, y: 90, right: 64 }, narrow: { x: 20, y: 34, right: 196 }, step: 34 };
/** With more pairs their lines are fainter. */
const FEW_PAIRS = 100;

/** Where the anchors were last drawn, in pixels. @type {Array<{id: number, x: number, y: number}>} */
let drawn = [];

/** The anchor at a pixel, of those that the survey's picture shows; undefined without one. */
export function anchorNear(x, y, hit) {
  const apart = (one) => Math.hypot(one.x - x, one.y - y);
  return drawn.filter((one) => apart(one) <= hit).sort((a, b) => apart(a) - apart(b))[0]?.id;
}

/** Pixel at which the map shows an anchor: of the survey, or of the site file; null without one. */
export function pixelOf(id) {
  if (surveyShown()) return drawn.find((one) => one.id === id) ?? null;
  const anchor = state.site?.anchors.find((one) => one.id === id);
  return anchor ? { id, x: toX(anchor.x_m, anchor.y_m), y: toY(anchor.x_m, anchor.y_m, anchor.z_m) } : null;
}

/** Positions of the survey's picture in metres: the result's, and rough ones where it has none. */
export function surveyPositions() {
  if (!surveyShown()) return new Map();
  const found = new Map();
  for (const id of [...state.survey.anchors, ...state.survey.missing]) {
    const rough = roughPosition(id);
    if (rough) found.set(id, { x_m: rough[0], y_m: rough[1], anchor: null });
  }
  for (const anchor of state.survey.survey?.anchors ?? []) {
    if (anchor.x_m !== null) found.set(anchor.id, { x_m: anchor.x_m, y_m: anchor.y_m, anchor });
  }
  return found;
}

/** A position that is known from elsewhere; only where nothing else names the axes. */
function roughPosition(id) {
  if (facts().gauge) return null;
  const own = state.site?.anchors.find((anchor) => anchor.id === id);
  return facts().points[id] ?? facts().sketch_m[id] ?? (own ? [own.x_m, own.y_m] : null);
}

/** Draw the survey's picture. */
export function drawSurvey(context) {
  drawn = [];
  if (!surveyShown()) return;
  const positions = surveyPositions();
  for (const [id, { x_m, y_m }] of positions) drawn.push({ id, x: px(x_m), y: py(y_m) });
  pairs(context);
  ghosts(context, positions);
  const factor = ellipseFactor(positions);
  for (const { x_m, y_m, anchor } of positions.values()) {
    const shape = anchor?.covariance_m2 && ellipseOf(anchor.covariance_m2);
    if (shape) ellipse(context, px(x_m), py(y_m), shape, factor * view.scale);
  }
  if (factor) caption(context, factor);
  if (axesNamed()) axes(context);
  tray(context, positions);
  context.font = "600 11px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "top";
  const moved = new Set((state.survey.survey?.ambiguities ?? []).flatMap((other) => other.anchors));
  for (const { id, x, y } of drawn) {
    const sure = positions.get(id)?.anchor?.determined ?? false;
    mark(context, x, y, sure, moved.has(id) ? palette.warn : palette.accent);
    if (id === state.selection.anchor) ring(context, x, y, MARK + 6);
    label(context, moved.has(id) ? `${id}?` : String(id), x, y + MARK + 5);
  }
}

/** Lines of the pairs that range each other; those that were left out are dashed. */
function pairs(context) {
  const at = new Map(drawn.map((one) => [one.id, one]));
  const known = state.survey.survey?.pairs ?? state.survey.pairs;
  const strength = known.length > FEW_PAIRS ? 0.15 : 0.4;
  for (const pair of known) {
    const [one, other] = [at.get(pair.a), at.get(pair.b)];
    if (!one || !other) continue;
    context.strokeStyle = pair.excluded ? palette.bad : faint(palette.muted, strength);
    context.lineWidth = pair.excluded ? 1.4 : 1;
    context.setLineDash(pair.excluded ? [3, 5] : []);
    context.beginPath();
    context.moveTo(one.x, one.y);
    context.lineTo(other.x, other.y);
    context.stroke();
  }
  context.setLineDash([]);
}

/** Where anchors would be in other results that fit as well. */
function ghosts(context, positions) {
  context.strokeStyle = palette.warn;
  context.lineWidth = 1.4;
  context.font = "11px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "top";
  for (const other of state.survey.survey?.ambiguities ?? []) {
    for (const id of other.anchors) {
      const [x_m, y_m] = other.positions_m[id] ?? [];
      const here = positions.get(id);
      if (x_m === undefined || !here) continue;
      const [x, y] = [px(x_m), py(y_m)];
      context.setLineDash([2, 4]);
      context.beginPath();
      context.moveTo(px(here.x_m), py(here.y_m));
      context.lineTo(x, y);
      context.stroke();
      context.setLineDash([]);
      context.strokeRect(x - MARK, y - MARK, 2 * MARK, 2 * MARK);
      label(context, `${id}?`, x, y + MARK + 4, palette.warn);
      context.strokeStyle = palette.warn;
      context.lineWidth = 1.4;
    }
  }
}

/** How much larger than the map the ellipses are drawn, so that the largest is seen; 0 without any. */
export function ellipseFactor(positions = surveyPositions()) {
  let largest_m = 0;
  for (const { anchor } of positions.values()) {
    if (anchor?.covariance_m2) largest_m = Math.max(largest_m, ellipseOf(anchor.covariance_m2)[0]);
  }
  return largest_m > 0 ? Math.max(1, roundStep(ELLIPSE / (largest_m * view.scale))) : 0;
}

/** The ellipse of 95 % of a covariance of three axes, seen from above. */
function ellipseOf([[xx, xy], [, yy]]) {
  return halfAxes(xx, xy, yy);
}

function ellipse(context, x, y, [long_m, short_m, angle], scale) {
  context.beginPath();
  context.ellipse(x, y, Math.max(long_m * scale, 1), Math.max(short_m * scale, 1), -angle, 0, 2 * Math.PI);
  context.fillStyle = faint(palette.accent, 0.14);
  context.fill();
  context.strokeStyle = faint(palette.accent, 0.8);
  context.lineWidth = 1.2;
  context.stroke();
}

function caption(context, factor) {
  const times = factor > 1 ? `, ${isNarrow() ? "" : "drawn "}${factor} × larger` : "";
  const words = isNarrow() ? "95 % ellipses" : "Ellipses: 95 % of the errors";
  context.font = "11px system-ui, sans-serif";
  context.textAlign = "right";
  context.textBaseline = "bottom";
  label(context, `${words}${times}`, view.width - 16, view.height - 74, palette.text);
}

/** Whether anything names the axes; otherwise origin and direction mean nothing. */
function axesNamed() {
  const { gauge, points, sketch_m } = facts();
  const given = Object.keys(points).length > 1 || Object.keys(sketch_m).length > 1;
  return Boolean(state.survey.survey) && (gauge !== null || given);
}

/** The axes at the origin. */
function axes(context) {
  const [x, y] = [px(0), py(0)];
  context.strokeStyle = palette.text;
  context.lineWidth = 1.6;
  context.font = "600 11px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  for (const [name, dx, dy] of [
    ["x", 1, 0],
    ["y", 0, -1],
  ]) {
    context.beginPath();
    context.moveTo(x + 12 * dx, y + 12 * dy);
    context.lineTo(x + 44 * dx, y + 44 * dy);
    context.moveTo(x + 38 * dx - 4 * dy, y + 38 * dy - 4 * dx);
    context.lineTo(x + 44 * dx, y + 44 * dy);
    context.lineTo(x + 38 * dx + 4 * dy, y + 38 * dy + 4 * dx);
    context.stroke();
    label(context, name, x + 53 * dx, y + 53 * dy);
    context.strokeStyle = palette.text;
    context.lineWidth = 1.6;
  }
}

/** Anchors that have been received and have no position yet stand in rows, so that they can be chosen too. */
function tray(context, positions) {
  const ids = state.survey.anchors.filter((id) => !positions.has(id));
  if (!ids.length) return;
  const { x, y, right } = isNarrow() ? TRAY.narrow : TRAY.wide;
  const columns = Math.max(1, Math.floor((view.width - x - right) / TRAY.step));
  ids.forEach((id, index) => {
    const [column, row] = [index % columns, Math.floor(index / columns)];
    drawn.push({ id, x: x + column * TRAY.step, y: y + row * TRAY.step });
  });
  context.font = "12px system-ui, sans-serif";
  context.textAlign = "left";
  context.textBaseline = "bottom";
  label(context, "Without a position yet:", x - MARK, y - MARK - 5, palette.muted);
}

function mark(context, x, y, sure, colour) {
  context.beginPath();
  context.arc(x, y, MARK, 0, 2 * Math.PI);
  context.fillStyle = sure ? colour : palette.surface;
  context.fill();
  context.setLineDash(sure ? [] : [3, 3]);
  context.strokeStyle = sure ? palette.surface : palette.muted;
  context.lineWidth = sure ? 1.5 : 1.8;
  context.stroke();
  context.setLineDash([]);
}

/** Corners that the map has to show besides the site's own, in metres. */
export function surveyCorners() {
  const corners = [...surveyPositions().values()].map(({ x_m, y_m }) => [x_m, y_m]);
  if (!surveyShown()) return corners;
  if (corners.length && axesNamed()) corners.push([0, 0]);
  for (const other of state.survey.survey?.ambiguities ?? []) {
    for (const [x_m, y_m] of Object.values(other.positions_m)) corners.push([x_m, y_m]);
  }
  return corners;
}

/** Whether none of the picture's anchors lies on the map as it is shown now. */
export function surveyOutOfSight() {
  const [left, top] = toSite(0, 0);
  const [right, bottom] = toSite(view.width, view.height);
  const positions = [...surveyPositions().values()];
  const seen = ({ x_m, y_m }) => x_m > left && x_m < right && y_m > bottom && y_m < top;
  return positions.length > 0 && !positions.some(seen);
}
