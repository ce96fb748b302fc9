"""Zones are drawn with mouse, finger and keyboard, named, moved, deleted; events are listed."""

import json
import time
from pathlib import Path

import numpy as np
import page_site as made_up
import pytest
from page_browser import THREE_FRAMES, until
from page_server import DOCK
from scipy.spatial import ConvexHull

pytestmark = pytest.mark.statistical


@pytest.fixture
def hall(serve, visit):
    server = serve(tags=1)
    return server, visit(server)


def wait_for_put(server, count=1):
    until = time.monotonic() + 5
    while len(server.stored) < count:
        assert time.monotonic() < until, "no zones came"
        time.sleep(0.02)
    return server.stored[-1]["zones"]


def near(polygon, expected):
    assert len(polygon) == len(expected)
    for (x1, y1), (x2, y2) in zip(polygon, expected, strict=True):
        assert abs(x1 - x2) <= 0.06
        assert abs(y1 - y2) <= 0.06


def test_a_zone_is_drawn_with_the_mouse(hall):
    server, visit = hall
    visit.page.click("#draw")
    corners = [(3, 3), (7, 3), (7, 6), (3, 6)]
    for corner in (*corners, corners[0]):
        visit.page.mouse.click(*visit.at(*corner))
    zones = wait_for_put(server)
    assert zones[0] == DOCK
    near(zones[1]["polygon_m"], corners)
    assert zones[1]["name"] == "Zone 2"
    until(visit.page, "skyless.state.zones.length === 2")


def test_a_zone_is_drawn_with_the_keyboard(hall):
    server, visit = hall
    keyboard = visit.page.keyboard
    visit.page.focus("#canvas")
    keyboard.press("z")
    start = visit.page.evaluate("import('/page/map/editor.js').then(({ editor }) => editor.cursor)")
    keyboard.press("Enter")
    for arrow, times in (("ArrowRight", 4), ("ArrowUp", 3), ("ArrowLeft", 4)):
        for _ in range(times):
            keyboard.press(arrow)
        keyboard.press("Enter")
    keyboard.press("f")
    x, y = start
    near(wait_for_put(server)[1]["polygon_m"], [(x, y), (x + 2, y), (x + 2, y + 1.5), (x, y + 1.5)])


def test_a_zone_is_drawn_with_a_finger(serve, visit):
    server = serve(tags=1)
    phone = visit(server, viewport={"width": 360, "height": 740}, has_touch=True)
    phone.page.tap("#draw")
    corners = [(3, 3), (9, 3), (6, 7)]
    for corner in corners:
        phone.page.touchscreen.tap(*phone.at(*corner))
    phone.page.tap("#drawing-finish")
    near(wait_for_put(server)[1]["polygon_m"], corners)


def test_escape_cancels_a_drawing(hall):
    server, visit = hall
    visit.page.click("#draw")
    visit.page.mouse.click(*visit.at(3, 3))
    visit.page.keyboard.press("Escape")
    visit.page.locator("#drawing").wait_for(state="hidden")
    assert server.stored == []


def test_a_corner_is_dragged_and_typed(hall):
    server, visit = hall
    page = visit.page
    page.mouse.click(*visit.at(19, 3))
    until(page, "skyless.state.selection.zone === 'dock'")
    x, y = visit.at(21, 6)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 2, y + 3)  # a click, not a drag
    page.mouse.up()
    page.evaluate(THREE_FRAMES)
    assert page.evaluate("skyless.state.zones") == server.zones == [DOCK]
    until(page, "skyless.state.selection.zone === 'dock'")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(*visit.at(22, 7), steps=4)
    page.mouse.up()
    near(wait_for_put(server)[0]["polygon_m"], [(14, 2.5), (21, 2.5), (22, 7), (14, 6)])
    corner = page.get_by_label("Corner 1, x in metres")
    corner.fill("13.5")
    corner.press("Enter")
    near(wait_for_put(server, 2)[0]["polygon_m"], [(13.5, 2.5), (21, 2.5), (22, 7), (14, 6)])


