/** Step 1: anchors as they are received, and which are missing. */

import { select, state } from "../store.js";
import { Rows, h, text } from "../dom.js";
import { duration, length, number } from "../format.js";
import { surveyed } from "../survey/model.js";
import { list } from "../survey/verdict.js";
import { findingAt, markWords } from "../survey/watch.js";

export const title = "Anchors";

const NONE = "No anchor has been received yet. Anchors that have power appear here by themselves.";
let parts = null;

/** Build the step. */
export function start(body) {
  const heads = ["Anchor", "Pairs", "Exchanges", "σ", "State"];
  const head = h("tr", {}, ...heads.map((words) => h("th", { scope: "col" }, words)));
  head.cells[3].title = "Standard deviation of the position, per axis";
  const rows = h("tbody", {});
  const table = h("table", { class: "list setup-anchors", id: "setup-anchors" }, h("thead", {}, head), rows);
  const none = h("p", { class: "empty" });
  const missing = h("p", { class: "reason" });
  const since = h("p", { class: "fine" });
  parts = { none, missing, since, table, rows: new Rows(rows, makeRow) };
  body.append(none, table, missing, since);
}

/** How it stands. */
export function summary() {
  if (!state.survey) return "";
  const { anchors, missing } = state.survey;
  return missing.length ? `${anchors.length} received, ${missing.length} missing` : `${anchors.length} received`;
}

/** Bring the step up to date. */
export function show() {
  const { anchors = [], missing = [], pairs = [], duration_s = 0 } = state.survey ?? {};
  parts.none.hidden = anchors.length > 0 || missing.length > 0;
  text(parts.none, state.survey ? NONE : "Anchors appear here once the survey program runs.");
  parts.table.hidden = !parts.none.hidden;
  parts.rows.show([
    ...anchors.map((id) => [id, { id, mine: pairs.filter((pair) => pair.a === id || pair.b === id) }]),
    ...missing.map((id) => [id, { id, mine: null }]),
  ]);
  parts.missing.hidden = !missing.length;
  text(parts.missing, missing.length ? `Not received: ${list(missing, 20)}. Check their power and their distance.` : "");
  const count = number(pairs.length);
  text(parts.since, state.survey ? `${count} pairs, ${duration(duration_s)} of data. More time makes each range better.` : "");
}

function makeRow(id) {
  const cells = Array.from({ length: 5 }, () => h("td", {}));
  const button = h("button", { type: "button", class: "name", onclick: () => select("anchor", id) }, String(id));
  cells[0].append(button);
  const update = ({ mine }) => {
    const anchor = surveyed(id);
    const finding = findingAt(id);
    button.setAttribute("aria-pressed", String(state.selection.anchor === id));
    const how = mine === null ? "missing" : anchor?.determined ? "sure" : "open";
    row.className = `${finding || how === "missing" ? "bad" : ""} ${state.selection.anchor === id ? "selected" : ""}`;
    text(cells[1], mine ? number(mine.length) : "–");
    text(cells[2], mine ? number(mine.reduce((sum, pair) => sum + pair.exchanges, 0)) : "–");
    text(cells[3], length(anchor?.std_m));
    const words = { missing: "not received", sure: "determined", open: "not determined" };
    text(cells[4], finding ? markWords(finding) : words[how]);
  };
  const row = h("tr", { onclick: (event) => event.target !== button && select("anchor", id) }, ...cells);
  return { element: row, update };
}
