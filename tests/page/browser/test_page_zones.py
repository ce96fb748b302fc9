"""A person draws zones with mouse, finger and keyboard, names, moves, deletes, keeps and copies them, and walks one."""

import json
import time

import page_site as made_up
import pytest
from page_site import DOCK

pytestmark = pytest.mark.statistical


@pytest.fixture
def hall(serve, visit):
    server = serve(tags=1)
    return server, visit(server)


def near(polygon, expected):
    assert len(polygon) == len(expected)
    for one, other in zip(polygon, expected, strict=True):
        assert one == pytest.approx(other, abs=0.06)


def stored(server, count=1):
    return server.body("zones", count)["zones"]


def test_a_zone_is_drawn_with_the_mouse_and_the_keyboard(hall):
    server, visit = hall
    page = visit.page
    page.click("#draw")
    page.mouse.click(*visit.at(3, 3))
    page.keyboard.press("Escape")
    page.locator("#drawing").wait_for(state="hidden")
    assert not server.bodies["zones"]
    page.click("#draw")
    corners = [(3, 3), (7, 3), (7, 6), (3, 6)]
    for corner in (*corners, corners[0]):
        page.mouse.click(*visit.at(*corner))
    dock, drawn = stored(server)
    assert (dock, drawn["name"]) == (DOCK, "Zone 2")
    near(drawn["polygon_m"], corners)
    visit.until("skyless.state.zones.length === 2")
    page.focus("#canvas")
    page.keyboard.press("z")
    x, y = visit.run("map/editor", "return editor.editor.cursor;")
    page.keyboard.press("Enter")
    for arrow, times in (("ArrowRight", 4), ("ArrowUp", 3), ("ArrowLeft", 4)):
        for _ in range(times):
            page.keyboard.press(arrow)
        page.keyboard.press("Enter")
    page.keyboard.press("f")
    near(stored(server, 2)[2]["polygon_m"], [(x, y), (x + 2, y), (x + 2, y + 1.5), (x, y + 1.5)])


def test_a_zone_is_drawn_with_a_finger(serve, visit):
    server = serve(tags=1)
    phone = visit(server, viewport={"width": 360, "height": 740}, has_touch=True)
    phone.page.tap("#draw")
    corners = [(3, 3), (9, 3), (6, 7)]
    for corner in corners:
        phone.page.touchscreen.tap(*phone.at(*corner))
    phone.page.tap("#drawing-finish")
    near(stored(server)[1]["polygon_m"], corners)


def test_a_zone_is_moved_renamed_deleted_and_brought_back_on_the_live_site_only(hall):
    server, visit = hall
    page = visit.page
    page.mouse.click(*visit.at(19, 3))
    visit.until("skyless.state.selection.zone === 'dock'")
    x, y = visit.at(21, 6)
    visit.drag((x, y), (x - 2, y + 3))  # a click, not a drag
    visit.frames()
    assert page.evaluate("skyless.state.zones") == server.zones == [DOCK]
    visit.until("skyless.state.selection.zone === 'dock'")
    visit.drag((x, y), visit.at(22, 7))
    near(stored(server)[0]["polygon_m"], [(14, 2.5), (21, 2.5), (22, 7), (14, 6)])
    for label, value in (("Corner 1, x in metres", "13.5"), ("Name of the zone", "Loading dock")):
        page.get_by_label(label).fill(value)
        page.get_by_label(label).press("Enter")
    (changed,) = stored(server, 3)
    assert changed["name"] == "Loading dock"
    near(changed["polygon_m"], [(13.5, 2.5), (21, 2.5), (22, 7), (14, 6)])
    delete = "#panel-zones .zones >> text=Delete"
    page.click(delete)
    assert stored(server, 4) == []
    page.click("#toasts >> text=Undo")
    assert stored(server, 5) == [changed]
    server.errors["zones"] = "zone 'dock' crosses itself"
    page.click(delete)
    page.wait_for_selector("text=Not stored: zone 'dock' crosses itself")
    assert page.evaluate("skyless.state.zones.length") == 1
    visit.forgive()
    server.errors.clear()
    page.click(delete)
    assert stored(server, 6) == []
    visit.run("player", "return player.open('walk.mcap');")
    visit.until("skyless.state.mode === 'replay'")
    page.click("#toasts .toast:has-text('Undo') >> text=Undo")
    page.wait_for_selector("#toasts >> text=on the live site only")
    assert server.zones == []
    assert page.evaluate("skyless.state.zones") == [DOCK]