def test_a_zone_is_renamed_deleted_and_brought_back(hall):
    server, visit = hall
    page = visit.page
    page.click("#tab-zones")
    name = page.get_by_label("Name of the zone")
    name.fill("Loading dock")
    name.press("Enter")
    assert wait_for_put(server)[0] == {**DOCK, "name": "Loading dock"}
    page.click("#panel-zones .zones >> text=Delete")
    assert wait_for_put(server, 2) == []
    page.click("#toasts >> text=Undo")
    assert wait_for_put(server, 3) == [{**DOCK, "name": "Loading dock"}]


def test_a_zone_is_not_brought_back_into_a_replay(hall):
    server, visit = hall
    page = visit.page
    page.click("#tab-zones")
    page.click("#panel-zones .zones >> text=Delete")
    assert wait_for_put(server) == []
    page.evaluate("import('/page/player.js').then(({ open }) => open('walk.mcap'))")
    until(page, "skyless.state.mode === 'replay'")
    page.click("#toasts >> text=Undo")
    page.wait_for_selector("#toasts >> text=on the live site only")
    assert server.zones == []
    assert page.evaluate("skyless.state.zones") == [DOCK]


def test_zones_that_the_server_refuses_are_taken_back(hall):
    server, visit = hall
    server.zone_error = "zone 'dock' crosses itself"
    visit.page.click("#tab-zones")
    visit.page.click("#panel-zones .zones >> text=Delete")
    visit.page.wait_for_selector("text=Not stored: zone 'dock' crosses itself")
    assert visit.page.evaluate("skyless.state.zones.length") == 1
    visit.problems.clear()  # the browser's own line about the answer 400


def test_events_are_listed_the_newest_first(hall):
    server, visit = hall
    visit.page.click("#tab-zones")
    event = {"type": "zone_event", "zone": "dock", "name": "Dock", "tag": "forklift", "position_m": [15, 3, 1]}
    server.send({**event, "kind": "enter", "unix_s": 1_780_000_000.0})
    server.send({**event, "kind": "leave", "unix_s": 1_780_000_009.0})
    until(visit.page, "document.querySelectorAll('#events li').length === 2")
    lines = visit.page.locator("#events li").all_inner_texts()
    assert "left Dock" in lines[0]
    assert "entered Dock" in lines[1]


def test_zones_of_another_site_are_not_shown_but_can_be_copied(hall):
    server, visit = hall
    page = visit.page
    door = {**DOCK, "name": "Door"}
    server.send({"type": "zones", "zones": [], "other_zones": [{"site": "Lab", "zones": [door]}], "zones_fault": None})
    page.click("#tab-zones")
    page.wait_for_selector("text=Site Lab: 1 zone")
    assert page.evaluate("skyless.state.zones.length") == 0
    page.click("text=Copy here")
    assert wait_for_put(server) == [door]
    assert server.stored[0]["site"] == "Hall 7", "zones are stored for the site that the page shows"


def test_zones_that_the_broker_keeps_and_nobody_can_read_are_not_drawn_over(hall):
    server, visit = hall
    fault = "the zones that the broker keeps at skyless/v1/7/zones cannot be read: this is no list of zones"
    server.send({"type": "zones", "zones": [], "other_zones": [], "zones_fault": fault})
    visit.page.click("#tab-zones")
    visit.page.wait_for_selector(f"text=T{fault[1:]}.")
    assert visit.page.locator("#add-zone").is_disabled()
    server.send({"type": "zones", "zones": [], "other_zones": [], "zones_fault": None})
    visit.page.wait_for_selector("#add-zone:enabled")


def test_zones_are_exported_and_imported(hall, tmp_path):
    server, visit = hall
    page = visit.page
    page.click("#tab-zones")
    with page.expect_download() as found:
        page.click("text=Export")
    assert found.value.suggested_filename == "zones-Hall-7.json"
    file = tmp_path / "zones.json"
    file.write_bytes(Path(found.value.path()).read_bytes())
    assert json.loads(file.read_bytes()) == {"zones": [DOCK], "site": "Hall 7"}
    page.set_input_files("#panel-zones input[type=file]", file)
    first, second = wait_for_put(server)
    assert first == DOCK
    assert second == {**DOCK, "id": second["id"]}
    assert second["id"] != "dock"
    file.write_text("no")
    page.set_input_files("#panel-zones input[type=file]", file)
    page.wait_for_selector("text=zones.json holds no zones.")
    assert len(server.stored) == 1


