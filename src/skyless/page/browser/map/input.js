/** Mouse, touch and keyboard on the map. */

import { changed, isChangeable, select, state } from "../store.js";
import { byId, text } from "../dom.js";
import { duration, metres } from "../format.js";
import { surveyShown } from "../survey/model.js";
import { picking, stopPicking } from "../survey/picking.js";
import { move as movePlan, moving as movingPlan } from "../survey/plan.js";
import { addPoint, begin, cancel, editor, finish, moveCorner, setCursor, storeShown, undoPoint } from "./editor.js";
import { KINDS, valueAt, writeValue } from "./overlay.js";
import { groundHeight } from "./floors.js";
import { endFollow, following, toggleFollow } from "./follow.js";
import { drawnAnchors } from "./anchors.js";
import { places } from "./places.js";
import { selectPoint } from "./many.js";
import { placeAnchor, predict } from "./placing.js";
import { secondsAt } from "./past.js";
import { anchorNear } from "./survey.js";
import { drawn } from "./tags.js";
import { orbit, pan, px, py, toSite, view, zoom } from "./view.js";
import { inside } from "./zones.js";

/** Distances in pixels: a pointer hits an item, and a press is no drag. */
const HIT = 14;
const MAX_TAP_TRAVEL = 6;
/** @type {Map<number, {x: number, y: number}>} */
const pointers = new Map();
let travelled = 0;
let dragged = null;

/** @param {HTMLElement} target the focusable element over the canvases */
export function listen(target, redraw, fitAll, toggleSpatial) {
  const pixel = (event) => {
    const box = target.getBoundingClientRect();
    return { x: event.clientX - box.left, y: event.clientY - box.top };
  };
  target.addEventListener("pointerdown", (event) => {
    if (event.button > 0) return;
    target.setPointerCapture(event.pointerId);
    const at = pixel(event);
    pointers.set(event.pointerId, at);
    if (pointers.size > 1) return;
    travelled = 0;
    dragged = anchorAt(at) ?? cornerAt(at);
    if (dragged?.index >= 0) dragged.before = state.zones;
  });
  target.addEventListener("pointermove", (event) => {
    const at = pixel(event);
    hover(at, event.pointerType);
    const before = pointers.get(event.pointerId);
    if (!before) return;
    travelled += Math.hypot(at.x - before.x, at.y - before.y);
    if (pointers.size === 2) pinch(event.pointerId, before, at);
    else if (travelled >= MAX_TAP_TRAVEL) {
      const [x_m, y_m] = toSite(at.x, at.y, groundHeight());
      if (dragged?.anchor !== undefined) placeAnchor(dragged.anchor, { x_m, y_m }, true);
      else if (dragged) moveCorner(dragged.id, dragged.index, toSite(at.x, at.y));
      else drag(at.x - before.x, at.y - before.y, event.shiftKey);
    }
    pointers.set(event.pointerId, at);
    redraw(true);
  });
  const release = (event) => {
    if (!pointers.delete(event.pointerId) || pointers.size) return;
    const moved = dragged && travelled >= MAX_TAP_TRAVEL;
    if (moved && dragged.anchor !== undefined) predict(false);
    else if (moved) storeShown(dragged.before);
    else if (event.type === "pointerup" && travelled < MAX_TAP_TRAVEL) tap(pixel(event));
    dragged = null;
  };
  target.addEventListener("pointerup", release);
  target.addEventListener("pointercancel", release);
  target.addEventListener("pointerleave", () => text(byId("readout"), ""));
  target.addEventListener("dblclick", () => editor.drawing && finish());
  target.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const at = pixel(event);
      zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), at.x, at.y);
      redraw(true);
    },
    { passive: false },
  );
  target.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (!(editor.drawing ? drawingKey(event) : mapKey(event, fitAll, toggleSpatial))) return;
    event.preventDefault();
    redraw(true);
  });
}

/** Angle by which the 3-D view turns for a pixel, and for a key. */
const TURN = 0.007;
const KEY_TURN = Math.PI / 24;

/** A drag moves the map, or the floor plan while that is being laid; in 3-D it turns the view, with Shift it moves it. */
function drag(dx, dy, shift) {
  if (movingPlan && !picking) movePlan(dx / view.scale, -dy / view.scale);
  else if (view.spatial && !shift) orbit(-TURN * dx, TURN * dy);
  else panByHand(dx, dy);
}

/** Whoever moves the map wants to see something else than the followed tag. */
function panByHand(dx, dy) {
  if (following() !== null) endFollow();
  pan(dx, dy);
}

function pinch(moved, before, at) {
  const other = [...pointers].find(([id]) => id !== moved)[1];
  const apart = Math.hypot(before.x - other.x, before.y - other.y);
  const middle = { x: (at.x + other.x) / 2, y: (at.y + other.y) / 2 };
  if (following() === null) pan((at.x - before.x) / 2, (at.y - before.y) / 2);
  if (apart > 1) zoom(Math.hypot(at.x - other.x, at.y - other.y) / apart, middle.x, middle.y);
  travelled += MAX_TAP_TRAVEL;
}

