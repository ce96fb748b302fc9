/** The map: view, room, zones, floors, marks, names, and what its layers draw of the site of the feed. */

import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { Drawing, clock, drawn, feed, known, load, screen } from "./browser.mjs";

const { state, siteOf } = await load("store");
const { live, now_s, resetOffset, updateOffset } = await load("clock");
const tracks = await load("tracks");
const view = await load("map/view");
const { drawAnchors } = await load("map/anchors");
const { drawTags, floorByZone, heightWords, visibleTags } = await load("map/tags");
const { otherFloor, floors, giveHeights, groundHeight } = await load("map/floors");
const { drawZones, inside } = await load("map/zones");
const { closedWalls, nameRoom, roomOutline } = await load("map/room");
const names = await load("map/names");

const HELLO = feed[0];
const ROWS = feed.findLast(({ type }) => type === "state");
const near = (one, other, within = 1e-9) => one.forEach((value, n) => assert.ok(Math.abs(value - other[n]) < within, `${one} is not ${other}`));
const corners = (outline) => new Set(outline.map(String));
/** Anchors on a grid of 24 m × 14 m, with changes by their numbers. */
const ANCHORS = [1, 8.5, 15.5, 23].flatMap((x_m, n) => [1, 13].map((y_m, up) => ({ id: 1 + n + 4 * up, x_m, y_m, z_m: 2.8 })));
const WALLS = [[0, 0, 24, 0], [24, 0, 24, 14], [24, 14, 0, 14], [0, 14, 0, 0], [12, 0, 12, 5], [12, 9, 12, 14]]; // prettier-ignore
const walls = (given) => given.map(([x1_m, y1_m, x2_m, y2_m]) => ({ x1_m, y1_m, x2_m, y2_m }));

function show(changes = {}, beside = {}) {
  state.site = siteOf({ ...HELLO.site, ...beside, site: { ...HELLO.site.site, name: "Hall", anchors: ANCHORS, walls: walls(WALLS), ...changes } });
}

beforeEach(() => {
  Object.assign(state, { mode: "live", zones: [], alarms: [], simulated: true, connection: { phase: "open" } });
  Object.assign(state.options, { floor: null, levels: true });
  Object.assign(view.view, { width: 800, height: 600 });
  state.selection = { tag: null, anchor: null, zone: null };
  view.setSpatial(false);
  show();
  view.fit(state.site, [], [], false);
  live.clear();
  resetOffset();
  updateOffset(ROWS.unix_s);
  clock.ms += 200; // positions are drawn with a delay
  live.add(ROWS.tags);
  names.still.length = 0;
});

test("pixels and places are each other's inverse, in every direction of the 3-D view", () => {
  view.setSpatial(true);
  for (let n = 0; n < 40; n++) {
    view.orbit(0.3, Math.sin(n));
    near(view.toSite(view.toX(3, 4), view.toY(3, 4, n / 10), n / 10), [3, 4]);
  }
  assert.ok(view.toY(5, 5, 0) - view.toY(5, 5, 3) > 10, "heights are seen");
  view.setSpatial(false);
  assert.equal(view.toY(5, 5, 0), view.toY(5, 5, 3));
});

