/** Numbers as text; a dash where nothing is known. */

export const DASH = "–";

function known(value) {
  return value !== null && value !== undefined && Number.isFinite(value);
}

/** A coordinate in metres. */
export function metres(value, digits = 2) {
  return known(value) ? value.toFixed(digits).replace(/^-(?=0?\.?0*$)/, "").replace("-", "−") : DASH;
}

/** A length in m or cm. */
export function length(value_m) {
  if (!known(value_m)) return DASH;
  const size = Math.abs(value_m);
  if (size >= 1) return `${value_m.toFixed(2)} m`;
  if (size >= 0.0995) return `${(value_m * 100).toFixed(0)} cm`;
  return `${(value_m * 100).toFixed(1)} cm`;
}

/** A plain number with its unit. */
export function number(value, digits = 0, unit = "") {
  if (!known(value)) return DASH;
  const written = value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits, signDisplay: "negative" });
  return written.replace("-", "−").replaceAll(",", "\u202f") + (unit ? `\u00a0${unit}` : "");
}

/** A time difference; with `least_s`, shorter ones are written as 0.1 s are. */
export function duration(value_s, least_s = 0) {
  if (!known(value_s)) return DASH;
  if (value_s < least_s) return `${value_s.toFixed(1)} s`;
  if (Math.abs(value_s) < 1e-3) return `${(value_s * 1e6).toFixed(0)} µs`;
  if (Math.abs(value_s) < 1) return `${(value_s * 1e3).toFixed(value_s < 0.1 ? 1 : 0)} ms`;
  if (value_s < 60) return `${value_s.toFixed(1)} s`;
  if (value_s < 3600) return `${Math.floor(value_s / 60)} min ${Math.floor(value_s % 60)} s`;
  return `${Math.floor(value_s / 3600)} h ${Math.floor((value_s % 3600) / 60)} min`;
}

/** Words as a sentence: with a capital at the start and a full stop at the end. */
export function sentence(words) {
  return words.charAt(0).toUpperCase() + words.slice(1) + (/[.!?]$/.test(words) ? "" : ".");
}

/** Minutes and seconds on a player. */
export function clock(value_s) {
  const tenths = Math.floor(value_s * 10 + 1e-6);
  const minutes = Math.floor(tenths / 600);
  return `${minutes}:${((tenths % 600) / 10).toFixed(1).padStart(4, "0")}`;
}

/** The largest of 1, 2 and 5 times a power of ten that is at most `limit`. */
export function roundStep(limit) {
  const power = 10 ** Math.floor(Math.log10(limit));
  return power * ([1, 2, 5, 10].findLast((factor) => factor * power <= limit) ?? 1);
}

/** Time of day. */
export function timeOfDay(unix_s) {
  return known(unix_s) ? new Date(unix_s * 1e3).toLocaleTimeString("en-GB") : DASH;
}

/** Date and time of day. */
export function dateTime(unix_s) {
  if (!known(unix_s)) return DASH;
  const date = new Date(unix_s * 1e3);
  const two = (value) => String(value).padStart(2, "0");
  const day = `${date.getFullYear()}-${two(date.getMonth() + 1)}-${two(date.getDate())}`;
  return `${day} ${date.toLocaleTimeString("en-GB")}`;
}

/** Size of a file or of memory. */
export function bytes(value) {
  if (!known(value)) return DASH;
  if (value >= 1e9) return `${(value / 1e9).toFixed(2)} GB`;
  return value >= 1e6 ? `${(value / 1e6).toFixed(1)} MB` : `${(value / 1e3).toFixed(0)} kB`;
}
