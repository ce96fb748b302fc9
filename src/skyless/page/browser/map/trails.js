/**
 * Trails on a separate canvas, which is drawn a few times a second: without a graphics card their strokes cost most.
 * The part since then is a short stub that is drawn with the tag.
 */

import { faint } from "../theme.js";
import { TIME, X, Y, Z } from "../tracks.js";
import { toX, toY } from "./view.js";

/** Time between two drawings: for few tags, and for more than `MANY`. */
const FEW_MS = 100;
const MANY_MS = 330;
const MANY = 40;
/** Points nearer than this to the last one are left out, in pixels. */
const MIN_STEP = 2.5;
/** Over a longer gap no line is drawn. */
const GAP_S = 1;

let drawn_s = NaN;
let strength = 0.4;

/** Whether the trails are due, for a number of tags. */
export function due(since_ms, count) {
  return since_ms > (count > MANY ? MANY_MS : FEW_MS);
}

/** Draw all trails up to a moment. */
export function drawTrails(context, seen, shown, length_s) {
  drawn_s = shown;
  strength = seen.length > MANY ? 0.22 : 0.4;
  for (const one of seen) if (!one.other) path(context, one, shown, shown - length_s);
}

/** Draw a trail from the last `drawTrails` to the tag. */
export function drawStub(context, one, shown) {
  if (!one.other) path(context, one, shown, Math.min(drawn_s, shown) - 0.15);
}

function path(context, { track, colour, selected, row }, shown, from) {
  const last = track.find(shown);
  context.strokeStyle = faint(colour, selected ? 0.9 : strength);
  context.lineWidth = selected ? 2 : 1.25;
  context.beginPath();
  let x0 = toX(row[X], row[Y]);
  let y0 = toY(row[X], row[Y], row[Z]);
  context.moveTo(x0, y0);
  let time0 = track.value(last, TIME);
  for (let index = last; index >= 0; index--) {
    const time = track.value(index, TIME);
    if (time < from) break;
    const [x_m, y_m] = [track.value(index, X), track.value(index, Y)];
    const x = toX(x_m, y_m);
    const y = toY(x_m, y_m, track.value(index, Z));
    const gap = time0 - time > GAP_S;
    if (!gap && index > 0 && Math.abs(x - x0) + Math.abs(y - y0) < MIN_STEP) continue;
    if (gap) context.moveTo(x, y);
    else context.lineTo(x, y);
    [x0, y0, time0] = [x, y, time];
  }
  context.stroke();
}
