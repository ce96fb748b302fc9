/** Step 6: what will be changed, and saving it. */

import { changed, state } from "../store.js";
import { h, text } from "../dom.js";
import { putFloorPlan, saveSurvey } from "../api.js";
import { timeOfDay } from "../format.js";
import { presence } from "../survey/model.js";
import { plan, stored } from "../survey/plan.js";
import { list, verdict } from "../survey/verdict.js";

export const title = "Save";

/** The survey program counts as silent when it has not saved after this long. */
const ANSWER_MS = 15_000;
/** An error that the program already had may be in a message that was on its way; after this long it is the answer. */
const CROSSED_MS = 3000;

/**
 * `error` and `saved_unix_s` are of the program's last message before the request.
 * @type {{phase: "none"|"sending"|"waiting"|"saved"|"failed", serial: number, sinceMs: number, words: string,
 *   error: string|null, saved_unix_s: number|null}}
 */
let saving = { phase: "none", serial: -1, sinceMs: 0, words: "", error: null, saved_unix_s: null };
let parts = null;

/** Build the step. */
export function start(body) {
  const what = h("ul", { class: "what", id: "save-what" });
  const warning = h("p", { class: "reason", id: "save-warning", hidden: true });
  const sure = h("input", { type: "checkbox", id: "save-sure" });
  sure.addEventListener("change", show);
  const confirm = h("label", { class: "switch", hidden: true }, sure, "Save it all the same");
  const button = h("button", { type: "button", class: "primary", id: "save", disabled: true, onclick: save }, "Save and use");
  const state = h("p", { id: "save-state", role: "status" });
  parts = { what, warning, sure, confirm, button, state, shown: "" };
  body.append(h("p", {}, "Saving writes the site file and lets the anchors adopt it; no program restarts:"));
  body.append(what, warning, confirm, button, state);
}

/** How it stands. */
export function summary() {
  const { survey } = state;
  if (!survey?.survey || survey.saved_serial === null || survey.saved_serial === undefined) return "";
  return survey.saved_serial === survey.serial ? "saved" : "saved, newer result";
}

/** Bring the step up to date. */
export function show() {
  follow();
  const lines = changes();
  const key = JSON.stringify(lines);
  if (key !== parts.shown) parts.what.replaceChildren(...lines.map((words) => h("li", {}, words)));
  parts.shown = key;
  const { kind, title: name, words } = verdict();
  const healthy = kind === "good" || (kind === "note" && state.survey?.survey);
  const possible = presence() === "fresh" && Boolean(state.survey?.survey) && state.connection.phase === "open";
  parts.warning.hidden = healthy || !possible;
  text(parts.warning, `${name}: ${words}`);
  parts.confirm.hidden = parts.warning.hidden;
  if (parts.confirm.hidden) parts.sure.checked = false;
  const busy = saving.phase === "sending" || saving.phase === "waiting";
  parts.button.disabled = !possible || busy || !(healthy || parts.sure.checked);
  text(parts.button, healthy ? "Save and use" : "Save all the same");
  text(parts.state, saving.words);
  parts.state.className = { saved: "good", failed: "bad" }[saving.phase] ?? "";
}

/** What saving changes, in lines. */
function changes() {
  const { survey, file } = state.survey ?? {};
  if (!survey) return ["There is no result yet."];
  const placed = survey.anchors.filter((anchor) => anchor.determined);
  const others = survey.anchors.filter((anchor) => !anchor.determined).map((anchor) => anchor.id);
  const lines = [`positions and antenna delays of ${placed.length} ${placed.length === 1 ? "anchor" : "anchors"}`];
  if (others.length) lines.push(`unchanged, as not determined: ${list(others, 12)}`);
  const { missing } = state.survey;
  if (missing.length) lines.push(`unchanged, as not received: ${list(missing, 12)}`);
  lines.push(`the file ${file ?? "of the site"}; the old one is kept`);
  if (plan) lines.push(plan.blob ? `the floor plan ${plan.name}` : "where the floor plan is");
  return lines;
}

async function save() {
  const { serial, error, saved_unix_s } = state.survey;
  saving = { phase: "sending", serial, sinceMs: performance.now(), words: "Sending …", error, saved_unix_s };
  show();
  try {
    if (plan?.blob) {
      await putFloorPlan(plan.blob);
      stored();
    }
    await saveSurvey(serial);
    saving = { ...saving, phase: "waiting", sinceMs: performance.now(), words: "Saving …" };
  } catch (problem) {
    saving = { ...saving, phase: "failed", words: `Not saved: ${problem.message}` };
  }
  changed("survey");
}

/** Watch for the program's answer. */
function follow() {
  if (saving.phase !== "waiting" || !state.survey) return;
  const past = performance.now() - saving.sinceMs;
  const { saved_serial, saved_unix_s, error, file } = state.survey;
  if (saved_unix_s && saved_unix_s !== saving.saved_unix_s && saved_serial >= saving.serial) {
    const words = `Saved at ${timeOfDay(saved_unix_s)}${file ? ` in ${file}` : ""}, and sent to the anchors.`;
    saving = { ...saving, phase: "saved", words };
  } else if (error && (error !== saving.error || past > CROSSED_MS)) {
    saving = { ...saving, phase: "failed", words: `Not saved: ${error}` };
  } else if (past > ANSWER_MS) {
    const words = "The survey program has not answered. Look at its log, then try again.";
    saving = { ...saving, phase: "failed", words };
  }
}
