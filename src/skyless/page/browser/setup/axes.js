/** Step 2: which anchor is the origin, which is on the x axis, and which on its left; by clicks or by lists. */

import { state } from "../store.js";
import { h, text, toast } from "../dom.js";
import { sentence } from "../format.js";
import { changeFacts, facts, surveyed } from "../survey/model.js";
import { pickAnchor, stopPicking } from "../survey/picking.js";
import { anchorList } from "./fields.js";

export const title = "Origin and axes";

/** Chosen here while the gauge is not complete. */
let draft = { origin: null, x_axis: null, left: null };
let parts = null;

/** Build the step. */
export function start(body) {
  const origin = anchorList("Origin", "none", (id) => choose({ origin: id }));
  const along = anchorList("On the x axis", "none", (id) => choose({ x_axis: id }));
  const left = anchorList("Left of it (y above 0)", "not known", (id) => choose({ left: id }));
  const pick = h("button", { type: "button", class: "primary", id: "pick-axes", onclick: pickOrigin }, "Click them on the map");
  const mirror = h("button", { type: "button", id: "mirror", onclick: flip }, "Mirror the picture");
  const hint = h("p", { class: "fine" });
  const frame = h("p", { class: "frame" });
  parts = { origin, along, left, pick, mirror, hint, frame };
  const intro = "Three anchors name the axes: x runs from the first through the second, y to the side of the third.";
  const fields = h("div", { class: "fields" }, origin.element, along.element, left.element);
  body.append(h("p", {}, intro), pick, fields, hint, h("div", { class: "above" }, mirror), frame);
}

/** How it stands. */
export function summary() {
  const { gauge, points } = facts();
  if (gauge) return `origin ${gauge.origin}, x axis ${gauge.x_axis}`;
  return Object.keys(points).length > 1 ? "by known points" : "";
}

/** Bring the step up to date. */
export function show() {
  const { gauge } = facts();
  if (gauge) draft = { ...gauge };
  parts.origin.show(draft.origin);
  parts.along.show(draft.x_axis);
  parts.left.show(draft.left);
  parts.pick.disabled = !state.survey?.anchors.length;
  parts.mirror.disabled = !gauge || !state.survey?.survey;
  text(parts.hint, hintWords());
  text(parts.frame, state.survey?.survey ? sentence(state.survey.survey.frame) : "");
}

/** The farthest anchor makes the best x axis: an error across it turns the site least. */
function hintWords() {
  const from = surveyed(draft.origin);
  if (!from || from.x_m === null) return "";
  const others = state.survey.survey.anchors.filter((one) => one.x_m !== null && one.id !== from.id);
  const apart = (one) => Math.hypot(one.x_m - from.x_m, one.y_m - from.y_m);
  const farthest = others.sort((a, b) => apart(b) - apart(a))[0];
  if (!farthest || farthest.id === draft.x_axis) return "";
  return `The farther the better: anchor ${farthest.id} is the farthest from anchor ${from.id}.`;
}

/** Change the choice; the gauge is given once origin and x axis are chosen, and removed when one is not. */
function choose(change) {
  const next = { ...draft, ...change };
  const named = Object.values(next).filter((id) => id !== null);
  if (new Set(named).size < named.length) {
    toast("Origin, x axis and left should be three different anchors.", "bad");
    return show();
  }
  draft = next;
  const gauge = next.origin === null || next.x_axis === null ? null : next;
  if (gauge || facts().gauge) changeFacts({ gauge });
  return show();
}

function pickOrigin() {
  pickAnchor("Click the anchor at the origin.", (origin) => {
    pickAnchor(`Origin: anchor ${origin}. Click an anchor on the x axis, far from it.`, (x_axis) => {
      if (x_axis === origin) return toast("That is the origin; click another anchor.");
      choose({ origin, x_axis, left: null });
      return pickAnchor("Click an anchor on the left when looking along x; Cancel if none is known.", (left) => {
        if (left === origin || left === x_axis) return toast("Click an anchor that is not on the x axis.");
        stopPicking();
        return choose({ left });
      });
    });
  });
}

/** The mirror image is the one with another anchor on the left: one that is on the right now. */
function flip() {
  const { gauge } = facts();
  const placed = state.survey.survey.anchors.filter((one) => one.y_m !== null);
  const right = placed.filter((one) => one.y_m < 0 && one.id !== gauge.origin && one.id !== gauge.x_axis);
  const farthest = right.sort((a, b) => a.y_m - b.y_m)[0];
  if (farthest) return choose({ left: farthest.id });
  // All are on the left. In the mirror image they are on the right, so x has to run the other way to keep y above 0.
  const left = placed.filter((one) => one.y_m > 0).sort((a, b) => b.y_m - a.y_m)[0];
  changeFacts({ gauge: { origin: gauge.x_axis, x_axis: gauge.origin, left: left?.id ?? null } });
  return toast(`Origin and x axis are exchanged: seen from anchor ${gauge.x_axis}, the others are on the left.`);
}
