/** Numbers that users type: with a comma or a dot, with a unit or without. */

const UNITS = { "": 1, m: 1, cm: 0.01, mm: 0.001 };

/** A length in metres; null where the text is none. */
export function readLength(text) {
  const match = /^\s*([-+−]?\d*[.,]?\d*)\s*([a-z]*)\s*$/i.exec(text);
  const factor = match && UNITS[match[2].toLowerCase()];
  if (!factor || !/\d/.test(match[1])) return null;
  const value = Number(match[1].replace(",", ".").replace("−", "-")) * factor;
  return Number.isFinite(value) ? Number(value.toFixed(6)) : null;
}

/** Why a text is no length between two limits; empty where it is one. */
export function lengthFault(text, low, high) {
  const value = readLength(text);
  const right = `a number of metres from ${low} to ${high}, such as 2.35`.replaceAll("-", "−");
  if (value === null) return `“${text.trim()}” should be ${right}.`;
  return value < low || value > high ? `${text.trim()} should be ${right}.` : "";
}
