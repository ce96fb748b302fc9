"""A recording is replayed: the map shows the time of the slider."""

import page_fake_site as made_up
import pytest
from page_browser import until


@pytest.fixture
def replay(serve, visit):
    shown = visit(serve())
    shown.page.click("#tab-recordings")
    shown.page.click(".recording")
    until(shown.page, "skyless.state.mode === 'replay' && !skyless.state.player.waiting")
    return shown


def place_slider(page, at_s):
    page.evaluate(
        """(value) => {
          const slider = document.getElementById("slider");
          slider.value = value;
          slider.dispatchEvent(new Event("input"));
        }""",
        str(at_s),
    )
    until(page, "at => !skyless.state.player.waiting && Math.abs(skyless.state.player.at_s - at) < 5", arg=at_s)


def assert_shown(visit):
    until(visit.page, "!skyless.state.player.waiting")
    at_s = visit.page.evaluate("skyless.state.player.at_s")
    x, y = visit.position("tag-001" if visit.position("tag-001", "replayed") else "forklift", "replayed")
    true_x, true_y, *_ = made_up.truth(0, at_s)
    assert abs(x - true_x) < 0.15
    assert abs(y - true_y) < 0.15


def test_it_plays(replay):
    page = replay.page
    assert page.locator("#pill").inner_text() == "Replay"
    before = page.evaluate("skyless.state.player.at_s")
    until(page, "before => skyless.state.player.at_s > before + 0.5", arg=before)
    page.click("#play")
    assert_shown(replay)
    still = page.evaluate("skyless.state.player.at_s")
    page.wait_for_timeout(300)
    assert page.evaluate("skyless.state.player.at_s") == still


def test_the_slider_leads_anywhere(replay):
    page = replay.page
    page.click("#play")
    for at_s in (70.0, 12.5, 13.0, 89.0, 0.0):
        place_slider(page, at_s)
        assert page.evaluate("skyless.state.player.at_s") == at_s
        assert_shown(replay)


def test_it_goes_on_beyond_what_was_fetched_first_and_stops_at_the_end(replay):
    page = replay.page
    page.select_option("#speed", "8")
    place_slider(page, 60.0)
    until(page, "!skyless.state.player.playing", timeout_s=15.0)
    assert page.evaluate("skyless.state.player.at_s") == 90.0
    assert_shown(replay)


def test_keys_move_the_slider(replay):
    page = replay.page
    page.keyboard.press("k")
    until(page, "!skyless.state.player.playing")
    place_slider(page, 30.0)
    page.keyboard.press("l")
    until(page, "skyless.state.player.at_s === 35 && document.getElementById('slider').value === '35'")
    page.focus("#slider")
    page.keyboard.press("ArrowLeft")
    until(page, "Math.abs(skyless.state.player.at_s - 34.9) < 1e-6")


def test_live_comes_back(replay):
    page = replay.page
    page.click("#back")
    assert page.evaluate("skyless.state.mode") == "live"
    until(page, "document.getElementById('pill').textContent === 'Live'")
    assert page.locator("table.tags tbody tr").count() == 0 or replay.position("robot")
