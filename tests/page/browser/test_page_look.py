"""Dark and light, narrow and wide, keyboard, screen readers, less motion."""

import pytest
from page_browser import until

pytestmark = pytest.mark.statistical

TABS = ("tags", "alarms", "anchors", "events", "timing", "zones", "recordings")
LUMA = "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number).reduce((a, b) => a + b)"


@pytest.fixture
def server(serve):
    return serve()


def test_colours_follow_the_system_until_somebody_chooses(server, visit):
    dark = visit(server, color_scheme="dark").page
    light = visit(server, color_scheme="light").page
    assert dark.evaluate(LUMA) < 150
    assert light.evaluate(LUMA) > 600
    dark.click("#theme")
    assert dark.evaluate(LUMA) > 600
    dark.reload()
    until(dark, "window.skyless?.state.connection.phase === 'open'")
    assert dark.evaluate(LUMA) > 600


@pytest.mark.parametrize("width", [360, 768, 1280])
def test_no_width_scrolls_sideways(server, visit, width):
    page = visit(server, viewport={"width": width, "height": 720}).page
    page.wait_for_selector("table.tags tr.fresh")
    wide = "[...document.querySelectorAll('html, body, #panels')].some((e) => e.scrollWidth > e.clientWidth + 1)"
    for tab in TABS:
        page.click(f"#tab-{tab}")
        page.wait_for_timeout(80)
        assert not page.evaluate(wide), tab
    page.click("#tab-tags")
    page.click("table.tags button >> nth=0")
    page.wait_for_selector("#panel-tags .detail canvas")
    assert not page.evaluate(wide)
    page.click("#tab-recordings")
    page.click(".recording")
    page.wait_for_selector("#player")
    assert not page.evaluate(wide)
    box = page.locator("#back").bounding_box()
    assert box["x"] + box["width"] <= width


OVERLAPS = """() => {
  const box = (id) => document.getElementById(id).getBoundingClientRect();
  const boxes = ["past-mark", "following", "readout"].map(box);
  const apart = (a, b) => a.right <= b.left || b.right <= a.left || a.bottom <= b.top || b.bottom <= a.top;
  return boxes.some((a, n) => boxes.slice(n + 1).some((b) => !apart(a, b)));
}"""


@pytest.mark.parametrize("size", [(390, 844), (1000, 700)])
def test_words_on_the_map_of_a_replay_keep_apart(server, visit, size):
    page = visit(server, viewport=dict(zip(("width", "height"), size, strict=True))).page
    assert page.locator("#summary .latency").is_visible() == (size[0] > 900)
    page.click("#legend summary")
    page.evaluate("import('/page/player.js').then(({ open }) => open('walk.mcap'))")
    page.wait_for_selector("#past-mark")
    page.evaluate("import('/page/map/follow.js').then(({ follow }) => follow('forklift'))")
    page.wait_for_selector("#following-words:has-text('forklift')")
    page.evaluate("document.getElementById('readout').textContent = 'x 12.34 m · y 5.67 m'")
    assert page.evaluate(OVERLAPS) is False


def test_the_sheet_on_a_phone_grows_and_shrinks(server, visit):
    page = visit(server, viewport={"width": 360, "height": 720}).page
    heights = []
    for _ in range(3):
        heights.append(page.locator("#panel").bounding_box()["height"])
        page.click("#sheet")
    assert heights[1] > heights[0] > heights[2]


def test_every_control_is_reached_by_tab_shows_it_and_has_a_name(server, visit):
    page = visit(server).page
    page.wait_for_selector("table.tags tr.fresh")
    reached = []
    for _ in range(22):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate("""() => {
              const e = document.activeElement;
              if (e === document.body) return ["", "", ""];
              const name = e.getAttribute("aria-label") || e.getAttribute("aria-labelledby") || e.textContent.trim();
              return [e.id, name, getComputedStyle(e).outlineStyle];
            }""")
        )
    ids = [one[0] for one in reached]
    for wanted in ("theme", "canvas", "zoom-in", "draw", "tab-tags", "panel-tags"):
        assert wanted in ids
    for identity, name, outline in reached:
        if identity or name:
            assert name, identity
            assert outline != "none", identity or name


def test_tabs_move_with_arrows(server, visit):
    page = visit(server).page
    page.focus("#tab-tags")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("document.activeElement.id") == "tab-alarms"
    assert page.locator("#panel-alarms").is_visible()
    page.keyboard.press("End")
    assert page.locator("#panel-setup").is_visible()


def test_less_motion_means_no_interpolation_and_no_transitions(server, visit):
    page = visit(server, reduced_motion="reduce").page
    until(page, "skyless.live.all.get('robot')?.count > 3")
    same = page.evaluate("""async () => {
      const { visibleTags } = await import("/page/map/tags.js");
      return visibleTags().seen.every(({ track, row }) => row[0] === track.value(track.find(row[14]), 0));
    }""")
    assert same
    assert page.evaluate("getComputedStyle(document.getElementById('draw')).transitionDuration") == "0s"
    spinner = """() => {
      document.getElementById("ramp-box").classList.add("pending");
      return getComputedStyle(document.getElementById("ramp-head"), "::before").animationName;
    }"""
    assert page.evaluate(spinner) == "none"
    page.click("#legend summary")
    assert "not interpolated" in page.locator("#legend").inner_text()


def test_the_token_does_not_stay_in_the_address(server, visit):
    page = visit(server).page
    page.goto(f"{server.address}?token=secret")
    until(page, "window.skyless !== undefined")
    assert page.url == server.address
