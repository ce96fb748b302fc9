/** All tags as a list; the selected one in detail, with its last minute as charts. */

import { changed, reports, state } from "../store.js";
import { editAssets } from "../assets/editor.js";
import { allGroups, labelOf, shownName } from "../assets/model.js";
import { freshness, now_s, shown_s, tracks } from "../clock.js";
import { Chart } from "../chart.js";
import { h, offer, options, text } from "../dom.js";
import { DASH, bytes, duration, length, metres, number } from "../format.js";
import { tagHistory } from "../history.js";
import { filtering, passes } from "../map/filter.js";
import { floorNameAt, floors } from "../map/floors.js";
import { tagMark, tagStyle } from "../map/marks.js";
import { inside } from "../map/zones.js";
import {
  ALERT,
  ALERTS,
  ANCHORS,
  CHI2,
  COLUMNS,
  ERROR,
  HEIGHT_GIVEN,
  HPL,
  STD,
  STD_Z,
  TIME,
  UNVERIFIED,
  VERIFIED_AGE,
  VX,
  VY,
  X,
  Y,
  Z,
} from "../tracks.js";
import { clockWords, faultWords, isUnverified, verifiedWords } from "./codes.js";
import { facts, selectionTable, split } from "./parts.js";

export const title = "Tags";
export const topics = ["tags", "health", "selection", "mode", "player", "theme", "site", "assets", "zones"];
export const interval_ms = 300;
export const changesWithTime = true;

const MARKS = { fresh: "●", late: "○", asleep: "☾", gone: "✕", never: "–" };
const WORDS = {
  fresh: "has a fix",
  late: "its fix is older than usual",
  asleep: "asleep",
  gone: "gone",
  never: "no fix yet",
};
/** The columns after the name, and what they mean. */
const HEADS = {
  "x (m)": "Position along x",
  "y (m)": "Position along y",
  "z (m)": "Height; in brackets where it was given and not estimated",
  σ: "Predicted standard deviation of the position",
  Error: "Distance to the true position, where it is known",
  "Rate (Hz)": "Fixes in the last second",
  "Speed (m/s)": "Horizontal speed",
  Level: "Protection level: the horizontal error is larger with at most the configured probability",
  Alert: "Integrity alert",
  Age: "Time since the last fix",
  Latency: "From the end of a frame to its fix, half of them",
  Method: "How positions are computed",
  Floor: "The floor that its height says",
};
/** With more tags than this, or with assets, there is a search field and a choice of groups and zones. */
const SEARCHED = 12;
/** With more tags than this the table is brought up to date less often: laying it out costs as much as a frame. */
const MANY = 40;
const MANY_MS = 900;
const WINDOW_S = 60;
const row = new Float64Array(COLUMNS);
const byName = new Intl.Collator("en", { numeric: true }).compare;
let parts = null;
let shown = { key: "", at: -Infinity };

/** Build the tab. */
export function start(panel) {
  const search = h("input", { type: "search", placeholder: "Find a tag", "aria-label": "Find a tag", maxLength: 100, oninput: choose });
  const group = options({ "aria-label": "Group" }, [], choose);
  const zone = options({ "aria-label": "Zone" }, [], choose);
  const all = h("button", { type: "button", class: "quiet", onclick: showAll }, "Show all");
  const filter = h("div", { class: "above filter" }, search, group, zone);
  const edit = h("button", { type: "button", id: "edit-assets", onclick: () => editAssets() }, "Assets …");
  const table = selectionTable("tag", ["Tag", ...Object.keys(HEADS)], describe);
  Object.values(HEADS).forEach((words, index) => (table.head.cells[index + 2].title = words));
  const empty = h("p", { class: "empty" });
  const count = h("p", { class: "count" });
  const box = h("div", { class: "scroll-x" }, table.element);
  const detail = makeDetail();
  panel.append(h("div", { class: "above" }, count, all, edit), filter, empty, box, detail.element);
  parts = { panel, box, search, group, zone, all, filter, edit, table, empty, count, detail };
}

