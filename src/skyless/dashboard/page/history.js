/** Health over the last minutes, for the charts. */

const MOST = 300;
/** What changes of a counter's offset: it counts modulo 2^40 ticks of 1/(128 × 499.2 MHz). */
const WRAP_S = 2 ** 40 / 63.8976e9;

/** @type {Map<number, {time: number[], offset_us: number[], rate_ppm: number[], std_mm: number[], offset_s: number}>} */
export const anchors = new Map();
/** @type {Map<string, {time: number[], rate: number[], p50_ms: number[], p99_ms: number[]}>} */
export const tags = new Map();

/** Take a second's health. */
export function remember(anchorHealth, tagHealth) {
  for (const health of anchorHealth) rememberAnchor(health);
  for (const health of tagHealth) {
    let past = tags.get(health.tag);
    if (!past) tags.set(health.tag, (past = { time: [], rate: [], p50_ms: [], p99_ms: [] }));
    if (!isNews(past, health)) continue;
    append(past, {
      time: health.unix_s,
      rate: health.updates_per_s,
      p50_ms: scaled(health.latency_p50_s, 1e3),
      p99_ms: scaled(health.latency_p99_s, 1e3),
    });
  }
}

function rememberAnchor(health) {
  let past = anchors.get(health.anchor);
  if (!past) {
    past = { time: [], offset_us: [], rate_ppm: [], std_mm: [], offset_s: NaN };
    anchors.set(health.anchor, past);
  }
  if (!isNews(past, health)) return;
  let offset_us = null;
  if (health.offset_s != null) {
    const before_us = past.offset_us.findLast((value) => value !== null) ?? 0;
    offset_us = Number.isNaN(past.offset_s) ? 0 : before_us + 1e6 * wrapped(health.offset_s - past.offset_s);
    past.offset_s = health.offset_s;
  }
  append(past, {
    time: health.unix_s,
    offset_us,
    rate_ppm: health.rate_ppm,
    std_mm: scaled(health.offset_std_m, 1e3),
  });
}

/** Whether a health is newer than the last; after a clock was set back, the charts begin anew. */
function isNews(past, health) {
  const last = past.time.at(-1) ?? -Infinity;
  if (health.unix_s < last - 5) for (const values of Object.values(past)) if (Array.isArray(values)) values.length = 0;
  return health.unix_s > last || past.time.length === 0;
}

function wrapped(difference_s) {
  return difference_s - WRAP_S * Math.round(difference_s / WRAP_S);
}

function scaled(value, factor) {
  return value == null ? null : value * factor;
}

function append(past, values) {
  for (const [key, value] of Object.entries(values)) {
    past[key].push(value ?? null);
    if (past[key].length > MOST) past[key].shift();
  }
}
