/** The lists of tags, anchors and events, and the phases, as words: with the messages of the feed. */

import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { Part, feed, load, sockets, wait } from "./browser.mjs";

const { state } = await load("store");
const { live, now_s } = await load("clock");
const { ALERT, TIME, UNVERIFIED, VERIFIED_AGE } = await load("tracks");
(await load("live")).start();

const HELLO = feed[0];
const HEALTH = feed.findLast(({ type }) => type === "health");
const DAY_S = 86_400;
const send = (message) => sockets.at(-1).receive(message);

/** A tab of the page, and what its detail says: words and grades by the names of the facts. */
async function tab(name) {
  const module = await load(`panels/${name}`);
  const part = new Part();
  module.start(part);
  const facts = (selection) => {
    Object.assign(state.selection, selection);
    module.show();
    const boxes = part.all((one) => one.className === "facts").flatMap((list) => list.children);
    return Object.fromEntries(boxes.map((box) => [box.firstChild.textContent, [box.lastChild.textContent, box.lastChild.className]]));
  };
  const rows = () => {
    module.show();
    const found = part.all((one) => one.cells.length > 7 && one.does.click);
    return found.map((row) => [row.className.split(" ")[0], ...row.cells.map(({ textContent }) => textContent)]);
  };
  return { ...module, part, facts, rows };
}

const [tags, anchors, events, timing] = await Promise.all(["tags", "anchors", "events", "timing"].map(tab));

/** A health message with changes to its tags and anchors by their names. */
function health({ of = {}, conditions = {}, ages = {}, ...changes } = {}) {
  const changed = (list, key) => list.map((one) => ({ ...one, unix_s: now_s(), ...of[one[key]] }));
  return {
    ...HEALTH, tags: changed(HEALTH.tags, "tag"), anchors: changed(HEALTH.anchors, "anchor"),
    conditions: { ...HEALTH.conditions, ...conditions }, ages: { ...HEALTH.ages, ...ages }, ...changes,
  }; // prettier-ignore
}

beforeEach(() => {
  for (const message of feed) send(message);
  Object.assign(state, { find: "", selection: { tag: null, anchor: null, zone: null } });
  wait(0.25); // positions are drawn with a delay
});

test("a tag has figures and facts; without keys it says nothing of codes", () => {
  const [[condition, , name, x, y, z, sigma]] = tags.rows();
  assert.deepEqual([condition, name], ["fresh", "a"]);
  assert.ok(Math.hypot(x - 3, y - 4) < 0.1);
  assert.match(z, /^\(−?0\.00\)$/, "its height was given");
  assert.match(sigma, /^\d\.\d cm$/);
  const facts = tags.facts({ tag: "a" });
  assert.deepEqual([facts.Zones, facts.Method, facts["Integrity alert"], facts.Dropped].map(([words]) => words), ["West", "joint", "none", "none"]);
  for (const none of ["Verified", "Not accepted", "Clock", "Carrier phases"]) assert.equal(facts[none], undefined);
}); // prettier-ignore

