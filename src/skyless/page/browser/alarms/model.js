/** Alarms of the live site: their order, what they are about, and who acknowledges them. */

import { changed, select, state } from "../store.js";
import { acknowledge } from "../api.js";
import { toast } from "../dom.js";

/** Severities, the worst first, with the colour and the mark of each. */
export const SEVERITIES = {
  critical: { colour: "bad", mark: "✕" },
  warning: { colour: "warn", mark: "▲" },
  info: { colour: "accent", mark: "●" },
};
const RANKS = Object.keys(SEVERITIES);

/** Keep the alarms: first those that nobody has acknowledged and those that last, of these the severest and newest. */
export function receiveAlarms(alarms, more = 0) {
  const rank = (alarm) => [!isUnseen(alarm), !isActive(alarm), RANKS.indexOf(alarm.severity), -alarm.unix_s];
  const ranked = alarms.map((alarm) => [rank(alarm), alarm]);
  ranked.sort(([a], [b]) => a.map((value, index) => value - b[index]).find(Boolean) ?? 0);
  state.alarms = ranked.map(([, alarm]) => alarm);
  state.moreAlarms = more;
  changed("alarms");
}

/** Whether its condition still holds. */
export function isActive(alarm) {
  return (alarm.ended_unix_s ?? null) === null;
}

/** Whether nobody has acknowledged it. */
export function isUnseen(alarm) {
  return (alarm.acknowledged_unix_s ?? null) === null;
}

/** How many nobody has acknowledged, and how many are acknowledged and active. */
export function counts() {
  const unseen = state.alarms.filter(isUnseen).length;
  return { unseen, seen: state.alarms.filter((alarm) => isActive(alarm) && !isUnseen(alarm)).length };
}

/** The critical ones that nobody has acknowledged. */
export function criticals() {
  return state.alarms.filter((alarm) => alarm.severity === "critical" && isUnseen(alarm));
}

/**
 * What an alarm is about, from its subject: `<tag>`, `<tag>~<tag>`, `zone-<id>` or `anchor-<id>`.
 * @returns {{kind: "tag"|"anchor"|"zone", ids: any[]}}
 */
export function subjectOf({ kind, subject }) {
  if (kind.startsWith("anchor-")) return { kind: "anchor", ids: [Number(subject.replace("anchor-", ""))] };
  if (kind === "crowded") return { kind: "zone", ids: [subject.replace("zone-", "")] };
  return { kind: "tag", ids: subject.split("~") };
}

/** The tags with an alarm that lasts. */
export function alarmedTags() {
  const subjects = state.mode === "live" ? state.alarms.filter(isActive).map(subjectOf) : [];
  return new Set(subjects.flatMap(({ kind, ids }) => (kind === "tag" ? ids : [])));
}

/** Select what an alarm is about. */
export function selectSubject(alarm) {
  const { kind, ids } = subjectOf(alarm);
  select(kind, ids[0]);
}

/** Acknowledge alarms, one after the other. @param {any[]} alarms */
export async function acknowledgeAll(alarms, by) {
  try {
    for (const alarm of alarms) {
      await acknowledge(alarm, by);
      const seen = { acknowledged_unix_s: Date.now() / 1e3, acknowledged_by: by };
      receiveAlarms(state.alarms.map((one) => (one.id === alarm.id ? { ...one, ...seen } : one)), state.moreAlarms);
    }
  } catch (error) {
    toast(`Not acknowledged: ${error.message}`, "bad");
  }
}
