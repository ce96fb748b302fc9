/** The bar below the map while it shows the past: controls, keys and events of what is played, and the scale of its colours. */

import { on, state } from "./store.js";
import { button, byId, h, offer, text } from "./dom.js";
import { fileOf } from "./api.js";
import { clock, dateTime, metres, timeOfDay } from "./format.js";
import { heatScale, heatTicks, placeNow, ramp, topSpeed } from "./map/past.js";
import { paintScale } from "./pictures.js";
import { SPEEDS, choose, close, seek, seekEvent, step, stepEvent, stepSpeed, toggle } from "./player.js";
import { ALERTS } from "./tracks.js";
import { openWhatIf } from "./what_if.js";

const PLAY = "M7 4.5v15l12-7.5z";
const PAUSE = "M7 5h3.5v14H7zM13.5 5H17v14h-3.5z";
/** The keys, for the list in the tab Replay. */
export const KEYS = [
  ["K or space", "play, pause"],
  ["J, L", "5 s back, 5 s on; of a long way 1 %"],
  [", .", "0.1 s back, 0.1 s on; of a long way 1 s"],
  ["[ ]", "the event before, the next event"],
  ["< >", "slower, faster"],
  ["0 to 9", "0 to 90 % of the time"],
];
/** A way is long from this time on. */
const LONG_S = 3600;
/** Marks have at least this distance, in pixels; events that are closer share one. */
const MARK_PX = 26;
/** How many of the events that share a mark are named. */
const NAMED = 3;

/** Build the bar. */
export function start() {
  const listen = (id, event, call) => byId(id).addEventListener(event, call);
  listen("play", "click", toggle);
  listen("event-back", "click", () => stepEvent(-1));
  listen("event-next", "click", () => stepEvent(1));
  listen("event-marks", "keydown", moveAlong);
  listen("slider", "input", ({ target }) => seek(Number(target.value)));
  listen("speed", "change", ({ target }) => choose({ speed: Number(target.value) }));
  listen("past-colours", "change", ({ target }) => choose({ colours: target.value }));
  listen("what-if", "click", openWhatIf);
  listen("back", "click", close);
  addEventListener("keydown", pressKey);
  new ResizeObserver(showMarks).observe(byId("event-marks"));
  on(["mode", "theme"], show);
  on(["player"], showMoment);
}

/** A moment as a place along the bar. */
function along({ duration_s }, at_s) {
  return `${100 * Math.min(Math.max(at_s / (duration_s || 1), 0), 1)}%`;
}

/** Show what does not depend on the moment. */
function show() {
  const { player } = state;
  byId("player").hidden = byId("past-mark").hidden = !player;
  document.body.classList.toggle("replaying", player?.kind === "recording");
  document.body.classList.toggle("past", state.past !== null);
  if (!player) return;
  text(byId("announcement"), "The map shows the past.");
  byId("player").dataset.kind = player.kind;
  Object.assign(byId("slider"), { max: player.duration_s, step: step_s(player) });
  offer(byId("speed"), SPEEDS[player.kind].map((speed) => [speed, `${speed} ×`]), player.speed);
  byId("past-colours").value = player.colours;
  const spans = player.fixes.map(([from, to]) => {
    const span = h("i", {});
    Object.assign(span.style, { left: along(player, from), right: `calc(100% - ${along(player, to)})` });
    return span;
  });
  byId("spans").replaceChildren(...spans);
  byId("event-back").disabled = byId("event-next").disabled = !player.marked.length;
  Object.assign(byId("download"), { href: fileOf(player.name), download: player.name, ariaLabel: `Download ${player.name}` });
  showMarks();
  showScale(player);
  showMoment();
}

/** What the colours of a way or of a heat map mean. */
function showScale(player) {
  if (player.kind === "recording") return;
  const isHeat = player.kind === "heat";
  const ends = player.colours === "speed" ? ["0", `${topSpeed(player).toFixed(1)} m/s`] : range(player);
  const ticks = isHeat ? heatTicks(heatScale(player.map)) : ends.map((words, at) => [at, words]);
  text(byId("past-scale"), isHeat ? `Time in a cell of ${player.map.cell_m} m × ${player.map.cell_m} m, logarithmic` : "");
  const [, canvas, marks] = byId("past-ramp").children;
  paintScale(canvas, ramp(), marks, ticks);
}

/** Begin and end in a few characters: within a day without the second date. */
function range({ start_unix_s, duration_s }) {
  const [from, to] = [start_unix_s, start_unix_s + duration_s].map((unix_s) => dateTime(unix_s).slice(5, 16));
  return [from, from.slice(0, 5) === to.slice(0, 5) ? to.slice(6) : to];
}

