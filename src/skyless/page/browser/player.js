/** The player of the past: a recording, whose states are fetched ahead, a tag's way, or a heat map, which has no moment. */

import { changed, on, select, siteOf, state } from "./store.js";
import { recordedEvents, recordedStates, recording } from "./api.js";
import { replayed } from "./clock.js";
import { backToLive } from "./live.js";

/** Time that is fetched before a moment (for trails and charts) and after it, at speed 1; together at most 60 s. */
const BEFORE_S = 25;
const AFTER_S = 20;
/** Time that is kept: a track's ring buffer holds 2048 states. */
const KEPT_S = 90;
/** Events nearer than this to the present moment are passed when the next or the last one is looked for. */
const AT_EVENT_S = 0.3;
/** An event is shown from a little before it on. */
const LEAD_S = 1.0;
/** Levels of events that have a mark on the bar. */
const MARKED = new Set(["warning", "bad"]);
/** Points of a way are joined up to the server's gap, or a multiple of their usual step: they are thinned. */
const GAP_STEPS = 3;
/** Multiples of real time. */
export const SPEEDS = { recording: [0.25, 0.5, 1, 2, 4, 8], way: [1, 4, 16, 60, 300, 1000], heat: [] };

/** What is chosen in the bar holds for the next one of the same kind, too. */
const chosen = { recording: { speed: 1 }, way: { speed: 16, colours: "time" } };
/** Increases where an answer that is awaited is useless, as another recording is to be opened. */
let openings = 0;
let lastFrame = 0;

/** Open a recording and play it from its first fix; where it cannot be opened, what is shown stays. */
export async function open(name) {
  const mine = ++openings;
  const { start_unix_s, end_unix_s, fix_spans_unix_s = [], site, tags = [], zones = [] } = await recording(name);
  if (mine !== openings) return;
  state.mode = "replay";
  state.site = siteOf(site);
  state.simulated = site?.simulated ?? false;
  state.zones = zones;
  replayed.clear();
  replayed.addNames(tags);
  select(null);
  const fixes = fix_spans_unix_s.map((span) => span.map((at) => at - start_unix_s));
  const duration_s = Math.max(0, end_unix_s - start_unix_s);
  play({ kind: "recording", name, start_unix_s, duration_s, fixes, loaded: { from: 0, to: 0 }, events: null, playing: true });
  changed("site", "zones", "tags");
  loadEvents(state.player);
}

/** Show a tag's way, a `Track` with at least one point; `title` says whose. */
export function showWay(track, title) {
  const start_unix_s = track.points[0][0];
  const times = track.points.map(([unix_s]) => unix_s - start_unix_s);
  const steps = Float64Array.from(times.slice(1), (at, index) => at - times[index]).sort();
  const gap_s = Math.max(track.gap_s, GAP_STEPS * (steps[steps.length >> 1] ?? 0));
  const fixes = [];
  times.forEach((at, index) => {
    if (index && at - times[index - 1] <= gap_s) fixes.at(-1)[1] = at;
    else fixes.push([at, at]);
  });
  play({ kind: "way", title, track, times, gap_s, start_unix_s, duration_s: times.at(-1), fixes });
}

/** Show a heat map, a `Heatmap` of a time. */
export function showHeat(map, title, { from_unix_s, to_unix_s }) {
  play({ kind: "heat", title, map, start_unix_s: from_unix_s, duration_s: to_unix_s - from_unix_s });
}

/** Show the past; `fixes` are when there are some, `loaded` is what can be played at once, in s since the start. */
function play(source) {
  const whole = { fixes: [], loaded: { from: 0, to: Infinity }, events: [], marked: [] };
  state.player = { playing: false, ...whole, ...chosen[source.kind], ...source };
  seek(firstFix_s(state.player));
  changed("mode");
}

/** Show the present again. */
export function close() {
  openings++;
  state.player = null;
  if (state.mode === "replay") backToLive();
  changed("mode", "player");
}

/** The first moment that shows a tag. */
function firstFix_s(player) {
  return player.fixes[0]?.[0] ?? 0;
}

