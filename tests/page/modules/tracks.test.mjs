/** Tracks, their times, and the histories of healths. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { clock, load, wait } from "./browser.mjs";

const { COLUMNS, FRESH, GONE, SLEEP, TIME, Track, Tracks } = await load("tracks");
const { freshness, now_s, resetOffset, updateOffset } = await load("clock");
const { addHealth, anchorHistory } = await load("history");
const { state } = await load("store");
const { noteGap, rowLimit, stall_s } = await load("pace");

/** A row of a state message: numbers by their columns. */
const row = (numbers, name = "t") =>
  Object.assign(Array(COLUMNS + 1).fill(0), { 0: name }, Object.fromEntries(Object.entries(numbers).map(([key, value]) => [Number(key) + 1, value])));

test("positions between fixes lie on straight lines, and nothing is interpolated over a gap", () => {
  const times = [0, 0.1, 0.23, 0.31, 0.71, 2.71, 2.81];
  const track = new Track("t");
  for (const time of times) track.push(row({ 0: time ** 2, 1: -time, [TIME]: time }));
  const out = new Float64Array(COLUMNS);
  const at = (time) => (track.at(time, out), [out[0], out[1]]);
  for (const [time, before, after] of [[0.05, 0, 0.1], [0.2, 0.1, 0.23], [0.5, 0.31, 0.71], [0.71, 0.71, 0.71], [2.75, 2.71, 2.81]]) {
    const share = after > before ? (time - before) / (after - before) : 0;
    const expected = [before ** 2 + share * (after ** 2 - before ** 2), -time];
    at(time).forEach((value, axis) => assert.ok(Math.abs(value - expected[axis]) < 1e-12));
  } // prettier-ignore
  for (const time of [1.5, 2.7]) assert.deepEqual(at(time), [0.71 ** 2, -0.71]);
  for (const time of [2.81, 9]) assert.deepEqual(at(time), [2.81 ** 2, -2.81]);
  assert.equal(track.at(-0.1, out), false);
});

test("a track keeps the newest states", () => {
  const track = new Track("t");
  for (let n = 0; n < 5000; n++) {
    track.push(row({ [TIME]: n / 10 }));
    if (n % 7 === 0) track.push(row({ [TIME]: n / 10 }));
  }
  assert.deepEqual([track.count, track.value(0, TIME), track.lastTime, track.find(499.85)], [2048, 295.2, 499.9, 2046]);
});

test("the server's times say whether a fix is fresh; one of another clock is not", () => {
  const times_s = { [FRESH]: 1, [SLEEP]: 5, [GONE]: 10 };
  const track = new Track("a");
  assert.equal(freshness(track, 1000, 1000), "never");
  track.push(row({ [TIME]: 1000, ...times_s }));
  const kinds = [1000.1, 998.5, 994, 985, NaN, 1000.99, 1001.01, 1009.9, 1010.1].map((now) => freshness(track, now, now - 0.15));
  assert.deepEqual(kinds, ["fresh", "asleep", "late", "gone", "gone", "fresh", "asleep", "late", "gone"]);
  const last = [999, 996, 990, 989, 992].map((time) => (track.push(row({ [TIME]: time, ...times_s })), track.lastTime));
  assert.deepEqual([...last, track.count], [1000, 1000, 990, 990, 992, 2], "a clock that was set back starts it again");
  track.push(row({ [TIME]: 992, ...times_s, [SLEEP]: 1e3 }));
  assert.deepEqual([track.count, freshness(track, 1000, 1000)], [2, "asleep"], "a state of the same time replaces the last");
});

test("the quickest message gives the server's time; later ones change it slowly, a clock that was set at once", () => {
  resetOffset();
  for (const [unix_s, expected] of [[1000, 1000], [999, 999.998], [1000.5, 1000.5], [900, 900], [5000, 5000], [4999.5, 4999.999]]) {
    updateOffset(unix_s);
    assert.ok(Math.abs(now_s() - expected) < 1e-6, `${now_s()} is not ${expected}`);
  }
}); // prettier-ignore

test("tags that are silent for long are forgotten, but for those that are named", () => {
  const tracks = new Tracks();
  tracks.add([row({ [TIME]: 100 }, "old"), row({ [TIME]: 100 }, "healthy"), row({ [TIME]: 800 }, "t10"), row({ [TIME]: 800 }, "t9")]);
  tracks.addNames(["named"]);
  tracks.expire(200, new Set(["healthy"]));
  assert.deepEqual(tracks.sorted.map(({ name }) => name), ["healthy", "t9", "t10"]); // prettier-ignore
});

