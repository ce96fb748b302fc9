"""A person plays a recording: the map shows the time of the slider, and nothing of the live site."""

import io

import page_site as made_up
import pytest
from page_site import FIRST_FIX_S
from PIL import Image

pytestmark = pytest.mark.statistical

AT_S = "skyless.state.player.at_s"


class Replay:
    """An open recording."""

    def __init__(self, visit):
        self.visit, self.page, self.until = visit, visit.page, visit.until
        self.begin()

    def begin(self):
        self.page.click("#tab-recordings")
        self.page.click(".recording")
        self.until("skyless.state.mode === 'replay'")

    @property
    def at_s(self):
        return self.page.evaluate(AT_S)

    def paused_at(self, at_s):
        self.until(f"at => Math.abs({AT_S} - at) < 0.01 && !skyless.state.player.playing", at_s)

    def place_slider(self, at_s):
        script = "slider => { slider.value = %s; slider.dispatchEvent(new Event('input')); }"
        self.page.locator("#slider").evaluate(script % at_s)
        self.until(f"at => !skyless.state.player.waiting && Math.abs({AT_S} - at) < 5", at_s)

    def is_shown(self):
        """Whether the first tag is where it was at the moment of the slider."""
        self.until("!skyless.state.player.waiting")
        x, y = self.visit.position("forklift", "replayed")
        true_x, true_y, *_ = made_up.truth(0, self.at_s)
        return abs(x - true_x) < 0.15 and abs(y - true_y) < 0.15


@pytest.fixture
def replay(hall):
    server, visit = hall
    replay = Replay(visit)
    visit.until("!skyless.state.player.waiting")
    return server, replay


def test_it_plays_from_the_first_fix_to_the_end_and_anywhere_and_does_not_look_live(replay):
    _, replay = replay
    page = replay.page
    before = replay.at_s
    assert before >= FIRST_FIX_S
    assert page.locator("#past-mark").inner_text().startswith("Replay · recorded 2026-05-28")
    assert page.locator("#pill").inner_text() == "Replay"
    page.locator("#banner").wait_for(state="hidden")
    replay.until(f"before => {AT_S} > before + 0.5", before)
    page.click("#play")
    assert replay.is_shown()
    still = replay.at_s
    for at_s in (70.0, 12.5, 13.0, 89.0, 2.5):
        replay.place_slider(at_s)
        assert replay.at_s == at_s != still, "it pauses"
        assert replay.is_shown()
    spans = page.evaluate("""() => {
      const box = document.querySelector("#spans").getBoundingClientRect();
      const at = (x) => (90 * (x - box.left)) / box.width;
      const spans = [...document.querySelectorAll("#spans i")].map((span) => span.getBoundingClientRect());
      return spans.flatMap((span) => [at(span.left), at(span.right)]);
    }""")
    assert [round(at_s) for at_s in spans] == [2, 55, 60, 90]
    page.select_option("#speed", "8")  # beyond what was fetched first, to the end, and again from the first fix
    replay.place_slider(60.0)
    page.click("#play")
    replay.until("!skyless.state.player.playing")
    assert replay.at_s == 90.0
    assert replay.is_shown()
    page.click("#play")
    replay.until(f"{AT_S} < 60")
    assert replay.at_s >= FIRST_FIX_S
    page.click("#tab-anchors")
    assert page.locator("#panel-anchors tr.good").count() == 0, "no anchor is shown as if its health were known"
    page.click("#back")
    page.locator("#past-mark").wait_for(state="hidden")
    assert page.evaluate("skyless.state.mode") == "live"
    replay.until("document.getElementById('pill').textContent === 'Live'")


