"""Alarms: the count, the line, the list, acknowledging, marks on the map, and the editor of rules. Simulated."""

import time

import pytest
from page_browser import THREE_FRAMES, until
from test_page_assets import asset, wait_for_puts

pytestmark = pytest.mark.statistical

TOO_NEAR = {"id": "too-near", "kind": "near", "name": "Too near", "tags": ["group:forklifts"], "limit": 2.0}
IN_FILE = {"id": "anchors", "kind": "anchor-offline", "name": "Anchors", "after_s": 10}


def alarm(kind, subject, severity, sentence, ago_s=60.0, **more):
    now = time.time()
    return {
        "id": f"{kind}-{subject}-{int(1e3 * (now - ago_s))}", "rule": kind, "name": kind, "kind": kind,
        "severity": severity, "subject": subject, "since_unix_s": now - ago_s, "unix_s": now - ago_s,
        "sentence": sentence, "tags": [], "zone": None, "place": "", "position_m": None, "ended_unix_s": None,
        "acknowledged_unix_s": None, "acknowledged_by": "", **more,
    }  # fmt: skip


@pytest.fixture
def hall(serve, visit):
    server = serve(tags=3)
    server.assets = [asset("forklift", "Linde 3", "forklifts"), asset("robot", "Arm", "robots")]
    server.rules, server.file_rules = [TOO_NEAR], [IN_FILE]
    return server, visit(server)


def lines(page):
    return page.locator(".alarms li button.name").all_inner_texts()


def test_beside_alarms_positions_are_good_and_not_all_is_well(hall):
    server, visit = hall
    words = "document.getElementById('condition-words').textContent"
    first, other = (alarm("silent", tag, "warning", f"{tag} is silent", tags=[tag]) for tag in ("robot", "forklift"))
    seen = first | {"acknowledged_unix_s": time.time()}
    for alarms, said in (
        ([first], "Positions are good; 1 alarm."),
        ([first, other], "Positions are good; 2 alarms."),
        ([seen], "Positions are good; 1 acknowledged alarm."),
        ([seen | {"ended_unix_s": time.time()}], "All is well: nothing speaks against the positions shown."),
    ):
        server.alarms = alarms
        server.send_site_messages()
        until(visit.page, f"said => {words} === said", said)


def test_alarms_are_raised_shown_and_acknowledged(hall):
    server, visit = hall
    page = visit.page
    until(page, "skyless.live.all.size === 3")
    assert page.locator("#alarm-count").is_hidden()
    assert page.locator("#alarm-line").is_hidden()
    server.alarms = [
        alarm("anchor-offline", "anchor-8", "warning", "Anchor 8 is offline", 900.0, acknowledged_unix_s=time.time(),
              acknowledged_by="Bea"),
        alarm("silent", "robot", "info", "Arm has sent nothing for 10 s", tags=["robot"], ended_unix_s=time.time()),
        alarm("crowded", "zone-dock", "warning", "5 tags are in Dock", 400.0, zone="dock"),
        alarm("near", "forklift~trolley", "critical", "Linde 3 and trolley are 1.4 m apart", 20.0,
              tags=["forklift", "trolley"]),
    ]  # fmt: skip
    server.send_site_messages()
    page.wait_for_selector("#alarm-line:has-text('Critical: Linde 3 and trolley are 1.4 m apart.')")
    assert page.locator("#condition-line").is_hidden(), "nothing says that all is well"
    assert page.locator("#pill-words").inner_text() == "Live"
    assert "Alarm" in page.title()
    assert page.locator("#alarm-count span").inner_text() == page.locator("#tab-alarms .unread").inner_text() == "3"
    page.set_viewport_size({"width": 390, "height": 844})
    for part in ("#alarm-count", "#tab-alarms .unread", "#alarm-line"):
        box = page.locator(part).bounding_box()
        assert 0 <= box["x"] < box["x"] + box["width"] <= 390
    page.set_viewport_size({"width": 1280, "height": 800})
    page.click("#alarm-count")
    assert page.locator("#panel-alarms").is_visible()
    assert lines(page) == [
        "Linde 3 and trolley are 1.4 m apart.", "5 tags are in Dock.", "Arm has sent nothing for 10 s.",
        "Anchor 8 is offline.",
    ]  # fmt: skip
    assert "Linde 3, trolley" in page.locator(".alarms li").first.inner_text()
    assert "acknowledged by Bea" in page.locator(".alarms li").last.inner_text()
    page.get_by_label("Which alarms").select_option("rule crowded")
    until(page, "document.querySelectorAll('.alarms li').length === 1")
    page.click(".alarms li button.name")
    until(page, "skyless.state.selection.zone === 'dock'")
    page.click("#tab-alarms")
    page.get_by_label("Which alarms").select_option("")
    page.click(".alarms li:has-text('apart') >> text=Acknowledge")
    assert page.evaluate("document.activeElement.id") == "acknowledged-by"
    assert server.puts == []
    page.keyboard.type("Ann")  # the field has the focus
    page.click(".alarms li:has-text('apart') >> text=Acknowledge")
    assert wait_for_puts(server) == {"id": server.alarms[3]["id"], "by": "Ann"}
    page.locator("#alarm-line").wait_for(state="hidden")
    page.click("text=Acknowledge all 2 shown")
    wait_for_puts(server, 3)
    until(page, "document.querySelector('#alarm-count span').textContent === '0'")
    assert page.locator("#alarm-count").is_visible(), "alarms that last stay counted"
    page.click("#panel-alarms .alarms li:has-text('apart') button.name")
    until(page, "skyless.state.selection.tag === 'forklift'")
    page.reload()
    until(page, "window.skyless?.state.alarms.length === 4")
    page.click("#tab-alarms")
    assert page.locator("#acknowledged-by").input_value() == "Ann"