function showMoment() {
  const { player } = state;
  if (!player) return;
  const { mark, time = "", about = "", problem = "" } = wordsOf(player);
  byId("play").ariaLabel = `${player.playing ? "Pause" : "Play"} (K)`;
  byId("play").querySelector("path").setAttribute("d", player.playing ? PAUSE : PLAY);
  byId("slider").value = String(player.at_s);
  byId("slider").ariaValueText = player.kind === "way" ? dateTime(player.start_unix_s + player.at_s) : time;
  text(byId("past-mark"), mark);
  text(byId("play-time"), time);
  text(byId("play-about"), about);
  text(byId("play-problem"), problem);
}

/** What is written of the moment: its time, what there is then, and the mark on the map. */
function wordsOf(player) {
  const { kind, title, name, at_s, duration_s } = player;
  const day = dateTime(player.start_unix_s + at_s);
  if (kind === "heat") return { mark: `Past · ${title} · ${range(player).join(" to ")}` };
  if (kind === "recording") {
    const loading = player.waiting ? " · loading" : player.events === null ? " · reading events" : "";
    const problem = player.error || (player.fixes.length ? "" : "There are no fixes in it.");
    return { time: `${clock(at_s)} of ${clock(duration_s)}`, about: `${name} · ${day}${loading}`, problem, mark: `Replay · recorded ${day}` };
  }
  const found = placeNow(player);
  const alert = ALERTS[found?.alert]?.grade ? ` · ${ALERTS[found.alert].words}` : "";
  const about = found ? `x ${metres(found.place[0])} m · y ${metres(found.place[1])} m${alert}` : "no position then";
  return { time: timeOfDay(player.start_unix_s + at_s), about, mark: `Past · ${title} · ${day}` };
}

/** A button for every event that deserves attention; those that are close share one. */
function showMarks() {
  const { player } = state;
  const box = byId("event-marks");
  const groups = [];
  for (const event of player?.marked ?? []) {
    const x = (event.at_s / (player.duration_s || 1)) * box.clientWidth;
    const last = groups.at(-1);
    if (last && x - last.x < MARK_PX) last.events.push(event);
    else groups.push({ x, events: [event] });
  }
  const held = [...box.children].indexOf(document.activeElement);
  box.replaceChildren(...groups.map(({ events }, index) => markOf(player, events, index)));
  box.hidden = !groups.length;
  box.children[held]?.focus();
}

function markOf(player, events, index) {
  const named = events.slice(0, NAMED).map((event) => `${clock(event.at_s)} ${event.text}`);
  if (events.length > NAMED) named.push(`and ${events.length - NAMED} more`);
  const worst = events.some((event) => event.level === "bad") ? "bad" : "warning";
  const side = events[0].at_s > player.duration_s / 2 ? "left" : "right";
  const bubble = h("span", { class: `bubble ${side}` }, ...named.map((words) => h("span", {}, words)));
  const properties = { class: `event-mark ${worst}`, tabIndex: index ? -1 : 0, "aria-label": named.join("; ") };
  const mark = button(h("i", { "aria-hidden": "true" }), () => seekEvent(events[0]), properties);
  mark.style.left = along(player, events[0].at_s);
  mark.append(bubble);
  return mark;
}

/** One mark is in the order of the tab key; arrows lead to the others. */
function moveAlong(event) {
  const marks = [...byId("event-marks").children];
  const at = marks.indexOf(event.target);
  const to = marks[{ ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: marks.length - 1 }[event.key]];
  if (!to) return;
  event.preventDefault();
  marks[at].tabIndex = -1;
  to.tabIndex = 0;
  to.focus();
}

/** A step by the comma or the full stop. */
function step_s({ kind, duration_s }) {
  return kind === "way" && duration_s > LONG_S ? 1 : 0.1;
}

/** Run what a key means; space is K's where the focus has no use for it, and digits are the map's there. Not while somebody types. */
function pressKey(event) {
  const { player } = state;
  const { target, key } = event;
  if (!player || player.kind === "heat" || event.ctrlKey || event.metaKey || event.altKey) return;
  if (target.matches?.("input:not([type=range]), select, textarea")) return;
  const free = !target.closest?.("button, input, summary, a, [role=tab]");
  const jump_s = player.kind === "way" ? Math.max(5, player.duration_s / 100) : 5;
  const actions = {
    k: toggle,
    j: () => seek(player.at_s - jump_s),
    l: () => seek(player.at_s + jump_s),
    ",": () => step(-step_s(player)),
    ".": () => step(step_s(player)),
    "[": () => stepEvent(-1),
    "]": () => stepEvent(1),
    "<": () => stepSpeed(-1),
    ">": () => stepSpeed(1),
  };
  const digit = /^\d$/.test(key) && target.id !== "canvas" && (() => seek((Number(key) / 10) * player.duration_s));
  const action = actions[key === " " && free ? "k" : key.toLowerCase()] ?? digit;
  if (!action) return;
  action();
  event.preventDefault();
}
