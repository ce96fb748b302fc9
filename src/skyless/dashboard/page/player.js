/** Plays a recording: fetches its states ahead of time, and moves the shown moment. */

import { changed, on, select, state } from "./store.js";
import { recordedStates, recording } from "./api.js";
import { replayed } from "./clock.js";
import { backToLive } from "./live.js";

/** Time that is fetched before a moment (for trails and charts) and after it, at speed 1; together at most 60 s. */
const BEFORE_S = 25;
const AFTER_S = 20;
/** Time that is kept: a track's ring buffer holds 2048 states. */
const KEPT_S = 90;
export const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];

let generation = 0;
let fetching = false;
let loaded = { from: 0, to: 0 };
let lastFrame = 0;
let seekTimer = 0;

/** Open a recording and play it from its start. */
export async function open(name) {
  const mine = ++generation;
  const found = await recording(name);
  if (mine !== generation) return;
  const duration_s = Math.max(0, found.end_unix_s - found.start_unix_s);
  state.player = { name, start_unix_s: found.start_unix_s, duration_s, at_s: 0, playing: true, speed: 1, error: "" };
  state.player.waiting = true;
  state.mode = "replay";
  state.site = found.site?.site ?? null;
  state.simulated = found.site?.simulated ?? false;
  state.zones = found.zones ?? [];
  replayed.all.clear();
  replayed.addNames(found.tags ?? []);
  replayed.sort();
  select(null);
  changed("mode", "site", "zones", "player", "tags", "selection");
  await seek(0);
}

/** Leave the replay. */
export function close() {
  generation++;
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
  clearTimeout(seekTimer);
  if (player.at_s >= loaded.from && player.at_s < loaded.to && loaded.name === player.name) return;
  player.waiting = true;
  seekTimer = setTimeout(() => load(true), 60);
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
    loaded = { name: player.name, from: restart ? from : Math.max(loaded.from, to - KEPT_S), to };
    player.waiting = false;
    player.error = "";
  } catch (error) {
    if (mine !== generation || player !== state.player) return;
    player.error = error.message;
    player.playing = false;
  } finally {
    if (mine === generation) fetching = false;
  }
  changed("player", "tags");
}

/** Play or pause; at the end, from the start. */
export function toggle() {
  const player = state.player;
  if (!player) return;
  player.playing = !player.playing;
  if (player.playing && player.at_s >= player.duration_s) seek(0);
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
