/** Tags on the map: ellipses, protection levels, true positions, marks and names. */

import { GONE_S, freshness, now_s, shown_s, stillMotion, tracks } from "../clock.js";
import { faint, palette, tagColour } from "../theme.js";
import { state } from "../store.js";
import { COLUMNS, CXX, CXY, CYY, HPL, TRUE_X, TRUE_Y, X, Y } from "../tracks.js";
import { label, ring } from "./anchors.js";
import { drawStub } from "./trails.js";
import { px, py, view } from "./view.js";

/** √5.991: half axes of the ellipse of 95 % in standard deviations, in two dimensions. */
const SIGMAS_95 = 2.4477;
/** With more tags than this only the selected one is named. */
export const NAMED = 40;
const MARK = 5;
const row = new Float64Array(COLUMNS);

/** The tags as drawn last, for the pointer: name, pixels. @type {Array<{name: string, x: number, y: number}>} */
export const drawn = [];

/** The tags on the map, whether the next frame differs without a message (moving), and whether a later one will (ageing). */
export function visibleTags() {
  const now = now_s();
  const shown = shown_s();
  const list = tracks().sorted;
  const seen = [];
  let moving = false;
  let ageing = false;
  list.forEach((track, index) => {
    const fresh = freshness(track, now, shown);
    if (fresh === "gone" || fresh === "never" || !track.at(shown, row, !stillMotion.matches)) return;
    if (state.mode === "live") {
      moving ||= track.lastTime > shown;
      ageing ||= now - track.lastTime < GONE_S + 1;
    }
    const colour = fresh === "fresh" ? tagColour(index, list.length) : palette.muted;
    seen.push({ track, colour, fresh, row: row.slice(), selected: track.name === state.selection.tag });
  });
  return { seen, shown, moving, ageing };
}

/** Draw all tags. */
export function drawTags(context, { seen, shown }) {
  const options = state.options;
  drawn.length = 0;
  if (options.trails) for (const one of seen) drawStub(context, one, shown);
  if (options.ellipses) for (const one of seen) ellipse(context, one);
  if (options.levels) for (const one of seen) if (seen.length <= NAMED || one.selected) level(context, one);
  if (options.truth && state.simulated) for (const one of seen) truth(context, one);
  for (const one of seen) mark(context, one);
  if (options.names) names(context, seen);
}

function ellipse(context, { row: at, colour, selected }) {
  const [major, minor, angle] = axes(at[CXX], at[CXY], at[CYY]);
  const long = SIGMAS_95 * major * view.scale;
  if (!(long > MARK)) return;
  context.beginPath();
  context.ellipse(px(at[X]), py(at[Y]), long, SIGMAS_95 * minor * view.scale, -angle, 0, 2 * Math.PI);
  context.fillStyle = faint(colour, 0.14);
  context.fill();
  context.strokeStyle = faint(colour, selected ? 0.95 : 0.6);
  context.lineWidth = 1;
  context.stroke();
}

/** The circle of the protection level. */
function level(context, { row: at, colour, selected }) {
  const radius = at[HPL] * view.scale;
  if (!(radius > MARK)) return;
  context.beginPath();
  context.arc(px(at[X]), py(at[Y]), radius, 0, 2 * Math.PI);
  context.setLineDash([3, 3]);
  context.strokeStyle = faint(colour, selected ? 0.95 : 0.6);
  context.lineWidth = 1;
  context.stroke();
  context.setLineDash([]);
}

/** Half axes of one sigma in m, and the angle of the long one from x, of a 2 × 2 covariance. */
export function axes(xx, xy, yy) {
  const middle = (xx + yy) / 2;
  const difference = Math.hypot((xx - yy) / 2, xy);
  return [Math.sqrt(middle + difference), Math.sqrt(Math.max(middle - difference, 0)), Math.atan2(2 * xy, xx - yy) / 2];
}

function truth(context, { row: at, colour }) {
  if (!(at[TRUE_X] === at[TRUE_X])) return;
  const x = px(at[TRUE_X]);
  const y = py(at[TRUE_Y]);
  context.strokeStyle = faint(colour, 0.55);
  context.lineWidth = 1.25;
  context.beginPath();
  context.arc(x, y, MARK + 4, 0, 2 * Math.PI);
  context.moveTo(px(at[X]), py(at[Y]));
  context.lineTo(x, y);
  context.stroke();
}

function mark(context, { track, row: at, colour, fresh, selected }) {
  const x = px(at[X]);
  const y = py(at[Y]);
  drawn.push({ name: track.name, x, y });
  context.beginPath();
  context.arc(x, y, MARK, 0, 2 * Math.PI);
  context.fillStyle = fresh === "fresh" ? colour : palette.surface;
  context.fill();
  context.strokeStyle = fresh === "fresh" ? palette.surface : colour;
  context.lineWidth = 1.5;
  context.stroke();
  if (selected) ring(context, x, y, MARK + 8);
}

function names(context, seen) {
  context.font = "11px system-ui, sans-serif";
  context.textAlign = "left";
  context.textBaseline = "bottom";
  for (const { track, row: at, fresh, selected } of seen) {
    if (seen.length > NAMED && !selected) continue;
    const quiet = fresh === "fresh" || state.connection.phase === "lost";
    const words = quiet ? track.name : `${track.name} · no fix`;
    label(context, words, px(at[X]) + 9, py(at[Y]) - 6, fresh === "fresh" ? palette.text : palette.muted);
  }
}