def test_active_alarms_are_marked_on_the_map(hall):
    server, visit = hall
    page = visit.page
    until(page, "skyless.live.all.size === 3")
    server.alarms = [
        alarm("anchor-moved", "anchor-8", "critical", "Anchor 8 has moved"),
        alarm("crowded", "zone-dock", "warning", "5 tags are in Dock", zone="dock"),
        alarm("silent", "gone", "critical", "gone has sent nothing", tags=["gone"], position_m=[3.0, 5.0, 1.0]),
        alarm("battery", "robot", "warning", "Battery low", tags=["robot"], ended_unix_s=time.time()),
    ]
    server.send_site_messages()
    until(page, "skyless.state.alarms.length === 4")
    page.evaluate(THREE_FRAMES)  # the line of alarms makes the map lower
    marks = """async (still) => {
      const { drawAlarms } = await import("/page/map/alarms.js");
      const { toSite } = await import("/page/map/view.js");
      const found = [];
      const nothing = () => {};
      drawAlarms({ beginPath: nothing, stroke: nothing, fill: nothing, fillText: nothing,
                   arc: (x, y, radius) => radius > 10 && found.push(toSite(x, y)) }, still);
      return found;
    }"""
    (anchor, dock) = sorted(page.evaluate(marks, True), key=lambda at: -at[0])
    assert anchor == pytest.approx([23, 13])
    assert dock[0] == pytest.approx(17.5)
    assert page.evaluate(marks, False) == [pytest.approx([3, 5])]


def test_rules_are_made_changed_and_deleted(hall):
    server, visit = hall
    page = visit.page
    until(page, "skyless.live.all.size === 3")
    page.click("#tab-alarms")
    panel = page.locator("#panel-alarms")
    assert panel.locator(".rules li:has-text('Anchors')").inner_text().endswith("site file")
    assert "group forklifts" in panel.locator(".rules li:has-text('Too near')").inner_text()
    page.click("#add-rule")
    form = panel.locator("form")
    shown = {
        "inside": (True, True, False, False), "near": (False, True, True, True), "battery": (False, True, False, True),
        "anchor-moved": (False, False, False, False), "crowded": (True, True, False, True),
    }  # fmt: skip
    for kind, fields in shown.items():
        form.get_by_label("Raised when").select_option(kind)
        labels = ("Zone", "Tags and groups", "Not near to", "Ends when back by")
        assert tuple(form.get_by_label(label, exact=True).is_visible() for label in labels) == fields, kind
    for label, value in (("Name", "Dock is full"), ("Zone", "dock"), ("Most tags allowed (tags)", "4")):
        form.get_by_role("button", name="Save").click()
        missing = form.get_by_label(label, exact=True)
        assert missing.evaluate("field => field === document.activeElement && !field.validity.valid"), label
        missing.select_option(value) if label == "Zone" else missing.fill(value)
    assert server.puts == []
    form.get_by_label("Tags and groups").select_option("group:forklifts")
    form.get_by_label("Tags and groups").select_option("Arm")
    form.get_by_label("Tags and groups").select_option("trolley")
    form.get_by_label("Remove trolley").click()
    form.get_by_label("Severity").select_option("critical")
    form.get_by_label("Hours").fill("mon 25:00")
    server.refusal = "rule 'dock-is-full': hours are 'mon 25:00'; they should be as mon-fri 06:00-18:00"
    form.get_by_role("button", name="Save").click()
    page.wait_for_selector("form .fault:has-text('they should be as mon-fri')")
    server.refusal = None
    visit.problems.clear()  # the browser's own line about the answer 400
    form.get_by_label("Hours").fill("mon 05:00-06:00")
    form.get_by_role("button", name="Save").click()
    made = {
        "id": "dock-is-full", "kind": "crowded", "name": "Dock is full", "zone": "dock",
        "tags": ["group:forklifts", "robot"], "limit": 4, "hysteresis": 0, "after_s": 0, "clear_after_s": 1,
        "hours": "mon 05:00-06:00", "severity": "critical",
    }  # fmt: skip
    assert wait_for_puts(server) == {"rules": [TOO_NEAR, made], "site": "Hall 7"}
    panel.get_by_label("Edit Too near").click()
    form.get_by_label("Distance (m)").fill("3")
    server.rules = [
        {**TOO_NEAR, "limit": 2.5},
        {**made, "limit": 5},
    ]  # another page, of which this one has not heard yet
    form.get_by_role("button", name="Save").click()
    page.wait_for_selector("form .fault:has-text('another page has changed')")
    assert len(server.puts) == 1
    form.get_by_role("button", name="Save").click()
    assert [rule["limit"] for rule in wait_for_puts(server, 2)["rules"]] == [3, 5]
    panel.get_by_label("Delete Dock is full").click()
    assert [rule["id"] for rule in wait_for_puts(server, 3)["rules"]] == ["too-near"]
    page.click("#toasts >> text=Undo")
    assert [rule["id"] for rule in wait_for_puts(server, 4)["rules"]] == ["too-near", "dock-is-full"]
