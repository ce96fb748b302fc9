/**
 * The condition of the site: a pill in the header with the first reason, the list of all reasons behind it, the mark in
 * the browser's tab; and a banner, with a button to reconnect, where the connection is lost.
 */

import { on, select, state } from "./store.js";
import { Rows, byId, h, text } from "./dom.js";
import { now_s } from "./clock.js";
import { LEVELS, shownCondition } from "./condition.js";
import { sentence, timeOfDay } from "./format.js";
import { retryNow } from "./live.js";
import { open as openTab } from "./tabs.js";
import { summaryFacts } from "./summary.js";

/** Pointer or focus on the pill show the list; a click keeps it. */
let kept = false;
let over = false;
let said = "";
/** The list behind the pill: its parts stay, so that a figure that changes takes neither a click nor the focus away. */
let list = null;

/** Fill the header and the banner, and keep them up to date. */
export function start() {
  on(["connection", "mode", "player", "condition", "site", "preparation"], show);
  setInterval(() => {
    show();
    if (state.connection.phase !== "lost") text(byId("time"), timeOfDay(now_s()));
  }, 500);
  byId("banner-button").addEventListener("click", retryNow);
  const box = byId("condition");
  buildList();
  byId("pill").addEventListener("click", () => {
    kept = !kept;
    over &&= kept;
    show();
  });
  box.addEventListener("pointerenter", (event) => event.pointerType === "mouse" && hover(true));
  box.addEventListener("pointerleave", () => hover(false));
  byId("pill").addEventListener("focus", (event) => event.target.matches(":focus-visible") && hover(true));
  box.addEventListener("focusout", ({ relatedTarget }) => relatedTarget && !box.contains(relatedTarget) && close());
  box.addEventListener("keydown", (event) => event.key === "Escape" && close());
  addEventListener("pointerdown", (event) => box.contains(/** @type {Node} */ (event.target)) || close());
  show();
}

function hover(on) {
  over = on;
  show();
}

function close() {
  kept = over = false;
  show();
}

function show() {
  const condition = shownCondition();
  const { word, mark } = LEVELS[condition.level];
  const words = condition.text ? sentence(condition.text).slice(0, -1) : word;
  const pill = byId("pill");
  if (pill.className !== `pill ${condition.level}`) pill.className = `pill ${condition.level}`;
  text(byId("pill-words"), words);
  pill.setAttribute("aria-label", condition.text ? `${word}: ${words}` : words);
  showList(condition, word);
  say(condition, `${word}. ${words}`);
  text(document.head.querySelector("title"), `${mark} ${state.site ? `${state.site.name} · ` : ""}Skyless`);
  showBanner();
}

/** Screen readers hear a change of level or of the first reason, not every change of a figure. */
function say({ level, reasons }, words) {
  const key = `${level} ${reasons[0]?.kind ?? ""}`;
  if (key === said) return;
  said = key;
  text(byId("condition-said"), words);
}

function buildList() {
  const heading = h("h2", {});
  const reasons = h("ul", {});
  const figures = h("dl", { class: "facts" });
  const all = h("button", { type: "button", class: "quiet", onclick: () => (close(), openTab("events")) }, "All events");
  byId("condition-list").append(heading, reasons, figures, all);
  list = { heading, reasons: new Rows(reasons, makeReason), figures: new Rows(figures, makeFigure) };
}

function showList({ level, text: first, reasons }, word) {
  const open = kept || over;
  byId("condition-list").hidden = !open;
  byId("pill").setAttribute("aria-expanded", String(open));
  if (!open) return;
  text(list.heading, headline(level, first, reasons, word));
  list.reasons.show(reasons.map((reason) => [reason.kind, reason]));
  list.figures.show(summaryFacts());
}

function makeReason() {
  const words = h("span", {});
  const links = h("span", {});
  const advice = h("p", { class: "fine" });
  const element = h("li", {}, h("p", {}, words, links), advice);
  const rows = new Rows(links, makeLink);
  const update = (reason) => {
    if (element.className !== reason.level) element.className = reason.level;
    text(words, sentence(reason.text));
    text(advice, reason.advice);
    rows.show(reason.names.slice(0, 3).map((name) => [name, name]));
  };
  return { element, update };
}

/** A button that selects a tag or anchor of a reason, and opens its tab. */
function makeLink(name) {
  const [kind, id] = [name.slice(0, name.indexOf("/")), name.slice(name.indexOf("/") + 1)];
  const go = () => (openTab(`${kind}s`), select(kind, kind === "anchor" ? Number(id) : id));
  return { element: h("button", { type: "button", class: "quiet", onclick: go }, `Show ${kind} ${id}`) };
}

function makeFigure(name) {
  const value = h("dd", {});
  return { element: h("div", {}, h("dt", {}, name), value), update: (words) => text(value, words) };
}

function headline(level, first, reasons, word) {
  if (level === "good") return "All is well: nothing speaks against the positions shown.";
  if (level === "replay") return "A recording is shown, not the live site.";
  if (!reasons.length) return sentence(first || word);
  return reasons.length === 1 ? "One thing is wrong:" : `${reasons.length} things are wrong:`;
}

function showBanner() {
  const { phase, since } = state.connection;
  const brokerAway = phase === "open" && state.mqtt && !state.mqtt.connected;
  const words = phase === "lost" ? lostWords() : brokerAway ? brokerWords() : "";
  const banner = byId("banner");
  banner.hidden = !words;
  banner.className = phase === "lost" ? "lost" : "broker";
  byId("banner-button").hidden = phase !== "lost";
  text(byId("banner-text"), words);
  text(byId("banner-age"), phase === "lost" ? age(since) : "");
  document.body.classList.toggle("lost", phase === "lost");
}

function lostWords() {
  const { reason } = state.connection;
  const old = state.mode === "live" ? " Nothing shown here is current." : "";
  return `Connection lost: ${reason}.${old} Reconnecting.`;
}

/** How long ago; not part of the message, so that screen readers read it only once. */
function age(since) {
  const past = Math.floor((performance.now() - since) / 1e3);
  return past < 120 ? `${past} s` : `${Math.floor(past / 60)} min`;
}

function brokerWords() {
  const broker = state.mqtt.broker ? ` ${state.mqtt.broker}` : "";
  return `The server has lost its broker${broker}: tags and anchors are not updated until it is connected again.`;
}
