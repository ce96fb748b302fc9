/** Files that the page saves. */

import { h } from "./dom.js";

/**
 * A table as CSV: commas, CRLF, quotes where they are needed; null is an empty field. Words that a spreadsheet would
 * take for a formula have an apostrophe before them. @param {Iterable<any[]>} rows
 */
export function csvOf(heads, rows) {
  const field = (value) => {
    const words = typeof value === "string" && /^[=+\-@']/.test(value) ? `'${value}` : String(value ?? "");
    return /[",\r\n]/.test(words) ? `"${words.replaceAll('"', '""')}"` : words;
  };
  const line = (row) => `${row.map(field).join(",")}\r\n`;
  return line(heads) + Array.from(rows, line).join("");
}

/** A time as CSV has it: UTC, ISO 8601; null stays null. */
export function utc(unix_s) {
  return unix_s === null ? null : new Date(Math.round(unix_s * 1e3)).toISOString();
}

/** Save a file; characters that names of files do not have become dashes. */
export function saveFile(blob, name) {
  const href = URL.createObjectURL(blob);
  h("a", { href, download: name.replaceAll(/[^\p{L}\p{N}.-]+/gu, "-") }).click();
  setTimeout(() => URL.revokeObjectURL(href), 10_000);
}

/** Save a table as a file. */
export function saveCsv(name, heads, rows) {
  saveFile(new Blob([csvOf(heads, rows)], { type: "text/csv" }), `${name}.csv`);
}
