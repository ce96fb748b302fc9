"""The page shows a live site: tags move, a silent or lost connection is reported, and the page reconnects."""

import io
import re
import time

import page_site as made_up
import pytest
from page_browser import THREE_FRAMES, until
from PIL import Image

from skyless.core.alert import Alert

pytestmark = pytest.mark.statistical

SHOWN = "document.getElementById('banner').hidden === false"


def picture(page):
    return page.evaluate("document.getElementById('moving').toDataURL()")


def test_tags_move_where_they_are(hall):
    server, visit = hall
    page = visit.page
    until(page, "skyless.frames.moving > 10")
    before, picture_before = visit.position("forklift"), picture(page)
    now = time.time()
    x, y = visit.position("forklift")
    true_x, true_y, *_ = made_up.truth(0, now - server.started)
    assert (x - true_x) ** 2 + (y - true_y) ** 2 < 1.0  # drawn late, and given errors of up to 0.1 m
    page.wait_for_timeout(700)
    assert visit.position("forklift") != before
    assert picture(page) != picture_before
    assert page.locator("table.tags tbody tr").count() == 3
    assert page.locator("#pill").inner_text() == "Live"


def test_many_tags_are_drawn(serve, visit):
    page = visit(serve(tags=200)).page
    until(page, "skyless.live.sorted.length === 200")
    frames = page.evaluate("skyless.frames.moving")
    until(page, "before => skyless.frames.moving > before + 5", arg=frames)


def test_nothing_is_drawn_while_nothing_changes(serve, visit):
    page = visit(serve(tags=0)).page
    page.wait_for_timeout(500)
    frames = page.evaluate("skyless.frames.moving")
    page.wait_for_timeout(2000)
    assert page.evaluate("skyless.frames.moving") - frames < 12  # health comes once a second


def test_a_site_may_come_later(serve, visit):
    server = serve(site=False, tags=0)
    page = visit(server).page
    assert page.locator("#waiting").is_visible()
    server.send({"type": "site", "site": made_up.site_message(time.time())})
    page.locator("#waiting").wait_for(state="hidden")
    assert page.locator("#site-name").inner_text() == "Hall 7"


def test_a_silent_tag_turns_grey_and_then_leaves_the_map(hall):
    server, visit = hall
    page = visit.page
    page.wait_for_selector("table.tags tr.fresh:has-text('robot')")
    server.silent_tags = {"robot"}
    page.wait_for_selector("table.tags tr.late:has-text('robot')")
    kinds = page.evaluate("""async () => {
      const { freshness, now_s } = await import("/page/clock.js");
      const track = skyless.live.all.get("robot");
      return [2.4, 2.6, 9.9, 10.1].map((age) => freshness(track, track.lastTime + age));
    }""")
    assert kinds == ["fresh", "late", "late", "gone"]
    late, states, kind, asleep = page.evaluate("""async () => {
      const { drawTags, visibleTags } = await import("/page/map/tags.js");
      const { ALERT, COLUMNS, FRESH, GONE, SLEEP } = await import("/page/tracks.js");
      const { freshness } = await import("/page/clock.js");
      const track = skyless.live.all.get("robot");
      const again = (presence) => {
        const row = Array.from({ length: COLUMNS }, (_, column) => track.value(track.count - 1, column));
        skyless.live.add([["robot", ...Object.values({ ...row, ...presence, [ALERT]: null })]]);
      };
      const label = () => {
        const words = [];
        const context = document.createElement("canvas").getContext("2d");
        context.fillText = (text) => words.push(text);
        drawTags(context, visibleTags());
        return words.find((text) => text.includes("robot"));
      };
      again({ [GONE]: 1e3 });
      const [late, states] = [label(), track.count];
      again({ [SLEEP]: 1e3 });
      return [late, track.count - states, freshness(track), label()];
    }""")
    assert re.fullmatch(r"robot · no fix for [\d.]+ s", late)
    assert (states, kind, asleep) == (0, "asleep", "robot · asleep")
    page.click("table.tags button:has-text('robot')")
    page.wait_for_selector("text=No fix: too few anchors")


def test_protection_levels_and_alerts_are_shown(hall):
    _, visit = hall
    page = visit.page
    for name, words in (("forklift", "none"), ("trolley", "faulty anchor excluded")):
        page.click(f"table.tags button:has-text('{name}')")
        page.wait_for_selector(f".detail dd:text-is('{words}')")
    assert page.locator(".detail dd.warn").all_inner_texts() == ["faulty anchor excluded"]
    page.click("table.tags button:has-text('robot')")
    page.wait_for_selector(".detail dd.bad:text-is('fault not excluded: no protection level')")
    names = page.evaluate("async () => Object.keys((await import('/page/tracks.js')).ALERTS)")
    assert names == [*made_up.ALERTS] == [alert.value for alert in Alert]
    circles = page.evaluate("""async () => {
      const { drawTags, visibleTags } = await import("/page/map/tags.js");
      const count = () => {
        let dashed = 0;
        const context = document.createElement("canvas").getContext("2d");
        const dash = context.setLineDash.bind(context);
        context.setLineDash = (list) => ((dashed += list.length > 0), dash(list));
        drawTags(context, visibleTags());
        return dashed;
      };
      const { state } = await import("/page/store.js");
      const shown = count();
      state.options.levels = false;
      return [shown, count()];
    }""")
    assert circles == [3, 0]


