/**
 * What can be asked of the history. Each kind has `words`, `ask(context)`, which fetches the answer and may show it on
 * the map, and `show(answer, context)`, which returns what the tab shows of it.
 */

import { state } from "../store.js";
import { shownName } from "../assets/model.js";
import { button, h } from "../dom.js";
import { saveCsv, utc } from "../files.js";
import { dateTime, duration, length, number } from "../format.js";
import { seek, showHeat, showWay } from "../player.js";
import { facts } from "./parts.js";

/** Of more rows only the first ones are shown; the file has all. */
const MAX_ROWS = 500;
/** The most cells of a heat map. */
const MAX_CELLS = 40_000;
const CELLS_M = [0.25, 0.5, 1, 2, 5, 10];
const NEAR_M = 2;

export const KINDS = {
  way: { words: "Way of a tag", ask: askWay, show: wayFacts },
  heat: { words: "Heat map", ask: askHeat, show: heatFacts },
  dwell: { words: "Time in zones", ask: async ({ get, tag }) => (await get("dwell", tag && { tag })).dwell, show: dwellTable },
  contacts: { words: "Contacts", ask: askContacts, show: contactsTable },
};

function needsTag(tag, what) {
  if (!tag) throw new Error(`Choose a tag: ${what}.`);
}

/** Nothing was found: of whom, and when. */
function nothing({ title, span }, what) {
  const range = `${dateTime(span.from_unix_s)} to ${dateTime(span.to_unix_s)}`;
  return [h("p", { class: "empty" }, `${what} of ${title} from ${range}.`)];
}

function saveButton(name, heads, rows) {
  return button("Save as CSV", () => saveCsv(name, heads, rows()), { class: "save-csv" });
}

/* The way of a tag. */

async function askWay({ get, tag, title, signal }) {
  needsTag(tag, "the way is that of one tag");
  const track = await get("track", { tag, points: 2000 });
  if (!signal.aborted && track.points.length) showWay(track, title);
  return track;
}

function wayFacts(track, context) {
  const { points } = track;
  if (!points.length) return nothing(context, "There are no positions");
  const list = facts();
  list.show({
    Tag: context.title,
    Length: length(track.length_m),
    Positions: number(track.fixes),
    Shown: track.fixes > points.length ? `${number(points.length)} of them, thinned` : "all",
    First: dateTime(points[0][0]),
    Last: dateTime(points.at(-1)[0]),
  });
  const heads = ["time", "x_m", "y_m", "z_m", "std_m", "hpl_m", "alert"];
  const rows = () => points.map(([unix_s, ...values]) => [utc(unix_s), ...values]);
  const words = "The bar below the map plays it: K, space, J and L on the keyboard. Gaps are not joined, and skipped.";
  return [list.element, h("p", { class: "fine" }, words), saveButton(`way ${track.tag}`, heads, rows)];
}

/* The heat map. */

async function askHeat({ get, tag, title, span, signal }) {
  const anchors = state.site?.anchors ?? [];
  const extent = (key) => Math.max(...anchors.map((one) => one[key])) - Math.min(...anchors.map((one) => one[key]));
  const area = anchors.length ? (extent("x_m") + 4) * (extent("y_m") + 4) : 100;
  const cell_m = CELLS_M.find((value) => area / value ** 2 < MAX_CELLS) ?? CELLS_M.at(-1);
  const map = await get("heatmap", { cell_m, ...(tag && { tag }) });
  if (!signal.aborted && map.seconds.some((value) => value > 0)) showHeat(map, title, span);
  return map;
}

function heatFacts(map, context) {
  const seconds = map.seconds.reduce((sum, value) => sum + value, 0);
  if (!seconds) return nothing(context, "There are no positions");
  const list = facts();
  list.show({
    Tags: number(map.tags),
    "Time of all tags": duration(seconds),
    "Longest in a cell": duration(map.seconds.reduce((most, value) => Math.max(most, value), 0)),
  });
  const corner = (index) => [map.x0_m + (index % map.columns) * map.cell_m, map.y0_m + Math.floor(index / map.columns) * map.cell_m];
  const write = (value) => Number(value.toFixed(4));
  const rows = () => map.seconds.flatMap((value, index) => (value > 0 ? [[...corner(index).map(write), map.cell_m, value]] : []));
  const words = "Point at the map to read a cell's time.";
  return [list.element, h("p", { class: "fine" }, words), saveButton(`heat map ${context.title}`, ["x_m", "y_m", "cell_m", "seconds"], rows)];
}

/* Tables. */

