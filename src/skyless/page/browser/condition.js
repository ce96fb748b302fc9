/** The condition of the site as this page can vouch for it: never better than what the server has just said. */

import { state } from "./store.js";
import { stall_s } from "./pace.js";

/** The server judges twice a second; a judgement older than this is worth nothing. */
const MAX_AGE_MS = 3000;
/** A page that gets its messages later than this says so. */
const MAX_BEHIND_S = 1.0;

/** Words and marks by level; the marks stand in the browser's tab. */
export const LEVELS = {
  good: { word: "Live", mark: "●" },
  warning: { word: "Warning", mark: "▲" },
  bad: { word: "Fault", mark: "✕" },
  waiting: { word: "Waiting", mark: "○" },
  lost: { word: "Disconnected", mark: "✕" },
  replay: { word: "Replay", mark: "▶" },
  past: { word: "Past", mark: "▶" },
  connecting: { word: "Connecting", mark: "○" },
};

/**
 * What the page shows of the site's condition.
 * @returns {{level: keyof LEVELS, text: string, reasons: any[]}}
 */
export function shownCondition() {
  const { phase, reason } = state.connection;
  if (phase === "lost") return { level: "lost", text: "", reasons: [lostReason(reason)] };
  if (state.mode === "replay") return { level: "replay", text: "", reasons: [] };
  if (phase !== "open") return { level: "connecting", text: "", reasons: [] };
  const condition = present();
  return state.past && condition.level === "good" ? { level: "past", text: "", reasons: [] } : condition;
}

function present() {
  const stall = stall_s();
  if (stall) return withWarning(judged(), slowReason(stall));
  const behind = behind_s();
  return behind > MAX_BEHIND_S ? withWarning(judged(), behindReason(behind)) : judged();
}

/** The server's judgement while it is fresh, otherwise null. */
export function freshCondition() {
  return performance.now() - state.conditionMs > MAX_AGE_MS ? null : state.condition;
}

/** What the server says, as far as it still holds. */
function judged() {
  const { condition } = state;
  if (!condition) return { level: "waiting", text: "waiting for the server", reasons: [] };
  if (!freshCondition()) {
    return { level: "waiting", text: "the server is silent", reasons: [silentReason()] };
  }
  if (state.mqtt && !state.mqtt.connected && condition.level !== "bad") {
    const text = state.hub ? "the site is not heard" : "no broker";
    return { level: condition.reasons.length ? "warning" : "waiting", text, reasons: condition.reasons };
  }
  return condition;
}

/** By how much messages are late, as the answers to pings show; an answer that is missing is late already. */
function behind_s() {
  const { sentMs, tripMs } = state.ping;
  return Math.max(tripMs, sentMs === null ? 0 : performance.now() - sentMs) / 1e3;
}

/** At least a warning: whatever the server says arrives too late. */
function withWarning({ level, text, reasons }, reason) {
  if (level === "bad") return { level, text, reasons: [...reasons, reason] };
  return { level: "warning", text: reason.text, reasons: [reason, ...reasons] };
}

function behindReason(behind) {
  const words = `this page is ${behind.toFixed(1)} s behind`;
  return { kind: "page-behind", level: "warning", text: words, advice: "The network is too slow.", names: [] };
}

function slowReason(stall) {
  const words = `this browser is too slow: it was busy for ${stall.toFixed(1)} s without a break`;
  const advice = "The page now asks for fewer tags. Zoom in, close the list or other pages, or use a quicker computer.";
  return { kind: "slow-browser", level: "warning", text: words, advice, names: [] };
}

function lostReason(words) {
  const advice = "Nothing that the page shows is current. It connects again by itself.";
  return { kind: "lost", level: "bad", text: `connection lost: ${words}`, advice, names: [] };
}

function silentReason() {
  const age = ((performance.now() - state.conditionMs) / 1e3).toFixed(0);
  const advice = "Its computer, or the network between it and this browser, is busy.";
  return { kind: "silent", level: "warning", text: `the page's server has sent nothing for ${age} s`, advice, names: [] };
}