def test_events_have_marks_with_words_and_keys_lead_anywhere(replay):
    """Events that are close share a mark; news of programs, and that an anchor is back, have none."""
    _, replay = replay
    page = replay.page
    replay.until("document.querySelectorAll('.event-mark').length === 3")
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
    replay.paused_at(49.0)
    page.keyboard.press("ArrowRight")
    assert page.evaluate("document.activeElement.ariaLabel") == names[2]
    page.mouse.move(0, 0)
    assert page.locator(".bubble:visible").inner_text() == names[2]
    page.keyboard.press("Enter")
    replay.paused_at(69.0)
    page.click("#event-back")
    replay.paused_at(49.0)
    page.keyboard.press("[")
    replay.paused_at(19.4)
    page.click("#event-next")
    replay.paused_at(49.0)
    replay.place_slider(30.0)
    for key, at_s in ((",", None), ("5", 45.0), (".", 45.1), (".", 45.2), ("l", 50.2), ("j", 45.2)):
        page.keyboard.press(key)
        replay.until("!skyless.state.player.playing")
        assert at_s is None or replay.at_s == pytest.approx(at_s)
    replay.until("Math.abs(document.getElementById('slider').value - 45.2) < 0.01")  # the key leads on from there
    page.focus("#slider")
    page.keyboard.press("ArrowLeft")
    replay.paused_at(45.1)
    for key, speed in ((">", "2"), ("<", "1"), ("<", "0.5")):
        page.keyboard.press(key)
        replay.until("speed => document.getElementById('speed').value === speed", speed)
    page.keyboard.press("k")
    replay.until(f"{AT_S} > 45.2")
    for link in ("#download", "#panel-recordings a"):
        assert replay.visit.saved(link) == ("walk.mcap", b"recorded")


def test_states_that_come_late_undo_no_seek_and_a_recording_that_cannot_be_opened_leaves_the_other_playing(replay):
    server, replay = replay
    page = replay.page
    server.waits = {"states"}
    replay.place_slider(18)  # so near to the end of what is loaded that more is asked for
    replay.visit.frames()
    replay.visit.run("player", "player.seek(70);")
    server.waits = set()
    replay.until(f"{AT_S} > 70.2")
    assert replay.is_shown()
    page.click("#back")
    replay.begin()
    replay.until("skyless.replayed.all.get('forklift').count > 0")
    server.waits = {"states"}
    page.select_option("#speed", "8")
    replay.place_slider(20)
    replay.until(f"{AT_S} > 21")  # the states after 22 s are awaited
    failure = "return player.open('broken.mcap').catch((error) => error.message);"
    assert replay.visit.run("player", failure) == "there is no such recording"
    server.waits = set()
    replay.until(f"{AT_S} > 25")
    assert page.evaluate("[skyless.state.player.name, skyless.state.player.playing]") == ["walk.mcap", True]
    replay.visit.forgive()


PICTURE = "width => import('/page/map/floor.js').then(({ floor }) => floor?.image.naturalWidth === width)"


def picture(width):
    file = io.BytesIO()
    Image.new("RGB", (width, 30)).save(file, "PNG")
    return file.getvalue()


def test_all_that_is_shown_is_of_the_recording(serve, visit):
    """Its events and its floor plan; nothing of the live site."""
    server = serve(floor_plan=picture(40), recorded_plan=picture(50), events_note=True)
    shown = visit(server)
    page = shown.page
    shown.until(PICTURE, 40)
    Replay(shown)
    shown.until(PICTURE, 50)
    page.click("#tab-events")
    page.wait_for_selector("#event-list li:has-text('Anchor 7 has moved by 31 cm')")
    assert page.locator("#event-list li").count() == 6
    assert page.locator("#panel-events").inner_text().count("The recording has more events than are listed.") == 1
    page.click("#tab-anchors")
    page.evaluate("void skyless.state.site.anchors.pop()")
    shown.until("document.querySelectorAll('#panel-anchors tbody tr').length === 7")  # the live site has 8
    page.locator("#panel-anchors h2:text-is('Programs')").wait_for(state="hidden")
    flashes = (
        "import('/page/map/zones.js').then(({ drawZones }) => drawZones(new OffscreenCanvas(1, 1).getContext('2d')))"
    )
    event = {"type": "zone_event", "kind": "enter", "zone": "dock", "tag": "robot", "unix_s": 1.0}
    server.send(event)
    shown.until("skyless.state.events.length === 1")
    shown.frames()
    assert page.evaluate(flashes) is False
    page.click("#back")
    shown.until(PICTURE, 40)
    page.locator("#panel-anchors h2:text-is('Programs')").wait_for()
    server.send({**event, "unix_s": 2.0})
    shown.until(flashes)


def test_a_recording_without_a_site_or_events_so_far(serve, visit):
    server = serve(recorded_site=False, waits={"events"})
    shown = visit(server)
    Replay(shown)
    shown.frames()
    shown.page.locator("#waiting").wait_for(state="hidden")
    shown.page.click("#tab-events")
    shown.page.wait_for_selector("#panel-events :text-is('Reading the events …')")
    server.waits = set()
    shown.page.wait_for_selector("#event-list li")
