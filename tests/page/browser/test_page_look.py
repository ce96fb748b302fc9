"""Dark and light, narrow and wide, keyboard and screen readers, less motion; what axe finds in either theme.

The light theme is checked by axe for what differs from the dark one, its colours.
"""

import page_site as made_up
import pytest
from page_browser import PHONE
from page_site import alarm, asset
from page_survey import MadeUpSurvey, moved, watch

pytestmark = pytest.mark.statistical

TABS = ("tags", "alarms", "anchors", "events", "timing", "zones", "recordings")
LUMA = "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number).reduce((a, b) => a + b)"
WIDE = "[...document.querySelectorAll('html, body, #panels')].some((e) => e.scrollWidth > e.clientWidth + 1)"


def test_colours_follow_the_system_until_somebody_chooses_and_less_motion_is_kept(serve, visit):
    server = serve()
    dark = visit(server, color_scheme="dark", reduced_motion="reduce")
    page = dark.page
    assert page.evaluate(LUMA) < 150
    page.emulate_media(color_scheme="light", reduced_motion="reduce")
    assert page.evaluate(LUMA) > 600
    page.emulate_media(color_scheme="dark", reduced_motion="reduce")
    page.click("#theme")
    assert page.evaluate(LUMA) > 600
    assert page.evaluate("getComputedStyle(document.getElementById('draw')).transitionDuration") == "0s"
    spinner = """() => {
      document.getElementById("ramp-box").classList.add("pending");
      return getComputedStyle(document.getElementById("ramp-head"), "::before").animationName;
    }"""
    assert page.evaluate(spinner) == "none"
    page.click("#legend summary")
    assert "not interpolated" in page.locator("#legend").inner_text()
    page.goto(f"{server.address}?token=secret")
    dark.until("window.skyless?.state.connection.phase === 'open'")
    assert page.url == server.address, "the token does not stay in the address"
    assert page.evaluate(LUMA) > 600


OVERLAPS = """() => {
  const boxes = ["past-mark", "following", "readout"].map((id) => document.getElementById(id).getBoundingClientRect());
  const apart = (a, b) => a.right <= b.left || b.right <= a.left || a.bottom <= b.top || b.bottom <= a.top;
  return boxes.some((a, n) => boxes.slice(n + 1).some((b) => !apart(a, b)));
}"""


@pytest.mark.parametrize("width", [360, 768, 1280])
def test_no_width_scrolls_sideways_and_words_on_the_map_keep_apart(serve, visit, width):
    server = serve()
    shown = visit(server, viewport={"width": width, "height": 720})
    page = shown.page
    page.wait_for_selector("table.tags tr.fresh")
    page.locator("#summary .latency").wait_for(state="visible" if width > 900 else "hidden")
    server.send(watch(moved(4), moved(5)))
    for tab in TABS:
        page.click(f"#tab-{tab}")
        page.wait_for_timeout(80)
        assert not page.evaluate(WIDE), tab
    page.click("#tab-tags")
    page.click("table.tags button >> nth=0")
    page.wait_for_selector("#panel-tags .detail canvas")
    assert not page.evaluate(WIDE)
    page.focus("#tab-tags")
    page.keyboard.press("End")
    box = page.locator("#tab-setup").bounding_box()
    assert box["x"] + box["width"] <= width + 1, "the open tab is in view"
    page.click("#tab-recordings")
    page.click(".recording")
    page.wait_for_selector("#past-mark")
    assert not page.evaluate(WIDE)
    box = page.locator("#back").bounding_box()
    assert box["x"] + box["width"] <= width
    shown.run("map/follow", "follow.follow('forklift');")
    page.wait_for_selector("#following-words:has-text('forklift')")
    page.evaluate("document.getElementById('readout').textContent = 'x 12.34 m · y 5.67 m'")
    assert page.evaluate(OVERLAPS) is False


def test_the_table_of_tags_is_not_cut_off_and_the_sheet_on_a_phone_grows_and_shrinks(serve, visit):
    page = visit(serve(tags=20)).page
    page.wait_for_selector("#panel-tags tr.fresh")
    for size in ({"width": 1440, "height": 900}, PHONE):
        page.set_viewport_size(size)
        assert page.evaluate("(box => box.scrollWidth <= box.clientWidth)(document.querySelector('.scroll-x'))")
    heights = []
    for _ in range(3):
        heights.append(page.locator("#panel").bounding_box()["height"])
        page.click("#sheet")
    assert heights[1] > heights[0] > heights[2]


def test_every_control_is_reached_by_tab_shows_it_and_has_a_name_and_tabs_move_with_arrows(hall):
    page = hall[1].page
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
    assert {identity for identity, *_ in reached} >= {"theme", "canvas", "zoom-in", "draw", "tab-tags", "panel-tags"}
    for identity, name, outline in reached:
        assert bool(name) == bool(identity or name)
        assert outline != "none", identity or name
    page.focus("#tab-tags")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("document.activeElement.id") == "tab-alarms"
    page.locator("#panel-alarms").wait_for()
    page.keyboard.press("End")
    page.locator("#panel-setup").wait_for()


RUN = """async ([context, rules]) => {
  const found = await axe.run(context ?? document, { resultTypes: ["violations"], ...(rules && { runOnly: rules }) });
  return found.violations.filter(({ impact }) => ["serious", "critical"].includes(impact)).map(({ id, nodes }) => ({
    id,
    nodes: nodes.slice(0, 5).map((node) => `${node.target.join(" ")}: ${node.any.map((one) => one.message)}`),
  }));
}"""