/** Take over the filter that the user has set. */
function choose() {
  state.find = parts.search.value.trim().toLowerCase();
  state.filter = { group: parts.group.value, zone: parts.zone.value };
  changed("tags");
  show();
}

function showAll() {
  for (const part of [parts.search, parts.group, parts.zone]) part.value = "";
  choose();
}

/** Bring the tab up to date. */
export function show() {
  const list = tracks().sorted;
  const all = state.mode === "live" && state.part ? state.part.of : list.length;
  const offered = all > SEARCHED || state.assets.size > 0;
  if (!offered) parts.search.value = state.find = state.filter.group = state.filter.zone = "";
  if (state.filter.zone && !state.zones.some(({ id }) => id === state.filter.zone)) state.filter.zone = "";
  offer(parts.group, [["", "All groups"], ...[...allGroups().keys()].map((name) => [name, name])], state.filter.group);
  offer(parts.zone, [["", "All zones"], ...state.zones.map(({ id, name }) => [id, name])], state.filter.zone);
  for (const list of [parts.group, parts.zone]) list.hidden = list.length < 2;
  parts.edit.disabled = state.mode !== "live" || !state.site;
  parts.filter.hidden = !offered;
  parts.all.hidden = !filtering();
  const key = JSON.stringify([state.mode, state.selection.tag, state.find, state.filter, list.length]);
  const now = performance.now();
  if (list.length > MANY && key === shown.key && now - shown.at < MANY_MS) return;
  shown = { key, at: now };
  parts.table.element.classList.toggle("no-truth", !state.simulated);
  parts.table.element.classList.toggle("no-floors", floors().length < 2);
  parts.table.element.classList.toggle("named", state.assets.size > 0);
  const items = list.map((track, index) => [track.name, { track, style: tagStyle(index, list.length, track.name) }]);
  const found = filtering() ? items.filter(([name, { track }]) => passes(name, stateOf(track))) : items;
  if (state.assets.size) found.sort(([a], [b]) => byName(shownName(a), shownName(b)));
  parts.table.rows.show(found);
  parts.table.element.hidden = !found.length;
  parts.empty.hidden = found.length > 0;
  text(parts.empty, list.length ? "No tag is found." : "No tags yet.");
  const fresh = list.filter((track) => freshness(track) === "fresh").length;
  text(parts.count, countWords(fresh, list.length, all, filtering() ? found.length : null));
  parts.detail.show(tracks().all.get(state.selection.tag) ?? null);
  split(parts.panel, parts.box, !parts.detail.element.hidden);
}

/** How many tags have a fix; of a large site also that only a part of them is listed. */
function countWords(fresh, listed, all, found) {
  if (!listed && !all) return "";
  if (found !== null && listed >= all) return `${found} of ${listed} tags found`;
  if (listed >= all) return `${fresh} of ${listed} with a fix`;
  return `${number(listed)} of ${number(all)} tags: those on the map, ${number(fresh)} with a fix. Find others by name.`;
}

/** State of a track at the moment that is shown; NaN where there is none. */
function stateOf(track) {
  if (!track.at(shown_s(), row, false)) row.fill(NaN);
  return row;
}

function describe(name, { track, style: look }) {
  const condition = freshness(track);
  stateOf(track);
  const health = state.mode === "live" && reports("tags", name) ? state.health.tags.get(name) : null;
  const alert = Object.values(ALERTS)[row[ALERT]];
  const unverified = isUnverified(health);
  return {
    condition: alert?.grade ? `${condition} alert-${alert.grade}` : condition,
    words: [WORDS[condition], unverified && "not verified", alert?.grade && alert.words].filter(Boolean).join(", "),
    key: `${condition} ${unverified} ${row[ALERT]} ${look.colour} ${look.shape}`,
    mark: () => (condition === "fresh" ? tagMark(look) : h("span", { "aria-hidden": "true" }, MARKS[condition])),
    name: unverified ? `${labelOf(name)} not verified` : labelOf(name),
    figures: [
      metres(row[X]),
      metres(row[Y]),
      row[HEIGHT_GIVEN] ? `(${metres(row[Z])})` : metres(row[Z]),
      length(row[STD]),
      length(row[ERROR]),
      number(health?.updates_per_s),
      metres(Math.hypot(row[VX], row[VY])),
      length(row[HPL]),
      alert?.short ?? DASH,
      duration(age_s(track), 1),
      duration(health?.latency_p50_s),
      health ? methodWords(health) : DASH,
      floorNameAt(row[Z]) || DASH,
    ],
  };
}

