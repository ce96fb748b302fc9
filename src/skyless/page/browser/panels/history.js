/** The tab History: a tag, a time range and a kind of question lead to an answer of the server, on the map or as a table. */

import { on, state } from "../store.js";
import { history } from "../api.js";
import { now_s } from "../clock.js";
import { h, options, text } from "../dom.js";
import { zoneWords } from "../format.js";
import { endPast } from "../past.js";
import { close } from "../player.js";
import { KINDS } from "./history_kinds.js";

export const title = "History";
export const topics = ["connection", "site", "zones", "mode"];
export const interval_ms = 200;

/** Progress is shown after this time. */
const PATIENCE_MS = 300;
/** Times are asked for so long after a change of a field of time, which changes with every digit. */
const TYPING_MS = 700;
/** The list of suggestions is not longer. */
const MAX_SUGGESTED = 100;
const DAY_S = 86_400;
const RANGES = { hour: "Last hour", today: "Today", yesterday: "Yesterday", week: "Last 7 days", own: "From … to …" };

let parts = null;
/** The kind that is chosen, the number of the newest question, what ends it, and the site that it is about. */
let kind = null;
let serial = 0;
let asking = new AbortController();
let site = null;
/** @type {string[]|null} names of the tags in the history; null: not asked for yet */
let tags = null;
let typing = 0;
/** The fields as they were asked for last; "" without an answer. */
let askedFields = "";

/** Build the tab. */
export function start(panel) {
  const names = h("datalist", { id: "history-tags" });
  const tag = h("input", { id: "history-tag", placeholder: "all tags", autocomplete: "off", spellcheck: false });
  tag.setAttribute("list", names.id);
  tag.addEventListener("input", () => suggest(tag.value));
  tag.addEventListener("change", again);
  const range = options({ id: "history-range" }, Object.entries(RANGES), (value) => {
    if (value === "own") return parts.from.focus();
    setRange();
    again();
  });
  const field = (id) => h("input", { type: "datetime-local", id, onchange: typed, oninput: () => (range.value = "own") });
  const [from, to] = [field("history-from"), field("history-to")];
  const buttons = Object.entries(KINDS).map(([key, { words }]) =>
    h("button", { type: "button", id: `history-${key}`, "aria-pressed": "false", onclick: () => ask(key) }, words),
  );
  const zone = options({ id: "history-zone" }, [], again);
  const zones = h("label", { hidden: true }, "Zone", zone);
  const times = h("p", { class: "fine" });
  const form = h(
    "form",
    { id: "history-form" },
    h("label", {}, "Tag", tag),
    h("label", {}, "Time", range),
    h("label", {}, "From", from),
    h("label", {}, "To", to),
    times,
    h("div", { id: "history-kinds", role: "group", "aria-label": "What to show" }, ...buttons),
    zones,
    names,
  );
  form.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" || !event.target.matches("input")) return;
    event.preventDefault();
    ask(kind ?? "way");
  });
  const nothing = h("p", { class: "empty" });
  const back = h("button", { type: "button", class: "primary", onclick: close }, "Back to live");
  const progress = h("p", { id: "history-state", role: "status" });
  const fault = h("p", { id: "history-fault", role: "alert" });
  const result = h("div", { id: "history-result" });
  parts = { tag, names, range, from, to, buttons, zone, zones, times, form, nothing, back, progress, fault, result };
  panel.append(nothing, back, form, progress, fault, result);
  on(["connection", "site"], forgetOtherSite);
}

/** Bring the tab up to date: whether there is a history, and the tags and zones to choose from. */
export function show() {
  const live = state.mode === "live";
  const words = !live
    ? "A recording is shown. The history is that of the live site."
    : state.history === null
      ? "Waiting for the server …"
      : state.history
        ? ""
        : "This server has no history. `skyless history run --to FOLDER` stores the positions and events of the site, and `skyless dashboard --history FOLDER` shows them here.";
  text(parts.nothing, words);
  parts.nothing.hidden = !words;
  parts.back.hidden = live;
  for (const part of [parts.form, parts.result]) part.hidden = Boolean(words);
  if (words) return;
  if (!parts.from.value) setRange();
  const zones = state.zones.map(({ id, name }) => [id, name]);
  if (JSON.stringify(zones) !== parts.zone.dataset.shown) {
    const chosen = parts.zone.value;
    parts.zone.replaceChildren(...zones.map(([value, name]) => h("option", { value }, name)));
    if (zones.some(([id]) => id === chosen)) parts.zone.value = chosen;
    parts.zone.dataset.shown = JSON.stringify(zones);
  }
  if (tags === null) loadTags();
}

async function loadTags() {
  const mine = (tags = []);
  try {
    const found = (await history("tags", {}, undefined)).tags;
    if (tags !== mine) return;
    tags = found;
    suggest(parts.tag.value);
  } catch (error) {
    if (tags === mine) text(parts.fault, `The tags cannot be read: ${error.message}`);
  }
}

/** What people call a tag. */
function nameOf(tag) {
  return state.assets?.get(tag)?.name || tag;
}

