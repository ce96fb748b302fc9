/** The map as a picture with its legend, and the positions that the page holds as a table. */

import { state } from "../store.js";
import { now_s, shown_s, tracks } from "../clock.js";
import { byId, toast } from "../dom.js";
import { csvOf, saveFile, utc } from "../files.js";
import { dateTime, length } from "../format.js";
import { labelOf } from "../assets/model.js";
import { colourAt } from "../pictures.js";
import { palette } from "../theme.js";
import { ALERT, ALERTS, HEIGHT_GIVEN, HPL, STD, TIME, X, Y, Z } from "../tracks.js";
import { CONDITIONS, wordsOf } from "./anchors.js";
import { drawMark, tagStyle } from "./marks.js";
import { KINDS, fractionOf, writeValue } from "./overlay.js";
import { visibleTags } from "./tags.js";
import { view } from "./view.js";

const HEAD = 44;
const LINE = 20;
const EDGE = 14;
export const COLUMNS = ["time", "tag", "x_m", "y_m", "z_m", "sigma_m", "level_m", "alert", "height_given"];

/** All positions up to the moment that is shown, as CSV: oldest first for each tag, time in UTC. */
export function positionsCsv(list = tracks().sorted, until_s = shown_s()) {
  return csvOf(COLUMNS, rowsOf(list, until_s));
}

function* rowsOf(list, until_s) {
  const alerts = Object.keys(ALERTS);
  const write = (value, digits) => (Number.isFinite(value) ? value.toFixed(digits) : "");
  for (const track of list) {
    for (let index = 0; index <= track.find(until_s); index++) {
      const at = (column) => track.value(index, column);
      const metres = [write(at(X), 4), write(at(Y), 4), write(at(Z), 4), write(at(STD), 5), write(at(HPL), 4)];
      yield [utc(at(TIME)), track.name, ...metres, alerts[at(ALERT)], at(HEIGHT_GIVEN) === 1 ? "yes" : "no"];
    }
  }
}

/** Save the positions as a file. */
export function savePositions() {
  const table = positionsCsv();
  if (table.indexOf("\n") === table.length - 1) return toast("There are no positions yet.");
  save(new Blob([table], { type: "text/csv" }), "csv");
}

/** Save the map as a picture. */
export function savePicture() {
  mapPicture().toBlob((blob) => blob && save(blob, "png"), "image/png");
}

/** Save a file that is named after the site and the time. */
export function save(blob, ending) {
  saveFile(blob, `skyless-${state.site?.name ?? "site"}-${dateTime(now_s())}.${ending}`);
}

/** The map as it is shown, with site and time above it and the legend below. */
export function mapPicture() {
  const entries = legendEntries();
  const picture = document.createElement("canvas");
  const context = picture.getContext("2d");
  context.font = "12px system-ui, sans-serif";
  const lines = inLines(context, entries);
  const ramp = state.overlay.data ? 3 * LINE : 0;
  const height = HEAD + view.height + EDGE + lines.length * LINE + ramp + EDGE;
  picture.width = Math.round(view.width * view.ratio);
  picture.height = Math.round(height * view.ratio);
  context.scale(view.ratio, view.ratio);
  context.fillStyle = palette.surface;
  context.fillRect(0, 0, view.width, height);
  context.fillStyle = palette.bg;
  context.fillRect(0, HEAD, view.width, view.height);
  for (const id of state.past ? ["still", "moment"] : ["still", "trails", "moving"]) context.drawImage(byId(id), 0, HEAD, view.width, view.height);

  context.fillStyle = palette.text;
  context.textBaseline = "middle";
  context.font = "600 15px system-ui, sans-serif";
  const title = state.site?.name ?? "No site";
  context.fillText(title, EDGE, HEAD / 2);
  const after = EDGE + context.measureText(title).width + 12;
  context.font = "12px system-ui, sans-serif";
  context.fillStyle = palette.muted;
  const { kind, unix_s } = pictured();
  context.fillText(`${dateTime(unix_s)} · ${kind}${state.simulated ? " · simulated" : ""}`, after, HEAD / 2 + 1);

  let y = HEAD + view.height + EDGE + LINE / 2;
  for (const line of lines) {
    for (const { draw, words, x } of line) {
      draw(context, x + 8, y);
      context.fillStyle = palette.text;
      context.fillText(words, x + 20, y);
    }
    y += LINE;
  }
  if (ramp) drawScaleOf(context, state.overlay.data, y);
  return picture;
}

/** Of what the picture is, and of when; without a connection it shows the state at the loss. */
function pictured() {
  if (state.past) return { kind: `the past: ${state.past.title}`, unix_s: state.past.start_unix_s + state.past.at_s };
  if (state.mode === "replay") return { kind: `recording ${state.player?.name ?? ""}`, unix_s: shown_s() };
  const { phase, since } = state.connection;
  if (phase !== "lost") return { kind: "live", unix_s: shown_s() };
  return { kind: "last known state, connection lost", unix_s: now_s() - (performance.now() - since) / 1e3 };
}

/** What the picture shows: tags with their marks, and the conditions of anchors. */
function legendEntries() {
  const list = tracks().sorted;
  const drawn = new Set(visibleTags().seen.map(({ track }) => track.name));
  const tags = list.flatMap((track, index) => {
    if (!drawn.has(track.name)) return [];
    const { colour, shape } = tagStyle(index, list.length, track.name);
    return [{ words: labelOf(track.name), draw: (context, x, y) => drawMark(context, x, y, colour, shape, false) }];
  });
  const anchors = Object.entries(CONDITIONS).map(([kind, { colour, shape }]) => ({
    words: `anchor ${wordsOf(kind)}`,
    draw(context, x, y) {
      const path = new Path2D();
      path.addPath(new Path2D(shape), new DOMMatrix([5, 0, 0, 5, x, y]));
      context.fillStyle = context.strokeStyle = palette[colour];
      context.lineWidth = 2;
      if (kind === "good" || kind === "warn") context.fill(path);
      else context.stroke(path);
    },
  }));
  return [...anchors, ...tags];
}

function inLines(context, entries) {
  const lines = [];
  let x = Infinity;
  for (const entry of entries) {
    const wide = context.measureText(entry.words).width + 38;
    if (x + wide > view.width - EDGE) {
      lines.push([]);
      x = EDGE;
    }
    lines.at(-1).push({ ...entry, x });
    x += wide;
  }
  return lines;
}

function drawScaleOf(context, data, y) {
  const wide = Math.min(320, view.width - 2 * EDGE);
  for (let n = 0; n < wide; n++) {
    context.fillStyle = `rgb(${colourAt(n / (wide - 1), data.scale).join(",")})`;
    context.fillRect(EDGE + n, y + LINE - 8, 1.5, 10);
  }
  context.fillStyle = palette.text;
  context.fillText(`${KINDS[data.kind]}, from ${writeValue(data.least)} to ${writeValue(data.most)}`, EDGE, y);
  context.textAlign = "center";
  for (const tick of data.scale.ticks) {
    const at = EDGE + wide * fractionOf(tick, data.scale);
    context.fillText(data.unit === "m" ? length(tick) : String(tick), at, y + 2 * LINE - 8);
  }
  context.textAlign = "left";
}
