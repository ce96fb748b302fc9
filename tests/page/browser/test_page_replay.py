"""A recording is replayed: the map shows the time of the slider."""

import io
from pathlib import Path

import page_site as made_up
import pytest
from page_browser import THREE_FRAMES, until
from page_server import FIRST_FIX_S
from PIL import Image

pytestmark = pytest.mark.statistical

AT_S = "skyless.state.player.at_s"


def begin(page):
    page.click("#tab-recordings")
    page.click(".recording")
    until(page, "skyless.state.mode === 'replay' && !skyless.state.player.waiting")


@pytest.fixture
def recorded(serve, visit):
    server = serve()
    shown = visit(server)
    begin(shown.page)
    return server, shown


def paused_at(page, at_s):
    until(page, f"at => Math.abs({AT_S} - at) < 0.01 && !skyless.state.player.playing", arg=at_s)


def place_slider(page, at_s):
    page.evaluate(
        """(value) => {
          const slider = document.getElementById("slider");
          slider.value = value;
          slider.dispatchEvent(new Event("input"));
        }""",
        str(at_s),
    )
    until(page, f"at => !skyless.state.player.waiting && Math.abs({AT_S} - at) < 5", arg=at_s)


def assert_shown(visit):
    until(visit.page, "!skyless.state.player.waiting")
    x, y = visit.position("tag-001" if visit.position("tag-001", "replayed") else "forklift", "replayed")
    true_x, true_y, *_ = made_up.truth(0, visit.page.evaluate(AT_S))
    assert abs(x - true_x) < 0.15
    assert abs(y - true_y) < 0.15


def test_it_plays_from_the_first_fix_to_the_end_and_anywhere_and_does_not_look_live(recorded):
    shown = recorded[1]
    page = shown.page
    before = page.evaluate(AT_S)
    assert before >= FIRST_FIX_S
    assert page.locator("#past-mark").inner_text().startswith("Replay · recorded 2026-05-28")
    assert page.locator("#pill").inner_text() == "Replay"
    assert page.locator("#banner").is_hidden()
    until(page, f"before => {AT_S} > before + 0.5", arg=before)
    page.click("#play")
    assert_shown(shown)
    still = page.evaluate(AT_S)
    for at_s in (70.0, 12.5, 13.0, 89.0, 2.5):
        place_slider(page, at_s)
        assert page.evaluate(AT_S) == at_s != still, "it pauses"
        assert_shown(shown)
    spans = page.evaluate("""() => {
      const box = document.querySelector("#spans").getBoundingClientRect();
      const at = (x) => (90 * (x - box.left)) / box.width;
      const spans = [...document.querySelectorAll("#spans i")].map((span) => span.getBoundingClientRect());
      return spans.map((span) => [at(span.left), at(span.right)]);
    }""")
    assert [round(at_s) for span in spans for at_s in span] == [2, 55, 60, 90]

    page.select_option("#speed", "8")  # beyond what was fetched first, to the end, and again from the first fix
    place_slider(page, 60.0)
    page.click("#play")
    until(page, "!skyless.state.player.playing", timeout_s=15.0)
    assert page.evaluate(AT_S) == 90.0
    assert_shown(shown)
    page.click("#play")
    until(page, f"{AT_S} < 60")
    assert page.evaluate(AT_S) >= FIRST_FIX_S

    page.click("#tab-anchors")
    assert page.locator("#panel-anchors tr.good").count() == 0, "no anchor is shown as if its health were known"
    page.click("#back")
    page.locator("#past-mark").wait_for(state="hidden")
    assert page.evaluate("skyless.state.mode") == "live"
    until(page, "document.getElementById('pill').textContent === 'Live'")


def test_events_have_marks_with_words_that_lead_to_them(recorded):
    """Events that are close share a mark; news of programs, and that an anchor is back, have none."""
    page = recorded[1].page
    until(page, "document.querySelectorAll('.event-mark').length === 3")
    page.keyboard.press("k")
    names = page.evaluate("[...document.querySelectorAll('.event-mark')].map((mark) => mark.ariaLabel)")
    assert names == [
        "0:20.0 anchor 2 does not report any more; 0:20.4 anchor 4 is the master now, after anchor 2",
        "0:50.0 tag tag-001: faulty anchor excluded",
        "1:10.0 Anchor 7 has moved by 31 cm",
    ]
    page.hover(".event-mark >> nth=1")
    assert page.locator(".bubble:visible").inner_text() == names[1]
    page.click(".event-mark >> nth=1")
    paused_at(page, 49.0)
    page.keyboard.press("ArrowRight")
    assert page.evaluate("document.activeElement.ariaLabel") == names[2]
    page.mouse.move(0, 0)
    assert page.locator(".bubble:visible").inner_text() == names[2]
    page.keyboard.press("Enter")
    paused_at(page, 69.0)
    page.click("#event-back")
    paused_at(page, 49.0)
    page.keyboard.press("[")
    paused_at(page, 19.4)
    page.click("#event-next")
    paused_at(page, 49.0)


