/** Tags on the map: ellipses, protection levels, true positions, marks and names. */

import { freshness, now_s, shown_s, stillMotion, tracks } from "../clock.js";
import { duration } from "../format.js";
import { faint, palette } from "../theme.js";
import { state } from "../store.js";
import { alarmedTags } from "../alarms/model.js";
import { labelOf } from "../assets/model.js";
import { CXX, CXY, CYY, HEIGHT_GIVEN, HPL, TIME, TRUE_X, TRUE_Y, X, Y, Z } from "../tracks.js";
import { DIMMED, dropLine, ring } from "./anchors.js";
import { filtering, passes } from "./filter.js";
import { otherFloor } from "./floors.js";
import { manyShown } from "./many.js";
import { drawMark, tagStyle } from "./marks.js";
import { drawNames, still } from "./names.js";
import { drawStub } from "./trails.js";
import { foreshortening, halfAxes, isSeen, seenCovariance, toX, toY, view } from "./view.js";
import { inside } from "./zones.js";

/** With more tags than this only the selected one is named. */
export const NAMED = 40;
/** With more tags than this only the selected one has a trail and its true position. */
export const RICH = 300;
/** Tags that are so far outside the picture are not drawn, pixels. */
const MARGIN = 60;
const MARK = 5;
/** More tags than this are dots of this radius. */
const DOTS = 400;
const DOT = 4;

/** The tags as drawn last, for the pointer: name, pixels. @type {Array<{name: string, x: number, y: number}>} */
export const drawn = [];

/** The tags on the map, whether the next frame differs without a message (moving), and whether a later one will (ageing). */
export function visibleTags() {
  const now = now_s();
  const shown = shown_s();
  const list = tracks().sorted;
  const seen = [];
  const other = otherFloor();
  const filtered = filtering();
  let moving = false;
  let ageing = false;
  list.forEach((track, index) => {
    const selected = track.name === state.selection.tag;
    const fresh = freshness(track, now, shown);
    if (fresh === "gone" || fresh === "never") return;
    const row = track.shown;
    if (!track.at(shown, row, !stillMotion.matches)) return;
    if (state.mode === "live") {
      moving ||= track.lastTime > shown;
      ageing = true;
    }
    const [x, y] = [toX(row[X], row[Y]), toY(row[X], row[Y], row[Z])];
    if (!isSeen(x, y, MARGIN) && !selected && track.name !== state.followed) return;
    const style = tagStyle(index, list.length, track.name);
    const colour = fresh === "fresh" ? style.colour : palette.muted;
    const dimmed = other(row[Z], floorByZone(row)) || (filtered && !selected && !passes(track.name, row));
    seen.push({ track, colour, shape: style.shape, fresh, row, selected, other: dimmed, x: 0, y: 0 });
  });
  return { seen, shown, moving, ageing };
}

/** The floor of the zone that holds a tag whose height was given; undefined where its height says it, or no zone does. */
export function floorByZone(row) {
  if (!row[HEIGHT_GIVEN] || !state.site?.floors) return undefined;
  const zone = state.zones.find((one) => typeof one.floor === "number" && inside(one.polygon_m, row[X], row[Y]));
  return zone?.floor;
}

/** Draw all tags. */
export function drawTags(context, { seen, shown }) {
  const options = state.options;
  drawn.length = 0;
  for (const one of seen) {
    one.x = toX(one.row[X], one.row[Y]);
    one.y = toY(one.row[X], one.row[Y], one.row[Z]);
  }
  const here = seen.filter((one) => !one.other);
  const rich = seen.length <= RICH && !manyShown() ? here : here.filter(({ selected }) => selected);
  if (options.trails) for (const one of rich) drawStub(context, one, shown);
  if (view.spatial) for (const one of here) dropLine(context, one.row[X], one.row[Y], one.y, faint(one.colour, 0.7));
  if (options.ellipses) for (const one of manyShown() ? rich : here) ellipse(context, one);
  if (options.levels) for (const one of here) if ((seen.length <= NAMED && !manyShown()) || one.selected) level(context, one);
  if (options.truth && state.simulated) for (const one of rich) truth(context, one);
  if (seen.length > DOTS || manyShown()) dots(context, seen);
  else for (const one of seen) mark(context, one);
  if (options.names) names(context, manyShown() ? rich : here);
}

