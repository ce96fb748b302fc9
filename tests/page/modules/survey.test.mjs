/** The set-up: what a survey's result is worth, its picture, a floor plan's place, typed lengths, and saving. */

import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { Part, asked, clock, drawn, frame, load, wait } from "./browser.mjs";

const { state } = await load("store");
const { receiveSurvey } = await load("survey/model");
const { command, headline, verdict } = await load("survey/verdict");
const { drawSurvey, ellipseFactor, pixelOf, surveyPositions } = await load("map/survey");
const view = await load("map/view");
const laid = await load("survey/plan");

const TRUE = { 1: [0, 0], 2: [4, 0.1], 3: [8.1, -0.1], 4: [8, 6], 5: [4.1, 5.9], 6: [-0.1, 6.1] };
const GAUGE = { origin: 1, x_axis: 3, left: 6 };
const ON_THE_FLOOR = "no heights are given: all anchors are taken to be on the floor.";

/** A message of the survey program, made up: `changes` to it, and to its result. */
function message({ heard = [1, 2, 3, 4, 5, 6], open = [], excluded = [], result, facts, ...changes } = {}) {
  const pairs = heard.flatMap((a) => heard.filter((b) => b > a).map((b) => ({ a, b, exchanges: 40, range_m: 5, std_m: 0.004 })));
  const anchors = heard.map((id) => {
    const [x_m, y_m] = open.includes(id) ? [null, null] : TRUE[id];
    const sure = x_m !== null;
    const covariance_m2 = sure ? [[0.0025, 0, 0], [0, 0.0004, 0], [0, 0, 0]] : null; // prettier-ignore
    const reason = sure ? null : "it is linked to one other anchor only";
    return { id, determined: sure, x_m, y_m, z_m: 0, std_m: sure ? 0.051 : null, covariance_m2, reason };
  });
  const none = {
    not_determined: [], ambiguities: [], unchecked: null, assumed_heights: null, notes: [], tapes: [],
    redundancy: 4, range_std_m: 0.03, frame: "",
  }; // prettier-ignore
  const used = pairs.map((pair) => ({ ...pair, excluded: excluded.includes(`${pair.a}-${pair.b}`) }));
  return {
    unix_s: 1.8e9, serial: 1, anchors: heard, missing: [], pairs, facts: { gauge: null, ...facts }, error: null,
    survey: heard.length > 2 ? { ...none, anchors, pairs: used, ...result } : null, state: "surveyed",
    file: "/srv/hall/site.toml", saved_serial: null, saved_unix_s: null, ...changes,
  }; // prettier-ignore
}

const OTHER = { sentence: "Anchor 4 could as well hang 2.3 m further to the right.", anchors: [4], positions_m: { 4: [10, 6, 0] } };
const GHOST = { ambiguities: [OTHER] };

beforeEach(() => {
  Object.assign(state.connection, { phase: "open" });
  Object.assign(state, { mqtt: { connected: true, broker: "mqtt://hall:1883" }, site: { name: "Hall 7", anchors: [], unplaced: [] }, mode: "live" });
  Object.assign(view.view, { width: 800, height: 600 });
  view.fit(null, [], Object.values(TRUE));
  receiveSurvey(message(), 0);
});

test("the verdict is good only where nothing speaks against the result, and its reasons are listed", async () => {
  const why = await load("setup/why");
  const body = new Part();
  why.start(body);
  const listed = () => (why.show(), body.textContent);
  assert.deepEqual([verdict().kind, verdict().words], ["good", "All 6 anchors are determined and checked, to ±5.1 cm or better."]);
  assert.match(listed(), /no other result fits them\.15 pairs are used\./);
  assert.equal(why.summary(), "nothing found");
  for (const [changes, kind, words, reason] of [
    [{ result: { notes: ["Point of anchor 3 does not fit."] } }, "note", "Point of anchor 3 does not fit.", "Note: Point of anchor 3 does not fit."],
    [{ missing: [7] }, "warn", "1 anchor has not been received: 7."],
    [{ missing: [7, 8] }, "warn", "2 anchors have not been received: 7, 8."],
    [{ result: { assumed_heights: ON_THE_FLOOR } }, "warn", "No heights are given: all anchors are taken to be on the floor. Step 3", "Heights: No heights are given"],
    [{ result: { unchecked: "Nothing checks this survey." } }, "warn", "Nothing checks this survey.", "Unchecked: Nothing checks"],
    [{ result: GHOST }, "warn", "1 other result fits", "Ambiguous: Anchor 4 could as well hang 2.3 m further to the right."],
    [{ open: [5] }, "bad", "Anchor 5 is not determined.", "Anchor 5: It is linked to one other anchor only."],
    [{ open: [5, 6] }, "bad", "2 anchors are not determined: 5, 6."],
    [{ result: { not_determined: ["anchors 7 and 8 are linked to one other"] } }, "bad", "Anchors 7 and 8 are linked to one other.", "Not determined: Anchors 7 and 8"],
    [{ error: "the disk is full" }, "bad", "The disk is full."],
    [{ state: "no data" }, "bad", "The survey program receives nothing of the anchors."],
    [{ heard: [1, 2] }, "note", "2 anchors have been received; too few pairs for a result yet.", "There is no result yet."],
    [{ heard: [1] }, "note", "1 anchor has been received"],
    [{ excluded: ["1-4"] }, "good", "All 6 anchors", "14 pairs are used; left out as late: 1–4 (dashed lines)."],
  ]) {
    receiveSurvey(message(changes), 0);
    assert.equal(verdict().kind, kind, words);
    assert.ok(verdict().words.includes(words), verdict().words);
    if (reason) assert.ok(listed().includes(reason), listed());
  }
}); // prettier-ignore

