/**
 * The condition of the site: a pill in the header with one word, below the header the worst reason as a whole sentence,
 * the list of all reasons behind both, and the mark in the browser's tab. Where the connection or the broker is lost, a
 * banner replaces the sentence.
 */

import { anchorName, on, select, state } from "./store.js";
import { counts, criticals } from "./alarms/model.js";
import { Rows, byId, h, text } from "./dom.js";
import { now_s } from "./clock.js";
import { LEVELS, shownCondition } from "./condition.js";
import { sentence, timeOfDay } from "./format.js";
import { retryNow } from "./live.js";
import { open as openTab } from "./tabs.js";
import { summaryFacts } from "./summary.js";

/** Pointer or focus on the pill show the list; a click on the pill or next to the sentence keeps it. */
let kept = false;
let over = false;
let said = "";
/** The list behind the pill: its parts stay, so that a figure that changes takes neither a click nor the focus away. */
let list = null;

/** Fill the header and the banner, and keep them up to date. */
export function start() {
  on(["connection", "mode", "player", "condition", "site", "alarms"], show);
  setInterval(() => {
    show();
    if (state.connection.phase !== "lost") text(byId("time"), timeOfDay(now_s()));
  }, 500);
  byId("banner-button").addEventListener("click", retryNow);
  const box = byId("condition");
  buildList();
  for (const id of ["pill", "condition-more"]) byId(id).addEventListener("click", toggle);
  box.addEventListener("pointerenter", (event) => event.pointerType === "mouse" && hover(true));
  box.addEventListener("pointerleave", () => hover(false));
  byId("pill").addEventListener("focus", (event) => event.target.matches(":focus-visible") && hover(true));
  box.addEventListener("focusout", ({ relatedTarget }) => relatedTarget && !box.contains(relatedTarget) && close());
  box.addEventListener("keydown", (event) => event.key === "Escape" && close());
  addEventListener("pointerdown", ({ target }) => {
    if (![box, byId("condition-more")].some((part) => part.contains(/** @type {Node} */ (target)))) close();
  });
  show();
}

function toggle() {
  kept = !kept;
  over &&= kept;
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
  const words = statement(condition, word);
  const pill = byId("pill");
  if (pill.className !== `pill ${condition.level}`) pill.className = `pill ${condition.level}`;
  text(byId("pill-words"), word);
  pill.setAttribute("aria-label", `${word}: ${words}`);
  const line = byId("condition-line");
  if (line.className !== condition.level) line.className = condition.level;
  text(byId("condition-words"), words);
  byId("condition-words").title = words; // it may be cut after two lines
  const further = condition.reasons.length - 1;
  byId("condition-more").hidden = further < 0;
  text(byId("condition-more"), further > 0 ? `and ${further} more` : "What to do");
  showList(condition, words);
  say(condition, `${word}. ${words}`);
  text(document.head.querySelector("title"), `${criticals().length ? "✕ Alarm · " : ""}${mark} ${state.site ? `${state.site.name} · ` : ""}Skyless`);
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

function showList({ reasons }, words) {
  const open = kept || over;
  byId("condition-list").hidden = !open;
  for (const id of ["pill", "condition-more"]) byId(id).setAttribute("aria-expanded", String(open));
  if (!open) return;
  const count = reasons.length;
  text(list.heading, count ? (count === 1 ? "One thing is wrong:" : `${count} things are wrong:`) : words);
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
  return { element: h("button", { type: "button", class: "quiet", onclick: go }, `Show ${kind} ${kind === "anchor" ? anchorName(id) : id}`) };
}

function makeFigure(name) {
  const value = h("dd", {});
  return { element: h("div", {}, h("dt", {}, name), value), update: (words) => text(value, words) };
}

/** The condition as a sentence: the worst reason, or what is so without one. */
function statement({ level, text: words }, word) {
  if (level === "good") return openAlarms() || "All is well: nothing speaks against the positions shown.";
  if (level === "replay") return "A recording is shown, not the live site.";
  if (level === "past") return "The map shows the past; nothing speaks against the live positions.";
  return sentence(words || word);
}

/** That there are alarms beside good positions; empty where there are none. */
function openAlarms() {
  const { unseen, seen } = counts();
  const [count, kind] = unseen ? [unseen, ""] : [seen, "acknowledged "];
  const more = state.moreAlarms ? "more than " : "";
  return count ? `Positions are good; ${more}${count} ${kind}${count === 1 ? "alarm" : "alarms"}.` : "";
}

function showBanner() {
  const { phase, since } = state.connection;
  const brokerAway = phase === "open" && state.mqtt && !state.mqtt.connected;
  const words = phase === "lost" ? lostWords() : brokerAway ? brokerWords() : "";
  const banner = byId("banner");
  banner.hidden = !words;
  banner.className = phase === "lost" ? "lost" : "broker";
  // Beside a critical alarm nothing says that all is well.
  byId("condition-line").hidden = !banner.hidden || (criticals().length > 0 && ["good", "past"].includes(shownCondition().level));
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
  const away = state.condition?.reasons.find(({ kind }) => kind === "broker");
  if (state.hub) return away ? sentence(away.text) : "";
  const broker = state.mqtt.broker ? ` ${state.mqtt.broker}` : "";
  return `The server has lost its broker${broker}: tags and anchors are not updated until it is connected again.`;
}
