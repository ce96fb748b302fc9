/**
 * The one state of the page. Modules change it and notify the topics; callbacks run at most once a frame.
 *
 * Topics: connection, site, zones, events, health, tags, mode, player, recordings, selection, options, overlay, editor,
 * theme, survey, watch, setup, picking, plan, placing, condition, log, read, sites, assets, alarms, rules.
 */

/** @type {Map<string, Set<() => void>>} */
const listeners = new Map();
/** @type {Set<string>} */
const dirty = new Set();
let scheduled = false;

export const state = {
  /** @type {{phase: "connecting"|"open"|"lost", since: number, reason: string}} */
  connection: { phase: "connecting", since: performance.now(), reason: "" },
  /** @type {{connected: boolean, broker: string}|null} */
  mqtt: null,
  /** The last ping: when it was sent, null once it is answered; and how long the last answer took. */
  ping: { sentMs: /** @type {number|null} */ (null), tripMs: 0 },
  version: "",
  /** @type {any} the site message's `site` */
  site: null,
  simulated: false,
  /** The server's times from which views decide what is still there, see `run/site_table.py`. */
  thresholds: { fresh_s: 0, gone_s: 0, report_s: 0, forgotten_s: 0 },
  /** Number of the live site, also while a recording is replayed. @type {number|null} */
  liveId: null,
  /** Whether the page's server is at a hub, which only reads; then this is one of several sites. */
  hub: false,
  /** The sites of the broker: number, name, whether programs are online. @type {Array<[number, string, boolean]>} */
  sites: [],
  /** @type {{done: number, total: number, left_s: number|null}|null} while kernels are compiled */
  /** @type {"live"|"replay"} */
  mode: "live",
  /** @type {Array<{id: string, name: string, polygon_m: number[][], colour: string|null}>} */
  zones: [],
  /** Zones of other sites that have this one's number: kept, not shown. @type {Array<{site: string, zones: any[]}>} */
  otherZones: [],
  /** Why the zones that the broker keeps cannot be read. @type {string|null} */
  zonesFault: null,
  /** @type {any[]} tags that entered or left zones, newest first; with `cameMs` those that came since the page connected */
  events: [],
  /** @type {any[]} what has happened at the live site, oldest first; `panels/events.js` lists it */
  log: [],
  /** @type {any} the server's newest judgement of the live site, and when it came; `condition.js` says what it is worth */
  condition: null,
  conditionMs: 0,
  /**
   * Healths and statuses by name, when each health was made by `performance.now()`, and the conditions of all anchors;
   * of a large site the healths of those that the page names only.
   */
  health: {
    anchors: new Map(),
    tags: new Map(),
    ether: null,
    dropped: {},
    nodes: new Map(),
    conditions: new Map(),
    heardMs: { anchors: new Map(), tags: new Map(), ether: new Map() },
  },
  /** Where the server sends a part of the tags: how many there are, and how many in this page's view. @type {any} */
  part: null,
  /** The part of the site that the map shows, [x1, y1, x2, y2]; null: all of it. @type {() => number[]|null} */
  seenBox: () => null,
  /** What the page asks the server for besides its view: rows in sight in the lists, a search, the followed tag. */
  listed: { tags: [], anchors: [] },
  find: "",
  /** Group and zone of which the list shows the tags; empty: all. */
  filter: { group: "", zone: "" },
  /** What the tags are attached to, by tag. @type {Map<string, any>} */
  assets: new Map(),
  /** The live site's alarms, and how many more the server has. @type {any[]} */
  alarms: [],
  moreAlarms: 0,
  /** Rules of alarms: those made on the page, and those of the site file. @type {any[]} */
  rules: [],
  fileRules: [],
  /** @type {string|null} */
  followed: null,
  /** @type {any} the newest message of the survey program; `survey/model.js` says how old it is */
  survey: null,
  /** @type {any} the newest message of the watch of the anchors */
  watch: null,
  /** Whether the tab Set up is open: the map then shows the survey instead of the site file's positions. */
  setup: { open: false },
  /** @type {string|null} changes with the floor plan's image */
  floorDigest: null,
  /** The same of single floors, by their numbers. @type {Record<string, string>} */
  floorDigests: {},
  /** @type {any[]|null} */
  recordings: null,
  /** @type {any} what `player.js` shows of the past, in `mode` "replay" a recording */
  player: null,
  /** The way or the heat map that the map shows instead of the present. @returns {any} */
  get past() {
    return this.mode === "live" ? this.player : null;
  },
  /** Whether the server keeps a history; null until it has said so. @type {boolean|null} */
  history: null,
  /** Whether the server streams all tags of a large site in binary, and the newest message with its view, see `map/many.js`. */
  live2: false,
  /** @type {any} */
  many: null,
  selection: { tag: null, anchor: null, zone: null },
  options: { names: true, trails: 15, ellipses: true, levels: true, truth: true, overlay: "none", floor: null },
  /** @type {{data: any, picture: HTMLCanvasElement|null, error: string, pendingSince: number|null}} pending: computing */
  overlay: { data: null, picture: null, error: "", pendingSince: null },
};

