/** Names on the map, none over another: those that stand still first, then tags', each in the first free position. */

import { palette } from "../theme.js";

const HEIGHT = 13;
/** Boxes of the marks and names that stand still, [left, top, right, bottom]; anchors' come first, then zones'. @type {number[][]} */
export const still = [];
/** Directions from the mark, the usual one first; then farther away, with a line to the mark. */
const NEAR = [[1, -1], [1, 1], [-1, -1], [-1, 1], [0, -1], [0, 1]]; // prettier-ignore
const STEPS = [
  { dx: 8, dy: 5, line: false },
  { dx: 16, dy: 22, line: true },
  { dx: 26, dy: 38, line: true },
];

/** By tag: the candidate of the last frame, which is tried first, so that names do not jump. @type {Map<string, number>} */
let last = new Map();
/** Widths of names in the font used, pixels. @type {Map<string, number>} */
const widths = new Map();

/** Write a label that is legible on any background. */
export function label(context, words, x, y, colour = palette.text) {
  context.lineWidth = 3;
  context.lineJoin = "round";
  context.strokeStyle = palette.bg;
  context.strokeText(words, x, y);
  context.fillStyle = colour;
  context.fillText(words, x, y);
}

/** The box of a label with its middle at x. */
export function boxOf(context, words, x, top) {
  const half = context.measureText(words).width / 2 + 2;
  return [x - half, top, x + half, top + HEIGHT];
}

/**
 * Write a label that stands still with its middle at the first of these heights where it covers nothing; where there is
 * none, it is left out.
 */
export function labelIfFree(context, words, x, heights, colour = palette.text) {
  context.textAlign = "center";
  context.textBaseline = "middle";
  for (const y of heights) {
    const box = boxOf(context, words, x, y - HEIGHT / 2);
    if (still.some((other) => overlap(other, box))) continue;
    still.push(box);
    label(context, words, x, y, colour);
    return;
  }
}

/**
 * Write names next to their marks; where there is no room, only those that must be seen.
 * @param {Array<{key: string, words: string, x: number, y: number, colour: string, must?: boolean}>} wanted
 * @param {Array<number[]>} taken boxes that are to stay free, [left, top, right, bottom]
 * @returns {Array<number[]>} the boxes of the names
 */
export function drawNames(context, wanted, taken) {
  context.font = "11px system-ui, sans-serif";
  context.textAlign = "left";
  context.textBaseline = "top";
  const boxes = [...taken, ...wanted.map(({ x, y }) => [x - 5, y - 5, x + 5, y + 5])];
  const own = boxes.length - wanted.length;
  const names = [];
  const now = new Map();
  wanted.forEach(({ key, words, x, y, colour, must }, index) => {
    const chosen = choose(key, x, y, width(context, words), boxes, own + index, must);
    if (!chosen) return;
    now.set(key, chosen.number);
    boxes.push(chosen.box);
    names.push(chosen.box);
    if (chosen.line) {
      context.strokeStyle = colour;
      context.lineWidth = 0.8;
      context.beginPath();
      context.moveTo(x, y);
      context.lineTo(Math.min(Math.max(x, chosen.box[0]), chosen.box[2]), chosen.box[3] <= y ? chosen.box[3] : chosen.box[1]);
      context.stroke();
    }
    label(context, words, chosen.box[0] + 1, chosen.box[1], colour);
  });
  last = now;
  return names;
}

function width(context, words) {
  let found = widths.get(words);
  if (found === undefined) {
    if (widths.size > 500) widths.clear();
    widths.set(words, (found = context.measureText(words).width));
  }
  return found;
}

/** The first position that covers nothing; where there is none, the usual one of a name that must be seen. */
function choose(key, x, y, wide, boxes, own, must) {
  const candidates = STEPS.flatMap(({ dx, dy, line }) =>
    NEAR.map(([right, down]) => {
      const left = right > 0 ? x + dx : right < 0 ? x - dx - wide : x - wide / 2;
      const top = down < 0 ? y - dy - (right ? 0 : 4) - HEIGHT + 1 : y + dy + (right ? 0 : 4) - 1;
      return { box: [left - 1, top, left + wide + 1, top + HEIGHT], line };
    }),
  );
  const before = last.get(key) ?? 0;
  const order = [before, ...candidates.keys()];
  const number = order.find((n) => !boxes.some((box, index) => index !== own && overlap(box, candidates[n].box)));
  return number === undefined && !must ? null : { ...candidates[number ?? 0], number: number ?? 0 };
}

function overlap(a, b) {
  return a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
}
