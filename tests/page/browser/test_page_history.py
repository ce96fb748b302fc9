"""The tab History: ways, heat maps, tables and charts of the past, and that the past never looks like the present."""

import csv
import json
from datetime import UTC, datetime
from pathlib import Path

import page_history as made_up
import pytest
from page_browser import THREE_FRAMES, until
from page_server import DOCK

pytestmark = pytest.mark.statistical

axe = pytest.importorskip("axe_playwright_python.base")

RUN_AXE = """async () => (await axe.run(document, { resultTypes: ["violations"] })).violations
  .filter(({ impact }) => impact === "serious" || impact === "critical")
  .map(({ id, nodes }) => [id, ...nodes.map((node) => node.target.join(" "))])"""
AISLE = {"id": "aisle", "name": "Aisle", "polygon_m": [[2, 4], [11, 4], [11, 10], [2, 10]], "colour": None}


@pytest.fixture
def kept(serve, visit):
    """A server with a history, and a visit in Berlin whose tab History is open."""
    server = serve(zones=(DOCK, AISLE))
    server.history = True
    shown = visit(server, timezone_id="Europe/Berlin", reduced_motion="reduce")
    shown.page.click("#tab-history")
    shown.page.wait_for_selector("#history-tags option", state="attached")
    return server, shown


def ask(page, kind, tag=""):
    page.fill("#history-tag", tag)
    page.click(f"#history-{kind}")
    page.wait_for_selector("#history-result > *")


def saved(page):
    with page.expect_download() as found:
        page.click(".save-csv")
    return found.value.suggested_filename, list(csv.reader(Path(found.value.path()).read_text().splitlines()))


def pixels(page, layer):
    """How many pixels of a layer of the map are drawn in a colour, not in grey."""
    page.evaluate(THREE_FRAMES)
    return page.evaluate(
        """(id) => {
          const { width, height } = document.getElementById(id);
          const context = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
          context.drawImage(document.getElementById(id), 0, 0);
          const { data } = context.getImageData(0, 0, width, height);
          let count = 0;
          for (let at = 0; at < data.length; at += 4) {
            const [low, high] = [Math.min(...data.slice(at, at + 3)), Math.max(...data.slice(at, at + 3))];
            if (data[at + 3] > 200 && high - low > 60) count++;
          }
          return count;
        }""",
        layer,
    )


def place(page, unix_s):
    """Where the marker is at a moment."""
    page.evaluate(
        "at => import('/page/player.js').then(({ seek }) => seek(at - skyless.state.past.start_unix_s))", unix_s
    )
    page.evaluate(THREE_FRAMES)
    return page.evaluate("import('/page/map/past.js').then(({ placeNow }) => placeNow(skyless.state.past)?.place)")