/** Call `callback` in the next frame after any of the topics has changed. */
export function on(topics, callback) {
  for (const topic of topics) {
    if (!listeners.has(topic)) listeners.set(topic, new Set());
    listeners.get(topic).add(callback);
  }
}

/** Notify the callbacks of topics that have changed. */
export function changed(...topics) {
  for (const topic of topics) dirty.add(topic);
  if (scheduled) return;
  scheduled = true;
  requestAnimationFrame(flush);
}

function flush() {
  scheduled = false;
  const callbacks = new Set();
  for (const topic of dirty) for (const callback of listeners.get(topic) ?? []) callbacks.add(callback);
  dirty.clear();
  for (const callback of callbacks) {
    try {
      callback();
    } catch (error) {
      reportError(error); // the others are still to run
    }
  }
}

/** Whether the server has a recent health of a node. @param {"anchors"|"tags"|"ether"} kind */
export function reports(kind, name) {
  return healthAge_s(kind, name) < state.thresholds.report_s;
}

/**
 * Seconds since the server got the health of a node; Infinity without any.
 * @param {"anchors"|"tags"|"ether"} kind
 */
export function healthAge_s(kind, name) {
  const heard = state.health.heardMs[kind].get(String(name));
  return heard === undefined ? Infinity : (performance.now() - heard) / 1e3;
}

/** The site of a message, with what stands beside it there; null without one. */
export function siteOf(message) {
  const { site, outline_m, floors, system } = message ?? {};
  return site ? { ...site, outline_m, floors, system } : null;
}

/** What people call an anchor: its number, or one of FiRa's by its MAC address. */
export function anchorName(id) {
  return state.site?.system === "dl-tdoa" ? Number(id).toString(16).toUpperCase().padStart(4, "0") : String(id);
}

/** Whether the page may change the site. */
export function isChangeable() {
  return state.mode === "live" && !state.hub;
}

/** Select one tag, anchor or zone, or with null none; its tab opens, also where it is selected already. */
export function select(kind, id) {
  const next = { tag: null, anchor: null, zone: null };
  if (kind) next[kind] = id;
  state.selection = next;
  changed("selection");
}

/** Select one item, or deselect it. */
export function toggleSelection(kind, id) {
  select(state.selection[kind] === id ? null : kind, id);
}

/** A setting that this browser has stored; null without one, as in private windows. @returns {string|null} */
export function savedSetting(key) {
  try {
    return localStorage.getItem(key);
  } catch {
    return null;
  }
}

/** Store a setting in this browser; where it cannot, the setting lasts as long as the page. */
export function saveSetting(key, value) {
  try {
    localStorage.setItem(key, value);
  } catch {
    // a private window
  }
}