function tap({ x, y }) {
  const site = toSite(x, y, groundHeight());
  if (picking) return pickAt(site, anchorNear(x, y, 1.5 * HIT));
  if (editor.drawing) {
    const [first] = editor.points;
    if (editor.points.length > 2 && near(px(first[0]), py(first[1]), x, y)) return finish();
    addPoint(site);
    return setCursor(null);
  }
  if (selectPoint(x, y, HIT)) return;
  const tag = drawn.findLast((one) => near(one.x, one.y, x, y));
  if (tag) return select("tag", tag.name);
  const anchor = surveyShown()
    ? anchorNear(x, y, HIT)
    : drawnAnchors.find((one) => near(one.x, one.y, x, y))?.id;
  if (anchor !== undefined) return select("anchor", anchor);
  const zone = state.zones.findLast((one) => inside(one.polygon_m, site[0], site[1]));
  return zone ? select("zone", zone.id) : select(null);
}

/** Give a step of the set-up what it has asked for; a click elsewhere is none. */
function pickAt(site, anchor) {
  if (picking.point) picking.point(site);
  else if (anchor !== undefined) picking.anchor(anchor);
}

function near(x1, y1, x2, y2) {
  return Math.hypot(x1 - x2, y1 - y2) <= HIT;
}

/** The anchor at a pixel, while other places are tried; seen from above only. */
function anchorAt({ x, y }) {
  if (!places || view.spatial) return null;
  const anchor = drawnAnchors.find((one) => near(one.x, one.y, x, y))?.id;
  return anchor === undefined ? null : { anchor };
}

function cornerAt({ x, y }) {
  if (editor.drawing || picking || movingPlan || !isChangeable() || view.spatial) return null;
  const zone = state.zones.find((one) => one.id === state.selection.zone);
  const index = zone?.polygon_m.findIndex(([x_m, y_m]) => near(px(x_m), py(y_m), x, y)) ?? -1;
  return index < 0 ? null : { id: zone.id, index };
}

function hover({ x, y }, type) {
  const [x_m, y_m] = toSite(x, y, groundHeight());
  if (editor.drawing && type === "mouse") setCursor([x_m, y_m]);
  const value = valueAt(x_m, y_m);
  const { data } = state.overlay;
  const overlay = !data ? "" : ` · ${KINDS[data.kind].split(" (")[0]} ${value === null ? "no fix" : writeValue(value)}`;
  const seconds = secondsAt(x_m, y_m);
  const past = seconds === null ? "" : ` · ${seconds ? duration(seconds) : "no tag"}`;
  const where = view.spatial ? " on the ground" : "";
  text(byId("readout"), `x ${metres(x_m)} m · y ${metres(y_m)} m${where}${overlay}${past}`);
}

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

function mapKey(event, fitAll, toggleSpatial) {
  const arrow = ARROWS[event.key];
  const step = event.shiftKey ? 0.02 : 0.2;
  if (event.key === "Escape" && picking) stopPicking();
  else if (arrow && movingPlan) movePlan(step * arrow[0], step * arrow[1]);
  else if (arrow && view.spatial && !event.shiftKey) orbit(KEY_TURN * arrow[0], -KEY_TURN * arrow[1]);
  else if (arrow) panByHand(-60 * arrow[0], 60 * arrow[1]);
  else if (event.key === "+" || event.key === "=") zoom(1.25);
  else if (event.key === "-") zoom(0.8);
  else if (event.key === "0") fitAll();
  else if (event.key === "z" && !view.spatial) begin([view.x_m, view.y_m]);
  else if (event.key === "3") toggleSpatial();
  else if (event.key === "f") toggleFollow();
  else if (event.key === "Escape" && following() !== null) endFollow();
  else if (event.key === "Escape") select(null);
  else return false;
  return true;
}

function drawingKey(event) {
  const arrow = ARROWS[event.key];
  const step = event.shiftKey ? 0.05 : 0.5;
  const at = editor.cursor ?? [view.x_m, view.y_m];
  if (arrow) setCursor([at[0] + step * arrow[0], at[1] + step * arrow[1]]);
  else if (event.key === "Enter" || event.key === " ") enter(at);
  else if (event.key === "f") finish();
  else if (event.key === "Backspace") undoPoint();
  else if (event.key === "Escape") cancel();
  else return false;
  const [x_m, y_m] = editor.cursor ?? at;
  const corners = `${editor.points.length} corner${editor.points.length === 1 ? "" : "s"}`;
  text(byId("announcement"), editor.drawing ? `x ${metres(x_m)}, y ${metres(y_m)}, ${corners}` : "Drawing finished");
  changed("editor");
  return true;
}

function enter(at) {
  const [first] = editor.points;
  const closed = editor.points.length > 2 && Math.hypot(at[0] - first[0], at[1] - first[1]) < 0.03;
  if (closed) finish();
  else addPoint(at);
}
