/** The connection, what it brings, and what the page makes of the site's condition: with the messages of the feed. */

import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { asked, byId, clock, feed, frame, known, load, sockets, wait } from "./browser.mjs";

const { state, changed, on } = await load("store");
const { live, now_s, shown_s } = await load("clock");
const { ALERTS } = await load("tracks");
const { shownCondition } = await load("condition");
const { anchorHistory, tagHistory } = await load("history");
const liveModule = await load("live");
(await load("banner")).start();
liveModule.start();

const HELLO = feed[0];
const GOOD = { type: "condition", unix_s: 1.8e9 + 3, level: "good", text: "", reasons: [], latency_p50_s: 0.0012, latency_p99_s: 0.0034 };
const OFFLINE = { kind: "anchors", level: "warning", text: "anchor 8 of 8 is offline", advice: "See its power.", names: ["anchor/8"] };
const SLOW = { kind: "slow", level: "bad", text: "this computer is too slow: the emulated air missed 41 %", advice: "", names: [] };

const socket = () => sockets.at(-1);
const send = (message) => socket().receive(message);
/** Time passes at a server that sends its condition twice a second and answers pings. */
function live_s(seconds, condition = GOOD) {
  for (let left = seconds; left > 0; left -= 0.5) {
    wait(0.5);
    send({ type: "pong" });
    if (condition) send(condition);
  }
}
const header = () => [byId("pill").className, byId("pill-words").textContent, byId("condition-words").textContent];

beforeEach(() => {
  if (state.connection.phase === "lost") liveModule.retryNow();
  for (const message of feed) send(message);
  send(GOOD);
});

test("the feed is what the page shows", async () => {
  assert.equal(state.site.name, HELLO.site.site.name);
  assert.deepEqual([...live.all.keys()], ["a", "b"]);
  assert.deepEqual(state.zones.map(({ name }) => name), ["West"]);
  assert.deepEqual(state.events.map(({ tag, kind }) => [tag, kind]).sort(), [["a", "enter"], ["b", "enter"]]);
  assert.deepEqual(state.log.at(-1).text, "condition good");
  const row = new Float64Array(24);
  assert.ok(live.all.get("a").at(shown_s(), row));
  assert.ok(Math.hypot(row[0] - 3, row[1] - 4) < 0.1, "tag a stands at 3, 4");
  const { summaryFacts } = await load("summary");
  const facts = new Map(summaryFacts());
  assert.deepEqual([facts.get("Tags"), facts.get("Anchors")], ["2/2", "5/6"], "the last anchor has not been heard");
  assert.deepEqual([facts.get("Rate"), facts.get("Latency")], ["400\u00a0Hz", "1.2 ms, p99 3.4 ms"]);
  assert.match(facts.get("Protection level"), /^\d+ cm, largest \d+ cm$/);
  assert.equal(facts.get("Site"), "lab, number 1");
  clock.ms += 3500;
  assert.equal(new Map(summaryFacts()).get("Latency"), "–", "an old judgement has no figures");
}); // prettier-ignore

test("names on the wire are the library's", async () => {
  assert.deepEqual(Object.keys(ALERTS), known.alerts);
  assert.deepEqual(Object.keys((await load("panels/codes")).FAULTS), known.faults);
});

test("the pill has the level, the line below it the first reason, and the browser's tab a mark", () => {
  const title = () => byId("title").textContent;
  for (const [condition, shown, more, mark] of [
    [{}, ["pill good", "Live", "All is well: nothing speaks against the positions shown."], null, "● lab · Skyless"],
    [{ level: "warning", reasons: [OFFLINE] }, ["pill warning", "Warning", "Anchor 8 of 8 is offline."], "What to do", "▲ lab · Skyless"],
    [
      { level: "bad", reasons: [SLOW, OFFLINE] },
      ["pill bad", "Fault", "This computer is too slow: the emulated air missed 41 %."], "and 1 more", "✕ lab · Skyless",
    ],
    [{ level: "waiting", text: "no tag is online" }, ["pill waiting", "Waiting", "No tag is online."], null, "○ lab · Skyless"],
  ]) {
    send({ ...GOOD, text: condition.reasons?.[0].text ?? "", ...condition });
    assert.deepEqual(header(), shown);
    assert.equal(byId("condition-more").hidden, more === null);
    if (more) assert.equal(byId("condition-more").textContent, more);
    assert.equal(title(), mark);
    assert.equal(byId("condition-said").textContent, `${shown[1]}. ${shown[2]}`);
  }
}); // prettier-ignore

