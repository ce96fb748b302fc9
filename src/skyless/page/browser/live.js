/** The live connection: reads the server's messages into the state, notices a loss, and reconnects. */

import { changed, healthAge_s, siteOf, state } from "./store.js";
import { live, now_s, resetOffset, updateOffset } from "./clock.js";
import { receiveAlarms } from "./alarms/model.js";
import { foundByAsset, receiveAssets } from "./assets/model.js";
import { byId, toast } from "./dom.js";
import { addHealth, clearHistory } from "./history.js";
import { chosenSite } from "./sites.js";
import { receiveSurvey, receiveWatch, restart } from "./survey/model.js";
import { noteGap, rowLimit } from "./pace.js";

const FIRST_RETRY_MS = 500;
const LAST_RETRY_MS = 3000;
const PING_MS = 2000;
const CHECK_MS = 250;
/** The connection is lost after this time without a message: while tags move, and otherwise (every ping is answered). */
const MOVING_TIMEOUT_MS = 3000;
const IDLE_TIMEOUT_MS = 9000;
const MAX_EVENTS = 50;
/** The server accepts no more names of each kind. */
const MAX_NAMED = 200;
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
let lastCheck = 0;
/** For how long the connection has been silent while this page was running. */
let silence = 0;
let asked = "";
/** The live site's message and zones, also while a recording is replayed. */
let site = null;
let zones = [];
/** Number and name of the site whose tags and histories are kept. */
let keptOf = "";

/** Connect, and stay connected. */
export function start() {
  connect();
  setInterval(checkConnection, CHECK_MS);
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
  lastMessage = lastPing = lastCheck = performance.now();
  silence = 0;
  asked = "";
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
  const now = performance.now();
  const gap = now - lastCheck;
  lastCheck = now;
  noteGap(gap - CHECK_MS);
  if (!socket) return;
  // What came while the browser was busy has yet to be read: it is no silence of the server.
  silence += document.hidden ? gap : Math.min(gap, 2 * CHECK_MS);
  const moved = lastMessage - lastMotion < 2000;
  const open = state.connection.phase === "open";
  if (silence > (moved || !open ? MOVING_TIMEOUT_MS : IDLE_TIMEOUT_MS)) {
    return lost(`no message for ${(silence / 1e3).toFixed(0)} s`);
  }
  if (open && state.mode === "live") ask();
  // Pongs have no number: only one is under way at a time.
  if (now - lastPing > PING_MS && state.ping.sentMs === null && socket.readyState === WebSocket.OPEN) {
    socket.send("ping");
    lastPing = state.ping.sentMs = now;
  }
}

/** Send the server what this page shows of a large site, so that it sends that part only. */
function ask() {
  const found = state.part ? foundByAsset() : [];
  const tags = [state.selection.tag, state.followed, ...state.listed.tags, ...found].filter((name) => name !== null);
  const anchors = [state.selection.anchor, ...state.listed.anchors].filter((id) => id !== null).map(String);
  const limit = (names) => [...new Set(names)].slice(0, MAX_NAMED);
  const wanted = { view: askedBox(), find: state.find, tags: limit(tags), anchors: limit(anchors), rows: rowLimit() };
  const words = JSON.stringify(wanted);
  if (words === asked || socket.readyState !== WebSocket.OPEN) return;
  asked = words;
  socket.send(words);
}

/** The part of the site of which tags are asked for: the zone of the filter, or what the map shows. */
function askedBox() {
  const zone = state.part && state.zones.find(({ id }) => id === state.filter.zone);
  if (!zone) return state.seenBox();
  const [x, y] = [0, 1].map((axis) => zone.polygon_m.map((corner) => corner[axis]));
  return [Math.min(...x), Math.min(...y), Math.max(...x), Math.max(...y)];
}

function process(text) {
  lastMessage = performance.now();
  silence = 0;
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
    state.thresholds = message.thresholds;
    state.history = message.history === true;
    state.live2 = message.live2 === true;
    state.hub = message.hub === true;
    document.body.classList.toggle("read-only", state.hub);
    byId("all-sites").hidden = !state.hub;
    changed("connection", "events", "log", "condition");
    handlers.sites({ shown: null, sites: [] });
    handlers.zones(message);
    handlers.alarms({ alarms: [], more: 0 });
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
    if (message.left?.length) live.remove(message.left);
    live.add(message.tags);
    state.part = message.of === undefined ? null : { of: message.of, inside: message.inside };
    changed("tags");
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
    const newer = events.filter((event) => event.serial > last);
    const replaced = new Set(newer.filter(({ count }) => count > 1).map(({ first }) => first));
    state.log = [...state.log.filter(({ first }) => !replaced.has(first)), ...newer].slice(-MAX_LOGGED);
    changed("log");
  },
  health({ whole, anchors, tags, ether, nodes, ages, conditions, waiting, dropped }) {
    const { health } = state;
    if (whole) for (const known of [health.anchors, health.tags, health.nodes, health.conditions]) known.clear();
    if (whole) health.ether = null;
    for (const one of anchors) health.anchors.set(one.anchor, one);
    for (const one of tags) health.tags.set(one.tag, one);
    for (const node of nodes) health.nodes.set(`${node.kind}/${node.name}`, node);
    for (const [id, kind] of Object.entries(conditions)) health.conditions.set(Number(id), kind);
    health.ether = ether ?? health.ether;
    health.dropped = dropped;
    const now = performance.now();
    for (const kind of ["anchors", "tags", "ether"]) {
      if (whole) health.heardMs[kind].clear();
      for (const [name, age_s] of Object.entries(ages[kind] ?? {})) health.heardMs[kind].set(name, now - 1e3 * age_s);
    }
    const { forgotten_s } = state.thresholds;
    for (const id of health.anchors.keys()) if (healthAge_s("anchors", id) > forgotten_s) health.anchors.delete(id);
    for (const name of health.tags.keys()) if (healthAge_s("tags", name) > forgotten_s) health.tags.delete(name);
    const named = state.part ? waiting : [...health.tags.keys(), ...waiting];
    live.addNames(named);
    live.expire(now_s() - forgotten_s, new Set(named));
    addHealth(anchors, tags, health.anchors, health.tags);
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
  assets: ({ assets }) => receiveAssets(assets),
  alarm_rules(message) {
    state.rules = message.rules;
    state.fileRules = message.file_rules;
    changed("rules");
  },
  alarms: ({ alarms, more }) => receiveAlarms(alarms, more),
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
  floor_plan(message) {
    state.floorDigest = message.digest;
    state.floorDigests = message.floors ?? {};
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
    state.floorDigests = {};
    handlers.assets({ assets: [] });
    handlers.alarm_rules({ rules: [], file_rules: [] });
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