test("a tag says what it verifies, which phases it uses, where it computes, and why it has no fix", () => {
  const says = { trust: "open", is_verified: false, clock_error_s: -3.25, faults: { 3: "bad-code" }, reason: "too-few-anchors" };
  send(health({ of: { a: { ...says, carrier_phase_anchors: [1, 2, 5], carrier_phase_hypotheses: 3, on_board: true } } }));
  const facts = tags.facts({ tag: "a" });
  assert.deepEqual([facts.Verified, facts.Clock], [["nothing is verified", "bad"], ["3.3 s behind the site's", "bad"]]);
  assert.deepEqual(facts["Not accepted"], ["anchor 3: wrong code: forged, or another seed", "bad"]);
  assert.deepEqual([facts["Carrier phases"][0], facts.Method[0]], ["of anchors 1, 2, 5, locking (3 left)", "joint, on its board (emulated)"]);
  assert.equal(tags.part.all(({ className }) => className === "reason")[0].textContent, "No fix: too few anchors");
  assert.deepEqual(tags.rows().map(([, , name]) => name), ["a not verified", "b"]);
  const row = [...feed.findLast(({ type }) => type === "state").tags[0]];
  row[TIME + 1] += 0.1;
  Object.assign(row, { [ALERT + 1]: "detected-not-excluded", [VERIFIED_AGE + 1]: 0.3, [UNVERIFIED + 1]: 0.18 });
  live.add([row]);
  send(health({ of: { a: { trust: "open", is_verified: true } } }));
  wait(0.25);
  const known = tags.facts({ tag: "a" });
  assert.match(known.Verified[0], /^up to 0\.\d s ago; 18\u00a0% of the last second's beacons not yet$/);
  assert.deepEqual(known["Integrity alert"], ["fault not excluded: no protection level", "bad"]);
}); // prettier-ignore

test("the search counts only where its field is shown", () => {
  state.find = "nobody";
  tags.show();
  assert.equal(state.find, "");
  live.addNames(Array.from({ length: 12 }, (_, n) => `t${n}`));
  state.find = "t11";
  assert.deepEqual(tags.rows().map(([, , name]) => name), ["t11"]);
  state.find = "nobody";
  assert.deepEqual(tags.rows(), []);
  assert.equal(tags.part.all(({ className }) => className === "empty")[0].textContent, "No tag is found.");
}); // prettier-ignore

test("an anchor shows its codes, its key chain and what it does not accept", () => {
  const keyed = { chain: 2, chain_ends_unix_s: now_s() + 400.5 * DAY_S };
  const ending = { ...keyed, chain_ends_unix_s: now_s() + 20.5 * DAY_S, faults: { 5: "bad-code" } };
  send(health({ of: { 1: keyed, 2: { ...keyed, code_fault: "clock-wrong" }, 3: ending } }));
  assert.deepEqual(anchors.facts({ anchor: 1 }).Codes, ["with each beacon", ""]);
  assert.match(anchors.facts({ anchor: 1 })["Key chain"][0], /in 400 days$/);
  assert.deepEqual(anchors.facts({ anchor: 2 }).Codes, ["none: its clock is wrong", "warn"]);
  const third = anchors.facts({ anchor: 3 });
  assert.deepEqual([third["Key chain"][1], third["Not accepted"]], ["warn", ["anchor 5: wrong code: forged, or another seed", "bad"]]);
  const fourth = anchors.facts({ anchor: 4 });
  assert.deepEqual([fourth.Codes, fourth["Key chain"]], [["none: it has no keys", "warn"], undefined]);
  const named = anchors.rows().slice(0, 4).map(([condition, , name]) => [condition, name]);
  assert.deepEqual(named, [["good", "1 master"], ["warn", "2 no codes"], ["good", "3"], ["warn", "4 no codes"]]);
  send(health());
  assert.equal(anchors.facts({ anchor: 1 }).Codes, undefined, "at a site without keys");
}); // prettier-ignore

test("an anchor has figures while it is heard; of one that is offline only what stays true", () => {
  const ages = { anchors: { ...HEALTH.ages.anchors, 2: 20 } };
  send(health({ of: { 3: { synchronised: false, master: 1 } }, conditions: { 2: "bad", 3: "warn" }, ages }));
  const [one, dead, open, , , unheard] = anchors.rows();
  assert.deepEqual(one.slice(2), ["1 master", "reference", "–", "–", "1", "9", "0"]);
  assert.deepEqual(dead, ["bad", "offline", "2", ...Array(6).fill("–")]);
  assert.deepEqual([open[0], open[1], unheard[0], unheard[1]], ["warn", "not synchronised", "unknown", "health unknown"]);
  assert.deepEqual(anchors.facts({ anchor: 2 }).State, ["offline: its figures are not known", "bad"]);
  assert.deepEqual([anchors.facts({ anchor: 3 }).State[0], anchors.facts({ anchor: 3 })["Synchronised to"]], ["not synchronised", undefined]);
  send({ ...HELLO, site: { ...HELLO.site, site: { ...HELLO.site.site, schedule: { ...HELLO.site.site.schedule, mode: "free" } } } });
  assert.deepEqual(anchors.rows()[0].slice(1, 3), ["on the air", "1"], "no master at a site without one");
  send({ ...HELLO, site: { ...HELLO.site, system: "tdoa" } });
  assert.deepEqual(anchors.rows()[0].slice(1, 3), ["on the air", "1"], "nor at another system's");
  send({ ...HELLO, site: { ...HELLO.site, system: "dl-tdoa" } });
  assert.equal(anchors.rows()[0][2], "0001", "FiRa's anchors are called by their MAC addresses");
}); // prettier-ignore

test("what the watch finds is listed, and marks its anchors", () => {
  const finding = { kind: "moved", anchors: [4], size_m: 0.11, std_m: 0.01, since_unix_s: 1.78e9, sentence: "anchor 4 has moved by about 11 cm" };
  send({ type: "watch", watch: { findings: [finding] } });
  assert.deepEqual(anchors.rows()[3].slice(0, 3), ["bad", "synchronised; moved 11 cm", "4 moved 11 cm"]);
  const list = anchors.part.all(({ className }) => className === "reasons findings")[0];
  assert.match(list.textContent, /^Anchor 4 has moved by about 11 cm, since /);
  send({ type: "watch", watch: { findings: [] } });
  anchors.show();
  assert.deepEqual([list.textContent, list.hidden], ["", true]);
}); // prettier-ignore

test("events are listed the newest first, filtered, and those that are severe counted until they are read", () => {
  const event = (serial, level, kind, name, text) => ({ serial, unix_s: 2e9 + serial, kind, level, name, text, first: serial, count: 1 });
  const log = [
    event(91, "good", "anchor", "anchor/3", "anchor 3 is online"), event(92, "note", "program", "recorder/demo", "recorder demo started"),
    event(93, "bad", "anchor", "anchor/8", "anchor 8 is offline"), event(94, "bad", "alert", "tag/robot", "tag robot: a fault is not excluded"),
  ];
  state.log = log;
  assert.equal(events.unread(), 2);
  const list = () => (events.show(), events.part.find("event-list").children.map((line) => line.children[3].textContent));
  assert.deepEqual(list(), ["Tag robot: a fault is not excluded.", "Anchor 8 is offline.", "Recorder demo started.", "Anchor 3 is online."]);
  assert.equal(events.unread(), 0);
  const filter = events.part.find("event-filter");
  for (const [group, count] of [["severe", 2], ["programs", 1], ["anchors", 2], ["alarms", 0], ["all", 4]]) {
    filter.value = group;
    filter.does.change();
    assert.equal(list().length, count, group);
  }
  Object.assign(state, { mode: "replay", player: { events: null } });
  events.show();
  assert.match(events.part.textContent, /Reading the events …/);
  state.mode = "live";
}); // prettier-ignore

test("phases are drawn for each message that a tag processes, and each fix", () => {
  const phases = Array.from({ length: 8 }, (_, n) => [7, n, n + 1, 0.0021 * n, 0.0021 * n + 0.00045, n >= 3]);
  send(health({ of: { a: { phases }, b: { phases } } }));
  timing.show();
  const marks = (kind) => timing.part.all(({ className }) => className === kind).length;
  assert.deepEqual([marks("busy"), marks("fix")], [16, 10]);
});
