/** Assets as a table of comma-separated values, as people export it from a spreadsheet. */

export const COLUMNS = ["tag", "name", "group", "icon", "colour", "owner", "notes"];

/**
 * Read assets; an asset has the columns only that the file has. Throws an Error that names the line.
 * @param {ArrayBuffer} file
 * @returns {Array<Record<string, string>>}
 */
export function readCsv(file) {
  let content = "";
  try {
    content = new TextDecoder("utf-8", { fatal: true }).decode(file);
  } catch {
    throw new Error("The file is not UTF-8; save the table as CSV UTF-8.");
  }
  const first = content.split(/\r?\n/, 1)[0];
  const mark = [",", ";", "\t"].toSorted((a, b) => first.split(b).length - first.split(a).length)[0];
  const [head, ...lines] = rowsOf(content, mark);
  const names = (head?.cells ?? []).map((name) => name.trim().toLowerCase());
  if (!names.includes("tag")) throw new Error(`The first line has no column "tag"; it should be ${COLUMNS.join(",")}.`);
  const other = names.find((name) => !COLUMNS.includes(name));
  if (other !== undefined) throw new Error(`The column "${other}" is not known; columns are ${COLUMNS.join(", ")}.`);
  const seen = new Set();
  return lines.map(({ cells, line }) => {
    if (cells.length > names.length) throw new Error(`Line ${line} has ${cells.length} values for ${names.length} columns.`);
    const asset = Object.fromEntries(names.map((name, index) => [name, wordsOf(cells[index] ?? "")]));
    if (!asset.tag) throw new Error(`Line ${line} names no tag.`);
    if (seen.has(asset.tag)) throw new Error(`Line ${line}: the tag "${asset.tag}" is listed twice.`);
    seen.add(asset.tag);
    return asset;
  });
}

/** A cell, without the apostrophe that stands before what a spreadsheet would take for a formula. */
function wordsOf(cell) {
  return cell.trim().replace(/^'(?=[=+\-@'])/, "");
}

/** The rows that are not empty, each with the number of its first line; a value in quotes may have separators and line ends. */
function rowsOf(text, mark) {
  const rows = [];
  let line = 1;
  let row = { cells: [], line };
  const pattern = new RegExp(`("(?:[^"]|"")*"|[^"${mark}\\r\\n][^${mark}\\r\\n]*|)(${mark}|\\r?\\n|$)`, "gy");
  while (pattern.lastIndex < text.length) {
    const found = pattern.exec(text);
    if (!found) throw new Error(`Line ${line}: a quotation mark is not closed, or something follows it.`);
    const [all, value, end] = found;
    row.cells.push(value.startsWith('"') ? value.slice(1, -1).replaceAll('""', '"') : value);
    line += all.split("\n").length - 1;
    if (end === mark) continue;
    if (row.cells.some(Boolean)) rows.push(row);
    row = { cells: [], line };
  }
  if (row.cells.some(Boolean)) rows.push(row);
  return rows;
}
