/**
 * Very many tags: the binary stream `/live2` of a large site (`docs/batches.md`), drawn as points or as counts in cells.
 *
 * Positions are shares of the view that was asked for; kept in metres, they follow a map that is moved meanwhile. Points
 * have the numbers of their tags; the name of one that is clicked is asked for.
 */

import { changed, select, state } from "../store.js";
import { now_s } from "../clock.js";
import { palette } from "../theme.js";
import { colourAt, paintGrid } from "../pictures.js";
import { drawPicture } from "./floor.js";
import { ramp } from "./past.js";
import { toX, toY, view } from "./view.js";

/** So few tags are drawn with names, ellipses and trails instead, from the ordinary stream. */
export const FEW = 400;
/** The view is sent when it has changed, looked at in this interval, and at least in the longer one: pages are alive. */
const LOOK_MS = 100;
const ALIVE_MS = 2000;
const NOT_EXCLUDED = 3;
const OVER_LIMIT = 5;
/** Side of a point, pixels of CSS. */
const SIDE = 4;

/** @type {WebSocket|null} */
let socket = null;
/** The site that it is about. @type {number|null} */
let site = null;
/** The number of a tag that was clicked, until its name is here. @type {number|null} */
let clicked = null;
let asked = "";
let askedMs = 0;
/** The view that is asked for, and the server's time from which messages are of it. */
let box = null;
let since_s = Infinity;

/**
 * Read a message of tags or of counts; null for another one: the anchors come by the other stream. Numbers of 16 bits are
 * packed in pairs as they lie in the message, which is little-endian as every browser's computer is.
 * @param {ArrayBuffer} data
 */
function readMany(data) {
  if (data.byteLength < 12) return null;
  const bytes = new DataView(data);
  const kind = String.fromCharCode(bytes.getUint8(0));
  const count = bytes.getUint16(2, true);
  const time = (at) => Number(bytes.getBigUint64(at, true)) / 1e6;
  const fits = (size) => data.byteLength === size;
  if (kind === "P" && fits(12 + 12 * count)) return { kind, count, unix_s: time(4), words: new Uint32Array(data, 12) };
  if (kind !== "B" || data.byteLength < 16) return null;
  const [columns, rows] = [count, bytes.getUint16(4, true)];
  if (!fits(16 + 2 * columns * rows)) return null;
  const counts = new Uint16Array(data, 16);
  return { kind, columns, rows, unix_s: time(8), cell: bytes.getUint8(1), counts, count: counts.reduce((sum, one) => sum + one, 0) };
}

/** Take a message of the view `seen`, {box, px}, in. */
function receiveMany(data, seen) {
  if (new Uint8Array(data)[0] === 78 /* N */) return receiveNames(JSON.parse(new TextDecoder().decode(data.slice(12))));
  const message = readMany(data);
  if (!seen || !(message?.unix_s >= since_s)) return;
  state.many = { ...message, ...seen };
  changed("tags");
}

/** Select the tag that was clicked; one without a name stays unknown. @param {Record<string, string>} names by number */
function receiveNames(names) {
  if (clicked in names) select("tag", names[clicked]);
  clicked = null;
}

/** Select the tag whose point is nearest to a pixel, if it is within a distance; false where there is none. */
export function selectPoint(x, y, reach) {
  if (!manyShown() || state.many.kind !== "P") return false;
  const { words, box: [x0, y0, x1, y1] } = state.many; // prettier-ignore
  const [left, low] = [toX(x0, y0), toY(x0, y0)];
  const [across, up] = [(toX(x1, y1) - left) / 65535, (toY(x1, y1) - low) / 65535];
  let [nearest, found] = [reach, null];
  for (let at = 0; at < words.length; at += 3) {
    const place = words[at + 1];
    const apart = Math.hypot(left + across * (place & 65535) - x, low + up * (place >>> 16) - y);
    if (apart <= nearest) [nearest, found] = [apart, words[at]];
  }
  clicked = found ?? clicked;
  return found !== null;
}

/** Whether the map draws its tags from this stream. */
export function manyShown() {
  return state.many !== null && state.mode === "live" && !view.spatial && (state.many.kind === "B" || state.many.count > FEW);
}

