/** The tab History: a tag, a time range and a kind of question lead to an answer of the server, on the map or as a table. */

import { on, state } from "../store.js";
import { history } from "../api.js";
import { shownName } from "../assets/model.js";
import { now_s } from "../clock.js";
import { button, h, offer, options, text } from "../dom.js";
import { close } from "../player.js";
import { KINDS } from "./history_kinds.js";

export const title = "History";
export const topics = ["connection", "site", "mode", "assets"];
export const interval_ms = 200;

/** Progress is shown after this time. */
const PATIENCE_MS = 300;
const DAY_S = 86_400;
const RANGES = { hour: "Last hour", today: "Today", yesterday: "Yesterday", week: "Last 7 days", own: "From … to …" };
const NONE =
  "This server has no history. `skyless history run --to FOLDER` stores the positions and events of the site, and " +
  "`skyless dashboard --history FOLDER` shows them here.";

let parts = null;
/** The kind that is chosen, what ends the newest question, and the site that it is about. */
let kind = "";
let asking = new AbortController();
let site = null;
/** @type {string[]|null} names of the tags in the history; null: not asked for yet */
let tags = null;

/** Build the tab. */
export function start(panel) {
  const names = h("datalist", { id: "history-tags" });
  const tag = h("input", { type: "text", id: "history-tag", placeholder: "all tags", autocomplete: "off", spellcheck: false });
  tag.setAttribute("list", names.id);
  const range = options({ id: "history-range" }, Object.entries(RANGES), (value) => {
    if (value === "own") return parts.from.focus();
    setRange();
    if (kind) ask(kind);
  });
  const field = (id) => h("input", { type: "datetime-local", id, oninput: () => (range.value = "own") });
  const [from, to] = [field("history-from"), field("history-to")];
  const kinds = Object.entries(KINDS).map(([key, { words }]) => button(words, () => ask(key), { id: `history-${key}`, "aria-pressed": "false" }));
  const times = h("p", { class: "fine" }, `Times of ${Intl.DateTimeFormat().resolvedOptions().timeZone}`);
  const form = h(
    "form",
    { id: "history-form", oninput: abandon },
    ...Object.entries({ Tag: tag, Time: range, From: from, To: to }).map(([words, one]) => h("label", { class: "field" }, words, one)),
    times,
    h("div", { id: "history-kinds", role: "group", "aria-label": "What to show" }, ...kinds),
    names,
  );
  form.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" || !event.target.matches("input")) return;
    event.preventDefault();
    ask(kind || "way");
  });
  const nothing = h("p", { class: "empty" });
  const back = button("Back to live", close, { class: "primary" });
  const progress = h("p", { id: "history-state", role: "status" });
  const fault = h("p", { id: "history-fault", role: "alert" });
  const result = h("div", { id: "history-result" });
  parts = { tag, names, range, from, to, kinds, form, nothing, back, progress, fault, result };
  panel.append(nothing, back, form, progress, fault, result);
  on(["connection", "site"], forgetOtherSite);
  on(["mode"], () => state.mode === "replay" && abandon());
}

/** Bring the tab up to date: whether there is a history, and the tags to choose from. */
export function show() {
  const isLive = state.mode === "live";
  const none = state.history === null ? "Waiting for the server …" : NONE;
  const words = !isLive ? "A recording is shown. The history is that of the live site." : state.history ? "" : none;
  text(parts.nothing, words);
  parts.nothing.hidden = !words;
  parts.back.hidden = isLive;
  for (const part of [parts.form, parts.result]) part.hidden = Boolean(words);
  if (words) return;
  if (!parts.from.value) setRange();
  if (tags === null) loadTags();
  else suggest();
}

async function loadTags() {
  const mine = (tags = []);
  try {
    const found = (await history("tags", {}, undefined)).tags;
    if (tags !== mine) return;
    tags = found;
    suggest();
  } catch (error) {
    if (tags === mine) text(parts.fault, `The tags cannot be read: ${error.message}`);
  }
}

function suggest() {
  offer(parts.names, tags.map((tag) => [tag, shownName(tag) === tag ? "" : shownName(tag)]), "");
}

/** The tag that is meant: its name, or that of its asset; "" for all. Throws an Error for one that is not there. */
function chosenTag() {
  const words = parts.tag.value.trim();
  if (!words || !tags?.length) return words;
  const found = tags.find((tag) => tag === words) ?? tags.find((tag) => shownName(tag).toLowerCase() === words.toLowerCase());
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

/** End the question that is under way, and show no answer. */
function abandon() {
  asking.abort();
  if (state.past) close();
  parts.progress.replaceChildren();
  text(parts.fault, "");
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
  asking = new AbortController();
  const { signal } = asking;
  for (const one of parts.kinds) one.setAttribute("aria-pressed", String(one.id === `history-${key}`));
  setRange();
  const waiting = setTimeout(() => parts.progress.append("Reading the history …", button("Cancel", abandon)), PATIENCE_MS);
  signal.addEventListener("abort", () => clearTimeout(waiting));
  try {
    const asked = { tag: chosenTag(), span: chosenSpan() };
    const { from_unix_s: from, to_unix_s: to } = asked.span;
    const get = (path, query = {}) => history(path, { from, to, ...query }, signal);
    const context = { ...asked, get, signal, title: asked.tag ? shownName(asked.tag) : "all tags" };
    const found = await KINDS[key].ask(context);
    if (!signal.aborted) parts.result.replaceChildren(...KINDS[key].show(found, context));
  } catch (error) {
    if (!signal.aborted) text(parts.fault, error.message);
  }
  clearTimeout(waiting);
  if (!signal.aborted) parts.progress.replaceChildren();
}
