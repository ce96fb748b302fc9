/** What the watch of the anchors finds: which anchors it concerns, and its words. */

import { state } from "../store.js";
import { length, sentence, timeOfDay } from "../format.js";

const MARKS = { moved: "moved", delay: "delay changed", link: "link blocked", check: "check" };

/** The findings on the live site; none in a recording. */
export function findings() {
  return state.mode === "live" ? (state.watch?.findings ?? []) : [];
}

/** The finding that concerns an anchor most; undefined without one. */
export function findingAt(id) {
  const mine = findings().filter((finding) => finding.anchors.includes(id));
  return mine.find((finding) => finding.kind === "moved") ?? mine.find((finding) => finding.kind === "delay") ?? mine[0];
}

/** A few words for the anchor's mark. */
export function markWords(finding) {
  return finding.kind === "moved" ? `moved ${length(finding.size_m)}` : MARKS[finding.kind];
}

/** A finding as a sentence with its time. */
export function findingWords(finding) {
  const since = timeOfDay(finding.since_unix_s).slice(0, 5);
  return sentence(`${finding.sentence.replace(/\.$/, "")}, since ${since}`);
}
