"""A person asks the history: ways, heat maps, tables of the past, and the past never looks like the present."""

import csv
from datetime import UTC, datetime

import page_site as made_up
import pytest

pytestmark = pytest.mark.statistical

PAST = "skyless.state.past"


class History:
    """A page in Berlin whose tab History is open."""

    def __init__(self, server, visit):
        self.server, self.visit, self.page, self.until = server, visit, visit.page, visit.until
        self.page.click("#tab-history")
        self.page.wait_for_selector("#history-tags option", state="attached")

    def ask(self, kind, tag=""):
        self.page.fill("#history-tag", tag)
        self.page.click(f"#history-{kind}")
        self.page.wait_for_selector("#history-result > *")

    def fault(self, words):
        self.page.wait_for_selector(f"#history-fault:has-text('{words}')")

    def saved(self):
        name, content = self.visit.saved(".save-csv")
        return name, list(csv.reader(content.decode().splitlines()))

    def pixels(self, layer):
        """How many pixels of a layer of the map are drawn in a colour, not in grey."""
        self.visit.frames()
        return self.page.evaluate(
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

    def place(self, unix_s):
        """Where the marker is at a moment."""
        self.visit.run("player", f"player.seek(given - {PAST}.start_unix_s);", unix_s)
        self.visit.frames()
        return self.visit.run("map/past", f"return past.placeNow({PAST})?.place;")


@pytest.fixture
def kept(serve, visit):
    server = serve(zones=made_up.ZONES, history=True)
    return History(server, visit(server, timezone_id="Europe/Berlin", reduced_motion="reduce"))


def test_the_way_of_a_tag_is_shown_and_played(kept):
    page = kept.page
    before = kept.pixels("still")
    kept.ask("way", "trolley")
    page.fill("#history-tag", "forklift")
    page.keyboard.press("Enter")
    kept.until(f"{PAST}?.track.tag === 'forklift'")
    query = kept.server.bodies["history"][-1][1]
    assert float(query["to"]) - float(query["from"]) == pytest.approx(3600, abs=60)
    assert query["site"] == "7"

    # Nothing looks like the present.
    assert kept.pixels("still") > before + 500
    assert page.locator("#past-mark").inner_text().startswith("Past · forklift · 20")
    assert page.locator("#pill").inner_text() != "Live"  # but Past, or a warning that the browser is busy
    assert page.evaluate("getComputedStyle(document.getElementById('moving')).opacity") == "0.2"
    assert "Times of Europe/Berlin" in page.locator("#history-form").inner_text()

    # The marker is between the two positions around the moment; a pause has no position.
    points = page.evaluate(f"{PAST}.track.points")
    index = next(n for n in range(20, len(points)) if points[n + 1][0] - points[n][0] < 5)
    (begin, *one), (end, *two) = points[index][:4], points[index + 1][:4]
    middle = [(a + b) / 2 for a, b in zip(one, two, strict=True)]
    assert kept.place((begin + end) / 2) == pytest.approx(middle, abs=1e-6)
    assert kept.pixels("moment") > 50
    pause = begin - begin % made_up.PERIOD_S + made_up.PERIOD_S + made_up.PAUSE_S / 2
    assert kept.place(pause) is None
    assert kept.pixels("moment") == 0
    assert page.locator("#play-about").inner_text() == "no position then"
    assert page.evaluate(f"{PAST}.fixes.length") in {6, 7}

    # Played from within a pause, it goes on where there are positions; the keys are those of recordings.
    page.select_option("#speed", "60")
    page.focus("#slider")
    page.keyboard.press(">")
    page.keyboard.press("k")
    kept.until(f"at => {PAST}.start_unix_s + {PAST}.at_s > at + {made_up.PAUSE_S / 2}", pause)
    assert page.evaluate(f"{PAST}.speed") == 300
    for key in ("k", "5", "j"):
        page.keyboard.press(key)
    assert page.evaluate(f"{PAST}.at_s / {PAST}.duration_s") == pytest.approx(0.49)
    page.keyboard.press("End")
    kept.until(f"{PAST}.at_s > {PAST}.duration_s - 1.5 && !{PAST}.playing")
    page.select_option("#past-colours", "speed")
    kept.until("document.querySelector('#player .ticks').textContent.endsWith('m/s')")
    name, (head, first, *rest) = kept.saved()
    assert (name, head) == ("way-forklift.csv", ["time", "x_m", "y_m", "z_m", "std_m", "hpl_m", "alert"])
    assert len(rest) == len(points) - 1
    assert datetime.fromisoformat(first[0]).astimezone(UTC).timestamp() == pytest.approx(points[0][0], abs=1e-3)
    assert [float(value) for value in first[1:4]] == points[0][1:4]
    page.click("#back")
    page.locator("#past-mark").wait_for(state="hidden")
    assert page.locator("#pill").inner_text() != "Past"
    assert abs(kept.pixels("still") - before) < 100
    assert kept.visit.position("forklift") is not None


def test_heat_map_zones_and_contacts(kept):
    page = kept.page
    before = kept.pixels("still")
    kept.ask("heat")
    assert kept.pixels("still") > before + 500
    assert "Time in a cell" in page.locator("#past-scale").inner_text()
    cells = page.evaluate(f"{PAST}.map")
    times = [value for value in cells["seconds"] if value]
    units = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}
    texts = [text.split() for text in kept.visit.texts("#player .ticks span")]
    ticks = [sum(float(n) * units[unit] for n, unit in zip(text[::2], text[1::2], strict=True)) for text in texts]
    assert min(times) / 10 <= ticks[0] < ticks[1] < ticks[2] <= max(times)
    seconds = max(times)
    row, column = divmod(cells["seconds"].index(seconds), cells["columns"])
    at = (cells[key] + (n + 0.5) * cells["cell_m"] for key, n in (("x0_m", column), ("y0_m", row)))
    page.mouse.move(*kept.visit.at(*at))
    words = f"· {int(seconds // 60)} min {int(seconds % 60)} s"
    kept.until("words => document.getElementById('readout').textContent.endsWith(words)", words)
    assert sum(float(row[3]) for row in kept.saved()[1][1:]) == pytest.approx(sum(times))

    kept.ask("dwell")
    assert page.evaluate(PAST) is None, "an answer without a map shows the present"

    def column_of(number):
        return kept.visit.texts(f"#history-result tbody tr > :nth-child({number})")

    assert column_of(4) == ["11 min 40 s", "1 min 20 s", "1 min 10 s", "9.5 s"]
    for visits in (["11", "10", "4", "2"], ["2", "4", "10", "11"]):
        page.click("#history-result th >> text=Visits")
        assert column_of(3) == visits
    assert page.locator("th[aria-sort=ascending]").inner_text().startswith("Visits")
    assert page.locator("tfoot td >> nth=2").inner_text() == "27"
    kept.ask("dwell", "trolley")
    assert set(column_of(2)) == {"trolley"}
    kept.ask("contacts", "forklift")
    moment = page.locator("#history-result tbody button >> nth=2")
    begun = moment.inner_text()
    moment.click()
    kept.until(f"{PAST}?.track.tag === 'forklift'")
    page.locator(f"#past-mark:has-text('{begun}')").wait_for()
    assert page.locator("#history-result tbody button").count(), "the contacts are still listed"


