/** Alarms of the live site: their order, what they are about, and who acknowledges them. */

import { changed, saveSetting, savedSetting, select, state } from "../store.js";
import { acknowledge } from "../api.js";
import { toast } from "../dom.js";

/** Severities, the worst first, with the colour and the mark of each. */
export const SEVERITIES = {
  critical: { colour: "bad", mark: "✕" },
  warning: { colour: "warn", mark: "▲" },
  info: { colour: "accent", mark: "●" },
};
const RANKS = Object.keys(SEVERITIES);
const BY = "skyless-acknowledged-by";

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

/** What an alarm is about: its kind, and the names or numbers. @returns {{kind: "tag"|"anchor"|"zone", ids: any[]}} */
export function subjectOf({ kind, subject, tags, zone }) {
  if (kind.startsWith("anchor-")) return { kind: "anchor", ids: [Number(subject.replace("anchor-", ""))] };
  if (kind === "crowded") return { kind: "zone", ids: [zone ?? subject.replace("zone-", "")] };
  return { kind: "tag", ids: tags?.length ? tags : subject.split("+") };
}

/** Select what an alarm is about. */
export function selectSubject(alarm) {
  const { kind, ids } = subjectOf(alarm);
  select(kind, ids[0]);
}

/** The name of the user of this browser. */
export function acknowledger() {
  return savedSetting(BY) ?? "";
}

/** Keep the name of the user of this browser. */
export function keepAcknowledger(name) {
  saveSetting(BY, name);
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
