/** Small helpers to build and update elements. */

const SVG = "http://www.w3.org/2000/svg";

/**
 * Make an element. `on…` become listeners, `class`, `aria-…`, `data-…` and SVG's attributes; the rest properties.
 * @param {string} tag
 */
export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(properties)) {
    if (value === undefined || value === null) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key in element && !key.startsWith("aria")) element[key] = value;
    else element.setAttribute(key, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** Make an SVG element. */
export function s(tag, attributes = {}, ...children) {
  const element = document.createElementNS(SVG, tag);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

/** Whether the window has the width of a phone, for which the style sheets have a layout of its own. */
export const isPhone = () => matchMedia("(max-width: 760px)").matches;

/** A button. */
export function button(words, onclick, properties = {}) {
  return h("button", { type: "button", onclick, ...properties }, words);
}

/** A list of options, pairs of value and words; calls `choose` with the value of the one that is chosen. */
export function options(properties, pairs, choose) {
  const list = h("select", properties, ...pairs.map(([value, words]) => h("option", { value }, words)));
  list.addEventListener("change", () => choose(list.value));
  return list;
}

/** Offer other options in a list, pairs of value and words, and choose one, or where it is none of them the first. */
export function offer(list, pairs, value) {
  const key = JSON.stringify(pairs);
  if (list.dataset.offered !== key) list.replaceChildren(...pairs.map(([id, words]) => h("option", { value: id }, words)));
  list.dataset.offered = key;
  list.value = String(value);
  if (list.selectedIndex < 0) list.selectedIndex = 0;
}

/** Set a node's text where it differs, which avoids needless layout. */
export function text(element, value) {
  if (element.textContent !== value) element.textContent = value;
}

/** @returns {any} */
export function byId(id) {
  return document.getElementById(id);
}

/** Keeps one row per item: rows are made once, updated, ordered and removed. */
export class Rows {
  constructor(parent, make) {
    this.parent = parent;
    this.make = make;
    this.rows = new Map();
  }

  /** @param {Array<[any, any]>} items pairs of key and value */
  show(items) {
    const keys = new Set(items.map(([key]) => key));
    for (const [key, row] of this.rows) {
      if (keys.has(key)) continue;
      row.element.remove();
      this.rows.delete(key);
    }
    let next = this.parent.firstElementChild;
    for (const [key, value] of items) {
      let row = this.rows.get(key);
      if (!row) this.rows.set(key, (row = this.make(key, value)));
      row.update?.(value);
      if (row.element === next) next = next.nextElementSibling;
      else this.parent.insertBefore(row.element, next);
    }
  }
}

/** Show a message for a few seconds, with a button for an action such as undo. */
export function toast(message, kind = "note", action = null) {
  const box = h("div", { class: `toast ${kind}`, role: kind === "bad" ? "alert" : "status" }, message);
  if (action) {
    box.append(h("button", { type: "button", onclick: () => (box.remove(), action.run()) }, action.name));
  }
  byId("toasts").append(box);
  setTimeout(() => box.remove(), action || kind === "bad" ? 8000 : 4000);
}

/** Limit how often a function is called; the last call is always made. */
export function throttle(interval_ms, call) {
  let last = -Infinity;
  let timer = 0;
  return () => {
    if (timer) return;
    const wait = last + interval_ms - performance.now();
    const run = () => {
      timer = 0;
      last = performance.now();
      call();
    };
    if (wait <= 0) run();
    else timer = setTimeout(run, wait);
  };
}