function ellipse(context, { row: at, colour, selected, x, y }) {
  const [major_m, minor_m, angle] = halfAxes(...seenCovariance(at[CXX], at[CXY], at[CYY]));
  const long = major_m * view.scale;
  if (!(long > MARK)) return;
  context.beginPath();
  context.ellipse(x, y, long, minor_m * view.scale, -angle, 0, 2 * Math.PI);
  context.fillStyle = faint(colour, 0.14);
  context.fill();
  context.strokeStyle = faint(colour, selected ? 0.95 : 0.6);
  context.lineWidth = 1;
  context.stroke();
}

/** The circle of the protection level. */
function level(context, { row: at, colour, selected, x, y }) {
  const radius = at[HPL] * view.scale;
  if (!(radius > MARK)) return;
  context.beginPath();
  context.ellipse(x, y, radius, radius * foreshortening().floor, 0, 0, 2 * Math.PI);
  context.setLineDash([3, 3]);
  context.strokeStyle = faint(colour, selected ? 0.95 : 0.6);
  context.lineWidth = 1;
  context.stroke();
  context.setLineDash([]);
}

function truth(context, { row: at, colour, x, y }) {
  if (!(at[TRUE_X] === at[TRUE_X])) return;
  const true_x = toX(at[TRUE_X], at[TRUE_Y]);
  const true_y = toY(at[TRUE_X], at[TRUE_Y], at[Z]);
  context.strokeStyle = faint(colour, 0.55);
  context.lineWidth = 1.25;
  context.beginPath();
  context.arc(true_x, true_y, MARK + 4, 0, 2 * Math.PI);
  context.moveTo(x, y);
  context.lineTo(true_x, true_y);
  context.stroke();
}

/** Marks of very many tags, a path for each look: a third of the time of pictures. */
function dots(context, seen) {
  const groups = new Map();
  for (const one of seen) {
    drawn.push({ name: one.track.name, x: one.x, y: one.y });
    const key = `${one.colour} ${one.fresh === "fresh"} ${one.other}`;
    groups.has(key) ? groups.get(key).push(one) : groups.set(key, [one]);
  }
  for (const group of manyShown() ? [] : groups.values()) {
    const [{ colour, fresh, other }] = group;
    context.globalAlpha = other ? DIMMED : 1;
    context.beginPath();
    for (const { x, y } of group) {
      context.moveTo(x + DOT, y);
      context.arc(x, y, DOT, 0, 2 * Math.PI);
    }
    context.fillStyle = fresh === "fresh" ? colour : palette.surface;
    context.fill();
    context.strokeStyle = colour;
    context.lineWidth = 1.6;
    if (fresh !== "fresh") context.stroke();
  }
  context.globalAlpha = 1;
  for (const { selected, x, y } of seen) if (selected) ring(context, x, y, MARK + 8);
}

function mark(context, { track, colour, shape, fresh, selected, other, x, y }) {
  drawn.push({ name: track.name, x, y });
  if (other) context.globalAlpha = DIMMED;
  drawMark(context, x, y, colour, shape, fresh !== "fresh");
  if (other) context.globalAlpha = 1;
  if (selected) ring(context, x, y, MARK + 8);
}

function names(context, seen) {
  const wanted = [];
  for (const { track, row: at, fresh, selected, x, y } of seen.toSorted((a, b) => Number(b.selected) - Number(a.selected))) {
    if (seen.length > NAMED && !selected) continue;
    const silence = fresh === "asleep" ? " · asleep" : ` · no fix for ${duration(Math.abs(now_s() - at[TIME]), 1)}`;
    const quiet = fresh === "fresh" || state.connection.phase === "lost";
    const words = labelOf(track.name) + (quiet ? "" : silence) + (view.spatial ? heightWords(at, selected) : "");
    wanted.push({ key: track.name, words, x, y, colour: fresh === "fresh" ? palette.text : palette.muted, must: selected });
  }
  const alarmed = alarmedTags();
  const shields = seen.filter(({ track }) => alarmed.has(track.name)).map(({ x, y }) => [x - 17, y - 17, x - 1, y - 1]);
  drawNames(context, wanted, [...still, ...shields]);
}

/** The height of a tag, and whether it was given; where all are given, only the selected one repeats it. */
export function heightWords(at, selected) {
  const all = Number.isFinite(state.site?.tags?.height_m ?? NaN);
  if (!Number.isFinite(at[Z]) || (all && at[HEIGHT_GIVEN] && !selected)) return "";
  return at[HEIGHT_GIVEN] ? ` · height ${Number(at[Z].toFixed(2))} m given` : ` · z ${at[Z].toFixed(2)} m`;
}