def test_answers_that_come_late_and_faults(kept):
    page, server = kept.page, kept.server
    page.click("#history-way")
    kept.fault("Choose a tag")
    page.fill("#history-tag", "nobody")
    page.keyboard.press("Enter")
    kept.fault("The history has no tag nobody.")

    # Progress, and Cancel.
    server.waits = {"track"}
    page.fill("#history-tag", "forklift")
    page.keyboard.press("Enter")
    page.click("#history-state >> text=Cancel")
    kept.until("document.getElementById('history-state').textContent === ''")
    server.waits = set()

    # The answer for the first tag comes after that for the second one, though the page has ended its question.
    page.evaluate("""() => {
      const ask = window.fetch;
      window.late = [];
      window.fetch = async (address, options) => {
        if (String(address).includes("history/dwell")) return new Response('{"dwell": []}');
        if (!String(address).includes("tag=forklift")) return ask(address, options);
        const answer = await ask(address, { ...options, signal: undefined });
        await new Promise((done) => window.late.push(done));
        return answer;
      };
    }""")
    page.click("#history-way")
    kept.until("window.late.length === 1")
    kept.ask("way", "trolley")
    page.evaluate("window.late[0]()")
    for _ in range(2):
        kept.visit.frames()
    assert page.evaluate(f"{PAST}.track.tag") == "trolley"
    assert "trolley" in page.locator("#history-result").inner_text()

    # An error of the server, in its words; and a range without anything.
    server.errors["heatmap"] = "from is 14:00; it should be before to"
    page.click("#history-heat")
    kept.fault("from is 14:00; it should be before to")
    assert page.evaluate(PAST) is None
    page.fill("#history-to", "2020-01-01T00:00")
    page.press("#history-to", "Enter")
    kept.fault("The range ends before it begins.")
    page.select_option("#history-range", "yesterday")
    page.click("#history-dwell")
    page.wait_for_selector("#history-result:has-text('No zone was entered, or there are no positions, of')")

    # A recording, and another site, end the past.
    kept.ask("way", "trolley")
    page.click("#tab-recordings")
    page.click(".recording")
    kept.until(f"skyless.state.mode === 'replay' && {PAST} === null")
    page.click("#tab-history")
    page.wait_for_selector("#panel-history:has-text('A recording is shown')")
    page.click("#panel-history >> text=Back to live")
    kept.ask("way", "trolley")
    server.send({"type": "site", "site": made_up.site_message(id=8)})
    kept.until(f"{PAST} === null && !document.querySelector('#history-result').children.length")
    kept.visit.forgive()


def test_without_a_history(hall):
    page = hall[1].page
    page.click("#tab-history")
    page.wait_for_selector("#panel-history:has-text('skyless dashboard --history FOLDER')")
    page.locator("#history-form").wait_for(state="hidden")