def test_the_way_of_a_tag_is_shown_and_played(kept):
    server, shown = kept
    page = shown.page
    before = pixels(page, "still")
    ask(page, "way", "trolley")
    page.fill("#history-tag", "forklift")
    page.keyboard.press("Enter")
    past = "skyless.state.past"
    until(page, f"{past}?.track.tag === 'forklift'")
    query = server.history_asked[-1][1]
    assert float(query["to"]) - float(query["from"]) == pytest.approx(3600, abs=60)
    assert query["site"] == "7"

    # Nothing looks like the present.
    assert pixels(page, "still") > before + 500
    assert page.locator("#past-mark").inner_text().startswith("Past · forklift · 20")
    assert page.locator("#pill").inner_text() != "Live"  # but Past, or a warning that the browser is busy
    assert page.evaluate("getComputedStyle(document.getElementById('moving')).opacity") == "0.2"
    assert "Times of Europe/Berlin" in page.locator("#history-form").inner_text()

    # The marker is between the two positions around the moment; a pause has no position.
    points = page.evaluate(f"{past}.track.points")
    index = next(n for n in range(20, len(points)) if points[n + 1][0] - points[n][0] < 5)
    (begin, *one), (end, *two) = points[index][:4], points[index + 1][:4]
    middle = [(a + b) / 2 for a, b in zip(one, two, strict=True)]
    assert place(page, (begin + end) / 2) == pytest.approx(middle, abs=1e-6)
    assert pixels(page, "moment") > 50
    pause = begin - begin % made_up.PERIOD_S + made_up.PERIOD_S + made_up.PAUSE_S / 2
    assert place(page, pause) is None
    assert pixels(page, "moment") == 0
    assert page.locator("#play-about").inner_text() == "no position then"
    assert page.evaluate(f"{past}.fixes.length") in {6, 7}

    # Played from within a pause, it goes on where there are positions; the keys are those of recordings.
    page.select_option("#speed", "60")
    page.focus("#slider")
    page.keyboard.press(">")
    page.keyboard.press("k")
    until(page, f"at => {past}.start_unix_s + {past}.at_s > at + {made_up.PAUSE_S / 2}", arg=pause)
    assert page.evaluate(f"{past}.speed") == 300
    page.keyboard.press("k")
    page.keyboard.press("5")
    page.keyboard.press("j")
    assert page.evaluate(f"{past}.at_s / {past}.duration_s") == pytest.approx(0.49)
    page.keyboard.press("End")
    until(page, f"{past}.at_s > {past}.duration_s - 1.5 && !{past}.playing")
    page.select_option("#past-colours", "speed")
    until(page, "document.querySelector('#player .ticks').textContent.endsWith('m/s')")

    name, rows = saved(page)
    assert name == "way-forklift.csv"
    assert rows[0] == ["time", "x_m", "y_m", "z_m", "std_m", "hpl_m", "alert"]
    assert len(rows) == len(points) + 1
    first = datetime.fromisoformat(rows[1][0])
    assert first.astimezone(UTC).timestamp() == pytest.approx(points[0][0], abs=1e-3)
    assert [float(value) for value in rows[1][1:4]] == points[0][1:4]

    page.click("#back")
    page.locator("#past-mark").wait_for(state="hidden")
    assert page.locator("#pill").inner_text() != "Past"
    assert abs(pixels(page, "still") - before) < 100
    assert shown.position("forklift") is not None


