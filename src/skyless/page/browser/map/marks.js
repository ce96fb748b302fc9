/**
 * Marks of tags: 8 colours and 7 shapes in turn, so that the first 56 tags never share both.
 *
 * 8 and 7 have no common divisor: tags with the same shape differ by 7, 14 or 21 in their number, and so in their colours
 * by 1, 2 or 3 steps; colours that far apart differ for colour-blind readers too (`tests/page/modules/map.test.mjs`).
 */

import { s } from "../dom.js";
import { on } from "../store.js";
import { assetLook } from "../assets/model.js";
import { DISTINCT, palette, tagColour } from "../theme.js";
import { view } from "./view.js";

/** Outlines in a square from -1 to 1; none is one of the anchors' shapes. */
export const SHAPES = {
  circle: "M1 0A1 1 0 1 1-1 0A1 1 0 1 1 1 0Z",
  diamond: "M0-1.25 1.05 0 0 1.25-1.05 0Z",
  down: "M-1.1-.9H1.1L0 1.15Z",
  star: "M0-1.35.34-.42 1.28-.42.55.2.83 1.15 0 .6-.83 1.15-.55.2-1.28-.42-.34-.42Z",
  plus: "M-.42-1.15H.42V-.42H1.15V.42H.42V1.15H-.42V.42H-1.15V-.42H-.42Z",
  right: "M-.9-1.1V1.1L1.15 0Z",
  bar: "M-1.3-.55H1.3V.55H-1.3Z",
};
const NAMES = Object.keys(SHAPES);
const RADIUS = 5.2;
/** Half of a sprite's side, pixels of CSS. */
const HALF = 9;

/** @type {Map<string, HTMLCanvasElement>} */
const sprites = new Map();
on(["theme"], () => sprites.clear());

/**
 * Colour and shape of a tag: the colour of its asset or group, else by its position among all tags in the order of their
 * names; of many tags the shape is the group's.
 */
export function tagStyle(index, count, name = "") {
  const look = assetLook(name);
  const few = count <= DISTINCT;
  const shape = few ? NAMES[index % NAMES.length] : look ? NAMES[look.number % NAMES.length] : "circle";
  return { colour: look?.colour ?? tagColour(index, count), shape };
}

/** Draw a mark, filled, or hollow without a fix; it is painted once for each look. */
export function drawMark(context, x, y, colour, shape, hollow) {
  const key = `${colour} ${shape} ${hollow} ${view.ratio}`;
  let sprite = sprites.get(key);
  if (!sprite) sprites.set(key, (sprite = paint(colour, shape, hollow, view.ratio)));
  context.drawImage(sprite, x - HALF, y - HALF, 2 * HALF, 2 * HALF);
}

function paint(colour, shape, hollow, ratio) {
  const sprite = document.createElement("canvas");
  sprite.width = sprite.height = Math.ceil(2 * HALF * ratio);
  const context = sprite.getContext("2d");
  const path = new Path2D();
  const k = RADIUS * ratio;
  path.addPath(new Path2D(SHAPES[shape]), new DOMMatrix([k, 0, 0, k, HALF * ratio, HALF * ratio]));
  context.lineJoin = "round";
  context.lineWidth = (hollow ? 1.6 : 2.6) * ratio;
  context.strokeStyle = hollow ? colour : palette.surface;
  context.fillStyle = hollow ? palette.surface : colour;
  if (hollow) context.fill(path);
  context.stroke(path);
  if (!hollow) context.fill(path);
  return sprite;
}

/** A tag's mark as a small picture for lists. */
export function tagMark({ colour, shape }) {
  const path = s("path", { d: SHAPES[shape], transform: "translate(9 9) scale(5)" });
  const mark = s("svg", { viewBox: "0 0 18 18", class: "tag-mark", "aria-hidden": "true", "data-shape": shape }, path);
  mark.style.color = colour;
  return mark;
}