test("an old message, a lost broker and a lost connection come before all else", () => {
  for (const [age_s, words] of [[4, null], [6, "sent nothing for 6 s"], [3600, "sent nothing for 3600 s"]]) {
    receiveSurvey(message(), age_s);
    assert.equal(verdict().kind, words ? "bad" : "good");
    if (words) assert.ok(verdict().words.includes(words));
  }
  state.mqtt.connected = false;
  assert.equal(verdict().title, "No broker");
  state.connection.phase = "lost";
  assert.equal(verdict().title, "Connection lost");
}); // prettier-ignore

test("without a survey program the page shows how to start it; a site is named after its file", () => {
  receiveSurvey(null, 0);
  assert.deepEqual([verdict().kind, verdict().title], ["bad", "No survey program"]);
  assert.equal(command(), "skyless survey --mqtt mqtt://hall:1883 --site site.toml --serve");
  state.site.name = "hall";
  assert.equal(command(), "skyless survey --mqtt mqtt://hall:1883 --site hall.toml --serve");
});

test("at a site in use what another survey would leave open is no fault, until somebody begins one", () => {
  state.site = { name: "Hall 7", anchors: [{ id: 1, x_m: 0, y_m: 0 }] };
  receiveSurvey(message({ open: [6], result: { unchecked: "Nothing checks this survey." } }), 0);
  assert.deepEqual([headline().kind, headline().title], ["note", "In use"]);
  assert.match(headline().words, /^All anchors have positions\. .* step 5 says/);
  assert.equal(verdict().words, "Anchor 6 is not determined.", "saving asks all the same");
  receiveSurvey(message({ open: [6], facts: { gauge: GAUGE } }), 0);
  assert.deepEqual([headline().kind, headline().words], ["bad", "Anchor 6 is not determined."]);
  receiveSurvey(null, 0);
  assert.match(headline().words, /start the survey program with the command below\.$/);
});

test("the picture shows pairs, late pairs, ghosts and anchors without a position", () => {
  const picture = (changes) => {
    receiveSurvey(message(changes), 0);
    const found = drawn(drawSurvey);
    const lines = found.of("lineTo");
    const dashed = lines.filter((line) => line.dashed).length;
    return { lines: lines.length - dashed, dashed, ellipses: found.of("ellipse").length, squares: found.of("strokeRect").length, words: found.words };
  };
  const whole = picture();
  assert.deepEqual([whole.lines, whole.dashed, whole.ellipses, whole.squares], [15, 0, 6, 0]);
  assert.ok(whole.words.some((words) => words.includes("larger")));
  assert.ok(ellipseFactor() >= 1);
  const doubtful = picture({ excluded: ["1-4"], open: [6], result: GHOST });
  assert.deepEqual([doubtful.lines, doubtful.dashed, doubtful.ellipses, doubtful.squares], [14 - 5, 2, 5, 1], "one late pair, one way to a ghost");
  assert.equal(doubtful.words.filter((words) => words === "4?").length, 2);
  assert.ok(["6", "Without a position yet:"].every((words) => doubtful.words.includes(words)));
  picture({ heard: [1, 2], missing: [3] });
  assert.ok([1, 2].map(pixelOf).every(Boolean), "in the tray");
  assert.deepEqual([pixelOf(3), surveyPositions().size], [null, 0]);
  assert.ok(picture({ facts: { gauge: GAUGE } }).words.includes("x"), "axes that are named are drawn");
}); // prettier-ignore