/** Time since the last fix at the moment that is shown. */
function age_s(track) {
  if (state.mode === "live") return Math.max(now_s() - track.lastTime, 0);
  return row[TIME] > 0 ? Math.max(shown_s() - row[TIME], 0) : NaN;
}

function makeDetail() {
  const heading = h("h2", {});
  const reason = h("p", { class: "reason", hidden: true });
  const edit = h("button", { type: "button", class: "quiet changes", onclick: () => editAssets(state.selection.tag) }, "Edit");
  const list = facts();
  const sigma = { name: "σ", colour: "accent" };
  const errors = new Chart("Error and predicted σ", [{ name: "error", colour: "bad" }, sigma], length, 0.02);
  const sigmas = new Chart("Predicted σ", [sigma], length, 0.02);
  const rates = new Chart("Rate of fixes (Hz)", [{ name: "rate", colour: "good", steps: true }], number, 4);
  const anchors = { name: "anchors", colour: "accent", steps: true };
  const used = new Chart("Anchors used", [anchors], number, 4, { whole: true });
  const chi2 = new Chart("Residuals (χ² of each fix)", [{ name: "χ²", colour: "warn" }], (v) => number(v, 1), 1);
  const element = h(
    "section",
    { class: "detail", "aria-label": "Selected tag", tabindex: "0", hidden: true },
    h("div", { class: "detail-head" }, heading, edit),
    reason,
    list.element,
    ...[errors, sigmas, rates, used, chi2].map((chart) => chart.element),
    h("p", { class: "fine" }, `Charts: the last ${WINDOW_S} s.`),
  );

  const showCharts = (track) => {
    const now = shown_s();
    const columns = lastMinute(track, now);
    const truth = columns[ERROR].some((value) => value !== null);
    errors.element.hidden = !truth;
    sigmas.element.hidden = truth;
    if (truth) errors.show([columns[TIME], columns[ERROR], columns[STD]], WINDOW_S);
    else sigmas.show([columns[TIME], columns[STD]], WINDOW_S);
    used.show([columns[TIME], columns[ANCHORS]], WINDOW_S);
    chi2.show([columns[TIME], columns[CHI2]], WINDOW_S);
    const past = state.mode === "live" ? tagHistory.get(track.name) : null;
    rates.element.hidden = !past;
    if (past) rates.show([past.time.map((time) => time - now), past.rate], WINDOW_S);
  };

  /** @param {import("../tracks.js").Track|null} track */
  const showDetail = (track) => {
    element.hidden = !track;
    if (!track) return;
    const health = state.mode === "live" && reports("tags", track.name) ? state.health.tags.get(track.name) : null;
    text(heading, labelOf(track.name));
    edit.hidden = state.mode !== "live";
    reason.hidden = !health?.reason;
    text(reason, health?.reason ? `No fix: ${health.reason.replaceAll("-", " ")}` : "");
    const known = track.at(shown_s(), row, false);
    if (!known) row.fill(NaN);
    const verified = verifiedWords(health, row[VERIFIED_AGE] + age_s(track), row[UNVERIFIED]);
    const alert = known && Object.values(ALERTS)[row[ALERT]];
    list.show(
      {
        ...assetFacts(track.name),
        ...(known ? fixFacts(track, alert) : {}),
        Verified: verified?.words,
        ...(health ? healthFacts(health) : {}),
      },
      { "Integrity alert": alert?.grade, Verified: verified?.grade, "Not accepted": "bad", Clock: "bad" },
    );
    showCharts(track);
  };
  return { element, show: showDetail };
}

