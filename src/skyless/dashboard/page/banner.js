/** Live, replay or lost: shown by words, a shape and a colour; and a button to reconnect. */

import { on, state } from "./store.js";
import { byId, text } from "./dom.js";
import { now_s } from "./clock.js";
import { timeOfDay } from "./format.js";
import { retryNow } from "./live.js";

const WORDS = {
  connecting: "Connecting",
  open: "Live",
  lost: "Connection lost",
  replay: "Replay",
  broker: "No broker",
};

/** Fill the banner and keep it up to date. */
export function start() {
  on(["connection", "mode", "player"], show);
  setInterval(() => state.connection.phase === "lost" || text(byId("time"), timeOfDay(now_s())), 500);
  byId("banner-button").addEventListener("click", retryNow);
  show();
}

function show() {
  const { phase } = state.connection;
  const brokerAway = phase === "open" && state.mqtt && !state.mqtt.connected;
  const kind = phase === "lost" ? "lost" : state.mode === "replay" ? "replay" : brokerAway ? "broker" : phase;
  const pill = byId("pill");
  if (pill.className !== `pill ${kind}`) pill.className = `pill ${kind}`;
  text(pill, WORDS[kind]);
  const words = phase === "lost" ? lostWords() : brokerAway ? brokerWords() : "";
  const banner = byId("banner");
  banner.hidden = !words;
  banner.className = phase === "lost" ? "lost" : "broker";
  byId("banner-button").hidden = phase !== "lost";
  text(byId("banner-text"), words);
  text(byId("banner-age"), phase === "lost" ? age(state.connection.since) : "");
  document.body.classList.toggle("lost", phase === "lost");
}

function lostWords() {
  const { reason } = state.connection;
  const old = state.mode === "live" ? " The map shows the last known state." : "";
  return `Connection lost: ${reason}.${old} Reconnecting.`;
}

/** How long ago; not part of the message, so that screen readers read it only once. */
function age(since) {
  const past = Math.floor((performance.now() - since) / 1e3);
  return past < 120 ? `${past} s` : `${Math.floor(past / 60)} min`;
}

function brokerWords() {
  const broker = state.mqtt.broker ? ` ${state.mqtt.broker}` : "";
  return `The server has lost its broker${broker}: tags and anchors are not updated until it is connected again.`;
}
