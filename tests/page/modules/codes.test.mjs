/** What tags and anchors report of codes and keys, in words. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { load } from "./browser.mjs";

const { chainWords, clockWords, codeWords, faultWords, isUnverified, verifiedWords } = await load("panels/codes");

const DAY_S = 86_400;

test("a tag says how far its position is verified, and nothing without keys", () => {
  const [open, only] = [{ trust: "open", is_verified: true }, { trust: "verified", is_verified: true }];
  for (const [health, age_s, share, expected] of [
    [null, NaN, NaN, undefined],
    [{}, NaN, NaN, undefined],
    [null, 0.2, 0, ["up to 0.2 s ago", ""]],
    [null, 0.2, 0.001, ["up to 0.2 s ago; 1\u00a0% of the last second's beacons not yet", ""]],
    [open, 0.3, 0.18, ["up to 0.3 s ago; 18\u00a0% of the last second's beacons not yet", ""]],
    [only, 0, 0, ["up to 0.0 s ago; only verified positions are given", ""]],
    [only, 30, 0.5, ["up to 30.0 s ago; only verified positions are given", "warn"]],
    [open, NaN, NaN, ["not yet", "warn"]],
    [{ trust: "open", is_verified: false }, 0, 0, ["nothing is verified", "bad"]],
  ]) {
    const found = verifiedWords(health, age_s, share);
    assert.deepEqual(found ? [found.words, found.grade] : undefined, expected);
  }
  assert.deepEqual([isUnverified(null), isUnverified(open), isUnverified({ trust: "open" })], [false, false, true]);
});

test("what is not accepted is named with its anchor, a fault of a later version by its name", () => {
  assert.equal(faultWords({ 3: "bad-code", 4: "of later" }), "anchor 3: wrong code: forged, or another seed; anchor 4: of later");
  assert.deepEqual([faultWords({}), faultWords(undefined)], [null, null]);
});

test("a clock that is off says by how much and whither", () => {
  assert.equal(clockWords({ clock_error_s: -3.25 }), "3.3 s behind the site's");
  assert.equal(clockWords({ clock_error_s: 0.5 }), "500 ms ahead of the site's");
  assert.equal(clockWords({}), null);
});

test("an anchor shows its codes, its key chain and when that ends", () => {
  const keyed = { chain: 2, chain_ends_unix_s: 400.5 * DAY_S, unix_s: 0, code_fault: null };
  for (const [health, codes, chain] of [
    [keyed, ["with each beacon", ""], [/^number 2, ends on 1971-0\d-\d\d, in 400 days$/, ""]],
    [{ ...keyed, code_fault: "clock-wrong" }, ["none: its clock is wrong", "warn"], [/in 400 days/, ""]],
    [{ ...keyed, chain_ends_unix_s: 20.5 * DAY_S }, ["with each beacon", ""], [/in 20 days/, "warn"]],
    [{ ...keyed, chain_ends_unix_s: 5400 }, ["with each beacon", ""], [/in 1 h 30 min/, "warn"]],
    [
      { chain: null, chain_ends_unix_s: -DAY_S, unix_s: 0, code_fault: "no-chain" },
      ["none: no key chain holds now", "warn"],
      [/^ended on 1969-12-3\d$/, "bad"],
    ],
    [{ chain: 1 }, ["with each beacon", ""], [/^number 1$/, ""]],
    [{}, ["none: it has no keys", "warn"], null],
  ]) {
    const found = codeWords(health, [keyed, health]);
    assert.deepEqual([found.words, found.grade], codes);
    const ends = chainWords(health);
    assert.equal(ends === null, chain === null);
    if (chain) assert.match(ends.words, chain[0]);
    if (chain) assert.equal(ends.grade, chain[1]);
  }
  assert.equal(codeWords({}, [{}, {}]), null, "at a site without keys");
});
