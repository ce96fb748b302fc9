"""A person sees an alarm, acknowledges it, and makes rules."""

import time

import pytest
from page_browser import PHONE, WINDOW
from page_site import alarm, asset

pytestmark = pytest.mark.statistical

TOO_NEAR = {"id": "too-near", "kind": "near", "name": "Too near", "tags": ["group:forklifts"], "limit": 2.0}
IN_FILE = {"id": "anchors", "kind": "anchor-offline", "name": "Anchors", "after_s": 10}


@pytest.fixture
def hall(serve, visit):
    known = [asset("forklift", "Linde 3", "forklifts"), asset("robot", "Arm", "robots")]
    server = serve(assets=known, rules=[TOO_NEAR], file_rules=[IN_FILE])
    shown = visit(server)
    shown.until("skyless.live.all.size === 3")
    return server, shown


def test_alarms_are_raised_shown_and_acknowledged(hall):
    server, visit = hall
    page, now = visit.page, time.time()
    page.locator("#alarm-count").wait_for(state="hidden")
    page.locator("#alarm-line").wait_for(state="hidden")
    server.alarms = [
        alarm("anchor-offline", "anchor-8", "warning", "Anchor 8 is offline", 900.0, acknowledged_unix_s=now,
              acknowledged_by="Bea"),
        alarm("silent", "robot", "info", "Arm has sent nothing for 10 s", tags=["robot"], ended_unix_s=now),
        alarm("crowded", "zone-dock", "warning", "5 tags are in Dock", 400.0, zone="dock"),
        alarm("near", "forklift~trolley", "critical", "Linde 3 and trolley are 1.4 m apart", 20.0,
              tags=["forklift", "trolley"]),
    ]  # fmt: skip
    server.send()
    page.wait_for_selector("#alarm-line:has-text('Critical: Linde 3 and trolley are 1.4 m apart.')")
    page.locator("#condition-line").wait_for(state="hidden")  # nothing says that all is well
    assert page.locator("#pill-words").inner_text() == "Live"
    assert page.locator("#alarm-count span").inner_text() == page.locator("#tab-alarms .unread").inner_text() == "3"
    page.set_viewport_size(PHONE)
    for part in ("#alarm-count", "#tab-alarms .unread", "#alarm-line"):
        box = page.locator(part).bounding_box()
        assert 0 <= box["x"] < box["x"] + box["width"] <= PHONE["width"]
    page.set_viewport_size(WINDOW)
    page.click("#alarm-count")
    page.locator("#panel-alarms").wait_for()
    assert visit.texts(".alarms li button.name") == [
        "Linde 3 and trolley are 1.4 m apart.", "5 tags are in Dock.", "Arm has sent nothing for 10 s.",
        "Anchor 8 is offline.",
    ]  # fmt: skip
    assert "Linde 3, trolley" in page.locator(".alarms li").first.inner_text()
    assert "acknowledged by Bea" in page.locator(".alarms li").last.inner_text()
    page.get_by_label("Which alarms").select_option("rule crowded")
    visit.until("document.querySelectorAll('.alarms li').length === 1")
    page.click(".alarms li button.name")
    visit.until("skyless.state.selection.zone === 'dock'")
    page.click("#tab-alarms")
    page.get_by_label("Which alarms").select_option("")
    page.click(".alarms li:has-text('apart') >> text=Acknowledge")
    assert page.evaluate("document.activeElement.id") == "acknowledged-by"
    assert not server.bodies["acknowledge"]
    page.keyboard.type("Ann")  # the field has the focus
    page.click(".alarms li:has-text('apart') >> text=Acknowledge")
    assert server.body("acknowledge") == {"id": server.alarms[3]["id"], "by": "Ann"}
    page.locator("#alarm-line").wait_for(state="hidden")
    page.click("text=Acknowledge all 2 shown")
    server.body("acknowledge", 3)
    visit.until("document.querySelector('#alarm-count span').textContent === '0'")
    page.locator("#alarm-count").wait_for()  # alarms that last stay counted
    page.click("#panel-alarms .alarms li:has-text('apart') button.name")
    visit.until("skyless.state.selection.tag === 'forklift'")
    page.reload()
    visit.until("window.skyless?.state.alarms.length === 4")
    page.click("#tab-alarms")
    assert page.locator("#acknowledged-by").input_value() == "Ann"


def test_rules_are_made_changed_and_deleted(hall):
    server, visit = hall
    page = visit.page
    page.click("#tab-alarms")
    panel = page.locator("#panel-alarms")
    assert panel.locator(".rules li:has-text('Anchors')").inner_text().endswith("site file")
    assert "group forklifts" in panel.locator(".rules li:has-text('Too near')").inner_text()
    page.click("#add-rule")
    form = panel.locator("form")
    field = form.get_by_label
    save = form.get_by_role("button", name="Save")
    shown = {
        "inside": (True, True, False, False), "near": (False, True, True, True), "battery": (False, True, False, True),
        "anchor-moved": (False, False, False, False), "crowded": (True, True, False, True),
    }  # fmt: skip
    for kind, fields in shown.items():
        field("Raised when").select_option(kind)
        labels = ("Zone", "Tags and groups", "Not near to", "Ends when back by")
        assert tuple(field(label, exact=True).is_visible() for label in labels) == fields, kind
    for label, value in (("Name", "Dock is full"), ("Zone", "dock"), ("Most tags allowed (tags)", "4")):
        save.click()
        missing = field(label, exact=True)
        assert missing.evaluate("field => field === document.activeElement && !field.validity.valid"), label
        missing.select_option(value) if label == "Zone" else missing.fill(value)
    assert not server.bodies["alarm_rules"]
    for one in ("group:forklifts", "Arm", "trolley"):
        field("Tags and groups").select_option(one)
    field("Remove trolley").click()
    field("Severity").select_option("critical")
    field("Hours").fill("mon 25:00")
    words = "hours are 'mon 25:00'; they should be as mon-fri 06:00-18:00"
    server.errors["alarm_rules"] = f"rule 'dock-is-full': {words}"
    save.click()
    page.wait_for_selector("form .fault:has-text('they should be as mon-fri')")
    server.errors.clear()
    visit.forgive()
    field("Hours").fill("mon 05:00-06:00")
    save.click()
    made = {
        "id": "dock-is-full", "kind": "crowded", "name": "Dock is full", "zone": "dock",
        "tags": ["group:forklifts", "robot"], "limit": 4, "hysteresis": 0, "after_s": 0, "clear_after_s": 1,
        "hours": "mon 05:00-06:00", "severity": "critical",
    }  # fmt: skip
    assert server.body("alarm_rules") == {"rules": [TOO_NEAR, made], "site": "Hall 7"}
    panel.get_by_label("Edit Too near").click()
    field("Distance (m)").fill("3")
    server.rules = [{**TOO_NEAR, "limit": 2.5}, {**made, "limit": 5}]  # another page's, of which this one has not heard
    save.click()
    page.wait_for_selector("form .fault:has-text('another page has changed')")
    assert len(server.bodies["alarm_rules"]) == 1
    save.click()
    assert [rule["limit"] for rule in server.body("alarm_rules", 2)["rules"]] == [3, 5]
    panel.get_by_label("Delete Dock is full").click()
    assert [rule["id"] for rule in server.body("alarm_rules", 3)["rules"]] == ["too-near"]
    page.click("#toasts >> text=Undo")
    assert [rule["id"] for rule in server.body("alarm_rules", 4)["rules"]] == ["too-near", "dock-is-full"]
