/** Whether this browser keeps up: how long it was busy without a break, and how many tags it can therefore show. */

/** A page that is busy for longer than this, twice within `AGAIN_MS`, is too slow; once may be its start. */
const SLOW_MS = 1000;
const AGAIN_MS = 10_000;
/** It is called too slow for this long after it was last. */
const HOLD_MS = 4000;
const MAX_ROWS = 1000;
const MIN_ROWS = 50;

let rows = MAX_ROWS;
let changedMs = -Infinity;
let before = -Infinity;
let slow = { ms: 0, at: -Infinity };

/** Note by how much the page was late with its own work; a hidden one is delayed by the browser on purpose. */
export function noteGap(late_ms) {
  const now = performance.now();
  if (document.hidden) return;
  if (late_ms > SLOW_MS) {
    if (now - before < AGAIN_MS) {
      slow = { ms: late_ms, at: now };
      changedMs = now;
      rows = Math.max(Math.round(rows / 2), MIN_ROWS);
    }
    before = now;
  } else if (rows < MAX_ROWS && now - changedMs > 2 * AGAIN_MS) {
    changedMs = now;
    rows = Math.min(2 * rows, MAX_ROWS);
  }
}

/** For how long the browser was busy without a break, in s, where that was too long; otherwise 0. */
export function stall_s() {
  return performance.now() - slow.at < HOLD_MS ? slow.ms / 1e3 : 0;
}

/** How many tags the page asks for at once. */
export function rowLimit() {
  return rows;
}
