/** The bar below the map while a recording is replayed: where fixes and events are, and the keys. */

import { on, state } from "./store.js";
import { byId, h, options, s, text } from "./dom.js";
import { fileOf } from "./api.js";
import { whatIfButton } from "./what_if.js";
import { clock, dateTime } from "./format.js";
import { SPEEDS, STEP_S, close, markedEvents, seek, seekEvent, setSpeed, step, stepEvent, stepSpeed, toggle } from "./player.js";

const ICONS = {
  play: "M7 4.5v15l12-7.5z",
  pause: "M7 5h3.5v14H7zM13.5 5H17v14h-3.5z",
  back: "M18 5v14L9 12zM6 5h2.5v14H6z",
  next: "M6 5v14l9-7zM15.5 5H18v14h-2.5z",
};
/** The keys of the replay, for its list of recordings. */
export const KEYS = [
  ["K or space", "play, pause"],
  ["J, L", "5 s back, 5 s on"],
  [", .", `${STEP_S} s back, ${STEP_S} s on`],
  ["[ ]", "the event before, the next event"],
  ["< >", "slower, faster"],
  ["0 to 9", "0 to 90 % of the recording"],
];
/** Marks have at least this distance, in pixels; events that are closer share one. */
const MARK_PX = 26;
/** How many of the events that share a mark are named. */
const NAMED = 3;

/** Build the bar. */
export function start() {
  const controls = playControls("", "Time since the recording's start", { toggle, seek, setSpeed, speeds: SPEEDS });
  const { button, slider, spans, time, speeds } = controls;
  slider.step = String(STEP_S);
  const marks = h("div", { class: "event-marks", role: "group", "aria-label": "Events" });
  const name = h("span", { class: "recording-name" });
  const problem = h("span", { class: "problem", role: "alert" });
  const jumps = [
    eventButton("event-back", "The event before ([)", ICONS.back, -1),
    eventButton("event-next", "The next event (])", ICONS.next, 1),
  ];
  const download = h("a", { id: "download", class: "button" }, "Download");
  const back = h("button", { type: "button", id: "back", onclick: close }, "Back to live");
  const track = h("div", { class: "timeline" }, marks, slider, spans);
  byId("player").append(
    button,
    ...jumps,
    h("div", { class: "along" }, track, h("div", { class: "under" }, time, name, problem)),
    speeds,
    whatIfButton(),
    download,
    back,
  );
  const badge = h("p", { id: "replay-mark", hidden: true });
  byId("map").append(badge);
  addEventListener("keydown", playKey);
  new ResizeObserver(() => state.player && showMarks(marks, state.player)).observe(track);
  let shown = null;
  let marked = null;
  on(["player", "mode"], () => {
    const player = state.player;
    byId("player").hidden = badge.hidden = !player;
    document.body.classList.toggle("replaying", Boolean(player));
    if (!player) return;
    if (shown !== player) {
      slider.max = String(player.duration_s);
      download.href = fileOf(player.name);
      download.setAttribute("download", player.name);
      download.setAttribute("aria-label", `Download ${player.name}`);
      showSpans(spans, player);
    }
    if (shown !== player || marked !== player.events) showMarks(marks, player);
    for (const jump of jumps) jump.disabled = !markedEvents(player).length;
    shown = player;
    marked = player.events;
    controls.show(player, player.at_s, `${clock(player.at_s)} of ${clock(player.duration_s)}`);
    const day = dateTime(player.start_unix_s + player.at_s);
    text(badge, `Replay · recorded ${day}`);
    text(time, `${clock(player.at_s)} / ${clock(player.duration_s)}`);
    text(name, `${player.name} · ${day}${loading(player)}`);
    text(problem, player.error);
  });
}

function loading(player) {
  return player.waiting ? " · loading" : player.events === null ? " · reading events" : "";
}

/** The button, the slider with the times of fixes, the time and the speeds of a player. */
export function playControls(prefix, label, { toggle, seek, setSpeed, speeds: choices }) {
  const icon = s("path", {});
  const button = iconButton({ id: `${prefix}play`, onclick: toggle }, icon);
  const slider = h("input", { type: "range", id: `${prefix}slider`, min: "0", "aria-label": label });
  slider.addEventListener("input", () => seek(Number(slider.value)));
  const spans = h("div", { class: "spans", "aria-hidden": "true" });
  const time = h("output", { id: `${prefix}play-time` });
  const pairs = choices.map((speed) => [speed, `${speed} ×`]);
  const speeds = options({ id: `${prefix}speed`, "aria-label": "Speed" }, pairs, (value) => setSpeed(Number(value)));
  const show = ({ playing, speed }, at_s, words) => {
    button.setAttribute("aria-label", `${playing ? "Pause" : "Play"} (K)`);
    icon.setAttribute("d", playing ? ICONS.pause : ICONS.play);
    slider.value = String(at_s);
    slider.setAttribute("aria-valuetext", words);
    speeds.value = String(speed);
  };
  return { button, slider, spans, time, speeds, show };
}

