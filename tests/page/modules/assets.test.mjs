/** Assets and alarms: tables, drafts, colours, searches; the order of alarms and what they are about. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { load } from "./browser.mjs";

const { COLUMNS, readCsv } = await load("assets/csv");
const { Draft, kindOf } = await load("assets/draft");
const { allGroups, assetLook, foundByAsset, isFound, labelOf, receiveAssets } = await load("assets/model");
const { state } = await load("store");

const asset = (tag, name = "", group = "", more = {}) => ({ tag, name, group, icon: "", colour: "", owner: "", notes: "", ...more });
const bytes = (words, encoding = "utf8") => new Uint8Array(Buffer.from(words, encoding)).buffer;

test("a table that cannot be read says where and why", () => {
  for (const [words, fault] of [
    ["name,group\r\nA,b\r\n", 'no column "tag"'],
    ["tag,size\r\na,b\r\n", 'column "size" is not known'],
    ["tag,name\na,b\na,c\n", 'Line 3: the tag "a" is listed twice'],
    ['tag,name\na,"b\n', "quotation mark is not closed"],
    ["tag,name\na,b,c\n", "Line 2 has 3 values for 2 columns"],
    ["tag,name\n,b\n", "Line 2 names no tag"],
    ["tag,name\na,Säge\n", "not UTF-8"],
  ]) {
    assert.throws(() => readCsv(bytes(words, "latin1")), ({ message }) => message.includes(fault), fault);
  }
}); // prettier-ignore

test("tables of spreadsheets are read: quotes, line ends, semicolons, tabs, formulas", () => {
  const words = '\ufefftag;name;notes\r\nforklift;"Linde; 4";\r\nrobot;"R ""2""";"two\nlines"\r\n\r\n';
  assert.deepEqual(readCsv(bytes(words)), [
    { tag: "forklift", name: "Linde; 4", notes: "" },
    { tag: "robot", name: 'R "2"', notes: "two\nlines" },
  ]);
  assert.deepEqual(readCsv(bytes("Tag\tname\na\t'=1+1\n")), [{ tag: "a", name: "=1+1" }]);
});

test("what the page saves it reads again", async () => {
  const { csvOf } = await load("files");
  const rows = [["a,b", 'say "x"', "=sum", "'quoted", "two\nlines", "@at", "-1"]];
  assert.deepEqual(readCsv(bytes(csvOf(COLUMNS, rows))).map(Object.values), rows);
});

test("a file changes the columns that it has, and adds; what differs comes first", () => {
  const draft = new Draft([asset("trolley", "Cart 1"), asset("forklift", "Linde 3", "forklifts", { icon: "F", owner: "Bea" })]);
  draft.merge([{ tag: "forklift", name: "Linde; 4", notes: "" }, { tag: "robot", name: "R 2" }]);
  assert.deepEqual(draft.rows.map(kindOf), ["new", "changed", ""]);
  assert.deepEqual(draft.changes(), { new: 1, changed: 1, removed: 0, "": 1 });
  const saved = [asset("trolley", "Cart 1"), asset("forklift", "Linde; 4", "forklifts", { icon: "F", owner: "Bea" }), asset("robot", "R 2")];
  assert.deepEqual(draft.assets(), saved, "assets that the file has not stay");
}); // prettier-ignore

test("assets are removed and brought back; a new one disappears", () => {
  const draft = new Draft([asset("a")]);
  draft.toggle(draft.rows[0]);
  assert.deepEqual([kindOf(draft.rows[0]), draft.assets()], ["removed", []]);
  draft.toggle(draft.rows[0]);
  draft.toggle(draft.add({ tag: "b" }));
  assert.deepEqual(draft.assets(), [asset("a")]);
});

test("of two pages that edit at once none erases the other's change", () => {
  const draft = new Draft([asset("forklift", "Linde"), asset("trolley", "Cart 1"), asset("gone")]);
  draft.rows[0].asset.name = "Mine";
  const theirs = [asset("forklift", "Theirs"), asset("trolley", "Cart 2"), asset("robot", "Third")];
  assert.deepEqual(draft.rebase(theirs), { changed: ["forklift", "trolley", "gone", "robot"], both: ["forklift"] });
  assert.deepEqual(draft.assets().map(({ name }) => name), ["Mine", "Cart 2", "Third"]);
  assert.deepEqual(draft.rebase(theirs), { changed: [], both: [] });
}); // prettier-ignore

test("assets name and colour their tags; groups differ, and a colour like the map's is moved away from it", () => {
  const names = ["forklifts", "people", "crates", "robots", "tools", "carts", "cranes", "drones", "pallets", "guests"];
  receiveAssets([
    ...Array.from({ length: 500 }, (_, n) => asset(`tag-${n}`, `Thing ${n}`, names[n % 10], { owner: n % 50 ? "" : "Ann" })),
    asset("white", "", "", { colour: "#ffffff" }), asset("plain"), asset("icon", "Linde 3", "", { icon: "F", colour: "#c2410c" }),
  ]);
  assert.equal(new Set([...allGroups().values()].map(({ colour }) => colour)).size, 10);
  assert.equal(assetLook("tag-7").colour, assetLook("tag-17").colour);
  assert.deepEqual([assetLook("plain"), assetLook("icon").colour], [null, "rgb(194, 65, 12)"]);
  assert.notEqual(assetLook("white").colour, "rgb(255, 255, 255)");
  assert.deepEqual(["icon", "tag-1", "stranger"].map(labelOf), ["F Linde 3", "Thing 1", "stranger"]);
  state.find = "ann";
  assert.equal(foundByAsset().length, 10);
  state.find = "thing 49";
  assert.equal(foundByAsset().length, 11);
  Object.assign(state, { find: "", filter: { group: "people", zone: "" } });
  assert.deepEqual([foundByAsset().length, isFound("tag-1"), isFound("stranger")], [50, true, false]);
  receiveAssets([]);
  assert.equal(state.filter.group, "", "a filter of a group that is gone would hide tags");
}); // prettier-ignore

test("the filter leaves tags that are in its zone and are found by tag, name or owner", async () => {
  const { filtering, passes } = await load("map/filter");
  state.zones = [{ id: "dock", polygon_m: [[0, 0], [4, 0], [4, 4], [0, 4]] }];
  assert.equal(filtering(), false);
  state.filter.zone = "dock";
  assert.deepEqual([filtering(), passes("a", [1, 1]), passes("a", [5, 1])], [true, true, false]);
  state.filter.zone = "gone";
  assert.equal(filtering(), false);
  state.find = "robot";
  assert.deepEqual([passes("ROBOT 1", [9, 9]), passes("drone", [9, 9])], [true, false]);
  Object.assign(state, { find: "", filter: { group: "", zone: "" } });
}); // prettier-ignore

test("alarms: those that nobody has acknowledged first, then those that last, the severest and the newest", async () => {
  const alarms = await load("alarms/model");
  const alarm = (id, severity, unix_s, acknowledged_unix_s = null, ended_unix_s = null) => {
    return { id, kind: "silent", subject: id, severity, unix_s, ended_unix_s, acknowledged_unix_s };
  };
  alarms.receiveAlarms([
    alarm("seen", "critical", 9, 10), alarm("ended", "critical", 8, null, 9), alarm("info", "info", 7),
    alarm("old", "warning", 1), alarm("new", "warning", 2), alarm("worst", "critical", 1),
  ], 4);
  assert.deepEqual(state.alarms.map(({ id }) => id), ["worst", "new", "old", "info", "ended", "seen"]);
  assert.deepEqual([alarms.counts(), state.moreAlarms], [{ unseen: 5, seen: 1 }, 4]);
  assert.deepEqual(alarms.criticals().map(({ id }) => id), ["worst", "ended"]);
  assert.deepEqual(alarms.alarmedTags(), new Set(["worst", "new", "old", "info", "seen"]));
  for (const [kind, subject, about] of [
    ["anchor-moved", "anchor-8", { kind: "anchor", ids: [8] }], ["crowded", "zone-dock", { kind: "zone", ids: ["dock"] }],
    ["near", "a~b", { kind: "tag", ids: ["a", "b"] }], ["silent", "a", { kind: "tag", ids: ["a"] }],
  ]) assert.deepEqual(alarms.subjectOf({ kind, subject }), about);
  alarms.selectSubject({ kind: "crowded", subject: "zone-dock" });
  assert.deepEqual(state.selection, { tag: null, anchor: null, zone: "dock" });
}); // prettier-ignore