def test_heat_map_zones_and_contacts(kept):
    server, shown = kept
    page = shown.page
    page.evaluate(axe.AXE_SCRIPT)
    before = pixels(page, "still")
    ask(page, "heat")
    assert pixels(page, "still") > before + 500
    assert "Time in a cell" in page.locator("#past-scale").inner_text()
    units = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}
    texts = [text.split() for text in page.locator("#player .ticks span").all_inner_texts()]
    ticks = [sum(float(n) * units[unit] for n, unit in zip(text[::2], text[1::2], strict=True)) for text in texts]
    times = page.evaluate("skyless.state.past.map.seconds.filter((value) => value > 0)")
    assert min(times) / 10 <= ticks[0] < ticks[1] < ticks[2] <= max(times)
    cells = page.evaluate("skyless.state.past.map")
    most = max(range(len(cells["seconds"])), key=lambda n: cells["seconds"][n])
    x = cells["x0_m"] + (most % cells["columns"] + 0.5) * cells["cell_m"]
    y = cells["y0_m"] + (most // cells["columns"] + 0.5) * cells["cell_m"]
    page.mouse.move(*shown.at(x, y))
    seconds = cells["seconds"][most]
    words = f"{int(seconds // 60)} min {int(seconds % 60)} s" if seconds >= 60 else f"{seconds:.1f} s"
    until(page, "words => document.getElementById('readout').textContent.endsWith(words)", arg=f"· {words}")
    assert sum(float(row[3]) for row in saved(page)[1][1:]) == pytest.approx(sum(cells["seconds"]))
    for theme in ("light", "dark"):
        page.emulate_media(color_scheme=theme)
        page.evaluate(THREE_FRAMES)
        assert page.evaluate(RUN_AXE) == [], theme

    ask(page, "dwell")
    assert page.evaluate("skyless.state.past") is None, "an answer without a map shows the present"
    kind, query = server.history_asked[-1]
    expected = made_up.answer(kind, query)[0]["dwell"]

    def column(number):
        return page.locator(f"#history-result tbody tr > :nth-child({number})").all_inner_texts()

    def by(key, descending):
        return [str(row[key]) for row in sorted(expected, key=lambda row: row[key], reverse=descending)]

    assert column(1) == by_time(expected)
    page.click("#history-result th >> text=Visits")
    assert column(3) == by("visits", descending=True)
    page.click("#history-result th >> text=Visits")
    assert column(3) == by("visits", descending=False)
    assert page.locator("th[aria-sort=ascending]").inner_text().startswith("Visits")
    assert page.locator("tfoot td >> nth=2").inner_text() == str(sum(row["visits"] for row in expected))
    ask(page, "dwell", "trolley")
    assert set(column(2)) == {"trolley"}

    ask(page, "contacts", "forklift")
    moment = page.locator("#history-result tbody button >> nth=2")
    begun = moment.inner_text()
    moment.click()
    until(page, "skyless.state.past?.track.tag === 'forklift'")
    page.locator(f"#past-mark:has-text('{begun}')").wait_for()
    assert page.locator("#history-result tbody button").count(), "the contacts are still listed"

    for theme in ("light", "dark"):
        page.emulate_media(color_scheme=theme)
        page.evaluate(THREE_FRAMES)
        assert page.evaluate(RUN_AXE) == [], theme


def by_time(rows):
    return [row["zone_name"] for row in sorted(rows, key=lambda row: row["seconds"], reverse=True)]


def test_answers_that_come_late_and_faults(kept):
    server, shown = kept
    page = shown.page
    page.click("#history-way")
    page.wait_for_selector("#history-fault:has-text('Choose a tag')")
    page.fill("#history-tag", "nobody")
    page.keyboard.press("Enter")
    page.wait_for_selector("#history-fault:has-text('The history has no tag nobody.')")

    # Progress, and Cancel.
    server.history_waits = {"track"}
    page.fill("#history-tag", "forklift")
    page.keyboard.press("Enter")
    page.click("#history-state >> text=Cancel")
    until(page, "document.getElementById('history-state').textContent === ''")

    # The answer for the first tag comes after that for the second one, though the page has ended its question.
    page.evaluate("""() => {
      const ask = window.fetch;
      window.late = [];
      window.fetch = async (address, options) => {
        if (!String(address).includes("tag=forklift")) return ask(address, options);
        const answer = await ask(address, { ...options, signal: undefined });
        await new Promise((done) => window.late.push(done));
        return answer;
      };
    }""")
    server.history_waits = set()
    page.click("#history-way")
    until(page, "window.late.length === 1")
    ask(page, "way", "trolley")
    page.evaluate("window.late[0]()")
    page.evaluate(THREE_FRAMES)
    page.evaluate(THREE_FRAMES)
    assert page.evaluate("skyless.state.past.track.tag") == "trolley"
    assert "trolley" in page.locator("#history-result").inner_text()

    # An error of the server, in its words; and a range without anything.
    server.history_error = "from is 14:00; it should be before to"
    page.click("#history-heat")
    page.wait_for_selector("#history-fault:has-text('from is 14:00; it should be before to')")
    assert page.evaluate("skyless.state.past") is None
    server.history_error = None
    page.fill("#history-to", "2020-01-01T00:00")
    page.press("#history-to", "Enter")
    page.wait_for_selector("#history-fault:has-text('The range ends before it begins.')")
    page.evaluate("""() => {
      const ask = window.fetch;
      window.fetch = (address, options) => String(address).includes("history/dwell")
        ? Promise.resolve(new Response('{"dwell": []}')) : ask(address, options);
    }""")
    page.select_option("#history-range", "yesterday")
    page.click("#history-dwell")
    page.wait_for_selector("#history-result:has-text('No zone was entered, or there are no positions, of')")

    # A recording, and another site, end the past.
    ask(page, "way", "trolley")
    page.click("#tab-recordings")
    page.click(".recording")
    until(page, "skyless.state.mode === 'replay'")
    until(page, "skyless.state.past === null")
    page.click("#tab-history")
    page.wait_for_selector("#panel-history:has-text('A recording is shown')")
    page.click("#panel-history >> text=Back to live")
    ask(page, "way", "trolley")
    message = json.loads(json.dumps(server._hello()["site"]))
    message["site"]["id"] = 8
    server.send({"type": "site", "site": message})
    until(page, "skyless.state.past === null && !document.querySelector('#history-result').children.length")
    shown.problems[:] = [text for text in shown.problems if "422" not in text]


def test_without_a_history(serve, visit):
    page = visit(serve()).page
    page.click("#tab-history")
    page.wait_for_selector("#panel-history:has-text('skyless dashboard --history FOLDER')")
    assert page.locator("#history-form").is_hidden()
