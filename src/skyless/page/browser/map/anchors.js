/** Anchors: their health as a colour and a shape, and their marks on the map. */

import { s } from "../dom.js";
import { anchorName, on, state } from "../store.js";
import { surveyShown } from "../survey/model.js";
import { palette } from "../theme.js";
import { groundHeight, otherFloor } from "./floors.js";
import { boxOf, label, still } from "./names.js";
import { placed } from "./places.js";
import { isSeen, toX, toY, view } from "./view.js";

const MARK = 7;
/** Height of a name, and with more names than this they are written only where they fit. */
const NAME = 18;
const CROWDED = 200;
/** Names of anchors that are closer than half of this would be in each other's way. */
const ROOM = 50;
/** Marks that touch are drawn this much smaller. */
const SMALL = 0.5;
/** A point of each cell of the grid that may hold something nearer than its size. */
const AROUND = [0, -MARK, MARK].flatMap((right) => [0, -MARK, MARK].map((down) => [right, down]));
/** Half of a sprite's side, and the sprites by their look: a path costs ten times as much. */
const HALF = 10;
/** @type {Map<string, HTMLCanvasElement>} */
const sprites = new Map();
on(["theme"], () => sprites.clear());
/** Opacity of what is on another floor than the chosen one. */
export const DIMMED = 0.22;

/** The conditions of anchors: their words, their colours and their shapes, outlines in a square from -1 to 1. */
export const CONDITIONS = {
  good: { colour: "good", words: "synchronised", shape: "M-.86-.86H.86V.86H-.86Z" },
  warn: { colour: "warn", words: "not synchronised", shape: "M0-1 1 .8H-1Z" },
  bad: { colour: "bad", words: "offline", shape: "M-1-1 1 1M1-1-1 1" },
  unknown: { colour: "muted", words: "health unknown", shape: "M-.86-.86H.86V.86H-.86Z" },
};

/** Condition of an anchor as the server finds it: good, warn, bad or unknown, as in a recording and without a connection. */
export function condition(id) {
  if (state.mode === "replay" || state.connection.phase === "lost") return "unknown";
  return state.health.conditions.get(id) ?? "unknown";
}

/** How the site's anchors share the air: master, or free as in all systems but the paper's. */
export function siteMode() {
  return state.site?.system ? "free" : (state.site?.schedule?.mode ?? "master");
}

/** Words for a condition; anchors that send at random instants are synchronised to nothing. */
export function wordsOf(kind) {
  return kind === "good" && siteMode() === "free" ? "on the air" : CONDITIONS[kind].words;
}

/** "master" for the master of a site that has one, "" for other anchors; `master` if known. */
export function leads(id, master = undefined) {
  return siteMode() === "master" && id === (master ?? masterNow()) ? "master" : "";
}

/** The current master: as the anchors report it, or else as in the site file. */
function masterNow() {
  const master = [...state.health.anchors.values()].filter((health) => health.role === "master");
  master.sort((a, b) => b.term - a.term);
  if (state.mode === "live" && master.length && condition(master[0].anchor) !== "bad") return master[0].anchor;
  return state.site?.master ?? null;
}

/** A condition's mark as a small picture; that of a master has a frame. */
export function anchorMark(kind, leading = false) {
  const path = s("path", { d: CONDITIONS[kind].shape, transform: "translate(9 9) scale(5)" });
  const mark = s("svg", { viewBox: "0 0 18 18", class: `mark ${kind}`, "aria-hidden": "true" }, path);
  if (leading) mark.append(s("path", { class: "frame", d: "M1.5 1.5h15v15h-15z" }));
  return mark;
}

/** The anchors as drawn last, for the pointer and for names that avoid them. @type {Array<{id: number, x: number, y: number}>} */
export let drawnAnchors = [];