/** A button with a picture. */
function iconButton(properties, path) {
  const picture = s("svg", { viewBox: "0 0 24 24", class: "solid", "aria-hidden": "true" }, path);
  return h("button", { type: "button", class: "icon", ...properties }, picture);
}

function eventButton(id, words, path, direction) {
  const properties = { id, "aria-label": words, title: words, onclick: () => stepEvent(direction) };
  return iconButton(properties, s("path", { d: path }));
}

/** A share of the recording as a place on the slider, whose knob is 16 px wide. */
function along(player, at_s) {
  const share = player.duration_s > 0 ? Math.min(Math.max(at_s / player.duration_s, 0), 1) : 0;
  return `calc(8px + ${share.toFixed(5)} * (100% - 16px))`;
}

/** Show when there are fixes. */
export function showSpans(box, player) {
  const made = player.fixes.map(([from, to]) => {
    const span = h("i", {});
    span.style.left = along(player, from);
    span.style.right = `calc(100% - ${along(player, to)})`;
    return span;
  });
  box.replaceChildren(...made);
}

/** A button for every event that deserves attention; those that are close share one. */
function showMarks(box, player) {
  const width = box.parentElement.clientWidth - 16;
  if (width <= 0) return;
  const groups = [];
  for (const event of markedEvents(player)) {
    const x = (event.at_s / (player.duration_s || 1)) * width;
    const last = groups.at(-1);
    if (last && x - last.x < MARK_PX) last.events.push(event);
    else groups.push({ x, events: [event] });
  }
  const held = box.contains(document.activeElement) ? [...box.children].indexOf(document.activeElement) : -1;
  box.replaceChildren(...groups.map((group, index) => markOf(player, group, index, groups.length)));
  box.hidden = !groups.length;
  box.children[held]?.focus();
}

function markOf(player, { events }, index, count) {
  const [first] = events;
  const named = events.slice(0, NAMED).map((event) => `${clock(event.at_s)} ${event.text}`);
  if (events.length > NAMED) named.push(`and ${events.length - NAMED} more`);
  const worst = events.some((event) => event.level === "bad") ? "bad" : "warning";
  const side = first.at_s > player.duration_s / 2 ? "left" : "right";
  const bubble = h("span", { class: `bubble ${side}` }, ...named.map((words) => h("span", {}, words)));
  const mark = h("button", {
    type: "button",
    class: `event-mark ${worst}`,
    tabIndex: index ? -1 : 0,
    "aria-label": named.join("; "),
    onclick: () => seekEvent(first),
    onkeydown: (event) => moveAlong(event, index, count),
  });
  mark.style.left = along(player, first.at_s);
  mark.append(h("i", { "aria-hidden": "true" }), bubble);
  return mark;
}

/** One mark is in the order of the tab key; arrows lead to the others. */
function moveAlong(event, index, count) {
  const to = { ArrowRight: index + 1, ArrowLeft: index - 1, Home: 0, End: count - 1 }[event.key];
  if (to === undefined || to < 0 || to >= count) return;
  event.preventDefault();
  const marks = event.currentTarget.parentElement.children;
  event.currentTarget.tabIndex = -1;
  marks[to].tabIndex = 0;
  marks[to].focus();
}

/** Run what a key means, `actions` by key; space is K's where the focus has no use for it. Not while somebody types. */
export function runKey(event, actions) {
  const { target, key } = event;
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (target.matches?.("input:not([type=range]), select, textarea")) return;
  const free = !target.closest?.("button, input, summary, a, [role=tab]");
  const action = actions[key === " " && free ? "k" : key.toLowerCase()];
  if (!action) return;
  action();
  event.preventDefault();
}

function playKey(event) {
  const { player } = state;
  if (!player) return;
  const tenths = Array.from({ length: 10 }, (_, n) => [n, () => seek((n / 10) * player.duration_s)]);
  runKey(event, {
    ...(event.target.id !== "canvas" && Object.fromEntries(tenths)), // the map has digits of its own
    k: toggle,
    j: () => seek(player.at_s - 5),
    l: () => seek(player.at_s + 5),
    ",": () => step(-STEP_S),
    ".": () => step(STEP_S),
    "[": () => stepEvent(-1),
    "]": () => stepEvent(1),
    "<": () => stepSpeed(-1),
    ">": () => stepSpeed(1),
  });
}