def test_zones_are_listed_with_events_copied_from_another_site_saved_and_read(hall, tmp_path):
    server, visit = hall
    page = visit.page
    page.click("#tab-zones")
    event = {"type": "zone_event", "zone": "dock", "name": "Dock", "tag": "forklift", "position_m": [15, 3, 1]}
    server.send({**event, "kind": "enter", "unix_s": 1.78e9}, {**event, "kind": "leave", "unix_s": 1.78e9 + 9})
    visit.until("document.querySelectorAll('#events li').length === 2")
    newest, oldest = visit.texts("#events li")
    assert ("left Dock" in newest, "entered Dock" in oldest) == (True, True)
    name, content = visit.saved("text=Export")
    assert (name, json.loads(content)) == ("zones-Hall-7.json", {"zones": [DOCK], "site": "Hall 7"})
    file = tmp_path / "zones.json"
    file.write_bytes(content)
    page.set_input_files("#panel-zones input[type=file]", file)
    first, second = stored(server)
    assert (first, second) == (DOCK, {**DOCK, "id": second["id"]})
    assert second["id"] != "dock"
    file.write_bytes(b"no")
    page.set_input_files("#panel-zones input[type=file]", file)
    page.wait_for_selector("text=zones.json holds no zones.")

    door = {**DOCK, "name": "Door"}
    zones = {"type": "zones", "zones": [], "other_zones": [{"site": "Lab", "zones": [door]}], "zones_fault": None}
    server.send(zones)
    page.wait_for_selector("text=Site Lab: 1 zone")
    assert page.evaluate("skyless.state.zones.length") == 0
    page.click("text=Copy here")
    assert server.body("zones", 2) == {"zones": [door], "site": "Hall 7"}, "for the site that the page shows"
    fault = "the zones that the broker keeps at skyless/v1/7/zones cannot be read: this is no list of zones"
    server.send({**zones, "zones_fault": fault})
    page.wait_for_selector(f"text=T{fault[1:]}.")
    assert page.locator("#add-zone").is_disabled(), "what nobody can read is not drawn over"
    server.send(zones)
    page.wait_for_selector("#add-zone:enabled")


def row(number, x, y, std_m=0.1, alert=None):
    """A state of a tag that is carried around."""
    _, _, _, *fields = made_up.state_row("walker", 0, 0.0, time.time() - 1.0 + 0.001 * number)
    fields[6], fields[14] = std_m, alert
    return ["walker", x, y, *fields]


def test_a_zone_is_walked(hall):
    """Its edges are outside of the walk; positions that may be wrong count for nothing."""
    server, visit = hall
    page = visit.page

    def send(*rows):
        server.send({"type": "state", "unix_s": time.time(), "tags": rows})

    send(row(0, 0, 0))
    visit.until("skyless.live.all.has('walker')")
    page.click("#tab-zones")
    page.select_option("#outline-tag", "walker")
    page.click("#outline")
    sides = [(x, y) for step in range(11) for x, y in ((3 + 0.4 * step, 3), (7, 3 + 0.3 * step), (3, 6 - 0.3 * step))]
    good = [row(n + 1, *at) for n, at in enumerate([*sides, (7, 6), (3, 6)])]
    send(*good, row(70, 20, 12, alert="detected-not-excluded"), row(71, 20, 12, std_m=1.2))
    page.wait_for_selector("text=35 good positions so far.")
    page.fill("#outline-margin", "9")
    page.click("#outline:text-is('Stop')")
    page.wait_for_selector("text=The margin is 9; it should be 0 to 5 m")
    page.fill("#outline-margin", "0.5")
    page.click("#outline")
    zone = stored(server)[1]
    xs, ys = (2.5, 2.8, 7.2, 7.5), (2.5, 2.8, 6.2, 6.5)
    octagon = [(x, y) for x in xs for y in ys if (x in {2.5, 7.5}) != (y in {2.5, 6.5})]
    near(sorted(zone["polygon_m"]), sorted(octagon))
    visit.until("id => skyless.state.selection.zone === id", arg=zone["id"])
    page.click("#outline:text-is('Record outline')")
    page.click("#outline")
    page.wait_for_selector("text=No zone: The tag had 0 good positions; an outline needs 10.")