/** A table that is sorted by a click on a head; `columns`: head, value to sort and save by, words or element to show. */
function sortedTable(name, columns, rows, sort, foot = null) {
  const body = h("tbody", {});
  const cell = (column, child) => h("td", { class: column.right ? "right" : "" }, child);
  const heads = columns.map((column, index) => {
    const words = button(column.head, () => order(index), { class: "quiet" });
    return h("th", { scope: "col", class: column.right ? "right" : "" }, words);
  });
  let [by, up] = sort;
  const fill = () => {
    const { value } = columns[by];
    const compare = (a, b) => (typeof a === "string" ? a.localeCompare(b, "en", { numeric: true }) : a - b);
    const sorted = rows.toSorted((a, b) => (up ? 1 : -1) * compare(value(a), value(b)));
    body.replaceChildren(
      ...sorted.slice(0, MAX_ROWS).map((row) => h("tr", {}, ...columns.map((one) => cell(one, (one.show ?? one.value)(row))))),
    );
    heads.forEach((head, index) => (index === by ? head.setAttribute("aria-sort", up ? "ascending" : "descending") : head.removeAttribute("aria-sort")));
  };
  const order = (index) => {
    up = index === by ? !up : !columns[index].right;
    by = index;
    fill();
  };
  fill();
  const end = foot ? h("tfoot", {}, h("tr", {}, ...columns.map((column, index) => cell(column, foot[index] ?? "")))) : null;
  const table = h("table", { class: "results" }, h("thead", {}, h("tr", {}, ...heads)), body, end);
  const count = rows.length > MAX_ROWS ? `The first ${MAX_ROWS} of ${number(rows.length)} rows; the file has all.` : "";
  const csv = columns.map(({ save, head }) => save ?? head.toLowerCase());
  const values = () => rows.map((row) => columns.map((column) => (column.time ? utc(column.value(row)) : column.value(row))));
  return [h("div", { class: "scroll-x" }, table), h("p", { class: "fine" }, count), saveButton(name, csv, values)];
}

function dwellTable(rows, context) {
  if (!rows.length) return nothing(context, "No zone was entered, or there are no positions,");
  const sum = (key) => rows.reduce((total, row) => total + row[key], 0);
  const columns = [
    { head: "Zone", value: (row) => row.zone_name },
    { head: "Tag", value: (row) => row.tag, show: (row) => shownName(row.tag) },
    { head: "Visits", value: (row) => row.visits, right: true },
    { head: "Time", save: "seconds", value: (row) => row.seconds, show: (row) => duration(row.seconds), right: true },
  ];
  return sortedTable("time in zones", columns, rows, [3, false], ["Sum", "", number(sum("visits")), duration(sum("seconds"))]);
}

/* Contacts. */

async function askContacts({ get, tag }) {
  needsTag(tag, "contacts are those of one tag");
  return (await get("contacts", { tag, distance_m: NEAR_M })).contacts;
}

/** A time that shows on the map where a tag was then. */
function placeButton(unix_s, tag, context) {
  const go = async ({ target }) => {
    target.disabled = true;
    try {
      if (state.past?.track?.tag !== tag) await askWay({ ...context, tag, title: shownName(tag) });
      if (!context.signal.aborted) seek(unix_s - state.past?.start_unix_s);
    } catch (error) {
      if (!context.signal.aborted) target.after(h("span", { role: "alert" }, ` ${error.message}`));
    }
    target.disabled = false;
  };
  const words = dateTime(unix_s);
  return button(words, go, { class: "name", "aria-label": `${words}: show where ${tag} was` });
}

function contactsTable(rows, context) {
  if (!rows.length) return nothing(context, `No other tag was within ${NEAR_M} m`);
  const columns = [
    { head: "Begin", save: "begin", value: (row) => row.begin_unix_s, time: true, show: (row) => placeButton(row.begin_unix_s, row.tag, context) },
    { head: "Other tag", save: "other", value: (row) => row.other, show: (row) => shownName(row.other) },
    { head: "Time", save: "seconds", value: (row) => row.end_unix_s - row.begin_unix_s, show: (row) => duration(row.end_unix_s - row.begin_unix_s, 1), right: true },
    { head: "Nearest", save: "least_m", value: (row) => row.least_m, show: (row) => length(row.least_m), right: true },
  ]; // prettier-ignore
  const words = `Other tags within ${NEAR_M} m of ${context.title}. A click on the time shows the place.`;
  return [h("p", { class: "fine" }, words), ...sortedTable(`contacts ${context.tag}`, columns, rows, [0, true])];
}
