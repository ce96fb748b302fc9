/**
 * The little of a browser that the page's modules ask for, with a clock that stands until it is moved: import this file
 * first. Parts of the document are made when somebody asks for them, and keep their words only.
 */

import { readFileSync } from "node:fs";

const PAGE = new URL("../../../src/skyless/page/browser/", import.meta.url);
const COLOURS = readFileSync(new URL("css/tokens.css", PAGE), "utf8");

/** A module of the page. */
export const load = (name) => import(new URL(`${name}.js`, PAGE));

/** What the library says that the page has to know, and the messages of a simulated site: see record_feed.py. */
export const [known, ...feed] = readFileSync(new URL("feed.jsonl", import.meta.url), "utf8").trim().split("\n").map(JSON.parse);

/** What a canvas was told to draw: names and arguments, with the dashes in use. */
export class Drawing {
  constructor() {
    const calls = [];
    const state = { calls, dashes: [], canvas: null };
    const answers = { measureText: (words) => ({ width: 6 * words.length }), setLineDash: (list) => (state.dashes = list) };
    return new Proxy(state, {
      get: (_, name) =>
        name in state ? state[name] : (...args) => (calls.push({ name, args, dashed: state.dashes.length > 0 }), answers[name]?.(...args)),
    });
  }
}

/** The words that a function writes on a canvas, and everything that it draws by name. */
export function drawn(draw) {
  const context = new Drawing();
  const answer = draw(context);
  const of = (name) => context.calls.filter((call) => call.name === name);
  return { answer, of, words: of("fillText").map(({ args }) => args[0]) };
}

export class Part {
  constructor() {
    Object.assign(this, { id: "", children: [], style: {}, dataset: {}, className: "", hidden: false, disabled: false, does: {} });
    this.classList = { toggle: (_name, on) => on, add() {}, contains: (name) => this.className.split(" ").includes(name) };
  }
  get cells() {
    return this.children;
  }
  get firstChild() {
    return this.children[0];
  }
  get lastChild() {
    return this.children.at(-1);
  }
  get textContent() {
    return this.children.map((child) => child.textContent ?? child).join("");
  }
  set textContent(words) {
    this.children = [words];
  }
  get firstElementChild() {
    return this.children[0] ?? null;
  }
  get nextElementSibling() {
    return this.parent.children[this.parent.children.indexOf(this) + 1] ?? null;
  }
  append(...children) {
    for (const child of children) if (child instanceof Part) child.parent = this;
    this.children.push(...children);
  }
  replaceChildren(...children) {
    this.children = [];
    this.append(...children);
  }
  insertBefore(child, next) {
    child.remove?.();
    child.parent = this;
    this.children.splice(next ? this.children.indexOf(next) : this.children.length, 0, child);
  }
  remove() {
    if (this.parent) this.parent.children = this.parent.children.filter((child) => child !== this);
  }
  setAttribute(name, value) {
    if (name === "class") this.className = value;
  }
  removeAttribute() {}
  querySelector() {
    return null;
  }
  after() {}
  addEventListener(event, call) {
    this.does[event] = call;
  }
  /** The parts in this one of which something is true. */
  all(wanted) {
    return [...(wanted(this) ? [this] : []), ...this.children.flatMap((child) => child.all?.(wanted) ?? [])];
  }
  /** The part in this one that has an identifier. */
  find(id) {
    return this.all((one) => one.id === id)[0];
  }
  getContext = () => new Drawing();
}

const parts = new Map();
/** The element of an identifier. */
export function byId(id) {
  if (!parts.has(id)) parts.set(id, new Part());
  return parts.get(id);
}

export const clock = { ms: 1e6 };
export const screen = { dark: false, still: false };
/** Connections that the page has opened, the newest last: `receive` gives it a message. */
export const sockets = [];
/** What the page has asked for besides, by fetch. */
export const asked = [];
const waiting = [];
const timers = new Set();

/** Let time pass; what was to be done meanwhile is done, in steps of a quarter of a second. */
export function wait(seconds) {
  for (const end = clock.ms + 1e3 * seconds; clock.ms < end; ) {
    clock.ms = Math.min(clock.ms + 250, end);
    for (const timer of [...timers].filter(({ due }) => due <= clock.ms)) {
      if (timer.every) timer.due = clock.ms + timer.every;
      else timers.delete(timer);
      timer.call();
    }
    frame();
  }
}

/** Draw a frame. */
export function frame() {
  for (const call of waiting.splice(0)) call(clock.ms);
}

function later(call, ms, every = 0) {
  const timer = { call, due: clock.ms + ms, every };
  timers.add(timer);
  return timer;
}

class Socket {
  static OPEN = 1;
  constructor(address) {
    Object.assign(this, { address: String(address), sent: [], readyState: 1 });
    sockets.push(this);
  }
  send(words) {
    this.sent.push(words);
  }
  receive(message) {
    this.onmessage({ data: JSON.stringify(message) });
    frame();
  }
  close(code = 1006, reason = "") {
    if (this.readyState === 3) return;
    this.readyState = 3;
    this.onclose?.({ code, reason });
  }
}

/** A colour of tokens.css in the theme that is shown, as a browser writes it. */
function resolved({ style }) {
  const pair = COLOURS.match(new RegExp(`${style.color.slice(4, -1)}: light-dark\\((#\\w+), (#\\w+)\\)`));
  const hex = pair[screen.dark ? 2 : 1];
  return { color: `rgb(${[1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)).join(", ")})` };
}

Object.assign(globalThis, {
  matchMedia: (query) => ({
    get matches() { return query.includes("dark") ? screen.dark : query.includes("motion") && screen.still; },
    addEventListener() {},
  }),
  document: {
    documentElement: new Part(), body: new Part(), head: { querySelector: () => byId("title") }, hidden: false,
    baseURI: "http://hall/", createElement: () => new Part(), createElementNS: () => new Part(), getElementById: byId,
    addEventListener() {},
  },
  addEventListener() {}, requestAnimationFrame: (call) => waiting.push(call), getComputedStyle: resolved,
  CSS: { supports: () => true }, Path2D: class { addPath() {} }, DOMMatrix: class {}, ImageData: class {},
  localStorage: { kept: {}, getItem(key) { return this.kept[key] ?? null; }, setItem(key, value) { this.kept[key] = value; } },
  ResizeObserver: class { observe() {} }, location: { href: "http://hall/" }, WebSocket: Socket, performance: { now: () => clock.ms },
  setInterval: (call, ms) => later(call, ms, ms), setTimeout: later, clearTimeout: (timer) => timers.delete(timer),
  fetch: async (address) => (asked.push(String(address)), { status: 200 }), reportError() {},
}); // prettier-ignore

const { start } = await load("theme");
start();