const add = (...healths) => addHealth(healths, [], new Set([99]), new Set());

test("offsets continue over the wrap of the counter", () => {
  const wrap_s = 2 ** 40 / 63.8976e9;
  for (let n = 0; n < 1500; n++) {
    const offset_s = ((8.602 + 3e-6 * n + wrap_s / 2) % wrap_s) - wrap_s / 2;
    add({ anchor: 99, unix_s: n + 1, offset_s, rate_ppm: 3, offset_std_m: 0.01 });
  }
  const kept = anchorHistory.get(99).offset_us;
  assert.equal(kept.length, 300);
  kept.forEach((value, n) => assert.ok(Math.abs(value - 3 * (1200 + n)) < 1e-3));
});

test("no line of a chart crosses a restart, a silence or another master", () => {
  anchorHistory.clear();
  const given = [[1, 10, 1, 0.5], [2, 11, 1, 0.5], [20, 1, 1, 7], [21, 2, 1, 7], [22, 3, 2, 1], [23, 4, 2, 1.1]]; // prettier-ignore
  for (const [unix_s, uptime_s, master, offset_s] of given) {
    add({ anchor: 99, role: "anchor", unix_s, uptime_s, master, offset_s, rate_ppm: 3 });
  }
  add({ anchor: 99, role: "master", master: 99, unix_s: 24, uptime_s: 5, offset_s: 0, rate_ppm: 0, offset_std_m: 0 });
  const { offset_us, rate_ppm } = anchorHistory.get(99);
  assert.deepEqual(rate_ppm, [3, 3, null, 3, 3, 3, 3, null]);
  assert.deepEqual(offset_us.map((value) => value && Number(value.toFixed(6))), [null, null, null, null, null, 0, 100_000, null]); // prettier-ignore
});

test("a browser that is late twice within ten seconds is too slow, and asks for fewer tags until it keeps up", () => {
  noteGap(1500);
  assert.deepEqual([stall_s(), rowLimit()], [0, 1000], "once may be its start");
  wait(9);
  noteGap(1500);
  assert.deepEqual([stall_s(), rowLimit()], [1.5, 500]);
  wait(4);
  assert.equal(stall_s(), 0);
  clock.ms += 16_100;
  noteGap(0);
  assert.equal(rowLimit(), 1000);
});

test("numbers are written with dashes where nothing is known, and one that is rounded to zero has no sign", async () => {
  const { bytes, clock: player, duration, length, metres, number, roundStep, sentence } = await load("format");
  for (const [write, ...expected] of [
    [metres, [[-0.001], "0.00"], [[-0.01], "−0.01"], [[-0.2, 0], "0"], [[NaN], "–"]],
    [number, [[-0.00001, 4, "s"], "0.0000\u00a0s"], [[-1.5, 1], "−1.5"], [[1234567], "1\u202f234\u202f567"], [[null], "–"]],
    [length, [[1.234], "1.23 m"], [[0.0996], "10 cm"], [[0.0994], "9.9 cm"], [[undefined], "–"]],
    [duration, [[4e-4], "400 µs"], [[0.0123], "12.3 ms"], [[0.123], "123 ms"], [[0.04, 1], "0.0 s"], [[59.9], "59.9 s"], [[61.5], "1 min 1 s"], [[3661], "1 h 1 min"]],
    [player, [[19.4], "0:19.4"], [[70], "1:10.0"]],
    [bytes, [[48.3e6], "48.3 MB"], [[2e9], "2.00 GB"], [[1500], "2 kB"]],
    [sentence, [["anchor 8 is offline"], "Anchor 8 is offline."], [["Why?"], "Why?"]],
    [roundStep, [[7], 5], [[0.19], 0.1], [[20], 20]],
  ]) for (const [given, words] of expected) assert.equal(write(...given), words); // prettier-ignore
});

test("in a recording the moment of the player counts", () => {
  const track = new Track("t");
  for (const time of [10, 20]) track.push(row({ [TIME]: time, [FRESH]: 1, [GONE]: 5 }));
  Object.assign(state, { mode: "replay", player: { start_unix_s: 0, at_s: 10.5 } });
  assert.deepEqual([freshness(track), freshness(track, 13, 13), freshness(track, 16, 16)], ["fresh", "late", "gone"]);
});
