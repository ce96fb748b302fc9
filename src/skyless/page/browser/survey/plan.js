/** The floor plan that is being laid under the picture: its image, where it lies, and its scale from two points. */

import { changed, state } from "../store.js";
import { placeFloorPlan } from "./model.js";

/** As the server. */
const MAX_BYTES = 8e6;
const TYPES = new Set(["image/png", "image/jpeg"]);
const MIN_WIDTH_M = 0.1;
const MAX_WIDTH_M = 10_000;

/**
 * The plan that is shown instead of the site's; `blob` is null where the image is the present one.
 * @type {{image: HTMLImageElement, blob: Blob|null, name: string, x_m: number, y_m: number, width_m: number}|null}
 */
export let plan = null;
/** Whether dragging on the map moves the plan. */
export let moving = false;
let later = 0;

/** Read a file of the user's; throws an Error that says what would be right. */
export async function readImage(file) {
  if (!TYPES.has(file.type)) throw new Error(`“${file.name}” should be a PNG or JPEG image.`);
  if (file.size > MAX_BYTES) {
    throw new Error(`“${file.name}” has ${(file.size / 1e6).toFixed(1)} MB; an image should have at most 8 MB.`);
  }
  const image = new Image();
  image.src = URL.createObjectURL(file);
  try {
    await image.decode();
  } catch {
    URL.revokeObjectURL(image.src);
    throw new Error(`“${file.name}” cannot be read as an image; it should be a PNG or JPEG.`);
  }
  return image;
}

/** Begin with an image that covers a box of the site, [left, bottom, right, top]. */
export function begin(image, blob, name, [left, bottom, right, top]) {
  const ratio = image.naturalHeight / image.naturalWidth;
  const width_m = Math.max(right - left, (top - bottom) / ratio, 1);
  plan = { image, blob, name, width_m, x_m: (left + right - width_m) / 2, y_m: (bottom + top - width_m * ratio) / 2 };
  placed();
}

/** Begin with the plan that the site has. */
export function beginWithPresent(floor) {
  plan = { image: floor.image, blob: null, name: "", x_m: floor.x_m, y_m: floor.y_m, width_m: floor.width_m };
  changed("plan");
}

/** Give the plan up. */
export function discard() {
  plan = null;
  clearTimeout(later);
  setMoving(false);
  placeFloorPlan(null);
  changed("plan");
}

/** The image was stored: only its position may change from now on. */
export function stored() {
  if (plan) plan.blob = null;
  changed("plan");
}

/** Height on the floor. */
export function height_m({ image, width_m } = plan) {
  return (width_m * image.naturalHeight) / image.naturalWidth;
}

/** Let drags move the plan, or the map again. */
export function setMoving(on) {
  moving = on && plan !== null;
  changed("plan");
}

/** Move the plan by metres. */
export function move(dx_m, dy_m) {
  if (!plan) return;
  plan.x_m += dx_m;
  plan.y_m += dy_m;
  placed();
}

/** Change lower left corner or width. */
export function place(values) {
  Object.assign(plan, values);
  placed();
}

/** Scale about the middle of two points of the picture so that they are `distance_m` apart. */
export function scaleTo(one, other, distance_m) {
  const middle = half(one, other);
  return fitTo(one, other, middle, distance_m / Math.hypot(other[0] - one[0], other[1] - one[1]));
}

/**
 * Scale and move the plan so that two of its points come as near to two points of the site as they can without a turn.
 * @returns {number} by how many degrees the plan is turned against the site; an image cannot be turned here
 */
export function fitToPoints(one, other, target, otherTarget) {
  const [ax, ay] = [other[0] - one[0], other[1] - one[1]];
  const [bx, by] = [otherTarget[0] - target[0], otherTarget[1] - target[1]];
  fitTo(one, other, half(target, otherTarget), Math.hypot(bx, by) / Math.hypot(ax, ay));
  return (Math.atan2(ax * by - ay * bx, ax * bx + ay * by) * 180) / Math.PI;
}

function fitTo(one, other, middle, factor) {
  const [x, y] = half(one, other);
  const width_m = Math.min(Math.max(plan.width_m * factor, MIN_WIDTH_M), MAX_WIDTH_M);
  const used = width_m / plan.width_m;
  place({ width_m, x_m: middle[0] + (plan.x_m - x) * used, y_m: middle[1] + (plan.y_m - y) * used });
}

function half([x1, y1], [x2, y2]) {
  return [(x1 + x2) / 2, (y1 + y2) / 2];
}

/** Show where the plan lies, and soon send it. */
function placed() {
  for (const key of ["x_m", "y_m", "width_m"]) plan[key] = Math.round(plan[key] * 1e3) / 1e3;
  changed("plan");
  clearTimeout(later);
  later = setTimeout(send, 300);
}

/** Send where the plan lies, if that has not been sent yet. */
function send() {
  if (!plan || state.mode !== "live") return;
  placeFloorPlan({ image: "", x_m: plan.x_m, y_m: plan.y_m, width_m: plan.width_m });
}