test("ellipses have the axes of the covariance, and are seen in 3-D as the projection of their points", () => {
  const sigmas = Math.sqrt(-2 * Math.log(0.05));
  for (let n = 1; n <= 20; n++) {
    const [a, b, c, d] = [1, 2, 3, 4].map((k) => 2 * Math.sin(9 * n * k));
    const [xx, xy, yy] = [a * a + b * b, a * c + b * d, c * c + d * d];
    const [major, minor, angle] = view.halfAxes(xx, xy, yy);
    const [long, short, cos, sin] = [(major / sigmas) ** 2, (minor / sigmas) ** 2, Math.cos(angle), Math.sin(angle)];
    const again = [long * cos * cos + short * sin * sin, (long - short) * cos * sin, long * sin * sin + short * cos * cos];
    near(again, [xx, xy, yy], 1e-4 * (xx + yy) + 1e-4);
  }
  view.setSpatial(true);
  view.orbit(0.7, 0.2);
  const [ax, bx] = [[1, 0], [0, 1]].map(([x, y]) => (view.toX(x, y) - view.toX(0, 0)) / view.view.scale);
  const [ay, by] = [[1, 0], [0, 1]].map(([x, y]) => (view.toY(0, 0) - view.toY(x, y)) / view.view.scale);
  const projected = (px, py, qx, qy) => 2 * px * qx + 0.5 * (px * qy + py * qx) + py * qy;
  near(view.seenCovariance(2, 0.5, 1), [projected(ax, bx, ax, bx), projected(ax, bx, ay, by), projected(ay, by, ay, by)]);
}); // prettier-ignore

test("a site is fitted whole, however wide", () => {
  for (const wide_m of [24, 900, 12_000]) {
    show({ walls: [], anchors: ANCHORS.map((one) => ({ ...one, x_m: (one.x_m * wide_m) / 24 })) });
    view.fit(state.site, [], []);
    for (const { x_m, y_m } of state.site.anchors) assert.ok(view.isSeen(view.toX(x_m, y_m), view.toY(x_m, y_m), 0));
  }
});

test("the room is the site's outline, else walls that close, else the area of the anchors, and is named as that", () => {
  const named = () => drawn((context) => nameRoom(context, [])).words;
  assert.equal(roomOutline().kind, "room");
  assert.deepEqual(corners(roomOutline().corners), corners([[0, 0], [24, 0], [24, 14], [0, 14]]));
  show({ walls: [] });
  assert.equal(roomOutline().name, "area of the anchors");
  assert.deepEqual(corners(roomOutline().corners), corners([[1, 1], [23, 1], [23, 13], [1, 13]]));
  assert.deepEqual(named(), ["area of the anchors, 22.0 m × 12.0 m"]);
  const outline_m = [[-3, 0], [27, 0], [27, 9], [12, 14], [-3, 14]];
  show({ walls: [] }, { outline_m });
  assert.deepEqual([roomOutline().kind, roomOutline().corners], ["room", outline_m]);
  names.still.length = 0;
  assert.deepEqual(named(), ["room, 30.0 m × 14.0 m"]);
  view.fit(state.site, [], []);
  assert.ok(Math.min(view.toX(-3, 0), view.view.width - view.toX(27, 0)) > 0);
  assert.equal(roomOutline([[0, 0], [4, 3]]).kind, "room");
  show({ walls: [] });
  assert.equal(roomOutline([[0, 0], [4, 3]]).name, "floor plan");
}); // prettier-ignore

test("the outer edge of walls", () => {
  for (const [given, expected] of [
    [[[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0], [2, 0, 2, 3]], [[0, 0], [4, 0], [4, 3], [0, 3]]],
    [[[0, 0, 6, 0], [6, 0, 6, 2], [6, 2, 2, 2], [2, 2, 2, 5], [2, 5, 0, 5], [0, 5, 0, 0]], [[0, 0], [6, 0], [6, 2], [2, 2], [2, 5], [0, 5]]],
    [
      [[0, 0, 4, 0], [4, 0, 4, 4], [4, 4, 0, 4], [0, 4, 0, 0], [4, 0, 8, 0], [8, 0, 8, 4], [8, 4, 4, 4]],
      [[0, 0], [4, 0], [8, 0], [8, 4], [4, 4], [0, 4]],
    ],
    [[[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3]], null],
  ]) {
    const found = closedWalls(walls(given));
    assert.deepEqual(found && corners(found), expected && corners(expected));
  }
}); // prettier-ignore

