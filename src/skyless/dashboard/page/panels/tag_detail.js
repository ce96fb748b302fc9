/** One tag in detail: what it is doing, and its last minute as charts. */

import { state } from "../store.js";
import { shown_s } from "../clock.js";
import { Chart } from "../chart.js";
import { h, text } from "../dom.js";
import { bytes, duration, length, metres, number } from "../format.js";
import { tags as past } from "../history.js";
import { ALERT, ALERTS, ANCHORS, CHI2, ERROR, HPL, STD, TIME, VX, VY, X, Y, Z } from "../tracks.js";

const WINDOW_S = 60;
const row = new Float64Array(17);
/** How grave each of ALERTS is. */
const GRAVITY = ["", "warn", "bad", "", "bad"];

export class TagDetail {
  constructor() {
    this.title = h("h2", {});
    this.reason = h("p", { class: "reason", hidden: true });
    this.facts = facts([
      "Position",
      "Speed",
      "Protection level",
      "Integrity alert",
      "Anchors used",
      "First fix",
      "Latency",
      "Method",
      "Dropped",
      "Processor",
      "Memory",
    ]);
    this.error = new Chart(
      "Error (true distance) and stated σ",
      [
        { name: "error", colour: "bad" },
        { name: "σ", colour: "accent" },
      ],
      length,
      { zero: true, least: 0.02 },
    );
    this.sigma = new Chart("Stated σ", [{ name: "σ", colour: "accent" }], length, { zero: true, least: 0.02 });
    this.rate = new Chart("Fixes in a second", [{ name: "rate", colour: "good", steps: true }], number, {
      zero: true,
      least: 4,
    });
    const few = { whole: true, zero: true, least: 4 };
    this.used = new Chart("Anchors used", [{ name: "anchors", colour: "accent", steps: true }], number, few);
    this.chi2 = new Chart("Residuals (χ² of each fix)", [{ name: "χ²", colour: "warn" }], (v) => number(v, 1), {
      zero: true,
      least: 1,
    });
    const charts = [this.error, this.sigma, this.rate, this.used, this.chi2].map((chart) => chart.element);
    this.element = h(
      "section",
      { class: "detail", "aria-label": "The selected tag" },
      this.title,
      this.reason,
      this.facts.element,
      ...charts,
      h("p", { class: "fine" }, "Charts: the last 60 s."),
    );
    this.element.hidden = true;
  }

  /** @param {import("../tracks.js").Track|null} track */
  show(track) {
    this.element.hidden = !track;
    if (!track) return;
    const health = state.mode === "live" ? state.health.tags.get(track.name) : null;
    text(this.title, track.name);
    this.reason.hidden = !health?.reason;
    text(this.reason, health?.reason ? `No fix: ${health.reason.replaceAll("-", " ")}` : "");
    this.showFacts(track, health);
    this.showCharts(track);
  }

  showFacts(track, health) {
    const known = track.at(shown_s(), row, false);
    const dropped = health ? Object.entries(health.counters).filter(([, count]) => count) : [];
    const speed = Math.hypot(row[VX], row[VY]);
    this.facts.show({
      Position: known ? `${metres(row[X], 3)}, ${metres(row[Y], 3)}, ${metres(row[Z], 3)} m` : null,
      Speed: known && speed >= 0 ? `${speed.toFixed(2)} m/s` : null,
      "Protection level": known && row[HPL] >= 0 ? length(row[HPL]) : null,
      "Integrity alert": known && row[ALERT] >= 0 ? ALERTS[row[ALERT]] : null,
      "Anchors used": known ? number(row[ANCHORS]) : null,
      "First fix": health?.first_fix_s == null ? null : `after ${duration(health.first_fix_s)}`,
      Latency:
        health?.latency_p50_s == null
          ? null
          : `${duration(health.latency_p50_s)}, p99 ${duration(health.latency_p99_s)}`,
      Method: health?.method ?? null,
      Dropped: health ? dropped.map(([reason, count]) => `${count} ${reason}`).join(", ") || "none" : null,
      Processor: health ? `${(100 * health.cpu).toFixed(1)} %` : null,
      Memory: health ? bytes(health.memory_bytes) : null,
    });
    this.facts.grade("Integrity alert", GRAVITY[row[ALERT]] ?? "");
  }

  showCharts(track) {
    const now = shown_s();
    const columns = window(track, now);
    const truth = columns[ERROR].some((value) => value !== null);
    this.error.element.hidden = !truth;
    this.sigma.element.hidden = truth;
    if (truth) this.error.show([columns[TIME], columns[ERROR], columns[STD]], WINDOW_S);
    else this.sigma.show([columns[TIME], columns[STD]], WINDOW_S);
    this.used.show([columns[TIME], columns[ANCHORS]], WINDOW_S);
    this.chi2.show([columns[TIME], columns[CHI2]], WINDOW_S);
    const rates = past.get(track.name);
    this.rate.element.hidden = state.mode === "replay" || !rates;
    if (rates && state.mode === "live") this.rate.show([rates.time.map((time) => time - now), rates.rate], WINDOW_S);
  }
}

/** The charts' columns of the last minute; a gap of more than a second is shown as one. */
function window(track, now) {
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

/** A list of named facts; what is unknown is left out. */
export function facts(names) {
  const list = h("dl", { class: "facts" });
  const places = new Map();
  for (const name of names) {
    const value = h("dd", {});
    const box = h("div", { hidden: true }, h("dt", {}, name), value);
    places.set(name, { box, value });
    list.append(box);
  }
  const show = (values) => {
    for (const [name, { box, value }] of places) {
      box.hidden = values[name] === null || values[name] === undefined;
      if (!box.hidden) text(value, values[name]);
    }
  };
  /** Have a fact stand out: "warn", "bad", or as the others. */
  const grade = (name, how) => void (places.get(name).value.className = how);
  return { element: list, show, grade };
}
