/** Assets while they are edited: the site's, and the changes that are not saved yet. No elements. */

import { COLUMNS } from "./csv.js";

/**
 * One asset; `base` is what the site has, null for a new one. The tag of one that the site has is never changed.
 * @typedef {{number: number, asset: Record<string, string>, base: Record<string, string>|null, removed: boolean}} Row
 */

export class Draft {
  /** @param {any[]} assets the site's */
  constructor(assets) {
    this.serial = 0;
    /** @type {Row[]} */
    this.rows = [];
    this.rebase(assets);
  }

  /** @returns {Row} */
  row(asset, base = null) {
    return { number: ++this.serial, asset: filled(asset), base, removed: false };
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
    this.rows.sort((a, b) => Number(kindOf(a) === "") - Number(kindOf(b) === ""));
  }

  /**
   * Take over what the site has now. Where another page and this one have changed an asset, this page's change stays.
   * @returns {{changed: string[], both: string[]}} tags that the other page has changed, and those that both have
   */
  rebase(assets) {
    const now = new Map(assets.map((asset) => [asset.tag, filled(asset)]));
    const [changed, both] = [[], []];
    const kept = new Set(this.rows.filter(({ base }) => base).map(({ asset }) => asset.tag));
    this.rows = this.rows.filter((row) => {
      if (!row.base && kept.has(row.asset.tag)) return true; // a second row of a tag; the server refuses both
      const theirs = now.get(row.asset.tag) ?? null;
      now.delete(row.asset.tag);
      if (same(row.base, theirs)) return true;
      changed.push(row.asset.tag);
      const mine = kindOf(row) !== "";
      row.base = theirs;
      if (mine) both.push(row.asset.tag);
      else if (theirs) row.asset = { ...theirs };
      return mine || theirs;
    });
    for (const [tag, theirs] of now) {
      changed.push(tag);
      this.rows.push(this.row(theirs, theirs));
    }
    return { changed, both };
  }

  /** Numbers of rows that are new, changed, removed and, under "", none of these. */
  changes() {
    const counts = { new: 0, changed: 0, removed: 0, "": 0 };
    for (const row of this.rows) counts[kindOf(row)] += 1;
    return counts;
  }

  /** All assets as they are to be saved: in their order, new ones at the end. */
  assets() {
    const kept = this.rows.filter(({ removed }) => !removed);
    return kept.sort((a, b) => a.number - b.number).map(({ asset }) => asset);
  }
}

/** What saving does to a row: "new", "changed", "removed" or "". @param {Row} row */
export function kindOf({ asset, base, removed }) {
  if (removed) return "removed";
  return base === null ? "new" : same(asset, base) ? "" : "changed";
}

function filled(asset) {
  return Object.fromEntries(COLUMNS.map((key) => [key, asset[key] ?? ""]));
}

function same(one, other) {
  return one === other || (one !== null && other !== null && COLUMNS.every((key) => one[key] === other[key]));
}