def row(number, x, y, std_m=0.1, alert=None):
    """A state of a tag that is carried around."""
    _, _, _, *fields = made_up.state_row("walker", 0, 0.0, time.time() - 1.0 + 0.001 * number)
    fields[6], fields[14] = std_m, alert
    return ["walker", x, y, *fields]


def test_a_zone_is_walked(hall):
    """Its edges are outside of the walk; positions that may be wrong count for nothing."""
    server, visit = hall
    page = visit.page
    server.send({"type": "state", "unix_s": time.time(), "tags": [row(0, 0, 0)]})
    until(page, "skyless.live.all.has('walker')")
    page.click("#tab-zones")
    page.select_option("#outline-tag", "walker")
    page.click("#outline")
    sides = [(x, y) for step in range(11) for x, y in ((3 + 0.4 * step, 3), (7, 3 + 0.3 * step), (3, 6 - 0.3 * step))]
    rows = [row(n + 1, *at) for n, at in enumerate([*sides, (7, 6), (3, 6)])]
    wrong = [row(70, 20, 12, alert="detected-not-excluded"), row(71, 20, 12, std_m=1.2)]
    server.send({"type": "state", "unix_s": time.time(), "tags": [*rows, *wrong]})
    page.wait_for_selector("text=35 good positions so far.")
    page.fill("#outline-margin", "9")
    page.click("#outline:text-is('Stop')")
    page.wait_for_selector("text=The margin is 9; it should be 0 to 5 m")
    page.fill("#outline-margin", "0.5")
    page.click("#outline")
    zone = wait_for_put(server)[1]
    octagon = [
        (x, y) for x in (2.5, 2.8, 7.2, 7.5) for y in (2.5, 2.8, 6.2, 6.5) if (x in {2.5, 7.5}) != (y in {2.5, 6.5})
    ]
    near(sorted(zone["polygon_m"]), sorted(octagon))
    until(page, "id => skyless.state.selection.zone === id", arg=zone["id"])
    page.click("#outline:text-is('Record outline')")
    page.click("#outline")
    page.wait_for_selector("text=No zone: The tag had 0 good positions; an outline needs 10.")


def test_the_outline_of_a_noisy_walk_holds_it_and_has_few_corners(hall):
    rng = np.random.default_rng(5)
    angles = np.linspace(0, 2 * np.pi, 3000)
    for radius_m, most in ((4.0, 40), (400.0, 100)):
        walked = radius_m * np.column_stack([np.cos(angles), np.sin(angles)]) + 0.1 * rng.standard_normal((3000, 2))
        outline = (
            "([points, margin]) => import('/page/map/outline.js').then(({ outlineOf }) => outlineOf(points, margin))"
        )
        corners = np.array(hall[1].page.evaluate(outline, [walked.tolist(), 0.3]))
        assert len(corners) <= most
        edges = np.roll(corners, -1, axis=0) - corners
        apart = walked[:, None] - corners
        left_m = (edges[:, 0] * apart[..., 1] - edges[:, 1] * apart[..., 0]) / np.hypot(*edges.T)
        assert left_m.min() > 0.2
        hull = ConvexHull(walked)
        grown_m2 = hull.volume + 0.3 * hull.area + np.pi * 0.3**2  # of a convex shape, by Steiner's formula
        assert ConvexHull(corners).volume == pytest.approx(grown_m2, rel=0.01)
    fault = hall[1].page.evaluate(f"({outline})([Array(20).fill([1, 2]), 0.3]).catch(({{ message }}) => message)")
    assert fault == "The walk spans 0.00 m²; an outline needs 0.25 m²: walk around the place."
