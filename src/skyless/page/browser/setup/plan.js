/** Step 4: an image of the floor under the picture, dragged, scaled by two points, or placed by figures. */

import { changed, state } from "../store.js";
import { h, text, toast } from "../dom.js";
import { metres } from "../format.js";
import { floor } from "../map/floor.js";
import { fitAll } from "../map/map.js";
import { pixelOf, surveyCorners } from "../map/survey.js";
import { toSite } from "../map/view.js";
import { pickAnchor, pickPoint, picking, stopPicking } from "../survey/picking.js";
import * as laid from "../survey/plan.js";
import { COORDINATE, DISTANCE, lengthField } from "./fields.js";

export const title = "Floor plan";

/** A notice says that the plan is turned when its two points are turned by more than this. */
const TURNED_DEG = 3;
/** Two points of the image must be apart, or clicking them accurately is not possible. */
const MIN_M = 0.05;

/** Two points of the image in site coordinates, while the plan is being scaled. @type {number[][]} */
let points = [];
let parts = null;

/** Build the step. */
export function start(body) {
  const file = h("input", { type: "file", accept: "image/png,image/jpeg", id: "plan-file" });
  file.addEventListener("change", () => open(file));
  const fault = h("p", { class: "fault", role: "alert", id: "plan-fault", hidden: true });
  const present = h("button", { type: "button", onclick: () => laid.beginWithPresent(floor) }, "Move the present plan");
  const drag = h("button", { type: "button", id: "plan-move", "aria-pressed": "false" }, "Move it on the map");
  drag.addEventListener("click", () => (stopPicking(), laid.setMoving(!laid.moving)));
  const scale = h("button", { type: "button", id: "plan-scale", onclick: pickFirst }, "Scale it by two points");
  const drop = h("button", { type: "button", class: "quiet", onclick: discard }, "Do without it");
  const distance = lengthField({ label: "Distance between the two points", limits: DISTANCE, optional: false });
  const apply = h("button", { type: "submit", class: "primary" }, "Scale");
  const anchors = h("button", { type: "button", onclick: pickTargets }, "They are at two anchors");
  const finish = h("form", { class: "fields", id: "plan-distance", hidden: true }, distance.element, apply, anchors);
  finish.addEventListener("submit", (event) => {
    event.preventDefault();
    const value = distance.read();
    if (value === undefined) return;
    laid.scaleTo(points[0], points[1], value);
    distance.clear();
    done();
  });
  const place = {
    x_m: lengthField({ label: "Left edge, x", limits: COORDINATE, optional: false, apply: (x_m) => laid.place({ x_m }) }),
    y_m: lengthField({ label: "Lower edge, y", limits: COORDINATE, optional: false, apply: (y_m) => laid.place({ y_m }) }),
    width_m: lengthField({ label: "Width", limits: [0.1, 10_000], optional: false, apply: (width_m) => laid.place({ width_m }) }),
  };
  const figures = h("div", { class: "fields", id: "plan-figures" }, ...Object.values(place).map((field) => field.element));
  const turned = h("p", { class: "reason", id: "plan-turned", hidden: true });
  const tools = h("div", { class: "plan-tools" }, h("div", { class: "above" }, drag, scale, drop), finish, turned, figures);
  const intro = "A PNG or JPEG of the floor, up to 8 MB, with its edges along the axes. It is stored when you save.";
  body.append(h("p", {}, intro), h("label", { class: "field file" }, h("span", {}, "Image"), file), fault, present, tools);
  parts = { file, fault, present, drag, finish, distance, place, tools, turned };
}

/** How it stands. */
export function summary() {
  if (laid.plan) return laid.plan.blob ? "not saved yet" : `${metres(laid.plan.width_m, 1)} m wide`;
  return floor ? "as before" : "";
}

/** Bring the step up to date. */
export function show() {
  const { plan, moving } = laid;
  parts.tools.hidden = plan === null;
  parts.present.hidden = plan !== null || floor === null;
  parts.drag.setAttribute("aria-pressed", String(moving));
  parts.finish.hidden = points.length < 2 || plan === null;
  for (const [key, field] of Object.entries(parts.place)) field.show(plan?.[key] ?? null);
  if (!picking && points.length === 1) points = [];
}

async function open(file) {
  const chosen = file.files[0];
  if (!chosen) return;
  parts.fault.hidden = true;
  try {
    const image = await laid.readImage(chosen);
    laid.begin(image, chosen, chosen.name, box());
    laid.setMoving(true);
    fitAll();
  } catch (error) {
    text(parts.fault, error.message);
    parts.fault.hidden = false;
  }
  file.value = ""; // the same file may be chosen again
}

/** The box around the survey's picture, or else around the anchors of the site file: left, lower, right, upper edge. */
function box() {
  const corners = surveyCorners();
  const anchors = (state.site?.anchors ?? []).map(({ x_m, y_m }) => [x_m, y_m]);
  const covered = corners.length > 1 ? corners : anchors;
  if (!covered.length) return [0, 0, 10, 10];
  const [xs, ys] = [0, 1].map((axis) => covered.map((point) => point[axis]));
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}

function pickFirst() {
  laid.setMoving(false);
  points = [];
  parts.turned.hidden = true;
  pickPoint("Click a point of the plan whose distance to another you know.", (first) => {
    points = [first];
    pickPoint("Click the other point, far from the first.", (second) => {
      if (Math.hypot(second[0] - first[0], second[1] - first[1]) < MIN_M) return toast("That is the same point.");
      points = [first, second];
      stopPicking();
      return changed("plan");
    });
  });
}

/** The two points of the image belong to two anchors. */
function pickTargets() {
  pickAnchor("Click the anchor at the first point.", (first) =>
    pickAnchor(`First point: anchor ${first}. Click the anchor at the second point.`, (second) => {
      if (first === second) return toast("That is the same anchor.");
      const [from, to] = [first, second].map((id) => pixelOf(id)).map(({ x, y }) => toSite(x, y));
      const turned = laid.fitToPoints(points[0], points[1], from, to);
      parts.turned.hidden = Math.abs(turned) <= TURNED_DEG;
      const words = `The plan is turned by ${Math.abs(turned).toFixed(0)}° against the axes: choose an x axis along its lower edge, or turn the image.`;
      text(parts.turned, words);
      return done();
    }),
  );
}

function done() {
  points = [];
  stopPicking();
  changed("plan");
  fitAll();
}

function discard() {
  points = [];
  stopPicking();
  laid.discard();
}
