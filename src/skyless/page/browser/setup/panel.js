/** The guided set-up: how the survey stands, and its steps from the first anchor received to the site file. */

import { on, state } from "../store.js";
import { h, s, text, toast } from "../dom.js";
import { presence } from "../survey/model.js";
import { setMoving } from "../survey/plan.js";
import { stopPicking } from "../survey/picking.js";
import { command, headline } from "../survey/verdict.js";
import * as axes from "./axes.js";
import * as heard from "./heard.js";
import * as measures from "./measures.js";
import * as plan from "./plan.js";
import * as save from "./save.js";
import * as why from "./why.js";

export const title = "Set up";
export const topics = ["survey", "setup", "site", "mode", "connection", "health", "selection", "plan", "picking", "watch"];
export const interval_ms = 150;
export const changesWithTime = true;

/** Each has a title, `start(body)`, `show()` and `summary()`, a few words about how it stands. */
const STEPS = [heard, axes, measures, plan, why, save];
/** One shape for each verdict, so that the colour is not all that says it. */
const SHAPES = {
  good: "M2 9.5 7 14.5 16 4",
  note: "M9 3v7M9 14v.6",
  warn: "M9 2 17 16H1ZM9 7v4M9 13.4v.4",
  bad: "M3 3 15 15M15 3 3 15",
};

let parts = null;

/** Build the tab. */
export function start(panel) {
  const heading = h("strong", {});
  const words = h("span", {});
  const mark = h("span", { class: "verdict-mark", "aria-hidden": "true" });
  const box = h("div", { class: "verdict", id: "verdict", role: "status" }, mark, h("div", {}, heading, " ", words));
  const line = h("code", {});
  const copy = h("button", { type: "button", onclick: () => copyLine(line.textContent) }, "Copy");
  const starting = h("div", { class: "command", hidden: true }, line, copy);
  const note = h("p", { class: "empty", hidden: true }, "A site is set up live; go back from the replay first.");
  const steps = STEPS.map(makeStep);
  const list = h("div", { class: "steps" }, ...steps.map((step) => step.element));
  steps[0].element.open = true;
  parts = { box, heading, words, mark, starting, line, note, steps, list, kind: "" };
  panel.append(note, box, starting, list);
  on(["setup", "mode"], () => {
    if (state.setup.open && state.mode === "live") return;
    stopPicking();
    setMoving(false);
  });
}

function makeStep(step, index) {
  const summary = h("span", { class: "step-state" });
  const body = h("div", { class: "step-body" });
  const head = h("summary", {}, h("span", { class: "step-number" }, String(index + 1)), h("span", {}, step.title), summary);
  const element = h("details", { class: "step", name: "setup-step", id: `step-${index + 1}` }, head, body);
  step.start(body);
  if (index + 1 < STEPS.length) {
    const next = h("button", { type: "button", class: "next" }, `Next: ${STEPS[index + 1].title}`);
    next.addEventListener("click", () => openStep(index + 1));
    body.append(next);
  }
  element.addEventListener("toggle", () => {
    stopPicking();
    setMoving(false);
    if (!element.open) return;
    step.show();
    head.scrollIntoView({ block: "nearest" });
  });
  return { element, show: () => element.open && step.show(), summary: () => text(summary, step.summary()) };
}

function openStep(index) {
  const { element } = parts.steps[index];
  element.open = true;
  element.querySelector("summary").focus({ preventScroll: true });
  element.scrollIntoView({ block: "nearest" });
}

/** Bring the tab up to date. */
export function show() {
  const live = state.mode === "live";
  parts.note.hidden = live;
  parts.box.hidden = parts.list.hidden = !live;
  parts.starting.hidden = !live || presence() !== "none" || state.connection.phase !== "open";
  if (!live) return;
  const now = headline();
  if (parts.kind !== now.kind) {
    parts.kind = now.kind;
    parts.box.className = `verdict ${now.kind}`;
    parts.mark.replaceChildren(s("svg", { viewBox: "0 0 18 18" }, s("path", { d: SHAPES[now.kind] })));
  }
  text(parts.heading, `${now.title}.`);
  text(parts.words, now.words);
  text(parts.line, command());
  for (const step of parts.steps) {
    step.summary();
    step.show();
  }
}

async function copyLine(line) {
  try {
    await navigator.clipboard.writeText(line);
    toast("Copied.");
  } catch {
    toast("The browser does not allow copying here; select the line instead.", "bad");
  }
}