/** Draw the tags, before all else of their canvas: the picture replaces what is there. */
export function drawMany(context) {
  if (!manyShown()) return;
  if (state.many.kind === "P") drawPoints(context, state.many);
  else drawCounts(context, state.many);
}

let picture = new ImageData(1, 1);

function drawPoints(context, { words, box: [x0, y0, x1, y1] }) {
  const { width, height } = context.canvas;
  if (picture.width !== width || picture.height !== height) picture = new ImageData(width, height);
  const pixels = new Uint32Array(picture.data.buffer);
  pixels.fill(0);
  const { ratio } = view;
  const [left, low] = [ratio * toX(x0, y0), ratio * toY(x0, y0)];
  const [across, up] = [(ratio * toX(x1, y1) - left) / 65535, (ratio * toY(x1, y1) - low) / 65535];
  const side = Math.max(2, Math.round(SIDE * ratio));
  const [fresh, old, bad] = [palette.accent, palette.muted, palette.bad].map(pixelOf);
  const grey = 10 * state.thresholds.fresh_s;
  for (let at = 0; at < words.length; at += 3) {
    const place = words[at + 1];
    const age = (words[at + 2] >>> 16) & 255;
    const alert = words[at + 2] >>> 24;
    const x = (left + across * (place & 65535) - side / 2) | 0;
    const y = (low + up * (place >>> 16) - side / 2) | 0;
    if (x < 0 || y < 0 || x + side > width || y + side > height) continue;
    const colour = age >= grey ? old : alert === NOT_EXCLUDED || alert === OVER_LIMIT ? bad : fresh;
    for (let row = y * width + x, end = row + side * width; row < end; row += width) {
      for (let column = 0; column < side; column++) pixels[row + column] = colour;
    }
  }
  context.putImageData(picture, 0, 0);
}

/** A colour of the palette as a pixel of a picture. */
function pixelOf(colour) {
  const [red, green, blue] = colour.match(/[\d.]+/g).map(Number);
  return ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
}

let cells = { of: null, picture: null };

function drawCounts(context, many) {
  const { columns, rows, cell, counts, box: [x0, y0, x1], px } = many; // prettier-ignore
  if (cells.of !== counts) {
    const most = Math.log1p(counts.reduce((top, one) => Math.max(top, one), 1));
    const colourOf = (count) => (count ? colourAt(Math.log1p(count) / most, ramp()) : null);
    cells = { of: counts, picture: paintGrid(many, counts, colourOf) };
  }
  const side_m = (cell * (x1 - x0)) / px[0];
  context.globalAlpha = 0.9;
  context.imageSmoothingEnabled = false;
  drawPicture(context, cells.picture, x0, y0, columns * side_m, rows * side_m);
  context.globalAlpha = 1;
}

function look() {
  if (!state.live2 || state.connection.phase !== "open" || (socket && site !== state.liveId)) return end();
  if (!socket) return connect();
  const seen = state.mode === "live" ? state.seenBox() : null;
  if (!seen || socket.readyState !== WebSocket.OPEN) return;
  const px = [view.width, view.height].map((value) => Math.max(1, Math.round(value)));
  const words = JSON.stringify({ view: seen, px, named: clicked === null ? [] : [clicked] });
  const now = performance.now();
  if (words === asked && now - askedMs < ALIVE_MS) return;
  if (words !== asked) since_s = now_s() + state.ping.tripMs / 1e3; // until then messages are of the former view
  [asked, askedMs, box] = [words, now, { box: seen, px }];
  socket.send(words);
}

function connect() {
  const address = new URL("live2", document.baseURI);
  site = state.liveId;
  if (site !== null) address.searchParams.set("site", String(site));
  address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
  const mine = (socket = new WebSocket(address));
  mine.binaryType = "arraybuffer";
  mine.onmessage = ({ data }) => mine === socket && receiveMany(data, box);
  mine.onclose = () => mine === socket && setTimeout(() => mine === socket && end(), ALIVE_MS);
}

/** Forget all; the next look connects again where the server has the stream. */
function end() {
  const old = socket;
  [socket, asked, box, since_s] = [null, "", null, Infinity];
  old?.close();
  if (state.many) changed("tags");
  state.many = null;
}

/** Connect where the server says that it has the stream. */
export function start() {
  setInterval(look, LOOK_MS);
}
