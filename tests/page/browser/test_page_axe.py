"""Axe, a checker of accessibility, finds nothing serious: both themes, every tab, live, in a replay, in the set-up.

The light theme is checked for what differs from the dark one, its colours.

What it cannot find, such as the order of the keyboard's focus, is in ``test_page_look.py``.
"""

import page_site as made_up
import pytest
from page_browser import THREE_FRAMES, until
from page_survey import MadeUpSurvey
from test_page_alarms import IN_FILE, TOO_NEAR, alarm
from test_page_assets import asset

pytestmark = pytest.mark.statistical

axe = pytest.importorskip("axe_playwright_python.base")

SERIOUS = {"serious", "critical"}
RUN = """async ([context, rules]) => {
  const found = await axe.run(context ?? document, { resultTypes: ["violations"], ...(rules && { runOnly: rules }) });
  return found.violations.map(({ id, impact, nodes }) => ({
    id,
    impact,
    nodes: nodes.slice(0, 5).map((node) => `${node.target.join(" ")}: ${node.any.map((one) => one.message)}`),
  }));
}"""


class Checks:
    """An open page, and what axe has found in it so far."""

    def __init__(self, visit):
        self.visit, self.page, self.found = visit, visit.page, {}
        self.page.evaluate(axe.AXE_SCRIPT)

    def check(self, what, context=None):
        """Note the serious findings in the page, or in a part of it."""
        for theme, rules in (("light", ["color-contrast"]), ("dark", None)):
            self.page.emulate_media(color_scheme=theme)
            self.page.evaluate(THREE_FRAMES)
            faults = [fault for fault in self.page.evaluate(RUN, [context, rules]) if fault["impact"] in SERIOUS]
            if faults:
                self.found[f"{what}, {theme}"] = faults

    def check_tabs(self, what):
        for tab in self.page.evaluate("[...document.querySelectorAll('#tabs [role=tab]')].map((tab) => tab.id)"):
            self.page.click(f"#{tab}")
            self.check(f"{what}, {tab}", "#panel")


@pytest.fixture
def checks(serve, visit):
    return lambda server: Checks(visit(server, color_scheme="dark", reduced_motion="reduce"))


def test_the_live_page(serve, checks):
    live = checks(serve(tags=4))
    page = live.page
    page.wait_for_selector("table.tags tr.fresh")
    page.click("#legend summary")
    live.check("whole page")
    live.check_tabs("live")
    page.click("#tab-tags")
    page.click("table.tags button >> nth=0")
    page.wait_for_selector("#panel-tags .detail canvas")
    live.check("a tag", "#panel")
    page.click("#tab-anchors")
    page.click("table.anchors button >> nth=2")
    page.wait_for_selector("#panel-anchors .detail canvas")
    live.check("an anchor", "#panel")
    page.click("#tab-zones")
    page.click("#panel-zones .zones >> text=Corners")
    live.check("corners of a zone", "#panel")
    page.click("#draw")
    live.check("a zone is drawn", "#map")
    assert live.found == {}


def test_a_replay(serve, checks):
    replay = checks(serve())
    page = replay.page
    page.click("#tab-recordings")
    page.click(".recording")
    until(page, "skyless.state.player?.events && !skyless.state.player.waiting")
    page.focus(".event-mark")
    replay.check("whole page")
    replay.check_tabs("replay")
    assert replay.found == {}


def test_a_lost_connection(serve, checks):
    server = serve()
    lost = checks(server)
    server.cut()
    lost.page.wait_for_selector("#banner.lost")
    lost.check("whole page")
    assert lost.found == {}
    lost.page.evaluate("document.getElementById('fit').removeAttribute('aria-label')")
    lost.page.evaluate("document.getElementById('fit').removeAttribute('title')")
    lost.check("axe finds what is there to be found", "#map")
    assert [fault["id"] for fault in lost.found.popitem()[1]] == ["button-name"]
    server.refuse = False
    until(lost.page, "skyless.state.connection.phase === 'open'", timeout_s=15.0)
    lost.visit.problems.clear()  # the browser's own lines about the refused sockets


def test_the_condition_with_its_reasons(serve, checks):
    server = serve()
    shown = checks(server)
    shown.page.click("#pill")
    for reasons in (
        [made_up.reason("anchors", "warning", "anchor 8 of 8 is offline", "See its power.", ["anchor/8"])],
        [made_up.reason("slow", "bad", "this computer is too slow: the emulated air missed 41 %")],
    ):
        server.condition = made_up.condition(*reasons)
        until(shown.page, "level => document.getElementById('pill').classList.contains(level)", arg=reasons[0]["level"])
        shown.check(reasons[0]["level"], "header")
    assert shown.found == {}


def test_the_set_up(serve, checks):
    setup = checks(serve(tags=0, placed=False, survey=MadeUpSurvey()))
    page = setup.page
    page.wait_for_selector("#panel-setup .step")
    for step in page.query_selector_all("#panel-setup .step > summary"):
        step.click()
        setup.check(step.inner_text(), "#panel")
    setup.check("whole page")
    assert setup.found == {}


def test_assets_and_alarms(serve, checks):
    server = serve(tags=4)
    server.assets = [asset("forklift", "Linde 3", "forklifts", icon="F"), asset("robot", "Arm", colour="#c2410c")]
    server.rules, server.file_rules = [TOO_NEAR], [IN_FILE]
    server.alarms = [
        alarm("near", "forklift~robot", "critical", "Linde 3 and Arm are 1.4 m apart", tags=["forklift", "robot"]),
        alarm("crowded", "zone-dock", "warning", "5 tags are in Dock", zone="dock", acknowledged_unix_s=1.0),
    ]
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
    server.refusal = "rule 'near': hours are wrong"
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
    shown.visit.problems.clear()  # the browser's own lines about the answers 400
    assert shown.found == {}