test("typed lengths have a comma or a dot, and a unit or none", async () => {
  const { lengthFault, readLength } = await load("survey/values");
  const known = { "10,02 m": 10.02, "250 cm": 2.5, 2.5: 2.5, "−3": -3, "12mm": 0.012 };
  for (const [words, value] of Object.entries(known)) assert.equal(readLength(words), value, words);
  for (const words of ["2.5o", "ten", "", "1e3", "."]) assert.equal(readLength(words), null, words);
  const right = /should be a number of metres from 0\.05 to 1000, such as 2\.35\.$/;
  for (const wrong of ["", "ten", "-3", "0,01"]) assert.match(lengthFault(wrong, 0.05, 1000), right);
  assert.match(lengthFault("2.5o", -10, 100), /^“2\.5o” should be a number of metres from −10 to 100/);
  assert.equal(lengthFault("10", 0.05, 1000), "");
}); // prettier-ignore

test("a floor plan is an image of at most 8 MB; it is moved, scaled by points and fitted to anchors", async () => {
  await assert.rejects(laid.readImage({ type: "image/gif", name: "x.gif" }), { message: "“x.gif” should be a PNG or JPEG image." });
  const large = { type: "image/png", name: "x.png", size: 8_000_001 };
  await assert.rejects(laid.readImage(large), { message: "“x.png” has 8.0 MB; an image should have at most 8 MB." });
  const at = () => [laid.plan.x_m, laid.plan.y_m, laid.plan.width_m];
  laid.begin({ naturalWidth: 800, naturalHeight: 600 }, {}, "hall.png", [0, 0, 8, 6]);
  assert.deepEqual([at(), laid.height_m()], [[0, 0, 8], 6]);
  laid.move(1.2345, -2);
  assert.deepEqual(at(), [1.235, -2, 8]);
  laid.place({ x_m: 0, y_m: 0 });
  laid.scaleTo([2, 3], [6, 3], 10);
  assert.deepEqual(at(), [-6, -4.5, 20], "about the middle of both points");
  laid.place({ x_m: 0, y_m: 0, width_m: 8 });
  assert.ok(Math.abs(laid.fitToPoints([0.8, 0.6], [7.2, 0.6], [0, 0], [8.1, 0])) < 1e-9);
  assert.deepEqual(at(), [-1.012, -0.759, 10.125]);
  assert.ok(Math.abs(laid.fitToPoints([0, 0], [5, 0], [0, 0], [0, 5]) - 90) < 1e-9, "an image cannot be turned here");
  const sent = asked.length;
  wait(0.5);
  assert.equal(asked.length, sent + 1, "where it lies is sent once it rests");
  laid.discard();
  assert.equal(laid.plan, null);
}); // prettier-ignore

test("a result is saved, a weak one only on purpose, and the program's answer is awaited", async () => {
  const save = await load("setup/save");
  const body = new Part();
  save.start(body);
  const [button, sure, warning, said] = ["save", "save-sure", "save-warning", "save-state"].map((id) => body.find(id));
  const receive = (changes) => (receiveSurvey(message(changes), 0), save.show());
  const press = async () => (await button.does.click(), save.show());
  receive();
  assert.equal(body.find("save-what").textContent, "positions and antenna delays of 6 anchorsthe file /srv/hall/site.toml; the old one is kept");
  assert.deepEqual([button.disabled, warning.hidden], [false, true]);
  for (const [changes, words] of [[{ open: [6] }, "Anchor 6 is not determined."], [{ result: { assumed_heights: ON_THE_FLOOR } }, "on the floor"]]) {
    receive(changes);
    assert.ok(warning.textContent.includes(words));
    assert.equal(button.disabled, true);
    sure.checked = true;
    save.show();
    assert.deepEqual([button.disabled, button.textContent], [false, "Save all the same"]);
    receive();
    assert.equal(sure.checked, false, "it is asked for each time");
  }
  globalThis.fetch = async () => ({ ok: true, json: async () => ({}) });
  receive({ saved_serial: 1, saved_unix_s: 1.78e9 });
  await press();
  assert.deepEqual([said.textContent, button.disabled], ["Saving …", true]);
  receive({ saved_serial: 1, saved_unix_s: 1.78e9 });
  assert.equal(said.textContent, "Saving …", "the answer to the request before is none to this one");
  receive({ saved_serial: 1, saved_unix_s: 1.78e9 + 3661 });
  assert.match(said.textContent, /^Saved at \d\d:\d\d:\d\d in \/srv\/hall\/site\.toml, and sent to the anchors\.$/);
  assert.equal(said.className, "good");
  receive();
  await press();
  receive({ error: "site.toml cannot be written: the disk is full" });
  assert.deepEqual([said.textContent, said.className], ["Not saved: site.toml cannot be written: the disk is full", "bad"]);
  receive();
  await press();
  clock.ms += 15_100;
  receive();
  assert.equal(said.textContent, "The survey program has not answered. Look at its log, then try again.");
  receiveSurvey(message(), 3600);
  save.show();
  assert.equal(button.disabled, true, "an old result is not saved");
  frame();
}); // prettier-ignore
