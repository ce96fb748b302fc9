/** Anchors: their health as a colour and a shape, and their marks on the map. */

import { state } from "../store.js";
import { palette } from "../theme.js";
import { px, py } from "./view.js";

/** Older health than this tells nothing. */
const OLD_S = 3.5;
const MARK = 7;

/** What the words mean, for legend and lists. */
export const CONDITIONS = {
  good: { colour: "good", words: "in step" },
  warn: { colour: "warn", words: "not in step" },
  bad: { colour: "bad", words: "not heard of" },
  unknown: { colour: "muted", words: "of unknown health" },
};

/** How an anchor is: good, warn, bad or unknown. A recording tells nothing of it. */
export function condition(id) {
  if (state.mode === "replay") return "unknown";
  const health = state.health.anchors.get(id);
  const status = state.health.nodes.find((node) => node.kind === "anchor" && String(node.name) === String(id));
  if (status && !status.online) return "bad";
  if (!health) return status ? "warn" : "unknown";
  const newest = Math.max(...[...state.health.anchors.values()].map((one) => one.unix_s));
  const age_s = (performance.now() - state.health.atMs) / 1e3 + newest - health.unix_s;
  if (age_s > OLD_S) return "bad";
  return health.synchronised || health.role === "master" ? "good" : "warn";
}

/** Who the master is now: the anchors' word before the site file's. */
export function masterNow() {
  const master = [...state.health.anchors.values()].filter((health) => health.role === "master");
  master.sort((a, b) => b.term - a.term);
  if (state.mode === "live" && master.length && condition(master[0].anchor) !== "bad") return master[0].anchor;
  return state.site?.master ?? null;
}

/** Trace a condition's shape: square, triangle, cross or hollow square. */
export function shape(context, kind, x, y, size) {
  context.beginPath();
  if (kind === "warn") {
    context.moveTo(x, y - size);
    context.lineTo(x + size, y + size * 0.8);
    context.lineTo(x - size, y + size * 0.8);
    context.closePath();
  } else if (kind === "bad") {
    context.moveTo(x - size, y - size);
    context.lineTo(x + size, y + size);
    context.moveTo(x + size, y - size);
    context.lineTo(x - size, y + size);
  } else {
    context.rect(x - size + 1, y - size + 1, 2 * size - 2, 2 * size - 2);
  }
}

/** Draw all anchors; the master has a frame around it, the selected one a ring. */
export function drawAnchors(context) {
  const master = masterNow();
  context.font = "600 11px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "top";
  for (const anchor of state.site?.anchors ?? []) {
    const x = px(anchor.x_m);
    const y = py(anchor.y_m);
    const kind = condition(anchor.id);
    const colour = palette[CONDITIONS[kind].colour];
    mark(context, kind, x, y, colour);
    if (anchor.id === master) {
      context.strokeStyle = colour;
      context.lineWidth = 1.5;
      context.strokeRect(x - MARK - 4.5, y - MARK - 4.5, 2 * MARK + 9, 2 * MARK + 9);
    }
    if (anchor.id === state.selection.anchor) ring(context, x, y, MARK + 9);
    label(
      context,
      anchor.id === master ? `${anchor.id} master` : String(anchor.id),
      x,
      y + MARK + (anchor.id === state.selection.anchor ? 12 : 7),
    );
  }
}

function mark(context, kind, x, y, colour) {
  shape(context, kind, x, y, MARK);
  context.lineJoin = "round";
  if (kind !== "bad") {
    context.fillStyle = kind === "unknown" ? palette.surface : colour;
    context.fill();
  }
  context.strokeStyle = kind === "bad" || kind === "unknown" ? colour : palette.surface;
  context.lineWidth = kind === "bad" ? 3 : 1.5;
  context.stroke();
}

/** Draw the ring of what is selected. */
export function ring(context, x, y, radius) {
  context.strokeStyle = palette.text;
  context.lineWidth = 1.5;
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.stroke();
}

/** Write a label that can be read on anything. */
export function label(context, words, x, y, colour = palette.text) {
  context.lineWidth = 3;
  context.lineJoin = "round";
  context.strokeStyle = palette.bg;
  context.strokeText(words, x, y);
  context.fillStyle = colour;
  context.fillText(words, x, y);
}