/** Draw all anchors, unless the survey's picture shows them; a master has a frame around it, the selected one a ring. */
export function drawAnchors(context) {
  drawnAnchors = [];
  still.length = 0;
  if (surveyShown()) return;
  const other = otherFloor();
  context.font = "600 11px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "top";
  const names = [];
  const master = masterNow();
  const seen = [];
  for (const own of state.site?.anchors ?? []) {
    const anchor = placed(own);
    if (anchor !== own) ghost(context, own);
    const x = toX(anchor.x_m, anchor.y_m);
    const y = toY(anchor.x_m, anchor.y_m, anchor.z_m);
    if (!isSeen(x, y) && !view.spatial) continue;
    drawnAnchors.push({ id: anchor.id, x, y });
    seen.push({ anchor, x, y });
  }
  const small = crowded(NAME);
  for (const { anchor, x, y } of seen) {
    const alpha = other(anchor.z_m, anchor.floor ?? 0) ? DIMMED : 1;
    context.globalAlpha = alpha;
    if (view.spatial) dropLine(context, anchor.x_m, anchor.y_m, y, palette.muted);
    const kind = condition(anchor.id);
    const colour = palette[CONDITIONS[kind].colour];
    if (small && kind === "good") drawDot(context, x, y, colour);
    else drawSprite(context, kind, x, y, colour, small ? SMALL * HALF : HALF);
    const leading = leads(anchor.id, master);
    if (leading) {
      context.strokeStyle = colour;
      context.lineWidth = 1.5;
      context.strokeRect(x - MARK - 4.5, y - MARK - 4.5, 2 * MARK + 9, 2 * MARK + 9);
    }
    if (anchor.id === state.selection.anchor) ring(context, x, y, MARK + 9);
    const words = leading ? `${anchorName(anchor.id)} ${leading}` : anchorName(anchor.id);
    const height = view.spatial ? ` · ${Number(anchor.z_m.toFixed(2))} m` : "";
    const chosen = anchor.id === state.selection.anchor;
    names.push({ words: words + height, x, y, alpha, below: chosen ? 12 : 7, leading: chosen || leading !== "" });
  }
  const lines = joined(crowded(ROOM) ? names.filter(({ leading }) => leading) : names);
  const shown = lines.length > CROWDED ? lines.filter(fits()) : lines;
  for (const { words, x, y, alpha, below } of shown) {
    context.globalAlpha = alpha;
    label(context, words, x, y + MARK + below);
    still.push(boxOf(context, words, x, y + MARK + below));
  }
  context.globalAlpha = 1;
  still.push(...drawnAnchors.map(({ x, y }) => [x - 8, y - 8, x + 8, y + 8]));
}

/** Where an anchor is, while it is shown at a place that is tried. */
function ghost(context, { x_m, y_m, z_m }) {
  context.strokeStyle = palette.muted;
  context.lineWidth = 1.5;
  context.setLineDash([2, 3]);
  context.beginPath();
  context.arc(toX(x_m, y_m), toY(x_m, y_m, z_m), MARK, 0, 2 * Math.PI);
  context.stroke();
  context.setLineDash([]);
}

/** Whether there are many marks, and more than two in each cell of this size. */
function crowded(size) {
  if (drawnAnchors.length < CROWDED) return false;
  return new Set(drawnAnchors.map(({ x, y }) => cellOf(x, y, size))).size < drawnAnchors.length / 2;
}

/** A test for each name in turn whether it has room between the marks and the names before it, by cells of a grid. */
function fits() {
  const cells = new Set(drawnAnchors.map(({ x, y }) => cellOf(x, y, NAME)));
  return ({ words, x, y, leading }) => {
    const at = cellOf(x, y + MARK + NAME, NAME);
    const beside = words.length > 4 ? cellOf(x + NAME, y + MARK + NAME, NAME) : at;
    if (!leading && (cells.has(at) || cells.has(beside))) return false;
    cells.add(at).add(beside);
    return true;
  };
}

function cellOf(x, y, size) {
  return `${Math.floor(x / size)} ${Math.floor(y / size)}`;
}

/** One line of names for anchors above each other, of the chosen floor where one of them is on it. */
function joined(names) {
  const lines = [];
  const cells = new Map();
  for (const name of names.toSorted((a, b) => b.alpha - a.alpha)) {
    const near = AROUND.flatMap(([right, down]) => cells.get(cellOf(name.x + right, name.y + down, MARK)) ?? []);
    const line = near.find(({ x, y }) => Math.hypot(x - name.x, y - name.y) < MARK);
    if (!line) {
      const made = { ...name };
      lines.push(made);
      const cell = cellOf(name.x, name.y, MARK);
      cells.has(cell) ? cells.get(cell).push(made) : cells.set(cell, [made]);
    } else if (line.alpha === name.alpha) {
      line.words += `, ${name.words}`;
      line.below = Math.max(line.below, name.below);
    }
  }
  return lines;
}

/** In the 3-D view, the line from something straight down to the ground. */
export function dropLine(context, x_m, y_m, y, colour) {
  const x = toX(x_m, y_m);
  const ground = toY(x_m, y_m, groundHeight());
  context.strokeStyle = colour;
  context.lineWidth = 1;
  context.setLineDash([2, 3]);
  context.beginPath();
  context.moveTo(x, y);
  context.lineTo(x, ground);
  context.stroke();
  context.setLineDash([]);
  context.fillStyle = colour;
  context.fillRect(x - 1.5, ground - 1, 3, 2);
}

/** A small mark of an anchor that is well: a sixth of a sprite's time. */
function drawDot(context, x, y, colour) {
  if (context.fillStyle !== colour) context.fillStyle = colour;
  context.fillRect(x - 2, y - 2, 4, 4);
}

function drawSprite(context, kind, x, y, colour, half) {
  const key = `${kind} ${view.ratio}`;
  let sprite = sprites.get(key);
  if (!sprite) {
    sprite = document.createElement("canvas");
    sprite.width = sprite.height = Math.ceil(2 * HALF * view.ratio);
    const painted = sprite.getContext("2d");
    painted.scale(view.ratio, view.ratio);
    mark(painted, kind, HALF, HALF, colour);
    sprites.set(key, sprite);
  }
  context.drawImage(sprite, x - half, y - half, 2 * half, 2 * half);
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
