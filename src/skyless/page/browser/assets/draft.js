/** Assets while they are edited: the site's as they were loaded, and the changes that are not saved yet. No elements. */

import { COLUMNS } from "./csv.js";

const TAG = /^[\w.-]{1,64}$/;
const COLOUR = /^#[0-9a-f]{6}$/i;

/** @typedef {{number: number, asset: Record<string, string>, base: Record<string, string>|null, removed: boolean, other: string}} Row */

export class Draft {
  /** @param {any[]} assets the site's */
  constructor(assets) {
    this.serial = 0;
    /** @type {Row[]} */
    this.rows = assets.map((asset) => this.row(asset, filled(asset)));
  }

  /** @returns {Row} `base` is the asset as the site has it, null for a new one */
  row(asset, base = null) {
    return { number: ++this.serial, asset: filled(asset), base, removed: false, other: "" };
  }

  /** Add an asset, above the others. */
  add(asset = {}) {
    const row = this.row(asset);
    this.rows.unshift(row);
    return row;
  }

  /** Remove an asset, or bring it back; a new one disappears. */
  toggle(row) {
    if (row.base) row.removed = !row.removed;
    else this.rows = this.rows.filter((one) => one !== row);
  }

  /** Take over the assets of a file, each with the columns that the file has; others stay. What differs comes first. */
  merge(assets) {
    const known = new Map(this.rows.map((row) => [row.asset.tag, row]));
    for (const asset of assets) {
      const row = known.get(asset.tag);
      if (row) Object.assign(row, { asset: { ...row.asset, ...asset }, removed: false });
      else this.add(asset);
    }
    this.rows.sort((a, b) => Number(this.kind(a) === "") - Number(this.kind(b) === ""));
  }

  /**
   * Take over what another page has saved meanwhile; where both have changed an asset, this page's change stays and the
   * row says so. Returns the tags that the other has changed.
   */
  rebase(assets) {
    const now = new Map(assets.map((asset) => [asset.tag, filled(asset)]));
    const changed = [];
    for (const row of [...this.rows]) {
      const { base } = row;
      const tag = base?.tag ?? row.asset.tag;
      const theirs = now.get(tag) ?? null;
      now.delete(tag);
      if (same(base, theirs)) continue;
      changed.push(tag);
      const mine = this.kind(row) !== "";
      row.base = theirs;
      if (mine && !(theirs && same(row.asset, theirs))) row.other = theirs ? `saved elsewhere as ${words(theirs)}` : "removed elsewhere";
      else if (theirs) row.asset = { ...theirs };
      else this.rows = this.rows.filter((one) => one !== row);
    }
    for (const [tag, theirs] of now) {
      changed.push(tag);
      this.rows.push(this.row(theirs, theirs));
    }
    return changed;
  }

  /** What saving does to a row: "new", "changed", "removed" or "". @param {Row} row */
  kind({ asset, base, removed }) {
    if (removed) return "removed";
    return base === null ? "new" : same(asset, base) ? "" : "changed";
  }

  /** Numbers of rows that are new, changed and removed, and whether there is any. */
  changes() {
    const counts = { new: 0, changed: 0, removed: 0, "": 0 };
    for (const row of this.rows) counts[this.kind(row)] += 1;
    return { counts, any: counts[""] < this.rows.length };
  }

  /** Set the group of rows that stay. */
  setGroup(rows, group) {
    for (const row of rows) if (!row.removed) row.asset.group = group;
  }

  /** What is wrong: pairs of row and field with a sentence. @returns {Array<{row: Row, field: string, words: string}>} */
  faults() {
    const faults = [];
    const seen = new Set();
    const kept = this.rows.filter(({ removed }) => !removed);
    for (const row of [...kept.filter(({ base }) => base), ...kept.filter(({ base }) => !base)]) {
      const { tag, colour } = row.asset;
      if (!tag) faults.push({ row, field: "tag", words: "The name of the tag is missing." });
      else if (seen.has(tag)) faults.push({ row, field: "tag", words: `Another row has the tag ${tag} already.` });
      else if (!TAG.test(tag)) faults.push({ row, field: "tag", words: "A tag's name has letters, digits, dots, dashes and underscores only." });
      seen.add(tag);
      if (colour && !COLOUR.test(colour)) faults.push({ row, field: "colour", words: "A colour is # and six digits, as #c2410c." });
    }
    return faults;
  }

  /** All assets as they are to be saved: in their order, new ones at the end. */
  assets() {
    const kept = this.rows.filter(({ removed }) => !removed);
    return kept.sort((a, b) => a.number - b.number).map(({ asset }) => asset);
  }
}

function filled(asset) {
  return Object.fromEntries(COLUMNS.map((key) => [key, asset[key] ?? ""]));
}

function same(one, other) {
  return one === other || (one !== null && other !== null && COLUMNS.every((key) => one[key] === other[key]));
}

function words(asset) {
  return [asset.name, asset.group, asset.colour, asset.owner, asset.notes].filter(Boolean).join(", ") || asset.tag;
}
