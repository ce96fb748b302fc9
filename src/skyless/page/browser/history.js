/** Health over the last minutes, for the charts. */

const MAX_POINTS = 300;
/** Health comes once a second; over a longer gap no line is drawn. */
const MAX_GAP_S = 5;
/** Period of a counter's offset: it counts modulo 2^40 ticks of 1/(128 × 499.2 MHz). */
const WRAP_S = 2 ** 40 / 63.8976e9;

/** Columns by anchor: time, offset_us, rate_ppm, std_mm. @type {Map<number, any>} */
export const anchorHistory = new Map();
/** Columns by tag: time, rate. @type {Map<string, any>} */
export const tagHistory = new Map();

/** Forget all. */
export function clearHistory() {
  anchorHistory.clear();
  tagHistory.clear();
}

/** Add healths that are new; what is not in the maps of all that are known loses its history. */
export function addHealth(anchors, tags, allAnchors, allTags) {
  for (const health of anchors) add(anchorHistory, health.anchor, health.unix_s, (past) => clockOf(past, health));
  keepOnly(anchorHistory, allAnchors);
  keepOnly(tagHistory, allTags);
  for (const health of tags) add(tagHistory, health.tag, health.unix_s, () => ({ rate: health.updates_per_s }));
}

function keepOnly(histories, ids) {
  for (const id of histories.keys()) if (!ids.has(id)) histories.delete(id);
}

/** Append a point; after a clock was set back, the history starts again. */
function add(histories, id, time, columns) {
  let past = histories.get(id);
  const last = past?.time.at(-1) ?? -Infinity;
  if (!past || time < last - 5) histories.set(id, (past = { time: [] }));
  else if (time <= last) return;
  const values = columns(past);
  const none = Object.fromEntries(Object.keys(values).map((key) => [key, null]));
  if (past.time.length && time > last + MAX_GAP_S) append(past, { time: (last + time) / 2, ...none });
  append(past, { time, ...values });
}

function append(past, row) {
  for (const [key, value] of Object.entries(row)) {
    past[key] ??= [];
    past[key].push(value ?? null);
    if (past[key].length > MAX_POINTS) past[key].shift();
  }
}

/** The offset is counted from the first one, across the wraps of the counter; of another clock or master it starts again. */
function clockOf(past, { offset_s, rate_ppm, offset_std_m, uptime_s, master, role }) {
  if (role === "master") return { offset_us: null, rate_ppm: null, std_mm: null }; // its clock is the reference
  if (uptime_s < past.uptime_s || (master ?? null) !== (past.master ?? null)) {
    past.offset_us?.fill(null);
    past.last_offset_s = undefined;
  }
  Object.assign(past, { uptime_s, master });
  let offset_us = null;
  if (offset_s != null) {
    const change_s = offset_s - (past.last_offset_s ?? offset_s);
    const last_us = past.offset_us?.findLast((value) => value !== null) ?? 0;
    offset_us = last_us + 1e6 * (change_s - WRAP_S * Math.round(change_s / WRAP_S));
    past.last_offset_s = offset_s;
  }
  return { offset_us, rate_ppm, std_mm: offset_std_m == null ? null : 1e3 * offset_std_m };
}
