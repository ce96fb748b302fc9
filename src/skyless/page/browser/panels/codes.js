/** What tags and anchors report of codes and keys, in words; null where there is nothing, as of those without keys. */

import { dateTime, duration } from "../format.js";

/** Why a beacon is not accepted, or an anchor sends no codes: the names on the wire, and their words. */
export const FAULTS = {
  "no-code": "no code",
  "bad-code": "wrong code: forged, or another seed",
  "revoked-chain": "of a key chain that was replaced",
  "late-frame": "too late",
  "early-frame": "too early",
  "repeated-frame": "repeated",
  "first-frame": "the first one",
  "no-key": "its key has not come",
  "too-many-frames": "too many",
  "no-time": "the time is not known yet",
  "no-chain": "no key chain holds now",
  "clock-wrong": "its clock is wrong",
};

/** A key chain that ends within this time needs a successor soon. */
const CHAIN_ENDS_S = 60 * 86400;
/** A position that is verified up to longer ago counts as not verified. */
const VERIFIED_AGE_S = 2;

/** Anchors that are not accepted, and why. */
export function faultWords(faults) {
  const words = Object.entries(faults ?? {}).map(([anchor, fault]) => `anchor ${anchor}: ${FAULTS[fault] ?? fault}`);
  return words.join("; ") || null;
}

/** Whether a tag verifies beacons, and none is verified. */
export function isUnverified(health) {
  return Boolean(health?.trust) && !health.is_verified;
}

/**
 * How far a position is verified.
 * @param {any} health null where it is not known, as in a recording
 * @param {number} age_s time since the last verified beacon that counts; NaN where none is
 * @param {number} unverified share of the last second's beacons
 * @returns {{words: string, grade: string}|null}
 */
export function verifiedWords(health, age_s, unverified) {
  if (isUnverified(health)) return { words: "nothing is verified", grade: "bad" };
  if (Number.isNaN(age_s)) return health?.trust ? { words: "not yet", grade: "warn" } : null;
  const until = `up to ${duration(age_s, 1)} ago`;
  const percent = unverified > 0 ? Math.max(1, Math.round(100 * unverified)) : 0;
  const share = percent ? `; ${percent}\u00a0% of the last second's beacons not yet` : "";
  const only = health?.trust === "verified" ? "; only verified positions are given" : "";
  return { words: until + (only || share), grade: age_s > VERIFIED_AGE_S ? "warn" : "" };
}

/** How far a tag's clock is off, where that is more than its bound. */
export function clockWords(health) {
  const error_s = health?.clock_error_s ?? null;
  return error_s === null ? null : `${duration(Math.abs(error_s))} ${error_s > 0 ? "ahead of" : "behind"} the site's`;
}

function hasKeys(health) {
  return [health.chain, health.chain_ends_unix_s, health.code_fault].some((value) => value != null);
}

/** Whether an anchor's beacons have codes, where some anchor has keys. @returns {{words: string, grade: string}|null} */
export function codeWords(health, all) {
  if (!hasKeys(health)) return [...all].some(hasKeys) ? { words: "none: it has no keys", grade: "warn" } : null;
  if (health.code_fault == null) return { words: "with each beacon", grade: "" };
  return { words: `none: ${FAULTS[health.code_fault] ?? health.code_fault}`, grade: "warn" };
}

/** Its key chain, and when the last one ends. @returns {{words: string, grade: string}|null} */
export function chainWords({ chain, chain_ends_unix_s, unix_s }) {
  const number = chain == null ? null : `number ${chain}`;
  if (chain_ends_unix_s == null) return number === null ? null : { words: number, grade: "" };
  const left_s = chain_ends_unix_s - unix_s;
  const day = dateTime(chain_ends_unix_s).slice(0, 10);
  const end = left_s > 0 ? `ends on ${day}, in ${spanWords(left_s)}` : `ended on ${day}`;
  const grade = left_s <= 0 ? "bad" : left_s < CHAIN_ENDS_S ? "warn" : "";
  return { words: [number, end].filter(Boolean).join(", "), grade };
}

function spanWords(value_s) {
  const days = value_s / 86400;
  return days < 2 ? duration(value_s) : `${Math.floor(days)} days`;
}
