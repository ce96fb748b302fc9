/** Anchors and their clocks as a list; the selected one in detail; and the other programs of the site. */

import { anchorName, healthAge_s, state } from "../store.js";
import { Chart } from "../chart.js";
import { Rows, h, text } from "../dom.js";
import { DASH, duration, length, number } from "../format.js";
import { anchorHistory } from "../history.js";
import { anchorMark, condition, leads, siteMode, wordsOf } from "../map/anchors.js";
import { places } from "../map/places.js";
import { startPlacing } from "../map/placing.js";
import { findingAt, findingWords, findings, markWords } from "../survey/watch.js";
import { chainWords, codeWords, faultWords } from "./codes.js";
import { facts, selectionTable, split } from "./parts.js";

export const title = "Anchors";
export const topics = ["health", "selection", "site", "mode", "watch", "placing"];
export const interval_ms = 200;
export const changesWithTime = true;

const WINDOW_S = 120;
const HEARD_S = 3;
/** Counters that have a fact of their own. */
const SHOWN = new Set(["sent", "heard", "late"]);
const PROGRAMS = { dashboard: "page server", ether: "emulated air", survey: "survey program" };

let parts = null;

/** Build the tab. */
export function start(panel) {
  const table = selectionTable("anchor", ["Anchor", "Offset", "Rate", "Sync σ", "Hears", "Sent", "Late"], describe);
  table.head.cells[5].title = "Anchors that it has received in the last seconds";
  table.head.cells[7].title = "Transmissions that were skipped because they were late";
  const nodes = h("ul", { class: "nodes" });
  const unused = h("p", { class: "fine" });
  const programs = h("section", {}, h("h2", {}, "Programs"), nodes, unused);
  const note = h("p", { class: "empty" }, "Anchor health is shown on the live site only.");
  const box = h("div", { class: "scroll-x" }, table.element);
  const list = h("ul", { class: "reasons findings" });
  const found = new Rows(list, (_key, finding) => ({ element: h("li", { class: "bad" }, findingWords(finding)) }));
  const rows = table.rows;
  const trying = h("button", { type: "button", class: "quiet", id: "try-places", onclick: startPlacing }, "Try other places …");
  parts = { panel, note, list, found, box, rows, trying, detail: makeDetail(), programs, unused, nodes: new Rows(nodes, makeNode) };
  panel.append(note, list, box, parts.detail.element, h("div", { class: "above" }, trying), programs);
}

/** Bring the tab up to date. */
export function show() {
  const live = state.mode === "live";
  parts.box.classList.toggle("free", siteMode() === "free");
  parts.note.hidden = live;
  parts.programs.hidden = !live || state.connection.phase === "lost"; // without messages none is known to run
  parts.trying.disabled = !live || !state.site?.anchors.length || places !== null;
  parts.list.hidden = !findings().length;
  parts.found.show(findings().map((finding) => [JSON.stringify(finding), finding]));
  const ids = new Set((state.site?.anchors ?? []).map((anchor) => anchor.id));
  for (const { id } of state.site?.unplaced ?? []) ids.add(id);
  if (live) for (const id of state.health.conditions.keys()) ids.add(id);
  parts.rows.show([...ids].map((id) => [id, id]));
  parts.detail.show(state.selection.anchor);
  split(parts.panel, parts.box, !parts.detail.element.hidden);
  const unused = Object.entries(state.health.dropped).map(([reason, count]) => `${number(count)} ${reason}`);
  text(parts.unused, unused.length ? `Messages that the page server has not used: ${unused.join(", ")}.` : "");
  parts.nodes.show([...state.health.nodes.values()].sort(onlineFirst).map((node) => [`${node.kind}/${node.name}`, node]));
}

function onlineFirst(a, b) {
  const order = b.online - a.online || a.kind.localeCompare(b.kind);
  return order || String(a.name).localeCompare(String(b.name), undefined, { numeric: true });
}

/** Health of an anchor on the live site. */
function healthOf(id) {
  return state.mode === "live" ? state.health.anchors.get(id) : null;
}

function codesOf(health) {
  return health && codeWords(health, state.health.anchors.values());
}

function describe(id) {
  const kind = condition(id);
  const leading = leads(id);
  const health = healthOf(id);
  const finding = findingAt(id);
  const noCodes = kind === "good" && codesOf(health)?.grade ? "no codes" : "";
  const shown = finding ? "bad" : noCodes ? "warn" : kind;
  const words = finding ? `${wordsOf(kind)}; ${markWords(finding)}` : wordsOf(kind);
  const known = kind === "good" && health;
  return {
    condition: shown,
    words: [words, noCodes].filter(Boolean).join("; "),
    key: words + leading + noCodes,
    mark: () => anchorMark(noCodes ? "warn" : kind, leading !== ""),
    name: [anchorName(id), leading, finding && markWords(finding), noCodes].filter(Boolean).join(" "),
    figures: [
      leading ? "reference" : known ? number(health.offset_s, 4, "s") : DASH,
      leading || !known ? DASH : number(health.rate_ppm, 3, "ppm"),
      leading || !known ? DASH : sigma(health.offset_std_m),
      known ? number(Object.values(health.heard_age_s ?? {}).filter((age_s) => age_s < HEARD_S).length) : DASH,
      known ? number(health.sent) : DASH,
      kind === "bad" || kind === "unknown" ? DASH : number(health?.late),
    ],
  };
}

