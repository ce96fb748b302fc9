/** What the survey program has sent, how old it is, and the facts that this page's user gives it. */

import { changed, state } from "../store.js";
import { putFacts } from "../api.js";
import { toast } from "../dom.js";

/** A message older than this is reported as old; the program of a large site sends this many pairs a second. */
const FRESH_S = 5;
const PAIRS_PER_S = 400;
/** Without stamps of the anchors the program, which says so, sends every ten seconds. */
const IDLE_S = 15;
/** Facts that were given count as not used when no message shows them for this long. */
const ANSWER_S = 10;

/** Facts as the survey program has them where the user has given none. */
const NO_FACTS = {
  dimensions: 2,
  heights_m: {},
  height_std_m: 0.02,
  tapes: [],
  points: {},
  point_std_m: 0.005,
  sketch_m: {},
  sketch_std_m: 0.3,
  keep_positions: false,
  delay_std_m: 0.07,
  common_delay_std_m: 0.1,
  pair_std_m: 0.03,
  gauge: null,
};

/** When the survey program's last message came, less its age then, by `performance.now()`. */
let surveyMs = 0;
/** @type {{facts: any, sinceMs: number}|null} facts given here that no message shows yet */
let given = null;
/** @type {any} where the floor plan lies, as far as this page's user has said so */
let floorPlan = null;
/** Whether this page's user has given anything. */
let hasGiven = false;

/** Expect the messages of a new connection. */
export function restart() {
  state.survey = null;
  state.watch = null;
  changed("survey", "watch");
}

/** Keep a message of the survey program, which was so old when the server sent it. */
export function receiveSurvey(message, old_s) {
  surveyMs = performance.now() - 1e3 * (old_s ?? 0);
  state.survey = message;
  if (given && message && sameFacts(message.facts, given.facts)) given = null;
  changed("survey");
}

/** Keep a message of the watch. */
export function receiveWatch(message) {
  state.watch = message;
  changed("watch");
}

/** Age of the survey program's last message; null without one. */
export function age_s() {
  return state.survey ? (performance.now() - surveyMs) / 1e3 : null;
}

/** Whether the survey program is there: "fresh", "old", or "none". */
export function presence() {
  const programs = [...state.health.nodes.values()].filter((node) => node.kind === "survey");
  const age = age_s();
  if (age === null || (programs.length && !programs.some((node) => node.online))) return "none";
  const interval_s = state.survey.pairs.length / PAIRS_PER_S;
  return age < (noData() ? IDLE_S : Math.max(FRESH_S, 2 * interval_s)) ? "fresh" : "old";
}

/** Whether the survey program receives nothing of the anchors. */
export function noData() {
  return state.survey?.state === "no data";
}

/** All facts, with those that are on their way. */
export function facts() {
  return { ...NO_FACTS, ...(given?.facts ?? state.survey?.facts) };
}

/** Whether facts are on their way; "late" when no message shows them after a while. */
export function pending() {
  if (!given) return null;
  return performance.now() - given.sinceMs > ANSWER_S * 1e3 ? "late" : "soon";
}

/** Change some facts: all are sent, as they replace those before. Resolves to whether they were accepted. */
export async function changeFacts(change) {
  hasGiven = true;
  const before = given;
  const next = { ...facts(), ...change };
  const mine = { facts: next, sinceMs: performance.now() };
  if (!sameFacts(state.survey?.facts ?? {}, next)) given = mine;
  changed("survey");
  try {
    await putFacts(next, floorPlan);
    return true;
  } catch (error) {
    if (given === mine) given = before;
    changed("survey");
    toast(`Not accepted: ${error.message}`, "bad");
    return false;
  }
}

/** Say where the floor plan lies; its image is stored with the survey. */
export function placeFloorPlan(plan) {
  floorPlan = plan;
  return changeFacts({});
}

/** Whether the map shows the survey's picture: during the set-up, and at a site that has no positions yet. */
export function surveyShown() {
  return state.mode === "live" && state.survey !== null && (state.setup.open || !state.site?.anchors.length);
}

/** Whether all anchors have positions, and nobody has named axes or measured anything for a survey. */
export function isInUse() {
  if (hasGiven || !state.site?.anchors.length || state.site.unplaced?.length) return false;
  const { gauge, tapes, points } = facts();
  return gauge === null && !tapes.length && !Object.keys(points).length;
}

/** Anchors that are known from anywhere, in ascending order. */
export function anchorIds() {
  const ids = new Set([...(state.survey?.anchors ?? []), ...(state.survey?.missing ?? [])]);
  for (const anchor of [...(state.site?.anchors ?? []), ...(state.site?.unplaced ?? [])]) ids.add(anchor.id);
  return [...ids].sort((a, b) => a - b);
}

/** The result of one anchor; undefined without one. */
export function surveyed(id) {
  return state.survey?.survey?.anchors.find((anchor) => anchor.id === id);
}

/** Whether two sets of facts are equal; values at their defaults may be missing. */
function sameFacts(one, other) {
  return sorted({ ...NO_FACTS, ...one }) === sorted({ ...NO_FACTS, ...other });
}

/** JSON whose keys are in order. */
function sorted(value) {
  return JSON.stringify(value, (_key, part) =>
    part && typeof part === "object" && !Array.isArray(part)
      ? Object.fromEntries(Object.entries(part).sort(([a], [b]) => (a < b ? -1 : 1)))
      : part,
  );
}