function suggest(words) {
  const sought = words.trim().toLowerCase();
  const fits = tags.filter((tag) => `${tag} ${nameOf(tag)}`.toLowerCase().includes(sought));
  const found = fits.slice(0, MAX_SUGGESTED).map((tag) => h("option", { value: tag }, nameOf(tag) === tag ? "" : nameOf(tag)));
  parts.names.replaceChildren(...found);
}

/** The tag that is meant: its name, or that of its asset; "" for all. Throws an Error for one that is not there. */
function chosenTag() {
  const words = parts.tag.value.trim();
  if (!words || !tags?.length) return words;
  const found = tags.find((tag) => tag === words) ?? tags.find((tag) => nameOf(tag).toLowerCase() === words.toLowerCase());
  if (!found) throw new Error(`The history has no tag ${words}.`);
  return found;
}

/** Fill the fields of time with the chosen range, by the server's clock. */
function setRange() {
  const now = Number.isFinite(now_s()) ? now_s() : Date.now() / 1e3;
  const midnight = new Date(now * 1e3).setHours(0, 0, 0, 0) / 1e3;
  const before = new Date((midnight - DAY_S / 2) * 1e3).setHours(0, 0, 0, 0) / 1e3; // days have 23 or 25 hours, too
  const spans = { hour: [now - 3600, now], today: [midnight, now], yesterday: [before, midnight], week: [now - 7 * DAY_S, now] };
  const [from, to] = spans[parts.range.value] ?? [];
  if (from === undefined) return;
  parts.from.value = local(from);
  parts.to.value = local(60 * Math.ceil(to / 60));
}

/** A time as a field of local time has it. */
function local(unix_s) {
  const date = new Date(unix_s * 1e3);
  return new Date(date.getTime() - 60e3 * date.getTimezoneOffset()).toISOString().slice(0, 16);
}

/** The range of the fields. Throws an Error that says what is wrong. */
function chosenSpan() {
  const [from_unix_s, to_unix_s] = [parts.from, parts.to].map((input) => new Date(input.value).getTime() / 1e3);
  if (!Number.isFinite(from_unix_s) || !Number.isFinite(to_unix_s)) throw new Error("Give a date and a time in both fields.");
  if (from_unix_s >= to_unix_s) throw new Error("The range ends before it begins.");
  return { from_unix_s, to_unix_s };
}

function fields() {
  return JSON.stringify([parts.tag, parts.from, parts.to, parts.zone].map(({ value }) => value));
}

function typed() {
  if (fields() === askedFields) return;
  abandon();
  clearTimeout(typing);
  typing = setTimeout(again, TYPING_MS);
}

/** Ask the same of another tag or range; a field that loses the focus after Enter has changed nothing. */
function again() {
  if (kind && fields() !== askedFields) ask(kind);
}

/** End the question that is under way, and show no answer. */
function abandon() {
  serial++;
  askedFields = "";
  clearTimeout(typing);
  asking.abort();
  endPast();
  text(parts.progress, "");
  text(parts.fault, "");
  KINDS[kind]?.end?.();
  parts.result.replaceChildren();
}

/** The answers of another site, or of a server without a history, are not shown any longer. */
function forgetOtherSite() {
  if (state.history && (state.liveId === site || state.liveId === null)) return;
  if (site !== null) abandon();
  site = state.history ? state.liveId : null;
  tags = null;
}

async function ask(key) {
  abandon();
  kind = key;
  const mine = serial;
  const abort = (asking = new AbortController());
  for (const button of parts.buttons) button.setAttribute("aria-pressed", String(button.id === `history-${key}`));
  parts.zones.hidden = !KINDS[key].zone;
  setRange();
  askedFields = fields();
  const begun = performance.now();
  const progress = setInterval(() => mine === serial && showProgress(begun, mine), PATIENCE_MS);
  try {
    const asked = { tag: chosenTag(), span: chosenSpan(), zone: parts.zone.value };
    text(parts.times, `Times of ${zoneWords(asked.span.from_unix_s)}`);
    const get = (path, query = {}) => {
      const { from_unix_s, to_unix_s } = asked.span;
      return history(path, { from: from_unix_s, to: to_unix_s, ...query }, abort.signal);
    };
    const context = { ...asked, get, title: asked.tag ? nameOf(asked.tag) : "all tags", tags, isNew: () => mine === serial };
    const found = await KINDS[key].ask(context);
    if (mine !== serial) return;
    parts.result.replaceChildren(...KINDS[key].show(found, context));
  } catch (error) {
    if (mine === serial) text(parts.fault, error.message);
  } finally {
    clearInterval(progress);
    if (mine === serial) text(parts.progress, "");
  }
}

function showProgress(begun, mine) {
  const seconds = Math.round((performance.now() - begun) / 1e3);
  const words = `Reading the history … ${seconds ? `${seconds} s` : ""}`;
  if (parts.progress.firstChild) return text(parts.progress.firstChild, words);
  const cancel = () => mine === serial && abandon();
  parts.progress.append(h("span", {}, words), h("button", { type: "button", onclick: cancel }, "Cancel"));
}
