/** Tables as CSV files. */

import { h } from "./dom.js";

/** A table as CSV: commas, CRLF, quotes where they are needed; null is an empty field. */
export function csvOf(heads, rows) {
  const field = (value) => {
    const words = value === null || value === undefined ? "" : String(value);
    return /[",\r\n]/.test(words) ? `"${words.replaceAll('"', '""')}"` : words;
  };
  return [heads, ...rows].map((row) => `${row.map(field).join(",")}\r\n`).join("");
}

/** A time as CSV has it: UTC, ISO 8601; null stays null. */
export function utc(unix_s) {
  return unix_s === null ? null : new Date(Math.round(unix_s * 1e3)).toISOString();
}

/** Save a table as a file. */
export function saveCsv(name, heads, rows) {
  const href = URL.createObjectURL(new Blob([csvOf(heads, rows)], { type: "text/csv" }));
  h("a", { href, download: `${name.replaceAll(/[^\p{L}\p{N}.-]+/gu, "-")}.csv` }).click();
  setTimeout(() => URL.revokeObjectURL(href), 10_000);
}
