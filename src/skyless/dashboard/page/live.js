/** The live connection: takes the server's messages into the state, notices when it is lost, comes back by itself. */

import { changed, state } from "./store.js";
import { heard, live, newServer } from "./clock.js";
import { toast } from "./dom.js";
import { remember } from "./history.js";

const FIRST_RETRY_MS = 500;
const LAST_RETRY_MS = 3000;
const PING_MS = 5000;
/** Silence after which a connection is given up: while tags moved, and at all (every ping is answered). */
const SILENT_MS = 3000;
const DEAF_MS = 9000;
const EVENTS = 50;

/** @type {WebSocket|null} */
let socket = null;
let retry_ms = FIRST_RETRY_MS;
let retryTimer = 0;
let lastMessage = 0;
let lastMotion = 0;
let lastPing = 0;

/** Connect, and stay connected. */
export function start() {
  connect();
  setInterval(watch, 250);
  addEventListener("online", retryNow);
  document.addEventListener("visibilitychange", () => document.visibilityState === "visible" && retryNow());
}

/** Try again at once. */
export function retryNow() {
  if (state.connection.phase !== "lost") return;
  clearTimeout(retryTimer);
  connect();
}

function connect() {
  const address = new URL("live", document.baseURI);
  address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
  const mine = (socket = new WebSocket(address));
  lastMessage = lastPing = performance.now();
  mine.onmessage = (event) => mine === socket && take(event.data);
  mine.onclose = () => mine === socket && lost("the server does not answer");
}

function lost(reason) {
  const old = socket;
  socket = null;
  old?.close();
  if (state.connection.phase !== "lost") state.connection = { phase: "lost", since: performance.now(), reason };
  retryTimer = setTimeout(connect, retry_ms);
  retry_ms = Math.min(retry_ms * 1.6, LAST_RETRY_MS);
  changed("connection");
  explain(state.connection);
}

/** A browser does not tell why a socket is refused; an ordinary request does. */
async function explain(connection) {
  try {
    const answer = await fetch(new URL("api/recordings", document.baseURI), { cache: "no-store" });
    if (answer.status !== 401 && answer.status !== 403) return;
    connection.reason = "the server wants its token: open the address that it has printed";
    changed("connection");
  } catch {
    // nobody there: the first reason holds
  }
}

function watch() {
  if (state.connection.phase === "lost") changed("connection");
  if (!socket) return;
  const now = performance.now();
  const silent = now - lastMessage;
  const moved = lastMessage - lastMotion < 2000;
  const open = state.connection.phase === "open";
  if (silent > (moved || !open ? SILENT_MS : DEAF_MS)) return lost(`silent for ${(silent / 1e3).toFixed(0)} s`);
  if (now - lastPing > PING_MS && socket.readyState === WebSocket.OPEN) {
    socket.send("ping");
    lastPing = now;
  }
}

function take(text) {
  lastMessage = performance.now();
  let message;
  try {
    message = JSON.parse(text);
  } catch {
    return;
  }
  takers[message?.type]?.(message);
}

const takers = {
  hello(message) {
    newServer();
    retry_ms = FIRST_RETRY_MS;
    lastMotion = 0;
    state.connection = { phase: "open", since: performance.now(), reason: "" };
    noticeVersion(message.version ?? "");
    state.mqtt = { connected: message.mqtt !== false, broker: state.mqtt?.broker ?? "" };
    state.events = [...(message.events ?? [])].sort((a, b) => b.unix_s - a.unix_s);
    changed("connection", "events");
    takers.zones(message);
    if (message.site) takers.site(message);
  },
  site(message) {
    site = message.site;
    if (state.mode !== "live") return;
    state.site = message.site.site;
    state.simulated = message.site.simulated;
    changed("site");
  },
  state(message) {
    heard(message.unix_s);
    lastMotion = lastMessage;
    live.add(message.tags, message.unix_s);
    if (message.tags.length) changed("tags");
  },
  health(message) {
    const { anchors = [], tags = [], ether = null, nodes = [] } = message;
    state.health = {
      anchors: new Map(anchors.map((health) => [health.anchor, health])),
      tags: new Map(tags.map((health) => [health.tag, health])),
      ether,
      nodes,
      atMs: performance.now(),
    };
    live.name(state.health.tags.keys());
    remember(anchors, tags);
    changed("health");
  },
  zones(message) {
    liveZones = message.zones ?? [];
    if (state.mode !== "live") return;
    state.zones = liveZones;
    changed("zones");
  },
  zone_event(message) {
    state.events = [message, ...state.events].slice(0, EVENTS);
    changed("events");
  },
  mqtt(message) {
    state.mqtt = { connected: message.connected, broker: message.broker };
    changed("connection");
  },
};

function noticeVersion(version) {
  if (state.version && version !== state.version) {
    toast(`The server is version ${version} now.`, "note", { name: "Reload the page", run: () => location.reload() });
  }
  state.version = version;
}

let site = null;
let liveZones = [];

/** The live site, also while a recording is replayed. */
export function liveSite() {
  return site?.site ?? null;
}

/** Show the live site again after a replay. */
export function backToLive() {
  state.mode = "live";
  state.site = site?.site ?? null;
  state.simulated = site?.simulated ?? false;
  state.zones = liveZones;
  changed("mode", "site", "zones", "tags", "selection");
}

/** Take zones that this page has stored, without waiting for the server's message. */
export function stored(zones) {
  takers.zones({ zones });
}