/** What a tag is attached to, and the zones that it is in. */
function assetFacts(tag) {
  const { name, group, owner, notes } = state.assets.get(tag) ?? {};
  const zones = state.zones.filter(({ polygon_m }) => inside(polygon_m, row[X], row[Y])).map((zone) => zone.name);
  return { Tag: name ? tag : null, Group: group || null, Owner: owner || null, Notes: notes || null, Zones: zones.join(", ") || null };
}

/** What `row` holds, the state of a track. */
function fixFacts(track, alert) {
  const speed = Math.hypot(row[VX], row[VY]);
  const height = `${metres(row[Z], 2)} m`;
  return {
    Position: `${metres(row[X], 3)}, ${metres(row[Y], 3)} m`,
    Height: row[HEIGHT_GIVEN] ? `${height} given, not estimated` : `${height}, σ ${length(row[STD_Z])}`,
    Velocity: speed >= 0 ? `${metres(row[VX])}, ${metres(row[VY])} m/s; speed ${speed.toFixed(2)} m/s` : null,
    "Predicted σ": length(row[STD]),
    Error: row[ERROR] >= 0 ? length(row[ERROR]) : null,
    "Age of the fix": duration(age_s(track), 1),
    "Anchors used": number(row[ANCHORS]),
    "Protection level": row[HPL] >= 0 ? length(row[HPL]) : null,
    "Integrity alert": alert?.words,
  };
}

/** How positions are computed, and where that is not the tag's program. */
function methodWords({ method, on_board }) {
  return on_board ? `${method}, on its board${state.simulated ? " (emulated)" : ""}` : method;
}

function phaseWords({ carrier_phase_anchors: anchors, carrier_phase_hypotheses: left }) {
  if (!anchors?.length) return null;
  const state = left > 1 ? `, locking (${left} left)` : left === 1 ? ", locked" : "";
  return `of anchors ${anchors.join(", ")}${state}`;
}

function healthFacts(health) {
  const { updates_per_s, first_fix_s, latency_p50_s, latency_p99_s, counters, cpu, memory_bytes } = health;
  const dropped = Object.entries(counters).filter(([, count]) => count);
  return {
    "Not accepted": faultWords(health.faults),
    Clock: clockWords(health),
    Rate: number(updates_per_s, 0, "Hz"),
    "Time to first fix": first_fix_s == null ? null : duration(first_fix_s),
    Latency: latency_p50_s == null ? null : `${duration(latency_p50_s)}, p99 ${duration(latency_p99_s)}`,
    Method: methodWords(health),
    "Carrier phases": phaseWords(health),
    Dropped: dropped.map(([name, count]) => `${count} ${name}`).join(", ") || "none",
    CPU: `${(100 * cpu).toFixed(1)} %`,
    Memory: bytes(memory_bytes),
  };
}

/** The charts' columns of the last minute; a gap of more than a second is shown as one. */
function lastMinute(track, now) {
  const columns = { [TIME]: [], [ERROR]: [], [STD]: [], [ANCHORS]: [], [CHI2]: [] };
  const wanted = [ERROR, STD, ANCHORS, CHI2];
  const first = Math.max(track.find(now - WINDOW_S), 0);
  const last = track.find(now);
  let before = NaN;
  for (let index = first; index <= last; index++) {
    const time = track.value(index, TIME) - now;
    if (time - before > 1) {
      columns[TIME].push(before + 0.01);
      for (const column of wanted) columns[column].push(null);
    }
    columns[TIME].push(time);
    for (const column of wanted) {
      const value = track.value(index, column);
      columns[column].push(Number.isNaN(value) ? null : value);
    }
    before = time;
  }
  return columns;
}
