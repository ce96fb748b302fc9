/** The states of each tag over time, in a ring buffer, and the position between two of them. */

const FIRST_CAPACITY = 64;
const MAX_CAPACITY = 2048;
/** Between states further apart than this nothing is interpolated. */
const GAP_S = 1.0;
/** A state older than the last by more than this comes after the server's clock was set back. */
const SET_BACK_S = 5;

export const COLUMNS = 24;
/**
 * Columns of a track: the fields of a `state` message's row after the tag's name, in the order of the wire.
 * `HEIGHT_GIVEN` is 1 where z was given and not estimated; `STD_Z` is NaN there. `VERIFIED_AGE` is how long before the
 * fix its last verified beacon was, `UNVERIFIED` the share of others in the last second; NaN where none is verified.
 * For how many seconds the fix is fresh, the tag sleeps, and until it is gone: `FRESH`, `SLEEP` and `GONE`.
 */
export const [
  X,
  Y,
  Z,
  VX,
  VY,
  CXX,
  CXY,
  CYY,
  STD,
  ERROR,
  TRUE_X,
  TRUE_Y,
  ANCHORS,
  CHI2,
  TIME,
  HPL,
  ALERT,
  HEIGHT_GIVEN,
  STD_Z,
  VERIFIED_AGE,
  UNVERIFIED,
  FRESH,
  SLEEP,
  GONE,
] = Array(COLUMNS).keys();

/** Integrity alerts by their names on the wire; a track holds their index. */
export const ALERTS = {
  none: { short: "none", words: "none", grade: "" },
  "detected-excluded": { short: "excluded", words: "faulty anchor excluded", grade: "warn" },
  "detected-not-excluded": { short: "not excluded", words: "fault not excluded: no protection level", grade: "bad" },
  unavailable: { short: "no level", words: "no protection level available", grade: "" },
  "alert-limit-exceeded": { short: "over limit", words: "protection level above the alert limit", grade: "bad" },
};
const ALERT_NAMES = Object.keys(ALERTS);

const collator = new Intl.Collator("en", { numeric: true });

export class Track {
  /** @param {string} name */
  constructor(name) {
    this.name = name;
    this.rows = new Float64Array(FIRST_CAPACITY * COLUMNS);
    /** The columns that the map shows now. */
    this.shown = new Float64Array(COLUMNS);
    this.capacity = FIRST_CAPACITY;
    this.start = 0;
    this.count = 0;
  }

  /**
   * Add a row of a state: `[name, x, y, …]`, null for unknown. One of the same time replaces the last, as its tag has gone
   * to sleep or has ended. A row older than the last is ignored, or starts the track again where a clock was set back.
   */
  push(row) {
    const time = row[TIME + 1];
    if (time < this.lastTime - SET_BACK_S) this.start = this.count = 0;
    if (!Number.isFinite(time) || time < this.lastTime) return;
    if (time > this.lastTime) {
      if (this.count === this.capacity && this.capacity < MAX_CAPACITY) this.grow();
      if (this.count === this.capacity) this.start = (this.start + 1) % this.capacity;
      else this.count += 1;
    }
    const at = ((this.start + this.count - 1) % this.capacity) * COLUMNS;
    for (let column = 0; column < COLUMNS; column++) this.rows[at + column] = row[column + 1] ?? NaN;
    this.rows[at + ALERT] = ALERT_NAMES.indexOf(row[ALERT + 1]);
  }

  grow() {
    const rows = new Float64Array(this.capacity * 2 * COLUMNS);
    const split = this.start * COLUMNS;
    rows.set(this.rows.subarray(split));
    rows.set(this.rows.subarray(0, split), this.rows.length - split);
    this.rows = rows;
    this.capacity *= 2;
    this.start = 0;
  }

  /** Column of the n-th state, counted from the oldest. */
  value(index, column) {
    return this.rows[((this.start + index) % this.capacity) * COLUMNS + column];
  }

  /** Number of the last state at or before a time, −1 where there is none. */
  find(time) {
    let low = 0;
    let high = this.count;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.value(middle, TIME) <= time) low = middle + 1;
      else high = middle;
    }
    return low - 1;
  }

  /** Time of the last state. */
  get lastTime() {
    return this.count ? this.value(this.count - 1, TIME) : -Infinity;
  }

  /**
   * Write the columns at a time into `out`: interpolated linearly between two states, constant after the last one.
   * Returns false before the first one.
   * @param {number} time
   * @param {Float64Array} out at least COLUMNS long
   * @param {boolean} between whether to interpolate
   */
  at(time, out, between = true) {
    const index = this.find(time);
    if (index < 0) return false;
    const at = ((this.start + index) % this.capacity) * COLUMNS;
    for (let column = 0; column < COLUMNS; column++) out[column] = this.rows[at + column];
    if (!between || index + 1 >= this.count) return true;
    const gap = this.value(index + 1, TIME) - out[TIME];
    if (gap > GAP_S) return true;
    const share = (time - out[TIME]) / gap;
    const next = ((this.start + index + 1) % this.capacity) * COLUMNS;
    for (let column = 0; column < ANCHORS; column++) out[column] += share * (this.rows[next + column] - out[column]);
    return true;
  }
}

/** All tags of the live site or of a recording. */
export class Tracks {
  constructor() {
    /** @type {Map<string, Track>} */
    this.all = new Map();
    /** @type {Track[]} by name */
    this.sorted = [];
  }

  /** Add a state message's rows. */
  add(rows) {
    this.addNames(rows.map(([name]) => name));
    for (const row of rows) this.all.get(row[0]).push(row);
  }

  /** Add tags by name, without a state. */
  addNames(names) {
    const before = this.all.size;
    for (const name of names) if (!this.all.has(name)) this.all.set(name, new Track(name));
    if (this.all.size !== before) this.sort();
  }

  /** Remove the tags without a state since a time, but for some names. */
  expire(since, kept) {
    const before = this.all.size;
    for (const [name, track] of this.all) if (track.lastTime < since && !kept.has(name)) this.all.delete(name);
    if (this.all.size !== before) this.sort();
  }

  /** Remove tags by name. */
  remove(names) {
    for (const name of names) this.all.delete(name);
    this.sort();
  }

  /** Remove all tags. */
  clear() {
    this.all.clear();
    this.sort();
  }

  /** Remove the states, keep the names. */
  clearStates() {
    for (const name of this.all.keys()) this.all.set(name, new Track(name));
    this.sort();
  }

  sort() {
    this.sorted = [...this.all.values()].sort((a, b) => collator.compare(a.name, b.name));
  }
}
