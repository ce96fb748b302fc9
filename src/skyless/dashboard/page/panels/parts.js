/** Parts that several panels use: tables whose rows select an item, lists of facts, a list above its detail. */

import { state, toggleSelection } from "../store.js";
import { Rows, h, text } from "../dom.js";

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
  // Of hundreds of rows only those in view are kept up to date: laying them all out costs more than drawing the map.
  const inView = new WeakSet();
  const observer = new IntersectionObserver(
    (entries) => {
      for (const { target, isIntersecting } of entries) inView[isIntersecting ? "add" : "delete"](target);
    },
    { rootMargin: "120px" },
  );
  const makeRow = (id) => {
    const cells = Array.from({ length: heads.length + 1 }, () => h("td", {}));
    const button = h("button", { type: "button", class: "name", onclick: () => toggleSelection(kind, id) });
    cells[1].append(button);
    const row = h("tr", { onclick: (event) => event.target === button || toggleSelection(kind, id) }, ...cells);
    let shown = "";
    observer.observe(row);
    const update = (item) => {
      const chosen = state.selection[kind] === id;
      if (row.classList.contains("selected") !== chosen) {
        row.classList.toggle("selected", chosen);
        button.setAttribute("aria-pressed", String(chosen));
      }
      if (shown && !inView.has(row)) return;
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
  return { element, head, rows: new Rows(body, makeRow) };
}

/** A list of named facts; what is unknown is left out. */
export function facts(names) {
  const element = h("dl", { class: "facts" });
  const boxes = new Map();
  for (const name of names) {
    const value = h("dd", {});
    const box = h("div", { hidden: true }, h("dt", {}, name), value);
    boxes.set(name, { box, value });
    element.append(box);
  }
  const show = (values) => {
    for (const [name, { box, value }] of boxes) {
      box.hidden = values[name] === null || values[name] === undefined;
      if (!box.hidden) text(value, values[name]);
    }
  };
  /** Highlight a fact: "warn", "bad", or not. */
  const grade = (name, how) => void (boxes.get(name).value.className = how);
  return { element, show, grade };
}

/** Show a list and a detail below it, each with its own scrolling; or the list alone. */
export function split(panel, list, on) {
  if (panel.classList.toggle("split", on) === list.classList.contains("short")) return;
  list.classList.toggle("short", on);
  list.querySelector(".selected")?.scrollIntoView({ block: "nearest" });
}
