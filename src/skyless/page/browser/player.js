/** Plays a recording: fetches its states ahead of time, and moves the shown moment. */

import { changed, on, select, siteOf, state } from "./store.js";
import { recordedEvents, recordedStates, recording } from "./api.js";
import { replayed } from "./clock.js";
import { backToLive } from "./live.js";

/** Time that is fetched before a moment (for trails and charts) and after it, at speed 1; together at most 60 s. */
const BEFORE_S = 25;
const AFTER_S = 20;
/** Time that is kept: a track's ring buffer holds 2048 states. */
const KEPT_S = 90;
export const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];

/** Count what makes an answer that is awaited useless: another recording is to be opened; another moment is shown. */
let openings = 0;
let generation = 0;
let fetching = false;
let loaded = { from: 0, to: 0 };
let lastFrame = 0;
let seekTimer = 0;

/** Events nearer than this to the present moment are passed when the next or the last one is looked for. */
const AT_EVENT_S = 0.3;
/** An event is shown from a little before it on. */
const LEAD_S = 1.0;
/** A step by the keyboard. */
export const STEP_S = 0.1;
/** Levels of events that have a mark on the bar. */
const MARKED = new Set(["warning", "bad"]);

/** Open a recording and play it from its first fix; where it cannot be opened, what is shown stays. */
export async function open(name) {
  const mine = ++openings;
  const found = await recording(name);
  if (mine !== openings) return;
  abandon();
  loaded = { from: 0, to: 0 };
  const duration_s = Math.max(0, found.end_unix_s - found.start_unix_s);
  const fixes = (found.fix_spans_unix_s ?? []).map((span) => span.map((at) => at - found.start_unix_s));
  const player = { name, start_unix_s: found.start_unix_s, duration_s, fixes, at_s: 0, playing: true, speed: 1 };
  state.player = { ...player, waiting: true, error: fixes.length ? "" : "There are no fixes in it.", events: null };
  state.mode = "replay";
  state.site = siteOf(found.site);
  state.simulated = found.site?.simulated ?? false;
  state.zones = found.zones ?? [];
  replayed.clear();
  replayed.addNames(found.tags ?? []);
  select(null);
  changed("mode", "site", "zones", "player", "tags", "selection");
  loadEvents(state.player);
  await seek(firstFix_s(state.player));
}

/** Wait for no states any more. */
function abandon() {
  clearTimeout(seekTimer);
  generation++;
  fetching = false;
}

/** The first moment that shows a tag. */
function firstFix_s(player) {
  return player.fixes[0]?.[0] ?? 0;
}

/** Fetch the events while the recording is played already. */
async function loadEvents(player) {
  try {
    const found = await recordedEvents(player.name);
    player.events = found.events.map((event) => ({ ...event, at_s: event.unix_s - player.start_unix_s }));
    player.eventsNote = found.complete ? "" : "The recording has more events than are listed.";
  } catch (error) {
    player.events = [];
    player.eventsNote = `The events cannot be read: ${error.message}`;
  }
  if (player === state.player) changed("player", "events");
}

/** The events that have a mark on the bar. */
export function markedEvents(player) {
  return (player.events ?? []).filter((event) => MARKED.has(event.level) && event.kind !== "program");
}

/** Show the moment of an event. */
export function seekEvent(event) {
  return seek(event.at_s - LEAD_S);
}

/** Seek to the next event with a mark (1) or the one before (-1). */
export function stepEvent(direction) {
  const player = state.player;
  if (!player) return;
  const now = player.at_s + LEAD_S;
  const marked = markedEvents(player);
  const found =
    direction > 0
      ? marked.find((event) => event.at_s > now + AT_EVENT_S)
      : marked.findLast((event) => event.at_s < now - AT_EVENT_S);
  if (found) seekEvent(found);
}

/** Pause, and seek by a time in s. */
export function step(by_s) {
  if (!state.player) return;
  state.player.playing = false;
  seek(state.player.at_s + by_s);
}

/** The next higher (1) or lower (-1) speed. */
export function stepSpeed(direction) {
  const at = SPEEDS.indexOf(state.player?.speed) + direction;
  if (SPEEDS[at]) setSpeed(SPEEDS[at]);
}

/** Leave the replay. */
export function close() {
  openings++;
  abandon();
  state.player = null;
  backToLive();
  changed("player");
}

/** Seek to a time in s since the start. */
export async function seek(at_s) {
  const player = state.player;
  if (!player) return;
  player.at_s = Math.min(Math.max(at_s, 0), player.duration_s);
  changed("player", "tags");
  const there = player.at_s >= loaded.from && player.at_s < loaded.to;
  if (there && !player.waiting) return;
  abandon(); // states of another moment
  player.waiting = !there;
  if (!there) seekTimer = setTimeout(() => load(true), 60);
}

async function load(restart) {
  const player = state.player;
  const mine = restart ? ++generation : generation;
  const ahead_s = Math.min(AFTER_S * Math.max(1, player.speed / 2), 60 - BEFORE_S);
  const from = restart ? Math.max(0, player.at_s - BEFORE_S) : loaded.to;
  const to = Math.min((restart ? player.at_s : loaded.to) + ahead_s, player.duration_s + 0.001);
  fetching = true;
  try {
    const states = await recordedStates(player.name, from, to, player.speed > 2 ? 10 : 20);
    if (mine !== generation || player !== state.player) return;
    if (restart) replayed.clearStates();
    for (const one of states) replayed.add(one.tags);
    loaded = { from: restart ? from : Math.max(loaded.from, to - KEPT_S), to };
    player.waiting = false;
    if (player.fixes.length) player.error = "";
  } catch (error) {
    if (mine !== generation || player !== state.player) return;
    player.error = error.message;
    player.playing = false;
  } finally {
    if (mine === generation) fetching = false;
  }
  changed("player", "tags");
}

/** Play or pause; at the end, from the first fix. */
export function toggle() {
  const player = state.player;
  if (!player) return;
  player.playing = !player.playing;
  if (player.playing && player.at_s >= player.duration_s) seek(firstFix_s(player));
  if (player.playing && player.error) load(true);
  lastFrame = 0;
  changed("player");
}

/** Set the speed, a multiple of real time. */
export function setSpeed(speed) {
  if (!state.player) return;
  state.player.speed = speed;
  changed("player");
}

on(["player"], () => {
  const player = state.player;
  const now = performance.now();
  const step_s = Math.min((now - (lastFrame || now)) / 1e3, 0.25);
  lastFrame = player?.playing ? now : 0;
  if (!player?.playing) return;
  if (!player.waiting) advance(player, step_s);
  changed("player", "tags");
});

function advance(player, step_s) {
  const end_s = Math.min(player.duration_s, loaded.to);
  player.at_s = Math.min(player.at_s + step_s * player.speed, end_s);
  if (player.at_s >= player.duration_s) player.playing = false;
  else if (loaded.to - player.at_s < 6 * Math.max(1, player.speed) && loaded.to < player.duration_s && !fetching) {
    load(false);
  }
}
