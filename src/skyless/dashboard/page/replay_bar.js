/** The bar below the map while a recording is replayed. */

import { on, state } from "./store.js";
import { byId, h, options, s, text } from "./dom.js";
import { clock, dateTime } from "./format.js";
import { SPEEDS, close, seek, setSpeed, toggle } from "./player.js";

const ICONS = { play: "M7 4.5v15l12-7.5z", pause: "M7 5h3.5v14H7zM13.5 5H17v14h-3.5z" };

/** Build the bar. */
export function start() {
  const icon = s("path", { d: ICONS.play });
  const button = h(
    "button",
    { type: "button", id: "play", class: "icon", onclick: toggle },
    s("svg", { viewBox: "0 0 24 24", class: "solid", "aria-hidden": "true" }, icon),
  );
  const slider = h("input", {
    type: "range",
    id: "slider",
    min: "0",
    step: "0.1",
    "aria-label": "Time since the recording's start",
  });
  slider.addEventListener("input", () => seek(Number(slider.value)));
  const time = h("output", { id: "play-time" });
  const speeds = options(
    { id: "speed", "aria-label": "Speed" },
    SPEEDS.map((speed) => [speed, `${speed} ×`]),
    (value) => setSpeed(Number(value)),
  );
  const name = h("span", { class: "recording-name" });
  const problem = h("span", { class: "problem", role: "alert" });
  const back = h("button", { type: "button", id: "back", onclick: close }, "Back to live");
  byId("player").append(
    button,
    h("div", { class: "along" }, slider, h("div", { class: "under" }, time, name, problem)),
    speeds,
    back,
  );
  addEventListener("keydown", playKey);
  let shown = "";
  on(["player", "mode"], () => {
    const player = state.player;
    byId("player").hidden = !player;
    document.body.classList.toggle("replaying", Boolean(player));
    if (!player) return;
    const playing = player.playing ? "Pause" : "Play";
    button.setAttribute("aria-label", `${playing} (K)`);
    icon.setAttribute("d", player.playing ? ICONS.pause : ICONS.play);
    if (shown !== player.name) slider.max = String(player.duration_s);
    shown = player.name;
    slider.value = String(player.at_s);
    slider.setAttribute("aria-valuetext", `${clock(player.at_s)} of ${clock(player.duration_s)}`);
    speeds.value = String(player.speed);
    text(time, `${clock(player.at_s)} / ${clock(player.duration_s)}`);
    text(name, `${player.name} · ${dateTime(player.start_unix_s + player.at_s)}${player.waiting ? " · loading" : ""}`);
    text(problem, player.error);
  });
}

function playKey(event) {
  if (!state.player || event.ctrlKey || event.metaKey || event.altKey) return;
  const { target } = event;
  if (target.matches?.("input:not([type=range]), select, textarea")) return;
  const free = !target.closest?.("button, input, summary, a, [role=tab]");
  if (event.key === "k" || (event.key === " " && free)) toggle();
  else if (event.key === "j") seek(state.player.at_s - 5);
  else if (event.key === "l") seek(state.player.at_s + 5);
  else return;
  event.preventDefault();
}
