/** The live connection: reads the server's messages into the state, notices a loss, and reconnects. */

import { changed, siteOf, state } from "./store.js";
import { live, now_s, resetOffset, updateOffset } from "./clock.js";
import { toast } from "./dom.js";
import { addHealth, clearHistory } from "./history.js";
import { chosenSite } from "./sites.js";
import { receiveSurvey, receiveWatch, restart } from "./survey/model.js";

const FIRST_RETRY_MS = 500;
const LAST_RETRY_MS = 3000;
const PING_MS = 2000;
/** The connection is lost after this time without a message: while tags move, and otherwise (every ping is answered). */
const MOVING_TIMEOUT_MS = 3000;
const IDLE_TIMEOUT_MS = 9000;
/** The server drops a tag, too, that it has received nothing of for so long. */
const EXPIRY_S = 600;
const MAX_EVENTS = 50;
const MAX_LOGGED = 500;
/** Close code of a server that has too many pages open. */
const TRY_LATER = 1013;
const NO_RESPONSE = "the server does not respond";

/** @type {WebSocket|null} */
let socket = null;
let retry_ms = FIRST_RETRY_MS;
let retryTimer = 0;
let lastMessage = 0;
let lastMotion = 0;
let lastPing = 0;
/** The live site's message and zones, also while a recording is replayed. */
let site = null;
let zones = [];
/** Number and name of the site whose tags and histories are kept. */
let keptOf = "";

/** Connect, and stay connected. */
export function start() {
  connect();
  setInterval(checkConnection, 250);
  addEventListener("online", retryNow);
  document.addEventListener("visibilitychange", () => document.visibilityState === "visible" && retryNow());
}

/** Reconnect at once. */
export function retryNow() {
  if (state.connection.phase !== "lost") return;
  clearTimeout(retryTimer);
  connect();
}

function connect() {
  const address = new URL("live", document.baseURI);
  if (chosenSite() !== null) address.searchParams.set("site", String(chosenSite()));
  address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
  const old = socket;
  const mine = (socket = new WebSocket(address));
  old?.close(); // one that was still connecting
  lastMessage = lastPing = performance.now();
  state.ping = { sentMs: null, tripMs: 0 };
  mine.onmessage = (event) => mine === socket && process(event.data);
  mine.onclose = ({ code, reason }) => {
    if (code === TRY_LATER) retry_ms = LAST_RETRY_MS;
    if (mine === socket) lost(reason || NO_RESPONSE);
  };
}

function lost(reason) {
  const old = socket;
  socket = null;
  old?.close();
  if (state.connection.phase !== "lost") state.connection = { phase: "lost", since: performance.now(), reason };
  else if (reason !== NO_RESPONSE) state.connection.reason = reason;
  retryTimer = setTimeout(connect, retry_ms);
  retry_ms = Math.min(retry_ms * 1.6, LAST_RETRY_MS);
  changed("connection");
  explain(state.connection);
}

/** A browser does not report why a socket is refused; an ordinary request does, here for this very file. */
async function explain(connection) {
  try {
    const answer = await fetch(import.meta.url, { cache: "no-store" });
    if (answer.status !== 401 && answer.status !== 403) return;
    connection.reason = "the token is missing or wrong: open the address that the dashboard has printed";
    changed("connection");
  } catch {
    // no server: the first reason holds
  }
}

function checkConnection() {
  if (state.connection.phase === "lost") changed("connection");
  if (!socket) return;
  const now = performance.now();
  const silence = now - lastMessage;
  const moved = lastMessage - lastMotion < 2000;
  const open = state.connection.phase === "open";
  if (silence > (moved || !open ? MOVING_TIMEOUT_MS : IDLE_TIMEOUT_MS)) {
    return lost(`no message for ${(silence / 1e3).toFixed(0)} s`);
  }
  // Pongs have no number: only one is under way at a time.
  if (now - lastPing > PING_MS && state.ping.sentMs === null && socket.readyState === WebSocket.OPEN) {
    socket.send("ping");
    lastPing = state.ping.sentMs = now;
  }
}

function process(text) {
  lastMessage = performance.now();
  let message;
  try {
    message = JSON.parse(text);
  } catch {
    return;
  }
  handlers[message?.type]?.(message);
}