/** Fetch the events while the recording is played already. */
async function loadEvents(player) {
  try {
    const { events, complete } = await recordedEvents(player.name);
    player.events = events.map((event) => ({ ...event, at_s: event.unix_s - player.start_unix_s }));
    player.marked = player.events.filter(({ level, kind }) => MARKED.has(level) && kind !== "program");
    player.eventsNote = complete ? "" : "The recording has more events than are listed.";
  } catch (error) {
    player.events = [];
    player.eventsNote = `The events cannot be read: ${error.message}`;
  }
  if (player === state.player) changed("mode", "player");
}

/** Show the moment of an event. */
export function seekEvent(event) {
  seek(event.at_s - LEAD_S);
}

/** Seek to the next event with a mark (1) or the one before (-1). */
export function stepEvent(direction) {
  const { marked, at_s } = state.player;
  const apart_s = (event) => direction * (event.at_s - at_s - LEAD_S);
  const found = (direction > 0 ? marked : marked.toReversed()).find((event) => apart_s(event) > AT_EVENT_S);
  if (found) seekEvent(found);
}

/** Pause, and seek by a time in s. */
export function step(by_s) {
  state.player.playing = false;
  seek(state.player.at_s + by_s);
}

/** The next higher (1) or lower (-1) speed. */
export function stepSpeed(direction) {
  const speeds = SPEEDS[state.player.kind];
  const speed = speeds[speeds.indexOf(state.player.speed) + direction];
  if (speed) choose({ speed });
}

/** Set the speed, or what the colours of a way mean ("time" or "speed"). */
export function choose(values) {
  Object.assign(chosen[state.player.kind], values);
  Object.assign(state.player, values);
  changed("mode", "player");
}

/** Show a moment, in s since the start. */
export function seek(at_s) {
  const { player } = state;
  if (!player) return;
  player.at_s = Math.min(Math.max(at_s, 0), player.duration_s);
  player.waiting = isMissing(player);
  player.error = "";
  changed("player", "tags");
}

/** Whether the states of the moment have to be fetched first. */
function isMissing({ at_s, loaded }) {
  return at_s < loaded.from || at_s >= loaded.to;
}

/** Fetch the states around the moment, or with `more` those after what is loaded. */
async function load(player, more) {
  player.loading = true;
  const ahead_s = Math.min(AFTER_S * Math.max(1, player.speed / 2), 60 - BEFORE_S);
  const from = more ? player.loaded.to : Math.max(0, player.at_s - BEFORE_S);
  const to = Math.min((more ? from : player.at_s) + ahead_s, player.duration_s + 0.001);
  try {
    const states = await recordedStates(player.name, from, to, player.speed > 2 ? 10 : 20);
    if (player !== state.player) return;
    if (!more) replayed.clearStates();
    for (const one of states) replayed.add(one.tags);
    player.loaded = { from: more ? Math.max(player.loaded.from, to - KEPT_S) : from, to };
    player.waiting = isMissing(player); // where another moment has been chosen meanwhile
  } catch (error) {
    Object.assign(player, { error: error.message, playing: false });
  }
  player.loading = false;
  changed("player", "tags");
}

/** Play or pause; at the end, from the first fix. */
export function toggle() {
  const { player } = state;
  player.playing = !player.playing;
  if (player.playing) seek(player.at_s < player.duration_s ? player.at_s : firstFix_s(player));
  lastFrame = 0;
  changed("player");
}

on(["player"], () => {
  const { player } = state;
  const now = performance.now();
  const step_s = Math.min((now - (lastFrame || now)) / 1e3, 0.25);
  lastFrame = player?.playing ? now : 0;
  if (!player) return;
  if (player.playing && !player.waiting) advance(player, step_s * player.speed);
  const { loaded, duration_s, at_s } = player;
  const ends = player.playing && loaded.to < duration_s && loaded.to - at_s < 6 * Math.max(1, player.speed);
  if ((player.waiting || ends) && !player.loading && !player.error) load(player, !player.waiting);
  if (player.playing) changed("player", "tags");
});

function advance(player, step_s) {
  player.at_s = Math.min(player.at_s + step_s, player.duration_s, player.loaded.to);
  if (player.kind === "way") player.at_s = Math.max(player.at_s, player.fixes.find(([, to]) => player.at_s <= to)[0]); // gaps are skipped
  if (player.at_s >= player.duration_s) player.playing = false;
}