test("beside alarms positions are good and not all is well; a critical one takes the line away", () => {
  const one = { id: "1", kind: "silent", subject: "a", severity: "warning", unix_s: 1, ended_unix_s: null, acknowledged_unix_s: null };
  for (const [alarms, said] of [
    [[one], "Positions are good; 1 alarm."],
    [[one, { ...one, id: "2" }], "Positions are good; 2 alarms."],
    [[{ ...one, acknowledged_unix_s: 2 }], "Positions are good; 1 acknowledged alarm."],
    [[{ ...one, acknowledged_unix_s: 2, ended_unix_s: 3 }], "All is well: nothing speaks against the positions shown."],
  ]) {
    send({ type: "alarms", alarms, more: 0 });
    assert.equal(header()[2], said);
    assert.equal(byId("condition-line").hidden, false);
  }
  send({ type: "alarms", alarms: [{ ...one, severity: "critical" }], more: 3 });
  assert.equal(header()[2], "Positions are good; more than 1 alarm.");
  assert.equal(byId("condition-line").hidden, true);
  assert.match(byId("title").textContent, /^✕ Alarm · /);
}); // prettier-ignore

test("without a judgement, or with an old one, the page is not green", () => {
  send({ ...HELLO, events: [] });
  assert.equal(shownCondition().level, "waiting");
  send(GOOD);
  assert.equal(shownCondition().level, "good");
  const positions = feed.findLast(({ type }) => type === "state");
  for (let n = 0; n < 8; n++) (wait(0.5), send(positions), send({ type: "pong" }));
  assert.deepEqual(header(), ["pill waiting", "Waiting", "The server is silent."]);
  assert.match(shownCondition().reasons[0].text, /^the page's server has sent nothing for 4 s$/);
  assert.equal(state.connection.phase, "open");
});

test("a page that is behind, or too slow, is not green", async () => {
  live_s(1);
  state.ping = { sentMs: clock.ms - 2300, tripMs: 0 };
  assert.deepEqual([shownCondition().level, shownCondition().text], ["warning", "this page is 2.3 s behind"]);
  send({ type: "pong" });
  assert.equal(shownCondition().level, "warning", "the answer was late");
  live_s(4);
  assert.equal(shownCondition().level, "good");
  send({ ...GOOD, level: "bad", text: SLOW.text, reasons: [SLOW] });
  state.ping = { sentMs: clock.ms - 2300, tripMs: 0 };
  assert.deepEqual(shownCondition().reasons.map(({ kind }) => kind), ["slow", "page-behind"]);
  state.ping = { sentMs: null, tripMs: 0 };
  for (let n = 0; n < 2; n++) {
    clock.ms += 1500; // nothing is done for so long
    wait(0.25);
  }
  assert.equal(state.connection.phase, "open", "what came meanwhile has yet to be read");
  send(GOOD);
  assert.match(shownCondition().text, /^this browser is too slow: it was busy for 1\.\d s/);
  live_s(5);
}); // prettier-ignore

test("a lost broker is reported and not green", () => {
  send({ type: "mqtt", connected: false, broker: "mqtt://hall:1883" });
  assert.deepEqual([shownCondition().level, shownCondition().text], ["waiting", "no broker"]);
  assert.equal(byId("banner").hidden, false);
  assert.match(byId("banner-text").textContent, /^The server has lost its broker mqtt:\/\/hall:1883: tags and anchors are not/);
  send({ type: "mqtt", connected: true, broker: "mqtt://hall:1883" });
  assert.deepEqual([shownCondition().level, byId("banner").hidden], ["good", true]);
});

test("a silent connection is lost, and nothing of before counts as current", async () => {
  const { condition } = await load("map/anchors");
  const { summaryFacts } = await load("summary");
  assert.equal(condition(1), "good");
  wait(3.5);
  assert.deepEqual(header().slice(0, 2), ["pill lost", "Disconnected"]);
  assert.equal(byId("condition-line").hidden, true, "the banner says it");
  assert.match(byId("banner-text").textContent, /^Connection lost: no message for 3 s. Nothing shown here is current. Reconnecting.$/);
  assert.equal(condition(1), "unknown");
  const unknown = summaryFacts().filter(([, words]) => words === "–");
  assert.deepEqual(unknown.map(([name]) => name), ["Tags", "σ", "Error", "Rate", "Latency", "Anchors"]);
}); // prettier-ignore

test("a cut connection comes back by itself; of several tries the newest counts", async () => {
  const first = sockets.length;
  asked.length = 0;
  socket().close();
  assert.equal(state.connection.phase, "lost");
  assert.match(shownCondition().reasons[0].text, /^connection lost: the server does not respond$/);
  for (let n = 0; n < 3; n++) liveModule.retryNow();
  assert.deepEqual(sockets.slice(first).map(({ readyState }) => readyState), [3, 3, 1]);
  assert.deepEqual(asked.map((address) => address.split("/").at(-1)), ["live.js"], "why is asked for without reading recordings");
  send(HELLO);
  assert.equal(state.connection.phase, "open");
  socket().close();
  wait(0.5);
  send(HELLO);
  assert.equal(state.connection.phase, "open");
}); // prettier-ignore

test("a page too many says why, and a refused one asks for the token", async () => {
  socket().close(1013, "too many pages are open: 100 of this computer, 100 in all");
  frame();
  assert.match(byId("banner-text").textContent, /too many pages are open/);
  const before = globalThis.fetch;
  globalThis.fetch = async () => ({ status: 403 });
  wait(3);
  socket().close();
  await new Promise(setImmediate);
  frame();
  globalThis.fetch = before;
  assert.match(byId("banner-text").textContent, /the token is missing or wrong: open the address that the dashboard has printed/);
});

test("another site after a reconnect begins without what was of the first", () => {
  send({ type: "floor_plan", digest: "c0ffee" });
  const kept = () => [live.all.size, tagHistory.size, anchorHistory.get(1)?.time.length > 1, Boolean(state.floorDigest)];
  assert.deepEqual(kept(), [2, 2, true, true]);
  send(HELLO);
  assert.deepEqual(kept(), [2, 2, true, true], "the same site");
  send({ ...HELLO, site: null });
  assert.equal(state.site, null);
  const other = { ...HELLO.site, site: { ...HELLO.site.site, name: "Hall 8" } };
  send({ ...HELLO, site: other });
  assert.deepEqual(kept(), [0, 0, false, false]);
  assert.equal(state.site.name, "Hall 8");
});

test("a server that sends a part is asked for the view, the tags that are found and the zone of the filter", () => {
  const wanted = () => (live_s(0.5), JSON.parse(socket().sent.findLast((words) => words !== "ping")));
  send({ type: "assets", assets: [{ tag: "t29", name: "Thing 29", group: "", owner: "" }, { tag: "t3", name: "Thing 3", group: "", owner: "" }] });
  send({ type: "state", unix_s: now_s(), tags: [], left: ["b"], of: 5000, inside: 10 });
  assert.deepEqual([[...live.all.keys()], state.part], [["a"], { of: 5000, inside: 10 }]);
  state.find = "thing 29";
  assert.deepEqual([wanted().find, wanted().tags, wanted().view], ["thing 29", ["t29"], null]);
  state.filter.zone = state.zones[0].id;
  assert.deepEqual(wanted().view, [0, 0, 3.5, 6]);
  Object.assign(state, { find: "", filter: { group: "", zone: "" } });
}); // prettier-ignore

test("news that changes again replaces its last line, and healths that are old are forgotten", () => {
  const event = (serial, more) => {
    const usual = { unix_s: serial, kind: "anchor", level: "bad", name: "anchor/8", text: `n ${serial}` };
    return { serial, ...usual, first: serial, count: 1, ...more };
  };
  send({ type: "log", events: [event(91), event(92)] });
  send({ type: "log", events: [event(92), event(93, { first: 92, count: 2 })] });
  assert.deepEqual(state.log.slice(-2).map(({ serial }) => serial), [91, 93]);
  const health = feed.find(({ type }) => type === "health");
  send({ ...health, ages: { ...health.ages, tags: { a: state.thresholds.forgotten_s + 1, b: 0 } } });
  assert.deepEqual([...state.health.tags.keys()], ["b"]);
}); // prettier-ignore

test("the empty map says which sites are gone", async () => {
  (await load("sites")).start();
  send({ ...HELLO, site: null });
  assert.equal(byId("waiting").textContent, "Waiting for a site …");
  send({ type: "sites", shown: null, sites: [[1, "lab", false]] });
  assert.equal(byId("waiting").textContent, "Site 1, lab, was here; none of its programs is online. Waiting for a site …");
});

test("a part that fails stops no other", () => {
  const ran = [];
  globalThis.reportError = ({ message }) => ran.push(message);
  on(["a test"], () => { throw new Error("wrong"); });
  on(["a test"], () => ran.push("another"));
  changed("a test");
  frame();
  assert.deepEqual(ran, ["wrong", "another"]);
}); // prettier-ignore
