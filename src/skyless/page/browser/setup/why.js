/** Step 5: what is uncertain, and why. */

import { state } from "../store.js";
import { h, text } from "../dom.js";
import { length, sentence } from "../format.js";

export const title = "What is uncertain";

let parts = null;

/** Build the step. */
export function start(body) {
  const sections = h("div", { id: "why" });
  const pairs = h("p", { class: "fine" });
  parts = { sections, pairs, shown: "" };
  body.append(sections, pairs);
}

/** How it stands. */
export function summary() {
  const survey = state.survey?.survey;
  if (!survey) return "";
  const count = reasons(survey).length;
  return count ? `${count} ${count === 1 ? "thing" : "things"}` : "nothing found";
}

/** Bring the step up to date. */
export function show() {
  const survey = state.survey?.survey;
  const found = survey ? reasons(survey) : [];
  const key = JSON.stringify([Boolean(survey), found]);
  if (key !== parts.shown) parts.sections.replaceChildren(...elements(survey, found));
  parts.shown = key;
  text(parts.pairs, survey ? pairWords(survey) : "");
}

/** Kind, heading and sentence of everything that speaks against the result. */
function reasons(survey) {
  const undetermined = survey.anchors.filter((anchor) => !anchor.determined && anchor.reason);
  return [
    ...survey.not_determined.map((words) => ["bad", "Not determined:", sentence(words)]),
    ...undetermined.map((anchor) => ["bad", `Anchor ${anchor.id}:`, sentence(anchor.reason)]),
    ...survey.ambiguities.map((other) => ["warn", "Ambiguous:", sentence(other.sentence)]),
    ...(survey.unchecked ? [["warn", "Unchecked:", sentence(survey.unchecked)]] : []),
    ...(survey.assumed_heights ? [["warn", "Heights:", sentence(survey.assumed_heights)]] : []),
    ...survey.notes.map((words) => ["note", "Note:", sentence(words)]),
  ];
}

function elements(survey, found) {
  if (!survey) return [h("p", { class: "empty" }, "There is no result yet.")];
  if (!found.length) return [h("p", {}, "The result is determined, the ranges check it, and no other result fits them.")];
  const items = found.map(([kind, heading, words]) => h("li", { class: kind }, h("strong", {}, heading), ` ${words}`));
  const help = "A dashed mark has no sure position; an open square with a question mark is where another result has an anchor.";
  return [h("ul", { class: "reasons" }, ...items), h("p", { class: "fine" }, help)];
}

/** How ranges fit. */
function pairWords(survey) {
  const used = survey.pairs.filter((pair) => !pair.excluded);
  const late = survey.pairs.filter((pair) => pair.excluded).map((pair) => `${pair.a}–${pair.b}`);
  const extra = survey.redundancy > 0 ? `${survey.redundancy} more` : "no more";
  const assumed = `Ranges are taken to be off by ${length(survey.range_std_m)} each; ${extra} than the result needs check it.`;
  if (!late.length) return `${used.length} pairs are used. ${assumed}`;
  const listed = late.length > 12 ? `${late.slice(0, 12).join(", ")} and ${late.length - 12} more` : late.join(", ");
  return `${used.length} pairs are used; left out as late: ${listed} (dashed lines). ${assumed}`;
}