def test_a_cut_connection_is_told_and_comes_back(hall):
    server, visit = hall
    page = visit.page
    until(page, "skyless.frames.moving > 3")
    server.cut()
    until(page, SHOWN)
    assert "Connection lost" in page.locator("#banner").inner_text()
    assert page.locator("#pill").inner_text() == "Disconnected"
    sockets = """async () => {
      const { retryNow } = await import("/page/live.js");
      const made = [];
      const Before = window.WebSocket;
      window.WebSocket = class extends Before {
        constructor(address) {
          super(address);
          made.push(this);
        }
      };
      for (let n = 0; n < 3; n++) retryNow();
      window.WebSocket = Before;
      return made.map((one) => one.readyState);
    }"""
    assert [phase >= 2 for phase in page.evaluate(sockets)] == [True, True, False]  # closing, closing, connecting
    server.refuse = False
    page.locator("#banner").wait_for(state="hidden")
    before = visit.position("forklift")
    page.wait_for_timeout(500)
    assert visit.position("forklift") != before
    refused = [text for text in visit.problems if "WebSocket connection" in text]
    assert visit.problems == refused  # the browser's own words for what the server refused
    visit.problems.clear()


def test_a_silent_connection_is_lost(hall):
    server, visit = hall
    page = visit.page
    until(page, "skyless.frames.moving > 3")
    server.mute = True
    until(page, "document.getElementById('banner').innerText.includes('no message for')", timeout_s=8.0)
    server.mute = False
    page.locator("#banner").wait_for(state="hidden")


def test_a_lost_broker_is_reported(hall):
    server, visit = hall
    server.send({"type": "mqtt", "connected": False, "broker": "mqtt://hall:1883"})
    until(visit.page, SHOWN)
    assert "mqtt://hall:1883" in visit.page.locator("#banner").inner_text()
    server.send({"type": "mqtt", "connected": True, "broker": "mqtt://hall:1883"})
    visit.page.locator("#banner").wait_for(state="hidden")


def test_health_and_phases_are_shown(hall):
    page = hall[1].page
    page.click("#tab-anchors")
    page.wait_for_selector("#panel-anchors tr.good:has-text('2 master')")
    assert page.locator("#panel-anchors tr.warn").inner_text().startswith("not synchronised")
    assert "8" in page.locator("#panel-anchors tr.bad").inner_text()
    page.click("#panel-anchors button:has-text('3')")
    page.wait_for_selector("#panel-anchors .detail canvas")
    page.click("#tab-timing")
    page.wait_for_selector("#phases svg")
    assert page.locator("#phases .busy").count() == 3 * made_up.SUPERFRAME
    assert page.locator("#phases .fix").count() == 3 * (made_up.SUPERFRAME - 3)


def test_a_site_with_random_instants_has_no_leader_and_no_superframe(serve, visit):
    page = visit(serve(mode="free", tags=0)).page
    page.click("#tab-anchors")
    page.wait_for_selector("#panel-anchors tr.good")
    assert page.locator("#panel-anchors td:first-child >> nth=0").get_attribute("title") == "on the air"
    assert "master" not in page.locator("#panel-anchors").inner_text()
    page.click("#legend summary")
    assert "anchor on the air" in page.locator(".marks").inner_text()
    assert "master" not in page.locator(".marks").inner_text()
    assert not page.locator("#tab-timing").is_visible()


def test_a_floor_plan_lies_where_the_site_says(serve, visit):
    file = io.BytesIO()
    Image.new("RGB", (480, 300), (200, 30, 30)).save(file, "PNG")
    shown = visit(serve(tags=0, floor_plan=file.getvalue()))
    page = shown.page
    until(page, "import('/page/map/floor.js').then(({ floor }) => floor?.height_m === 15)")
    reddish = """async ([x, y]) => {
      const view = await import("/page/map/view.js");
      const canvas = document.getElementById("still");
      const [r, g, b] = canvas.getContext("2d").getImageData(view.px(x), view.py(y), 1, 1).data;
      return r > 100 && g < 90 && b < 90;
    }"""
    until(page, reddish, [6.37, -0.71])
    assert page.evaluate(reddish, [23.37, 13.71])
    assert not page.evaluate(reddish, [6.37, -1.31])
    shown.problems.clear()  # a hint that pixels are read slowly


