/** All tags as a list, and the selected one in detail. */

import { on, select, state } from "../store.js";
import { freshness, shown_s, tracks } from "../clock.js";
import { Rows, h, slowly, text } from "../dom.js";
import { DASH, length, metres, number } from "../format.js";
import { tagColour } from "../theme.js";
import { ERROR, STD, X, Y } from "../tracks.js";
import { split } from "../tabs.js";
import { TagDetail } from "./tag_detail.js";

export const title = "Tags";
const MARKS = { fresh: "●", stale: "○", gone: "✕", never: "–" };
const WORDS = { fresh: "has a fix", stale: "no fix for a second", gone: "lost", never: "no fix yet" };
const SEARCHED = 12;
const row = new Float64Array(17);
let parts = null;
let isOpen = () => false;

/** Build the tab. */
export function start(panel, open) {
  isOpen = open;
  const search = h("input", { type: "search", placeholder: "Find a tag", "aria-label": "Find a tag", oninput: show });
  const head = h(
    "tr",
    {},
    ...["", "Tag", "x", "y", "σ", "Error", "Rate"].map((words) => h("th", { scope: "col" }, words)),
  );
  head.cells[0].append(h("span", { class: "unseen" }, "State"));
  head.cells[5].title = "Distance to the true position, where it is known";
  head.cells[6].title = "Fixes in the last second";
  const body = h("tbody", {});
  const table = h("table", { class: "list tags" }, h("thead", {}, head), body);
  const empty = h("p", { class: "empty" }, "No tag has been heard of yet.");
  const detail = new TagDetail();
  const count = h("p", { class: "count" });
  const box = h("div", { class: "scroll-x" }, table);
  panel.append(h("div", { class: "above" }, count, search), empty, box, detail.element);
  parts = { panel, box, search, table, head, empty, detail, count, rows: new Rows(body, makeRow) };
  on(["tags", "health", "selection", "mode", "player"], slowly(300, show));
  on(["theme", "site"], show);
  setInterval(show, 1000);
}

/** Bring the tab up to date, if anybody sees it. */
export function show() {
  if (!parts || !isOpen()) return;
  const list = tracks().sorted;
  const wanted = parts.search.value.trim().toLowerCase();
  parts.search.hidden = list.length <= SEARCHED;
  parts.empty.hidden = list.length > 0;
  parts.table.hidden = list.length === 0;
  parts.table.classList.toggle("untrue", !state.simulated);
  const shown = list.map((track, index) => [track.name, { track, colour: tagColour(index, list.length) }]);
  parts.rows.show(shown.filter(([name]) => name.toLowerCase().includes(wanted)));
  const fresh = list.filter((track) => freshness(track) === "fresh").length;
  text(parts.count, list.length ? `${fresh} of ${list.length} with a fix` : "");
  parts.detail.show(tracks().all.get(state.selection.tag) ?? null);
  split(parts.panel, parts.box, !parts.detail.element.hidden);
}

function makeRow(name) {
  const cells = Array.from({ length: 7 }, () => h("td", {}));
  const button = h("button", { type: "button", class: "name", onclick: () => toggle(name) }, name);
  cells[1].append(button);
  const words = h("span", { class: "unseen" });
  const mark = h("span", { "aria-hidden": "true" });
  cells[0].append(mark, words);
  const element = h("tr", { onclick: (event) => event.target === button || toggle(name) }, ...cells);
  const update = ({ track, colour }) => {
    const kind = freshness(track);
    const known = kind !== "never" && track.at(shown_s(), row, false);
    text(mark, MARKS[kind]);
    text(words, WORDS[kind]);
    mark.style.color = kind === "fresh" ? colour : "";
    element.className = `${kind} ${state.selection.tag === name ? "selected" : ""}`;
    button.setAttribute("aria-pressed", String(state.selection.tag === name));
    const rate = state.mode === "live" ? state.health.tags.get(name)?.updates_per_s : null;
    const values = known
      ? [metres(row[X]), metres(row[Y]), length(row[STD]), length(row[ERROR]), number(rate)]
      : [DASH, DASH, DASH, DASH, number(rate)];
    values.forEach((value, index) => text(cells[index + 2], value));
  };
  return { element, update };
}

function toggle(name) {
  if (state.selection.tag === name) select(null);
  else select("tag", name);
}
