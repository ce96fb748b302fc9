/** What is known of each tag over time: a ring of states, and the position between two of them. */

const STRIDE = 17;
const FIRST = 64;
const MOST = 2048;
/** Between states further apart than this nothing is known, and nothing is interpolated. */
const GAP_S = 1.0;
/** A tag whose host's clock differs more than this from the server's has a wrong clock, not an old fix. */
const CLOCK_S = 0.5;

/** Columns of a track: the fields of a state after the tag's name, in the order of the wire. */
export const X = 0,
  Y = 1,
  Z = 2,
  VX = 3,
  VY = 4,
  CXX = 5,
  CXY = 6,
  CYY = 7,
  STD = 8,
  ERROR = 9;
export const TRUE_X = 10,
  TRUE_Y = 11,
  ANCHORS = 12,
  CHI2 = 13,
  TIME = 14,
  HPL = 15,
  ALERT = 16;
/** What the numbers of alerts mean, in the order of the wire. */
export const ALERTS = [
  "none",
  "a faulty anchor is left out",
  "a fault that cannot be left out: no level",
  "too early to say",
  "the level exceeds its limit",
];

export class Track {
  /** @param {string} name */
  constructor(name) {
    this.name = name;
    this.rows = new Float64Array(FIRST * STRIDE);
    this.capacity = FIRST;
    this.start = 0;
    this.count = 0;
  }

  /** Take a state off the wire: `[name, x, y, …]`, null for unknown; older ones than the last are ignored. */
  push(row) {
    const time = row[TIME + 1];
    if (!Number.isFinite(time) || (this.count && time <= this.value(this.count - 1, TIME))) return false;
    if (this.count === this.capacity && this.capacity < MOST) this.grow();
    if (this.count === this.capacity) this.start = (this.start + 1) % this.capacity;
    else this.count += 1;
    const at = ((this.start + this.count - 1) % this.capacity) * STRIDE;
    for (let column = 0; column < STRIDE; column++) this.rows[at + column] = row[column + 1] ?? NaN;
    return true;
  }

  grow() {
    const rows = new Float64Array(this.capacity * 2 * STRIDE);
    const split = this.start * STRIDE;
    rows.set(this.rows.subarray(split));
    rows.set(this.rows.subarray(0, split), this.rows.length - split);
    this.rows = rows;
    this.capacity *= 2;
    this.start = 0;
  }

  /** Column of the n-th state, counted from the oldest. */
  value(index, column) {
    return this.rows[((this.start + index) % this.capacity) * STRIDE + column];
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
   * Write the columns as they are at a time into `out`: between two states in a straight line, after the last one as it
   * was. Returns false before the first one.
   * @param {number} time
   * @param {Float64Array} out at least 17 long
   * @param {boolean} between whether to interpolate
   */
  at(time, out, between = true) {
    const index = this.find(time);
    if (index < 0) return false;
    const at = ((this.start + index) % this.capacity) * STRIDE;
    for (let column = 0; column < STRIDE; column++) out[column] = this.rows[at + column];
    if (!between || index + 1 >= this.count) return true;
    const gap = this.value(index + 1, TIME) - out[TIME];
    if (gap > GAP_S) return true;
    const share = (time - out[TIME]) / gap;
    const next = ((this.start + index + 1) % this.capacity) * STRIDE;
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

  /**
   * Take a state message's rows; returns whether a tag appeared that was not there before. With `unix_s`, the message's
   * own time, fixes of hosts whose clocks are wrong are taken as made then.
   */
  add(rows, unix_s = NaN) {
    let more = false;
    for (const row of rows) {
      if (Math.abs(row[TIME + 1] - unix_s) > CLOCK_S) row[TIME + 1] = unix_s;
      let track = this.all.get(row[0]);
      if (!track) {
        this.all.set(row[0], (track = new Track(row[0])));
        more = true;
      }
      track.push(row);
    }
    if (more) this.sort();
    return more;
  }

  /** Make sure that these names are in the list, with or without a state. */
  name(names) {
    const before = this.all.size;
    for (const name of names) if (!this.all.has(name)) this.all.set(name, new Track(name));
    if (this.all.size !== before) this.sort();
    return this.all.size !== before;
  }

  /** Forget the states, keep the names. */
  forget() {
    for (const name of this.all.keys()) this.all.set(name, new Track(name));
    this.sort();
  }

  sort() {
    this.sorted = [...this.all.values()].sort((a, b) => a.name.localeCompare(b.name, "en", { numeric: true }));
  }
}