function sigma(value_m) {
  return value_m != null && value_m < 0.01 ? `${(value_m * 1000).toFixed(1)} mm` : length(value_m);
}

function makeDetail() {
  const heading = h("h2", {});
  const list = facts();
  const tenths = (value) => number(value, 1);
  const thousandths = (value) => number(value, 3);
  const around = { zero: false };
  const offsets = new Chart("Change of clock offset (µs)", [{ name: "offset", colour: "accent" }], tenths, 1, around);
  const rate = { name: "rate", colour: "warn" };
  const rates = new Chart("Clock rate relative to the site's (ppm)", [rate], thousandths, 0.01, around);
  const sigmas = new Chart("σ of the clock offset (mm)", [{ name: "σ", colour: "good" }], tenths, 1);
  const charts = h("div", {}, offsets.element, rates.element, sigmas.element);
  const attributes = { class: "detail", "aria-label": "Selected anchor", tabindex: "0", hidden: true };
  const element = h("section", attributes, heading, list.element, charts);
  const showDetail = (id) => {
    const health = healthOf(id);
    element.hidden = !health;
    if (!health) return;
    text(heading, `Anchor ${anchorName(id)}`);
    const [codes, chain] = [codesOf(health)?.grade, chainWords(health)?.grade];
    const grade = condition(id) === "good" ? "" : condition(id);
    list.show(anchorFacts(id, health), { State: grade, "Last report": "bad", Codes: codes, "Key chain": chain, "Not accepted": "bad" });
    charts.hidden = leads(id) !== "";
    const past = anchorHistory.get(id);
    if (!past || charts.hidden) return;
    const now = past.time.at(-1) + Math.max(0, healthAge_s("anchors", id) - 1);
    const times = past.time.map((time) => time - now);
    for (const [chart, values] of [
      [offsets, past.offset_us],
      [rates, past.rate_ppm],
      [sigmas, past.std_mm],
    ]) {
      chart.element.hidden = values.every((value) => value === null);
      if (!chart.element.hidden) chart.show([times, values], WINDOW_S);
    }
  };
  return { element, show: showDetail };
}

/** What an anchor reports; of one that is offline only what stays true. */
function anchorFacts(id, health) {
  const kind = condition(id);
  if (kind === "bad" || kind === "unknown") {
    const last = `${duration(healthAge_s("anchors", id))} ago`;
    return { State: kind === "bad" ? "offline: its figures are not known" : wordsOf(kind), "Last report": last, Uptime: null };
  }
  const ages = Object.entries(health.heard_age_s ?? {}).sort((a, b) => b[1] - a[1]);
  const counted = Object.entries(health.counters).filter(([name, count]) => count && !SHOWN.has(name));
  return {
    State: [wordsOf(kind), health.role === "anchor" ? "" : health.role].filter(Boolean).join(", "),
    "Synchronised to": kind !== "good" || health.master === null || health.master === id ? null : `anchor ${health.master}`,
    Codes: codesOf(health)?.words,
    "Key chain": chainWords(health)?.words,
    "Not accepted": faultWords(health.faults),
    Term: number(health.term),
    Superframe: number(health.superframe),
    Sent: number(health.sent),
    "Late, skipped": number(health.late),
    Heard: number(health.heard),
    "Longest not heard": ages.length ? `anchor ${ages[0][0]}, ${duration(ages[0][1])}` : null,
    Uptime: duration(health.uptime_s),
    MQTT: `${number(health.mqtt.published)} sent, ${number(health.mqtt.dropped)} dropped`,
    "Other counters": counted.map(([name, count]) => `${count} ${name.replaceAll("_", " ")}`).join(", ") || null,
  };
}

/** What people call a program: its kind, and its name where that says more. */
function programName({ kind, name }) {
  const words = PROGRAMS[kind] ?? kind;
  return name === kind || kind === "ether" ? words : `${words} ${name}`;
}

function makeNode(_key, node) {
  const mark = h("span", { class: "node-mark", "aria-hidden": "true" });
  const words = h("span", {});
  const element = h("li", {}, mark, h("span", {}, programName(node)), words);
  const update = (now) => {
    element.className = now.online ? "good" : "bad";
    text(mark, now.online ? "■" : "✕");
    text(words, now.online ? [now.host, now.pid ? `pid ${now.pid}` : ""].filter(Boolean).join(" · ") : "offline");
  };
  return { element, update };
}
