/** Parts that several panels use: tables whose rows select an item, lists of facts, a list above its detail. */

import { state, toggleSelection } from "../store.js";
import { Rows, byId, h, text } from "../dom.js";

/** Of more rows than this only those in sight are built, and as many on either side. */
const FEW = 60;
const BESIDE = 12;

/**
 * A table with one row per tag or anchor: a mark of its condition, its name, which selects it, and figures.
 * @param {"tag"|"anchor"} kind
 * @param {string[]} heads of the columns after the mark
 * @param {(id: any, item: any) => {condition: string, words: string, key: string, mark: () => Element, name: string,
 *   figures: string[]}} describe the mark is made again when its key changes
 */
export function selectionTable(kind, heads, describe) {
  const head = h("tr", {}, ...["", ...heads].map((words) => h("th", { scope: "col" }, words)));
  head.cells[0].append(h("span", { class: "unseen" }, "State"));
  const body = h("tbody", {});
  const element = h("table", { class: `list ${kind}s` }, h("thead", {}, head), body);
  const makeRow = (id, item) => {
    if (item.gap) return makeGap();
    const cells = Array.from({ length: heads.length + 1 }, () => h("td", {}));
    const button = h("button", { type: "button", class: "name", onclick: () => toggleSelection(kind, id) });
    cells[1].append(button);
    const row = h("tr", { onclick: (event) => event.target === button || toggleSelection(kind, id) }, ...cells);
    let shown = "";
    const update = ({ item, index }) => {
      const chosen = state.selection[kind] === id;
      if (index !== null) row.setAttribute("aria-rowindex", String(index + 2));
      const { condition, words, key, mark, name, figures } = describe(id, item);
      if (shown !== key) cells[0].replaceChildren(mark(), h("span", { class: "unseen" }, words));
      shown = key;
      cells[0].title = words;
      text(button, name);
      button.setAttribute("aria-pressed", String(chosen));
      row.className = `${condition} ${chosen ? "selected" : ""}`;
      figures.forEach((figure, index) => text(cells[index + 2], figure));
    };
    return { element: row, update };
  };
  const makeGap = () => {
    const cell = h("td", { colSpan: heads.length + 1 });
    const row = h("tr", { class: "gap", "aria-hidden": "true" }, cell);
    return { element: row, update: ({ gap }) => (row.style.height = `${gap}px`) };
  };
  return { element, head, rows: new RowsInSight(kind, element, new Rows(body, makeRow)) };
}

/** The rows of a long list that can be seen, with gaps instead of the others; the selected and the focused one stay. */
class RowsInSight {
  constructor(kind, table, rows) {
    this.kind = kind;
    this.table = table;
    this.rows = rows;
    this.items = [];
    let placed = true;
    const place = () => {
      placed = true;
      if (this.items.length > FEW && table.isConnected && table.getClientRects().length) this.place();
    };
    const scrolled = () => {
      if (placed) requestAnimationFrame(place);
      placed = false;
    };
    addEventListener("scroll", scrolled, { capture: true, passive: true });
    addEventListener("resize", scrolled);
  }

  /** @param {Array<[any, any]>} items pairs of key and value */
  show(items) {
    this.items = items;
    this.place();
  }

  place() {
    const { items, table, kind } = this;
    if (items.length <= FEW) {
      table.removeAttribute("aria-rowcount");
      state.listed[`${kind}s`] = items.map(([key]) => key);
      return this.rows.show(items.map(([key, item]) => [key, { item, index: null }]));
    }
    table.setAttribute("aria-rowcount", String(items.length + 1));
    const height = rowHeight(table);
    const { top, bottom } = sight(table);
    const from = table.tBodies[0].getBoundingClientRect().top;
    const first = Math.min(Math.max(Math.floor((top - from) / height), 0), items.length - 1);
    const last = Math.min(Math.max(Math.ceil((bottom - from) / height), first), items.length);
    state.listed[`${kind}s`] = items.slice(first, last).map(([key]) => key);
    const wanted = new Set();
    for (let n = Math.max(first - BESIDE, 0); n < Math.min(last + BESIDE, items.length); n++) wanted.add(n);
    const focused = [...this.rows.rows].find(([, row]) => row.element.contains(document.activeElement))?.[0];
    for (const key of [state.selection[kind], focused]) {
      const index = key === null || key === undefined ? -1 : items.findIndex(([one]) => one === key);
      if (index >= 0) wanted.add(index);
    }
    const shown = [];
    let next = 0;
    for (const index of [...wanted].sort((a, b) => a - b)) {
      if (index > next) shown.push([`gap ${shown.length ? index : "first"}`, { gap: (index - next) * height }]);
      shown.push([items[index][0], { item: items[index][1], index }]);
      next = index + 1;
    }
    if (next < items.length) shown.push(["gap last", { gap: (items.length - next) * height }]);
    this.rows.show(shown);
  }
}

/** Height of a row, as laid out; as in parts.css before there is one. */
function rowHeight(table) {
  return table.querySelector("tbody tr:not(.gap)")?.getBoundingClientRect().height || 33;
}

/** The part of the window in which a table can be seen. */
function sight(table) {
  const boxes = [byId("panels"), table.closest(".scroll-x")].map((box) => box.getBoundingClientRect());
  return { top: Math.max(...boxes.map((box) => box.top)), bottom: Math.min(...boxes.map((box) => box.bottom)) };
}

/** A list of named facts, shown in the order given and highlighted by `grades` ("warn", "bad"); what is unknown is left out. */
export function facts() {
  const element = h("dl", { class: "facts" });
  const boxes = new Map();
  let order = "";
  const show = (values, grades = {}) => {
    const names = Object.keys(values).filter((name) => values[name] != null);
    for (const name of names) if (!boxes.has(name)) boxes.set(name, h("div", {}, h("dt", {}, name), h("dd", {})));
    if (order !== names.join()) element.replaceChildren(...names.map((name) => boxes.get(name)));
    order = names.join();
    for (const name of names) {
      const value = boxes.get(name).lastChild;
      text(value, values[name]);
      value.className = grades[name] ?? "";
    }
  };
  return { element, show };
}

/** Show a list and a detail below it, each with its own scrolling; or the list alone. */
export function split(panel, list, on) {
  if (panel.classList.toggle("split", on) === list.classList.contains("short")) return;
  list.classList.toggle("short", on);
  list.querySelector(".selected")?.scrollIntoView({ block: "nearest" });
}
