/** Alarms: those first that need somebody, who acknowledges them, and the rules that raise them. */

import { saveSetting, savedSetting, state } from "../store.js";
import { shownName } from "../assets/model.js";
import { Rows, button, h, offer, options, text } from "../dom.js";
import { dateTime, duration, sentence, timeOfDay } from "../format.js";
import { now_s } from "../clock.js";
import { SEVERITIES, acknowledgeAll, isActive, isUnseen, selectSubject } from "./model.js";
import { rulesSection } from "./rules.js";

export const title = "Alarms";
export const topics = ["alarms", "rules", "zones", "assets", "mode", "connection"];
export const interval_ms = 100;
export const changesWithTime = true;

const FILTERS = {
  "": { words: "All alarms", has: () => true },
  unseen: { words: "Not acknowledged", has: isUnseen },
  active: { words: "Active", has: isActive },
  critical: { words: "Critical", has: ({ severity }) => severity === "critical" },
};
const BY = "skyless-acknowledged-by";
let parts = null;

/** Build the tab. */
export function start(panel) {
  const count = h("p", { class: "count" });
  const filter = options({ "aria-label": "Which alarms" }, [], show);
  const needed = { required: true, maxLength: 60, pattern: ".*\\S.*", title: "Others see who has acknowledged an alarm" };
  const by = h("input", { type: "text", id: "acknowledged-by", autocomplete: "name", value: savedSetting(BY) ?? "", ...needed });
  by.addEventListener("change", () => saveSetting(BY, by.value.trim()));
  const name = h("label", { class: "field by changes" }, h("span", {}, "Your name, for acknowledging; kept in this browser"), by);
  const all = button("", () => see(shownAlarms().filter(isUnseen)), { class: "quiet changes" });
  const note = h("p", { class: "fine" });
  const list = h("ol", { class: "alarms", "aria-label": "Alarms" });
  const rules = rulesSection();
  parts = { count, filter, by, all, note, name, rows: new Rows(list, makeAlarm), rules };
  panel.append(h("div", { class: "above" }, count, filter), name, all, list, note, rules.element);
}

/** Bring the tab up to date. */
export function show() {
  const rules = [...new Map(state.alarms.map(({ rule, name }) => [`rule ${rule}`, name || rule]))];
  const filters = Object.entries(FILTERS).map(([key, { words }]) => [key, words]);
  const pairs = [...filters, ...rules.map(([key, words]) => [key, `Rule: ${words}`])];
  const { filter } = parts;
  offer(filter, pairs, filter.value);
  const alarms = shownAlarms();
  const unseen = alarms.filter(isUnseen).length;
  filter.hidden = !state.alarms.length;
  const [active, open] = [isActive, isUnseen].map((test) => state.alarms.filter(test).length);
  text(parts.count, state.alarms.length ? `${active} active, ${open} not acknowledged` : "");
  parts.name.hidden = !state.alarms.length;
  parts.all.hidden = unseen < 2;
  text(parts.all, `Acknowledge all ${unseen} shown`);
  parts.rows.show(alarms.map((alarm) => [alarm.id, alarm]));
  const none = alarms.length ? "" : state.alarms.length ? "No alarm of this kind. " : "No alarms. ";
  text(parts.note, none + (state.moreAlarms ? `${state.moreAlarms} older alarms are not shown.` : ""));
  parts.rules.show();
}

function shownAlarms() {
  const chosen = parts.filter.value;
  const rule = chosen.startsWith("rule ") ? chosen.slice(5) : null;
  return state.alarms.filter((alarm) => (rule === null ? (FILTERS[chosen]?.has(alarm) ?? true) : alarm.rule === rule));
}

/** Acknowledge alarms; without a name, the browser asks for it. */
function see(alarms) {
  if (parts.by.reportValidity()) acknowledgeAll(alarms, parts.by.value.trim());
}

function makeAlarm(_id, alarm) {
  let now = alarm;
  const { mark } = SEVERITIES[alarm.severity];
  const what = button(sentence(alarm.sentence), () => selectSubject(now), { class: "name" });
  const about = h("p", { class: "fine" });
  const seen = button("Acknowledge", () => see([now]), { class: "changes", "aria-label": `Acknowledge: ${alarm.sentence}` });
  const icon = h("span", { class: "log-mark", "aria-hidden": "true" }, mark);
  const element = h("li", {}, icon, h("div", {}, h("span", { class: "unseen" }, `${alarm.severity}: `), what, about), seen);
  const update = (next) => {
    now = next;
    const state = isActive(next) ? "active" : "ended";
    element.className = `${next.severity} ${state}${isUnseen(next) ? " open" : ""}`;
    text(about, aboutWords(next));
    about.title = dateTime(next.since_unix_s);
    seen.hidden = !isUnseen(next);
  };
  return { element, update };
}

function aboutWords(alarm) {
  const { since_unix_s, ended_unix_s, acknowledged_by, place, rule, name, tags } = alarm;
  const lasts = duration(Math.max(0, (isActive(alarm) ? now_s() : ended_unix_s) - since_unix_s), 1);
  return [
    isActive(alarm) ? `Active since ${timeOfDay(since_unix_s)}, ${lasts}` : `Ended ${timeOfDay(ended_unix_s)} after ${lasts}`,
    place,
    tags?.map(shownName).join(", "),
    `rule ${name || rule}`,
    isUnseen(alarm) ? "" : `acknowledged by ${acknowledged_by || "somebody"}`,
  ].filter(Boolean).join(" · ");
}