const handlers = {
  hello(message) {
    resetOffset();
    restart();
    retry_ms = FIRST_RETRY_MS;
    lastMotion = 0;
    state.connection = { phase: "open", since: performance.now(), reason: "" };
    checkVersion(message.version ?? "");
    state.mqtt = { connected: message.mqtt !== false, broker: state.mqtt?.broker ?? "" };
    state.events = [...(message.events ?? [])].sort((a, b) => b.unix_s - a.unix_s);
    state.log = [];
    state.condition = null;
    changed("connection", "events", "log", "condition");
    handlers.sites({ shown: null, sites: [] });
    handlers.preparation({ preparation: null });
    handlers.zones(message);
    handlers.site(message);
  },
  site(message) {
    site = message.site ?? null;
    state.liveId = site?.site.id ?? null;
    forgetOtherSite();
    if (state.mode === "live") showSite();
  },
  state(message) {
    updateOffset(message.unix_s);
    lastMotion = lastMessage;
    live.add(message.tags);
    if (message.tags.length) changed("tags");
  },
  pong() {
    const { sentMs } = state.ping;
    if (sentMs !== null) state.ping = { sentMs: null, tripMs: lastMessage - sentMs };
  },
  condition(message) {
    updateOffset(message.unix_s);
    state.condition = message;
    state.conditionMs = performance.now();
    changed("condition");
  },
  log({ events }) {
    const last = state.log.at(-1)?.serial ?? 0;
    state.log = [...state.log, ...events.filter((event) => event.serial > last)].slice(-MAX_LOGGED);
    changed("log");
  },
  health({ anchors = [], tags = [], ether = null, nodes = [], ages = {} }) {
    state.health = {
      anchors: new Map(anchors.map((health) => [health.anchor, health])),
      tags: new Map(tags.map((health) => [health.tag, health])),
      ether,
      nodes,
      ages,
      atMs: performance.now(),
    };
    live.addNames([...state.health.tags.keys()]);
    live.expire(now_s() - EXPIRY_S, state.health.tags);
    addHealth(anchors, tags);
    changed("health");
  },
  zones(message) {
    zones = message.zones ?? [];
    state.otherZones = message.other_zones ?? state.otherZones;
    if ("zones_fault" in message) state.zonesFault = message.zones_fault;
    if (state.mode !== "live") return;
    state.zones = zones;
    changed("zones");
  },
  survey(message) {
    receiveSurvey(message.survey, message.age_s);
  },
  watch(message) {
    receiveWatch(message.watch);
  },
  sites({ shown, sites }) {
    state.sites = sites;
    changed("sites");
    const chosen = chosenSite();
    if (chosen !== null && chosen !== shown && sites.some(([id]) => id === chosen)) connect(); // it was not known before
  },
  preparation(message) {
    state.preparation = message.preparation;
    changed("preparation");
  },
  floor_plan(message) {
    state.floorDigest = message.digest;
    changed("site");
  },
  zone_event(message) {
    state.events = [{ ...message, cameMs: performance.now() }, ...state.events].slice(0, MAX_EVENTS);
    changed("events");
  },
  mqtt(message) {
    state.mqtt = { connected: message.connected, broker: message.broker };
    changed("connection");
  },
};

function checkVersion(version) {
  if (state.version && version !== state.version) {
    const action = { name: "Reload the page", run: () => location.reload() };
    toast(`The server now runs version ${version}.`, "note", action);
  }
  state.version = version;
}

/** Tags, histories and the floor plan are those of one site; a server that knows none yet may soon know the same. */
function forgetOtherSite() {
  if (!site) return;
  const now = JSON.stringify([site.site.id, site.site.name]);
  if (keptOf && now !== keptOf) {
    live.clear();
    clearHistory();
    state.floorDigest = null;
    changed("tags");
  }
  keptOf = now;
}

function showSite() {
  state.site = siteOf(site);
  state.simulated = site?.simulated ?? false;
  changed("site");
}

/** The live site, also while a recording is replayed. */
export function liveSite() {
  return site?.site ?? null;
}

/** Show the live site again after a replay. */
export function backToLive() {
  state.mode = "live";
  state.zones = zones;
  showSite();
  changed("mode", "zones", "tags", "selection");
}

/** Show zones that this page has stored, without waiting for the server's message. */
export function showStored(zones) {
  handlers.zones({ zones });
}