test("on a phone the size of the room is not covered by the scale", async () => {
  const { scaleBox } = await load("map/floor");
  Object.assign(view.view, { width: 390, height: 380 });
  show({ walls: [] });
  view.fit(state.site, [], []);
  const { left, top, height } = scaleBox();
  let count = 0;
  for (let y = top - 60; y < top + height; y += 2) {
    view.pan(0, y - view.toY(1, 1));
    names.still.length = 0;
    for (const { args: [words, x, at] } of drawn((context) => nameRoom(context, [])).of("fillText")) {
      count += 1;
      assert.ok(x + 3 * words.length <= left || at + 5 <= top || at - 6 >= top + height);
    }
  }
  assert.ok(count > 20);
}); // prettier-ignore

test("a polygon holds the points around which it winds", () => {
  const polygon = [[0, 0], [6, 0], [6, 5], [3, 2], [0, 5]]; // prettier-ignore
  const winds = (x, y) => {
    const angles = polygon.map(([px, py]) => Math.atan2(py - y, px - x));
    const turns = angles.map((angle, n) => angles[(n + 1) % angles.length] - angle);
    return Math.abs(turns.reduce((sum, turn) => sum + turn - 2 * Math.PI * Math.round(turn / (2 * Math.PI)), 0)) > 3;
  };
  for (let n = 1; n <= 300; n++) {
    const [x, y] = [(n * 8 * 0.618) % 8, (n * 8 * 0.414) % 8].map((part) => part - 1);
    assert.equal(inside(polygon, x, y), winds(x, y), `${x}, ${y}`);
  }
});

test("the outline of a noisy walk holds it, has few corners and little more area; why there is none", async () => {
  const { outlineOf } = await load("map/outline");
  for (const [radius_m, most] of [[4, 40], [400, 100]]) {
    const noise = (n) => 0.25 * ((n * 0.618) % 1) * Math.sin(97 * n);
    const axis = (n, k) => radius_m * [Math.cos, Math.sin][k]((2 * Math.PI * n) / 2999) + noise(n + 5 * k);
    const walked = Array.from({ length: 3000 }, (_, n) => [axis(n, 0), axis(n, 1)]);
    const found = outlineOf(walked, 0.3);
    assert.ok(found.length <= most);
    const left = ([x1, y1], [x2, y2], [x, y]) => ((x2 - x1) * (y - y1) - (y2 - y1) * (x - x1)) / Math.hypot(x2 - x1, y2 - y1);
    const edges = found.map((corner, n) => [corner, found[(n + 1) % found.length]]);
    for (const point of walked) for (const edge of edges) assert.ok(left(...edge, point) > 0.2);
    const area_m2 = edges.reduce((sum, [[x1, y1], [x2, y2]]) => sum + (x1 * y2 - x2 * y1) / 2, 0);
    const bare_m2 = Math.PI * (radius_m + 0.25) ** 2;
    assert.ok(area_m2 < (bare_m2 + 0.3 * 2 * Math.PI * (radius_m + 0.25) + Math.PI * 0.09) * 1.01);
  }
  const nowhere = { message: "The walk spans 0.00 m²; an outline needs 0.25 m²: walk around the place." };
  assert.throws(() => outlineOf(Array(20).fill([1, 2]), 0.3), nowhere);
  assert.throws(() => outlineOf([], 0.3), { message: "The tag had 0 good positions; an outline needs 10." });
}); // prettier-ignore

