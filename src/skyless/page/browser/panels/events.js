/** What has happened, at the live site or in a recording, the newest first; with filters, and a count of the unread. */

import { changed, savedSetting, saveSetting, select, state } from "../store.js";
import { Rows, h, options, text } from "../dom.js";
import { dateTime, sentence, timeOfDay } from "../format.js";

export const title = "Events";
export const topics = ["log", "mode", "player"];
export const interval_ms = 200;

/** Groups of the filter: the kinds in each. */
const GROUPS = {
  all: { words: "All", kinds: null },
  severe: { words: "Warnings and faults", kinds: null },
  condition: { words: "Condition", kinds: ["condition"] },
  alarms: { words: "Alarms", kinds: ["alarm"] },
  anchors: { words: "Anchors", kinds: ["anchor", "master", "watch"] },
  tags: { words: "Tags", kinds: ["tag", "alert"] },
  programs: { words: "Programs and survey", kinds: ["program", "survey"] },
};
const MARKS = { good: "●", note: "·", warning: "▲", bad: "✕" };
const WORDS = { good: "good", note: "note", warning: "warning", bad: "fault" };
/** The newest event that was shown, by its time: serials start again with the server. */
const READ = "skyless-events-read";

let parts = null;
let group = "all";
let readUnix_s = Number(savedSetting(READ)) || 0;

/** Build the tab. */
export function start(panel) {
  const groups = Object.entries(GROUPS).map(([value, { words }]) => [value, words]);
  const filter = options({ "aria-label": "Which events", id: "event-filter" }, groups, (value) => {
    group = value;
    show();
  });
  const count = h("p", { class: "count" });
  const none = h("p", { class: "empty" });
  const note = h("p", { class: "fine", hidden: true });
  const list = h("ol", { class: "log", id: "event-list", "aria-label": "Events of the site" });
  parts = { count, none, note, rows: new Rows(list, makeEvent) };
  panel.append(h("div", { class: "above" }, count, filter), note, none, list);
}

/** Bring the tab up to date; what it shows counts as read. */
export function show() {
  const all = state.mode === "live" ? state.log : (state.player?.events ?? []);
  const events = all.filter((event) => isIn(group, event)).reverse();
  parts.rows.show(events.map((event) => [`${event.serial} ${event.unix_s}`, event]));
  text(parts.count, events.length ? `${events.length} of ${all.length}, the newest first` : "");
  text(parts.none, all.length ? "No event of this kind." : nothing());
  parts.none.hidden = events.length > 0;
  const note = state.player?.eventsNote ?? "";
  text(parts.note, note);
  parts.note.hidden = !note || !all.length;
  markRead();
}

function nothing() {
  if (state.mode === "live") return "Nothing has happened since the server started.";
  if (!state.player?.events) return "Reading the events …";
  return state.player.eventsNote || "The recording holds no events.";
}

/** Severe events that have not been shown yet. */
export function unread() {
  return state.log.filter((event) => event.level === "bad" && event.unix_s > readUnix_s).length;
}

function markRead() {
  const newest = state.log.at(-1)?.unix_s ?? 0;
  if (state.mode !== "live" || newest <= readUnix_s) return;
  readUnix_s = newest;
  saveSetting(READ, String(newest));
  changed("read");
}

function isIn(name, { kind, level }) {
  if (name === "severe") return level === "bad" || level === "warning";
  return GROUPS[name].kinds?.includes(kind) ?? true;
}

function makeEvent(_key, { unix_s, level, name, text: only, count }) {
  const words = count > 1 ? `${only} (the last of ${count} changes in a row)` : only;
  const element = h(
    "li",
    { class: level },
    h("time", { class: "when", title: dateTime(unix_s), dateTime: new Date(unix_s * 1e3).toISOString() }, timeOfDay(unix_s)),
    h("span", { class: "log-mark", "aria-hidden": "true" }, MARKS[level]),
    h("span", { class: "unseen" }, WORDS[level]),
    subject(name, sentence(words)),
  );
  return { element };
}

/** The words, as a button where they are about a tag, an anchor or a zone of the map. */
function subject(name, words) {
  const [kind, id] = [name.slice(0, name.indexOf("/")), name.slice(name.indexOf("/") + 1)];
  if (!["tag", "anchor", "zone"].includes(kind)) return h("span", {}, words);
  const go = () => select(kind, kind === "anchor" ? Number(id) : id);
  return h("button", { type: "button", class: "name", onclick: go }, words);
}
