/** The site in a few figures, in the header: what is unknown, or old, is a dash. */

import { on, reports, state } from "./store.js";
import { byId, h, text } from "./dom.js";
import { freshCondition } from "./condition.js";
import { freshness, now_s, shown_s, tracks } from "./clock.js";
import { DASH, duration, length, number } from "./format.js";
import { condition } from "./map/anchors.js";
import { COLUMNS, ERROR, HPL, STD } from "./tracks.js";

/** Figures in the header; the list behind the pill has them all. */
const IN_HEADER = ["Tags", "σ", "Error", "Latency", "Anchors"];
const TITLES = {
  Tags: "Tags with a fix, of all",
  σ: "Median of the standard deviations that the tags predict",
  Error: "Median distance to the true positions, known as the site is simulated",
  Rate: "Fixes a second of each tag, the median",
  Latency: "From the end of a frame to the arrival of its fix at the page's server: half of all in the last 10 s, and 99 of 100, are quicker",
  "Protection level": "Median of the horizontal protection levels, and the largest",
  Anchors: "Anchors that are online, of all",
};
const row = new Float64Array(COLUMNS);
const boxes = new Map();

/** Build the summary and keep it up to date. */
export function start() {
  for (const name of IN_HEADER) {
    const value = h("dd", {});
    const box = h("div", { class: name.toLowerCase(), title: TITLES[name] }, h("dt", {}, name), value);
    boxes.set(name, { box, value });
    byId("summary").append(box);
  }
  on(["connection", "mode", "site"], show);
  setInterval(show, 1000);
  show();
}

function show() {
  const facts = new Map(summaryFacts());
  for (const [name, { box, value }] of boxes) {
    box.hidden = !facts.has(name);
    text(value, facts.get(name) ?? DASH);
  }
}

/** The figures as pairs of name and words. @returns {Array<[string, string]>} */
export function summaryFacts() {
  const lost = state.connection.phase !== "open";
  const fresh = { std: [], error: [], level: [] };
  const all = tracks().sorted;
  let count = 0;
  for (const track of lost ? [] : all) {
    if (freshness(track, now_s(), shown_s()) !== "fresh" || !track.at(shown_s(), row, false)) continue;
    count += 1;
    fresh.std.push(row[STD]);
    fresh.error.push(row[ERROR]);
    fresh.level.push(row[HPL]);
  }
  const { tags_with_fix, tags } = (state.mode === "live" && state.part && freshCondition()) || {};
  const facts = [
    ["Tags", lost ? DASH : tags ? `${tags_with_fix}/${tags}`  : `${count}/${all.length}`],
    ["σ", length(median(fresh.std))],
  ];
  if (state.simulated) facts.push(["Error", length(median(fresh.error))]);
  if (fresh.level.some(Number.isFinite)) {
    const levels = fresh.level.filter(Number.isFinite);
    facts.push(["Protection level", `${length(median(levels))}, largest ${length(levels.reduce((a, b) => Math.max(a, b)))}`]);
  }
  if (state.mode === "live") facts.push(...liveFacts(lost));
  if (state.site) facts.push(["Site", `${state.site.name}, number ${state.site.id}`]);
  return facts;
}

function liveFacts(lost) {
  const healths = lost ? [] : [...state.health.tags.values()].filter(({ tag }) => reports("tags", tag));
  const { latency_p50_s, latency_p99_s } = (!lost && freshCondition()) || {};
  const known = latency_p50_s !== null && latency_p50_s !== undefined;
  const anchors = [...(state.site?.anchors ?? []), ...(state.site?.unplaced ?? [])];
  const online = anchors.filter(({ id }) => ["good", "warn"].includes(condition(id))).length;
  return [
    ["Rate", number(median(healths.map((health) => health.updates_per_s)), 0, "Hz")],
    ["Latency", known ? `${duration(latency_p50_s)}, p99 ${duration(latency_p99_s)}` : DASH],
    ["Anchors", lost || !anchors.length ? DASH : `${online}/${anchors.length}`],
  ];
}

function median(values) {
  const sorted = values.filter(Number.isFinite).sort((a, b) => a - b);
  return sorted.length ? sorted[(sorted.length - 1) >> 1] : null;
}