/** A colour in OKLab, for an eye that lacks some cones. */
function oklab(colour, eye = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]) {
  const times = (matrix, vector) => matrix.map((line) => line.reduce((sum, value, n) => sum + value * vector[n], 0));
  const linear = colour.match(/\d+/g).map((part) => (part <= 10 ? part / 255 / 12.92 : ((part / 255 + 0.055) / 1.055) ** 2.4));
  const cones = [[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.63]];
  const mix = [[0.2105, 0.7936, -0.0041], [1.978, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]];
  return times(mix, times(cones, times(eye, linear).map((part) => Math.max(part, 0))).map(Math.cbrt));
} // prettier-ignore
/** How readers without one kind of cones see linear red, green and blue (Machado and others, 2009), besides all others. */
const EYES = [
  undefined,
  [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
  [[0.367, 0.861, -0.228], [0.28, 0.673, 0.047], [-0.012, 0.043, 0.969]],
]; // prettier-ignore

test("tags never share colour and mark, also for colour-blind readers, and keep their hue in both themes", async () => {
  const { tagStyle } = await load("map/marks");
  const theme = await load("theme");
  const hues = [];
  for (screen.dark of [false, true]) {
    theme.start();
    const styles = Array.from({ length: 56 }, (_, n) => tagStyle(n, 56));
    assert.equal(new Set(styles.map(({ colour, shape }) => colour + shape)).size, 56);
    styles.slice(0, 24).forEach((one, n) => {
      for (const other of styles.slice(0, n).filter(({ shape }) => shape === one.shape)) {
        for (const eye of EYES) {
          const [a, b] = [one, other].map(({ colour }) => oklab(colour, eye));
          assert.ok(Math.hypot(...a.map((value, k) => value - b[k])) > 0.1, `${one.colour} and ${other.colour}`);
        }
      }
    });
    const { tags, groups } = theme.palette;
    assert.deepEqual([new Set(tags).size, new Set(groups).size], [8, 24]);
    hues.push([...tags, ...groups].map((colour) => oklab(colour).slice(1)));
  }
  hues[0].forEach(([a, b], n) => {
    const [c, d] = hues[1][n];
    assert.ok(Math.min(Math.hypot(a, b), Math.hypot(c, d)) > 0.08, "not almost grey");
    assert.ok(Math.abs(Math.atan2(a * d - b * c, a * c + b * d)) < (3 * Math.PI) / 180);
  });
  screen.dark = false;
  theme.start();
});

test("names that stand still are moved or left out, and tags' names keep clear of each other and of marks", () => {
  names.still.push([90, 90, 110, 110]);
  const written = drawn((context) => ["one", "two", "none"].forEach((words) => names.labelIfFree(context, words, 100, [100, 120, 140])));
  assert.deepEqual(written.of("fillText").map(({ args }) => [args[0], args[2]]), [["one", 120], ["two", 140]]);
  const at = [[200, 200], [205, 203], [210, 198], [230, 205], [300, 300], [130, 98]];
  const wanted = at.map(([x, y], n) => ({ key: `t${n}`, words: `tag-00${n}`, x, y, colour: "black" }));
  const mark = [100, 100, 160, 160];
  const boxes = [mark, ...names.drawNames(new Drawing(), wanted, [mark])];
  assert.ok(boxes.length > 5);
  boxes.forEach((one, n) => boxes.slice(0, n).forEach((other) => {
    assert.ok(one[2] <= other[0] || other[2] <= one[0] || one[3] <= other[1] || other[3] <= one[1]);
  }));
}); // prettier-ignore

test("a tag is named with what it does not say: no fix, asleep, and its height in 3-D", () => {
  const { COLUMNS, FRESH, GONE, HEIGHT_GIVEN, SLEEP, Z } = tracks;
  const tag = (changes = {}) => {
    const row = [...ROWS.tags[0]];
    for (const [column, value] of Object.entries(changes)) row[Number(column) + 1] = value;
    live.clear();
    live.add([row]);
    return drawn((context) => drawTags(context, visibleTags())).words;
  };
  assert.deepEqual(tag(), ["a"]);
  clock.ms += 4000;
  assert.deepEqual(tag(), ["a · no fix for 4.2 s"]);
  assert.deepEqual(tag({ [SLEEP]: 1e3 }), ["a · asleep"]);
  assert.deepEqual(tag({ [GONE]: 3, [FRESH]: 1 }), []);
  const row = new Float64Array(COLUMNS);
  row[Z] = 1.2;
  state.site.tags = { height_m: 1.2 };
  assert.equal(heightWords(row, true), " · z 1.20 m");
  row[HEIGHT_GIVEN] = 1;
  assert.deepEqual([heightWords(row, true), heightWords(row, false)], [" · height 1.2 m given", ""]);
});

test("protection levels are dashed circles until they are switched off", () => {
  const circles = () => drawn((context) => drawTags(context, visibleTags())).of("setLineDash").filter(({ args }) => args[0].length).length;
  assert.equal(circles(), 2);
  state.options.levels = false;
  assert.equal(circles(), 0);
}); // prettier-ignore

test("with less motion positions are not interpolated", () => {
  const before = feed.filter(({ type }) => type === "state").at(-2);
  live.clear();
  live.add(before.tags);
  live.add(ROWS.tags);
  clock.ms -= 100; // the moment that is shown otherwise is between both
  const newest = () => visibleTags().seen.every(({ track, row }) => row[0] === track.value(track.count - 1, 0));
  assert.equal(newest(), false);
  screen.still = true;
  assert.equal(newest(), true);
  screen.still = false;
});

const twoFloors = () => ANCHORS.map((one) => ({ ...one, floor: Number(one.id > 4), z_m: one.id > 4 ? 6 : 2.8 }));

test("tags and anchors of other floors are dimmed; floors come from anchors, the site's file or given heights", () => {
  const dimmed = () => new Set(visibleTags().seen.map(({ other }) => other));
  show({ anchors: twoFloors() });
  assert.deepEqual(floors().map(({ name }) => name), ["floor 0", "floor 1"]);
  for (const [floor, expected] of [[null, false], [1, true], [0, false]]) {
    state.options.floor = floor;
    assert.deepEqual(dimmed(), new Set([expected]));
  }
  const other = otherFloor();
  assert.deepEqual([other(2.8, 0), other(6, 1), other(3.5)], [false, true, true]);
  show({ anchors: twoFloors() }, { floors: [{ number: 0, low_m: 0, name: "Ground" }, { number: 1, low_m: 3, name: "" }] });
  assert.deepEqual(floors().map(({ name }) => name), ["Ground", "floor 1"]);
  state.options.floor = 1;
  assert.equal(groundHeight(), 3);
  const all = { id: "all", name: "Everywhere", polygon_m: [[-99, -99], [99, -99], [99, 99], [-99, 99]], floor: 1 };
  state.zones = [all];
  const row = new Float64Array(tracks.COLUMNS);
  assert.equal(floorByZone(row), undefined, "its height says it");
  row[tracks.HEIGHT_GIVEN] = 1;
  assert.equal(floorByZone(row), 1, "a tag whose height is given is on the floor of its zone");
  assert.equal(drawn(drawZones).of("stroke").length, 1);
  state.options.floor = 0;
  assert.equal(drawn(drawZones).of("stroke").length, 0);
  show();
  giveHeights("0; 3.2 6.5");
  assert.deepEqual(floors().map(({ name }) => name), ["floor 0 (from 0 m)", "floor 1 (from 3.2 m)", "floor 2 (from 6.5 m)"]);
  assert.throws(() => giveHeights("ground"), { message: "ground is no list of heights such as 0, 3.2" });
}); // prettier-ignore

test("the map calls the master so at Skyless's own sites only, and FiRa's anchors by their MAC addresses", () => {
  const words = (system) => (show({ master: 1 }, { system }), new Set(drawn(drawAnchors).words));
  assert.deepEqual([words(undefined).has("1 master"), words("tdoa").has("1"), words("dl-tdoa").has("0001")], [true, true, true]);
});

test("anchors above each other have one line of names, or that of the chosen floor", () => {
  const lower = twoFloors().slice(0, 8).filter(({ floor }) => !floor);
  show({ master: null, anchors: [...lower, ...lower.map((one) => ({ ...one, id: one.id + 4, floor: 1, z_m: 6 }))] });
  const lines = () => new Set(drawn(drawAnchors).words);
  assert.deepEqual(lines(), new Set(lower.map(({ id }) => `${id}, ${id + 4}`)));
  state.options.floor = 1;
  assert.deepEqual(lines(), new Set(lower.map(({ id }) => String(id + 4))));
}); // prettier-ignore

test("active alarms are marked at their anchors, zones and tags, or where a tag was last", async () => {
  const { drawAlarms } = await load("map/alarms");
  const zone = { id: "dock", name: "Dock", polygon_m: [[14, 2.5], [21, 2.5], [21, 6], [14, 6]] };
  state.zones = [zone];
  const usual = { severity: "warning", unix_s: 1, ended_unix_s: null, position_m: null };
  const alarm = (kind, subject, more) => ({ id: subject, kind, subject, ...usual, ...more });
  state.alarms = [
    alarm("anchor-moved", "anchor-8"), alarm("crowded", "zone-dock"), alarm("silent", "gone", { position_m: [3, 5, 1] }),
    alarm("near", "a~gone"), alarm("battery", "b", { ended_unix_s: 2 }),
  ];
  drawAnchors(new Drawing());
  drawTags(new Drawing(), visibleTags());
  const marks = (still) => {
    const rings = drawn((context) => drawAlarms(context, still)).of("arc").filter(({ args }) => args[2] > 10);
    return rings.map(({ args: [x, y] }) => view.toSite(x, y));
  };
  const [anchor, dock] = marks(true);
  near(anchor, [23, 13]);
  assert.ok(Math.abs(dock[0] - 17.5) < 1e-9 && dock[1] > 4.25);
  const [gone, a] = marks(false);
  near(gone, [3, 5]);
  near(a, [3, 4], 0.1);
}); // prettier-ignore

test("what the watch finds stands at its anchors and in their lists", async () => {
  const { drawFindings } = await load("map/findings");
  const { findingWords } = await load("survey/watch");
  const moved = { kind: "moved", anchors: [4], size_m: 0.11, std_m: 0.01, since_unix_s: 1.78e9, sentence: "anchor 4 has moved by about 11 cm" };
  const link = { ...moved, kind: "link", anchors: [1, 5], sentence: "The link 1–5 is blocked, by about 35 cm." };
  const check = { ...moved, kind: "check", anchors: [6, 7] };
  state.watch = { findings: [moved, link, check] };
  assert.deepEqual(drawn(drawFindings).words, ["moved 11 cm", "link blocked", "check"]);
  assert.match(findingWords(moved), /^Anchor 4 has moved by about 11 cm, since \d\d:\d\d\.$/);
  assert.match(findingWords(link), /^The link 1–5 is blocked, by about 35 cm, since \d\d:\d\d\.$/);
  state.watch = { findings: [] };
  assert.deepEqual(drawn(drawFindings).words, []);
}); // prettier-ignore

test("values are coloured as the planner does", async () => {
  const { fractionOf } = await load("map/overlay");
  const { colourAt } = await load("pictures");
  for (const [value, ...colour] of known.colours) near(colourAt(fractionOf(value, known.scale), known.scale), colour, 1e-6);
});

test("positions are saved as a table", async () => {
  const { positionsCsv } = await load("map/export");
  const [head, ...lines] = positionsCsv(live.sorted, now_s()).trim().split("\r\n").map((line) => line.split(","));
  assert.deepEqual(head, ["time", "tag", "x_m", "y_m", "z_m", "sigma_m", "level_m", "alert", "height_given"]);
  const [tag, x, y, z] = ROWS.tags[0];
  assert.deepEqual(lines[0].slice(1, 5), [tag, ...[x, y, z].map((value) => value.toFixed(4))]);
  assert.deepEqual([lines[0][0], lines[0].slice(7)], [new Date(Math.round(1e3 * ROWS.tags[0][15])).toISOString(), ["none", "yes"]]);
  const quoted = new tracks.Track('a "b", c');
  quoted.push(Array(tracks.COLUMNS + 1).fill(1.5));
  assert.match(positionsCsv([quoted], 10).split("\r\n")[1], /Z,"a ""b"", c",1\.5000,/);
}); // prettier-ignore