def test_keys_and_downloads(recorded):
    page = recorded[1].page
    place_slider(page, 30.0)
    for key, at_s in ((",", None), ("5", 45.0), (".", 45.1), (".", 45.2), ("l", 50.2), ("j", 45.2)):
        page.keyboard.press(key)
        until(page, "!skyless.state.player.playing")
        assert at_s is None or page.evaluate(AT_S) == pytest.approx(at_s)
    page.focus("#slider")
    page.keyboard.press("ArrowLeft")
    paused_at(page, 45.1)
    for key, speed in ((">", "2"), ("<", "1"), ("<", "0.5")):
        page.keyboard.press(key)
        until(page, "speed => document.getElementById('speed').value === speed", arg=speed)
    page.keyboard.press("k")
    until(page, f"{AT_S} > 45.2")
    for link in ("#download", "#panel-recordings a"):
        with page.expect_download() as found:
            page.click(link)
        assert found.value.suggested_filename == "walk.mcap"
        assert Path(found.value.path()).read_bytes() == b"recorded"


def test_a_recording_opens_again_and_one_that_cannot_be_opened_leaves_it_playing(recorded):
    server, shown = recorded
    page = shown.page
    page.click("#back")
    begin(page)
    until(page, "skyless.replayed.all.get('forklift').count > 0")
    server.recorded_waits = True
    page.select_option("#speed", "8")
    place_slider(page, 20)
    until(page, f"{AT_S} > 21")  # the states after 22 s are awaited
    failure = "import('/page/player.js').then(({ open }) => open('broken.mcap')).catch((error) => error.message)"
    assert page.evaluate(failure) == "there is no such recording"
    server.recorded_waits = False
    until(page, f"{AT_S} > 25")
    assert page.evaluate("[skyless.state.player.name, skyless.state.player.playing]") == ["walk.mcap", True]
    assert [text for text in shown.problems if "404" not in text] == []
    shown.problems.clear()


def test_states_of_another_moment_that_come_late_do_not_undo_a_seek(recorded):
    server, shown = recorded
    page = shown.page
    server.recorded_waits = True
    place_slider(page, 18)  # so near to the end of what is loaded that more is asked for
    page.evaluate(THREE_FRAMES)
    page.evaluate("import('/page/player.js').then(({ seek }) => seek(70))")
    server.recorded_waits = False
    until(page, f"{AT_S} > 70.2")
    assert_shown(shown)


PICTURE = """async () => {
  const { floor } = await import("/page/map/floor.js");
  return floor?.image.naturalWidth ?? null;
}"""
FLASHES = """async () => {
  const { drawZones } = await import("/page/map/zones.js");
  return drawZones(document.createElement("canvas").getContext("2d"));
}"""


def picture(width):
    file = io.BytesIO()
    Image.new("RGB", (width, 30)).save(file, "PNG")
    return file.getvalue()


def test_all_that_is_shown_is_of_the_recording(serve, visit):
    """Its events and its floor plan; nothing of the live site."""
    server = serve(floor_plan=picture(40))
    server.recorded_plan = picture(50)
    server.events_note = True
    shown = visit(server)
    page = shown.page
    until(page, f"({PICTURE})().then((width) => width === 40)")
    begin(page)
    until(page, f"({PICTURE})().then((width) => width === 50)")
    page.click("#tab-events")
    page.wait_for_selector("#event-list li:has-text('Anchor 7 has moved by 31 cm')")
    assert page.locator("#event-list li").count() == 6
    assert page.locator("#panel-events").inner_text().count("The recording has more events than are listed.") == 1
    page.click("#tab-anchors")
    ids = "[...document.querySelectorAll('#panel-anchors tbody tr')].length"
    page.evaluate("void skyless.state.site.anchors.pop()")
    until(page, f"{ids} === 7")  # the live site has 8
    assert page.locator("#panel-anchors h2:text-is('Programs')").is_hidden()
    event = {"kind": "enter", "zone": "dock", "tag": "robot", "unix_s": 1.0}
    server.send({"type": "zone_event", **event})
    until(page, "skyless.state.events.length === 1")
    page.evaluate(THREE_FRAMES)
    assert page.evaluate(f"({FLASHES})()") is False
    page.click("#back")
    until(page, f"({PICTURE})().then((width) => width === 40)")
    page.locator("#panel-anchors h2:text-is('Programs')").wait_for()
    server.send({"type": "zone_event", **event, "unix_s": 2.0})
    until(page, f"({FLASHES})()")


def test_a_recording_without_a_site_or_events_so_far(serve, visit):
    server = serve()
    server.recorded_site = False
    page = visit(server).page
    begin(page)
    page.evaluate(THREE_FRAMES)
    assert page.locator("#waiting").is_hidden()
    server.recorded_waits = True
    page.click("#back")
    page.click(".recording")
    until(page, "skyless.state.mode === 'replay'")
    page.click("#tab-events")
    page.wait_for_selector("#panel-events :text-is('Reading the events …')")
    server.recorded_waits = False
    page.wait_for_selector("#event-list li")
