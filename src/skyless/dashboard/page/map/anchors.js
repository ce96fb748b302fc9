/** Anchors: their health as a colour and a shape, and their marks on the map. */

import { s } from "../dom.js";
import { healthAge_s, state } from "../store.js";
import { surveyShown } from "../survey/model.js";
import { palette } from "../theme.js";
import { px, py } from "./view.js";

/** An anchor whose health is older than this is offline. */
const MAX_AGE_S = 3.5;
const MARK = 7;

/** The conditions of anchors: their words, their colours and their shapes, outlines in a square from -1 to 1. */
export const CONDITIONS = {
  good: { colour: "good", words: "synchronised", shape: "M-.86-.86H.86V.86H-.86Z" },
  warn: { colour: "warn", words: "not synchronised", shape: "M0-1 1 .8H-1Z" },
  bad: { colour: "bad", words: "offline", shape: "M-1-1 1 1M1-1-1 1" },
  unknown: { colour: "muted", words: "health unknown", shape: "M-.86-.86H.86V.86H-.86Z" },
};

/** Condition of an anchor: good, warn, bad or unknown, as always in a recording. */
export function condition(id) {
  if (state.mode === "replay") return "unknown";
  const health = state.health.anchors.get(id);
  const status = state.health.nodes.find((node) => node.kind === "anchor" && String(node.name) === String(id));
  if (status && !status.online) return "bad";
  if (!health) return status ? "warn" : "unknown";
  if (healthAge_s("anchors", id) > MAX_AGE_S) return "bad";
  return health.synchronised || health.role === "master" ? "good" : "warn";
}

/** How the site's anchors share the air: master, slots or free. */
export function siteMode() {
  return state.site?.schedule?.mode ?? "master";
}

/** Words for a condition; anchors that send at random instants are synchronised to nothing. */
export function wordsOf(kind) {
  return kind === "good" && siteMode() === "free" ? "on the air" : CONDITIONS[kind].words;
}

/** What the anchor leads: "master" of the site, "root" of a slot time (islands have one each), or "". */
export function leads(id) {
  if (siteMode() === "master") return id === masterNow() ? "master" : "";
  const root = state.mode === "live" && state.health.anchors.get(id)?.role === "root";
  return root && condition(id) !== "bad" ? "root" : "";
}

/** The current master: as the anchors report it, or else as in the site file. */
function masterNow() {
  const master = [...state.health.anchors.values()].filter((health) => health.role === "master");
  master.sort((a, b) => b.term - a.term);
  if (state.mode === "live" && master.length && condition(master[0].anchor) !== "bad") return master[0].anchor;
  return state.site?.master ?? null;
}

/** A condition's mark as a small picture; that of a master or root has a frame. */
export function anchorMark(kind, leading = false) {
  const path = s("path", { d: CONDITIONS[kind].shape, transform: "translate(9 9) scale(5)" });
  const mark = s("svg", { viewBox: "0 0 18 18", class: `mark ${kind}`, "aria-hidden": "true" }, path);
  if (leading) mark.append(s("path", { class: "frame", d: "M1.5 1.5h15v15h-15z" }));
  return mark;
}

/** Draw all anchors, unless the survey's picture shows them; a master or root has a frame around it, the selected one a ring. */
export function drawAnchors(context) {
  if (surveyShown()) return;
  context.font = "600 11px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "top";
  for (const anchor of state.site?.anchors ?? []) {
    const x = px(anchor.x_m);
    const y = py(anchor.y_m);
    const kind = condition(anchor.id);
    const colour = palette[CONDITIONS[kind].colour];
    mark(context, kind, x, y, colour);
    const leading = leads(anchor.id);
    if (leading) {
      context.strokeStyle = colour;
      context.lineWidth = 1.5;
      context.strokeRect(x - MARK - 4.5, y - MARK - 4.5, 2 * MARK + 9, 2 * MARK + 9);
    }
    if (anchor.id === state.selection.anchor) ring(context, x, y, MARK + 9);
    label(
      context,
      leading ? `${anchor.id} ${leading}` : String(anchor.id),
      x,
      y + MARK + (anchor.id === state.selection.anchor ? 12 : 7),
    );
  }
}

function mark(context, kind, x, y, colour) {
  const shape = new Path2D();
  shape.addPath(new Path2D(CONDITIONS[kind].shape), new DOMMatrix([MARK, 0, 0, MARK, x, y]));
  const outlined = kind === "bad" || kind === "unknown";
  context.lineJoin = "round";
  context.fillStyle = kind === "unknown" ? palette.surface : colour;
  if (kind !== "bad") context.fill(shape);
  context.strokeStyle = outlined ? colour : palette.surface;
  context.lineWidth = kind === "bad" ? 3 : 1.5;
  context.stroke(shape);
}

/** Draw the ring around a selected item. */
export function ring(context, x, y, radius) {
  context.strokeStyle = palette.text;
  context.lineWidth = 1.5;
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.stroke();
}

/** Write a label that is legible on any background. */
export function label(context, words, x, y, colour = palette.text) {
  context.lineWidth = 3;
  context.lineJoin = "round";
  context.strokeStyle = palette.bg;
  context.strokeText(words, x, y);
  context.fillStyle = colour;
  context.fillText(words, x, y);
}