def test_another_site_after_a_reconnect_begins_without_what_was_of_the_first(hall):
    server, visit = hall
    page = visit.page
    until(page, "skyless.live.all.get('robot')?.count > 3")
    server.send({"type": "floor_plan", "digest": "c0ffee"})
    until(page, "skyless.state.floorDigest")
    event = {"kind": "enter", "zone": "dock", "tag": "robot", "unix_s": 1.0}
    old = """async () => {
      const { anchorHistory, tagHistory } = await import("/page/history.js");
      const { drawZones } = await import("/page/map/zones.js");
      const flashes = drawZones(document.createElement("canvas").getContext("2d"));
      const kept = [...skyless.live.all.keys(), ...tagHistory.keys()].filter((name) => name === "robot");
      return [kept.length, Boolean(skyless.state.floorDigest), anchorHistory.get(1).time.length > 1, flashes];
    }"""
    page.wait_for_timeout(1100)  # health comes once a second
    assert page.evaluate(old) == [2, True, True, False]
    for name in ("Hall 7", "Hall 8"):
        server.site_name, server.tags, server.zone_events = name, 1, [event]
        restart(server, page)
        until(page, "name => skyless.state.site?.name === name", arg=name)
        until(page, "import('/page/history.js').then(({ anchorHistory }) => anchorHistory.get(1))")
        page.evaluate(THREE_FRAMES)
        kept = page.evaluate(old)
        assert kept[1:] == ([True, True, False] if name == "Hall 7" else [False, False, False])
        assert kept[0] == (1 if name == "Hall 7" else 0)  # the history goes with the health
    server.site = False
    restart(server, page)
    page.locator("#waiting").wait_for()
    assert page.locator("#site-name").inner_text() == ""


def restart(server, page):
    """A server that is back before the page connects again."""
    page.evaluate("skyless.state.site.name = ''")
    server.cut()
    server.refuse = False
    until(page, "skyless.state.connection.phase === 'lost'")
    until(page, "skyless.state.connection.phase === 'open'")


def test_tags_of_another_clock_are_not_fresh_and_long_silent_ones_go(serve, visit):
    server = serve(tags=0)
    page = visit(server).page
    until(page, "/^[0-9:]+$/.test(document.getElementById('time').textContent)")  # without any tag
    found = page.evaluate("""async () => {
      const { COLUMNS, FRESH, GONE, SLEEP, TIME, Track, Tracks } = await import("/page/tracks.js");
      const { freshness } = await import("/page/clock.js");
      const times_s = { [FRESH + 1]: 1, [SLEEP + 1]: 5, [GONE + 1]: 10 };
      const row = (time, name = "a") =>
        Object.assign(Array(COLUMNS + 1).fill(0), { 0: name, [TIME + 1]: time, ...times_s });
      const track = new Track("a");
      const kinds = [freshness(track, 1000, 1000)];
      track.push(row(1000));
      for (const now of [1000.1, 998.5, 994, 985, NaN]) kinds.push(freshness(track, now, now - 0.15));
      const times = [999, 996, 990, 989, 992].map((time) => (track.push(row(time)), track.lastTime));
      const tracks = new Tracks();
      tracks.add([row(100, "old"), row(100, "healthy"), row(800, "new")]);
      tracks.addNames(["named"]);
      tracks.expire(200, new Map([["healthy", {}]]));
      return [kinds, times, track.count, tracks.sorted.map(({ name }) => name)];
    }""")
    assert found == [
        ["never", "fresh", "asleep", "late", "gone", "gone"],
        [1000, 1000, 990, 990, 992],
        2,
        ["healthy", "new"],
    ]
    now = time.time()
    server.send({"type": "state", "unix_s": now, "tags": [made_up.state_row("forklift", 0, 0.0, now - 300)]})
    page.wait_for_selector("table.tags tr.gone:has-text('forklift')", timeout=2000)


def test_the_search_field_counts_only_where_it_is_shown(serve, visit):
    server = serve(tags=13)
    page = visit(server).page
    rows = page.locator("table.tags tbody tr")
    page.fill("#panel-tags input[type=search]", "003")
    until(page, "document.querySelectorAll('table.tags tbody tr').length === 1")
    page.fill("#panel-tags input[type=search]", "nobody")
    page.wait_for_selector("#panel-tags :text-is('No tag is found.')")
    assert rows.count() == 0
    server.tags = 3
    until(page, "skyless.live.all.size === 3 || skyless.live.clear()")  # again, if a message of 13 was on its way
    until(page, "document.querySelectorAll('table.tags tbody tr').length === 3")
    assert page.locator("#panel-tags input[type=search]").is_hidden()
    assert page.locator("#panel-tags .empty").is_hidden()


def test_a_part_that_fails_stops_no_other(hall):
    _, visit = hall
    visit.page.evaluate("""async () => {
      const { changed, on } = await import("/page/store.js");
      on(["a test"], () => { throw new Error("wrong"); });
      on(["a test"], () => (window.othersRan = true));
      changed("a test");
    }""")
    until(visit.page, "window.othersRan")
    assert visit.problems == ["wrong"]
    visit.problems.clear()


def test_why_a_connection_is_refused_is_asked_for_without_reading_recordings(hall):
    server, visit = hall
    asked = []
    visit.page.on("request", lambda request: asked.append(request.url))
    restart(server, visit.page)
    assert [url.rsplit("/", 1)[1] for url in asked if not url.startswith("ws")] == ["live.js"]