class Checks:
    """An open page, and what axe has found in it so far that is serious."""

    def __init__(self, visit):
        axe = pytest.importorskip("axe_playwright_python.base")
        self.visit, self.page, self.found = visit, visit.page, {}
        self.page.evaluate(axe.AXE_SCRIPT)

    def check(self, what, context=None):
        """Note the findings in the page, or in a part of it."""
        for theme, rules in (("light", ["color-contrast"]), ("dark", None)):
            self.page.emulate_media(color_scheme=theme)
            self.visit.frames()
            if faults := self.page.evaluate(RUN, [context, rules]):
                self.found[f"{what}, {theme}"] = faults

    def check_tabs(self, what):
        for tab in self.page.evaluate("[...document.querySelectorAll('#tabs [role=tab]')].map((tab) => tab.id)"):
            self.page.click(f"#{tab}")
            self.check(f"{what}, {tab}", "#panel")


@pytest.fixture
def checks(serve, visit):
    return lambda server: Checks(visit(server, color_scheme="dark", reduced_motion="reduce"))


def test_axe_of_the_live_page_until_the_connection_is_lost(serve, checks):
    server = serve(tags=4)
    live = checks(server)
    page = live.page
    page.wait_for_selector("table.tags tr.fresh")
    page.click("#legend summary")
    live.check("whole page")
    live.check_tabs("live")
    for kind, number in (("tag", 0), ("anchor", 2)):
        page.click(f"#tab-{kind}s")
        page.click(f"table.{kind}s button >> nth={number}")
        page.wait_for_selector(f"#panel-{kind}s .detail canvas")
        live.check(f"a {kind}", "#panel")
    page.click("#tab-zones")
    page.click("#panel-zones .zones >> text=Corners")
    live.check("corners of a zone", "#panel")
    page.click("#draw")
    live.check("a zone is drawn", "#map")
    page.click("#pill")
    for level in ("warning", "bad"):
        server.condition = made_up.condition(
            made_up.reason("slow", level, "anchor 8 of 8 is offline", names=["anchor/8"])
        )
        live.visit.until("level => document.getElementById('pill').classList.contains(level)", level)
        live.check(level, "header")
    server.cut()
    page.wait_for_selector("#banner.lost")
    live.check("lost")
    assert live.found == {}
    for name in ("aria-label", "title"):
        page.evaluate("name => document.getElementById('fit').removeAttribute(name)", name)
    live.check("axe finds what is there to be found", "#map")
    assert [fault["id"] for fault in live.found.popitem()[1]] == ["button-name"]
    live.visit.forgive()


def test_axe_of_a_replay_and_of_the_past(serve, checks):
    replay = checks(serve(history=True, zones=made_up.ZONES))
    page = replay.page
    page.click("#tab-recordings")
    page.click(".recording")
    replay.visit.until("skyless.state.player?.events && !skyless.state.player.waiting")
    page.focus(".event-mark")
    replay.check("whole page")
    replay.check_tabs("replay")
    page.click("#back")
    page.click("#tab-history")
    for kind in ("heat", "dwell", "contacts"):
        page.fill("#history-tag", "forklift")
        page.click(f"#history-{kind}")
        page.wait_for_selector("#history-result > *")
        replay.check(kind)
    assert replay.found == {}


def test_axe_of_the_set_up(serve, checks):
    setup = checks(serve(tags=0, placed=False, survey=MadeUpSurvey(missing=(7,), ambiguous=True)))
    page = setup.page
    page.wait_for_selector("#panel-setup .step")
    for step in page.query_selector_all("#panel-setup .step > summary"):
        step.click()
        setup.check(step.inner_text(), "#panel")
    setup.check("whole page")
    assert setup.found == {}


def test_axe_of_assets_and_alarms(serve, checks):
    server = serve(tags=4)
    server.assets = [asset("forklift", "Linde 3", "forklifts", icon="F"), asset("robot", "Arm", colour="#c2410c")]
    server.rules = [{"id": "too-near", "kind": "near", "name": "Too near", "tags": ["group:forklifts"], "limit": 2.0}]
    server.file_rules = [{"id": "anchors", "kind": "anchor-offline", "name": "Anchors", "after_s": 10}]
    server.alarms = [
        alarm("near", "forklift~robot", "critical", "Linde 3 and Arm are 1.4 m apart", tags=["forklift", "robot"]),
        alarm("crowded", "zone-dock", "warning", "5 tags are in Dock", zone="dock", acknowledged_unix_s=1.0),
    ]
    server.errors = dict.fromkeys(("alarm_rules", "assets"), "they are wrong")
    shown = checks(server)
    page = shown.page
    page.wait_for_selector("table.tags tr.fresh")
    page.click("#legend summary")
    shown.check("tags with assets")
    page.click("#tab-alarms")
    page.click("#panel-alarms >> text=Acknowledge >> nth=0")
    page.click("#add-rule")
    page.get_by_label("Raised when").select_option("near")
    page.click(".rule-form >> text=Save")  # the browser marks the name, which is missing
    page.get_by_label("Name", exact=True).fill("Near")
    page.get_by_label("Distance (m)").fill("2")
    page.click(".rule-form >> text=Save")
    page.wait_for_selector(".rule-form .fault:not([hidden])")
    shown.check("alarms", "#panel")
    page.click("#tab-tags")
    page.click("#edit-assets")
    page.click("#assets-dialog >> text=Add >> nth=0")
    page.get_by_label("Name of robot").fill("Arm 2")
    page.keyboard.press("Tab")
    page.get_by_label("Remove forklift").click()
    page.click("#assets-dialog button.primary")  # the browser marks the tag, which is missing
    page.locator(".new .asset-tag").fill("trolley")
    page.click("#assets-dialog button.primary")
    page.wait_for_selector("#assets-dialog .fault:not([hidden])")
    shown.check("assets", "#assets-dialog")
    shown.visit.forgive()
    assert shown.found == {}
