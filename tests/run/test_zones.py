"""Zones: polygons against Matplotlib and closed forms, which lists are refused, and when tags enter and leave."""

import json
import math
from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from matplotlib.path import Path
from msgspec.structs import replace

from skyless.core.site import FloorSite
from skyless.run.mqtt.messages import SiteZones, WrongMessageError, Zone, ZonesMessage
from skyless.run.zones import (
    CROSSING_S,
    MAX_OTHER_SITES,
    ZoneMonitor,
    area_m2,
    depth_m,
    floor_at,
    is_simple,
    perimeter_m,
    read_zones,
    signed_area_m2,
    zones_of,
)
from support.site_messages import a_fix, diagonal

pytestmark = pytest.mark.site

COORDINATE = st.floats(-50.0, 50.0).map(lambda value: round(value, 3))
POINT = st.tuples(COORDINATE, COORDINATE)


# Polygons


@st.composite
def stars(draw):
    """Simple polygons: corners in the order of their bearing from the middle."""
    radii = draw(st.lists(st.floats(0.5, 20.0), min_size=3, max_size=12))
    x0, y0 = draw(POINT)
    bearings = [2 * math.pi * (k + 0.3 * draw(st.floats(0.0, 1.0))) / len(radii) for k in range(len(radii))]
    return tuple((x0 + r * math.cos(b), y0 + r * math.sin(b)) for r, b in zip(radii, bearings, strict=True))


@given(stars(), POINT)
def test_depths_have_the_sign_of_matplotlib_and_the_size_of_a_search_along_the_sides(polygon, point):
    assert is_simple(polygon)
    depth = depth_m(point, polygon)
    assume(abs(depth) > 1e-9)
    assert (depth > 0.0) == Path([*polygon, polygon[0]], closed=True).contains_point(point)
    corners = np.array([*polygon, polygon[0]])
    share = np.linspace(0.0, 1.0, 201)[:, None, None]
    along = corners[:-1] + share * np.diff(corners, axis=0)
    sampled = np.linalg.norm(along - np.array(point), axis=-1).min()
    spacing = np.linalg.norm(np.diff(corners, axis=0), axis=1).max() / 200
    assert sampled - spacing <= abs(depth) <= sampled + 1e-9


@given(st.floats(0.1, 50.0), st.floats(0.1, 50.0), POINT)
def test_rectangles_have_the_area_and_perimeter_of_the_book(width, height, corner):
    x, y = corner
    rectangle = ((x, y), (x + width, y), (x + width, y + height), (x, y + height))
    assert signed_area_m2(rectangle) == area_m2(rectangle) == pytest.approx(width * height, rel=1e-6)
    assert -signed_area_m2(rectangle[::-1]) == area_m2(rectangle[::-1]) == pytest.approx(area_m2(rectangle))
    assert perimeter_m(rectangle) == pytest.approx(2 * (width + height))
    assert depth_m((x + width / 2, y + height / 2), rectangle) == pytest.approx(min(width, height) / 2)


def test_a_side_whose_square_is_zero_is_a_point():
    assert depth_m((0.5, 0.25), ((0.0, 0.0), (1e-200, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))) == 0.25


@pytest.mark.parametrize("count", [4, 5, 6])
def test_corners_of_a_regular_polygon_in_any_other_order_cross(count):
    corners = [(math.cos(k), math.sin(k)) for k in np.linspace(0.1, 6.0, count)]
    for order in permutations(range(count)):
        steps = {(b - a) % count for a, b in zip(order, (*order[1:], order[0]), strict=True)}
        assert is_simple(tuple(corners[k] for k in order)) == (steps in ({1}, {count - 1}))


@pytest.mark.parametrize(
    ("polygon", "simple"),
    [
        (((0, 0), (4, 1), (0, 2), (1, 1)), True),
        (((0, 0), (1, 0), (1, 1), (2, 1), (2, 0), (3, 0), (3, 2), (0, 2)), True),  # two sides in one line, apart
        (((0, 0), (1, 0), (2, 0)), False),  # no area
        (((0, 0), (1, 0), (1, 0), (1, 1)), False),  # a corner twice
        (((0, 0), (4, 0), (4, 4), (2, 0), (0, 4)), False),  # a corner on a side
        (((0, 0), (2, 0), (1, 0), (1, 1)), False),  # a side that runs back
        (((0, 0), (1, 0), (2, 1), (1, 0), (0, 1)), False),  # two corners in one place
    ],
)
def test_polygons_that_touch_themselves_are_not_simple(polygon, simple):
    """Whatever the corner that is first, the direction, the scale and the side that is up."""
    for first, step, size_m, sign, swap in product(range(len(polygon)), (1, -1), (1.0, 1e-3), (1, -1), (1, -1)):
        turned = (polygon[first:] + polygon[:first])[::step]
        assert (
            is_simple(tuple((size_m * corner[::swap][0], sign * size_m * corner[::swap][1]) for corner in turned))
            == simple
        )


# The list


GOOD = {"id": "a", "name": "A", "polygon_m": [[0, 0], [1, 0], [1, 1]]}
MANY_CORNERS = [[k, k * k] for k in range(101)]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"polygon_m": [[0, 0], [1, 0]]}, "zone 'A' has 2 corners; it should have 3 to 100"),
        ({"polygon_m": MANY_CORNERS}, "zone 'A' has 101 corners"),
        ({"polygon_m": [[0, 0], [1, 1], [1, 0], [0, 1]]}, "zone 'A' crosses or touches itself"),
        ({"polygon_m": [[0, 0], [100_000.1, 0], [1, 1]]}, "farther than 100000 m"),
        ({"polygon_m": [[0, 0], [0, -100_000.1], [1, 1]]}, "farther than 100000 m"),
        ({"id": "a/b"}, "id"),
        ({"id": "+"}, "id"),
        ({"id": "x" * 65}, "id"),
        ({"id": "", "name": ""}, "zone '' has an id that is not"),
        ({"name": "x" * 101}, f"zone '{'x' * 40}' has a name of more than 100 characters"),
        ({"colour": "red;background:url(x)"}, "colour"),
        ({"polygon_m": [[0, 0], [1, "x"], [1, 1]]}, "polygon_m"),
    ],
)
def test_a_wrong_zone_is_refused_with_a_reason_also_among_those_of_other_sites(change, expected):
    for zones in ({"zones": [GOOD, GOOD | change]}, {"zones": [], "others": [{"site": "s", "zones": [GOOD | change]}]}):
        with pytest.raises(WrongMessageError, match=expected):
            read_zones(json.dumps(zones).encode())


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b'{"zones": 1}',
        json.dumps({"zones": [GOOD]}).encode().replace(b"A", b"\xff"),
        json.dumps({"zones": [GOOD | {"polygon_m": [[0, 0], [math.nan, 0], [1, 1]]}]}).encode(),
    ],
)
def test_anything_but_a_list_of_zones_is_refused(payload):
    with pytest.raises(WrongMessageError):
        read_zones(payload)


def test_ids_are_unique_and_zones_not_too_many():
    with pytest.raises(WrongMessageError, match="two zones have the id 'a'"):
        read_zones(json.dumps({"zones": [GOOD, GOOD]}).encode())
    far = {"id": "x" * 64, "name": "x" * 100, "colour": "#abcdef", "polygon_m": [[-1e5, 0], [1e5, 0], [0, 1e5]]}
    zones = [GOOD | {"polygon_m": MANY_CORNERS[:100]}, far, *(GOOD | {"id": str(k)} for k in range(99))]
    assert [zone.id for zone in read_zones(json.dumps({"zones": zones[:100]}).encode()).zones[:2]] == ["a", "x" * 64]
    with pytest.raises(WrongMessageError, match="there are 101 zones; at most 100 are allowed"):
        read_zones(json.dumps({"zones": zones}).encode())


def square(name, size_m=16.0, **fields):
    return Zone(name, name.title(), ((0.0, 0.0), (size_m, 0.0), (size_m, size_m), (0.0, size_m)), **fields)


HALL = square("hall")


@given(st.lists(st.tuples(st.sampled_from(["", "Hall", "Lab", "Yard"]), st.booleans()), min_size=1, max_size=12))
def test_every_site_of_a_number_keeps_its_zones(steps):
    """Sites come and go; at some of them a zone is drawn; each finds what was drawn there last."""
    message, drawn, site = ZonesMessage(()), {}, ""
    for count, (name, draws) in enumerate(steps):
        site = name or site  # a name that is not known yet changes nothing
        message = zones_of(message, name)
        assert (message.site, message.zones) == (site, drawn.get(site, ()))
        if draws and site:
            drawn[site] = (square(f"z{count}"),)
            message = ZonesMessage(drawn[site], site, message.others)
    kept = {other.site: other.zones for other in message.others}
    assert kept == {name: zones for name, zones in drawn.items() if name != site}


def test_zones_without_a_site_become_those_of_the_first_and_the_oldest_others_are_dropped():
    others = tuple(SiteZones(f"s{k}", (HALL,)) for k in range(MAX_OTHER_SITES))
    assert zones_of(ZonesMessage((HALL,), "", others), "here") == ZonesMessage((HALL,), "here", others)
    moved = zones_of(ZonesMessage((HALL,), "here", others), "there")
    assert moved == ZonesMessage((), "there", (SiteZones("here", (HALL,)), *others[:-1]))


# Tags that enter and leave


def monitor_of(*zones):
    monitor = ZoneMonitor()
    monitor.set_zones(zones or (HALL,), 0.0)
    return monitor


def at(x, y=8.0, unix_s=0.0, std_m=0.25, z=1.0, **fields):
    """A fix whose position has this standard deviation in each direction."""
    fields = {"covariance_m2": diagonal(std_m**2, std_m**2, std_m**2), "height_known": False} | fields
    return a_fix("t", unix_s=unix_s, position_m=(x, y, z), **fields)


def walk(monitor, xs, begin_s=1000.0, step_s=0.1, std_m=0.25):
    """Happenings of a tag that goes along y = 8: the step, and whether it enters or leaves."""
    fixes = [at(float(x), unix_s=begin_s + k * step_s, std_m=std_m) for k, x in enumerate(xs)]
    return [(step, event.kind) for step, one in enumerate(fixes) for event in monitor.update(one)]


def test_a_tag_crosses_at_the_margin_or_at_half_of_it_in_every_fix_for_a_while():
    """With a standard deviation of 0.25 m the margin is 0.75 m, with almost none 0.05 m."""
    monitor = monitor_of()
    assert walk(monitor, [-1.0, 0.0, 0.749, 0.75]) == [(3, "enter")]
    assert walk(monitor, [15.0, 16.0, 16.749, 16.75]) == [(3, "leave")]
    assert walk(monitor, [0.374] * 9) == []
    assert walk(monitor, [0.375, 0.375, 0.374, 0.375, 0.375, 0.375], step_s=CROSSING_S / 3) == []
    assert walk(monitor, [0.374, 0.375, 0.4], 0.0, CROSSING_S - 1e-9) == []
    assert walk(monitor, [0.374, 0.375, 0.4], -CROSSING_S, CROSSING_S) == [(2, "enter")]
    assert walk(monitor, [-0.049, -0.051], std_m=1e-9) == [(1, "leave")]


def test_a_crossing_ends_with_its_zone_and_survives_a_clock_that_is_set_back():
    monitor = monitor_of()
    assert walk(monitor, [0.4]) == []
    assert walk(monitor, [0.4] * 5, begin_s=10.0) == [(3, "enter")]
    walk(monitor, [-0.4])
    monitor.set_zones((HALL,), 0.0)
    assert walk(monitor, [-0.4], begin_s=1001.0) == []


@given(st.lists(st.tuples(st.floats(-4.0, 20.0), st.floats(-4.0, 20.0)), max_size=40), st.floats(0.001, 2.0))
def test_events_alternate_and_agree_with_where_the_tag_was(places, std_m):
    """Against Matplotlib: a tag that enters is inside, one that leaves is outside, and never two of a kind in a row."""
    monitor, last = monitor_of(), "leave"
    edge = Path([*HALL.polygon_m, HALL.polygon_m[0]], closed=True)
    for k, (x, y) in enumerate(places):
        for event in monitor.update(at(x, y, k * 0.1, std_m)):
            assert event.kind != last
            assert edge.contains_point((x, y)) == (event.kind == "enter")
            last = event.kind
    assert [event.kind for event in monitor.remove_tag("t", 9.0)] == (["leave"] if last == "enter" else [])
    assert monitor.remove_tag("t", 9.0) == []


def test_a_stationary_tag_on_an_edge_causes_few_events():
    """White noise of its own sigma, 10 fixes a second for 1000 s: a bare edge would be crossed 5000 times.

    An event needs three sigma at once (0.00135), or four fixes in a row beyond one and a half (0.0668 ** 4).
    """
    draws = np.random.default_rng(7).normal(0.0, 0.05, 10_000)
    assert len(walk(monitor_of(), draws, std_m=0.05)) <= 25  # 10 000 · 0.00137 / 2 is 7 on the average


def test_the_margin_is_of_the_worst_direction_and_at_most_the_area_over_the_perimeter():
    turned = (0.01, 0.0099, 0.0, 0.0099, 0.01, 0.0, 0.0, 0.0, 0.0)  # sigma of 0.14 m along the diagonal
    monitor = monitor_of()
    assert monitor.update(at(0.2, covariance_m2=turned)) == []
    assert len(monitor.update(at(0.5, covariance_m2=turned))) == 1
    small = replace(HALL, polygon_m=((1.0, 7.98), (1.04, 7.98), (1.04, 8.02), (1.0, 8.02)))  # 0.01 m
    assert walk(monitor_of(small), [1.0099, 1.0101, 1.0499, 1.0501], std_m=3.0) == [(1, "enter"), (3, "leave")]


def test_of_several_zones_the_smallest_comes_first_and_tags_leave_those_that_are_removed():
    desk = square("desk", 4.0)
    monitor = monitor_of(HALL, desk)
    assert monitor.zones_with("t") == []
    events = monitor.update(at(2.0, 2.0, 5.0))
    assert [(one.zone, one.name, one.tag, one.unix_s, one.position_m) for one in events] == [
        ("hall", "Hall", "t", 5.0, (2.0, 2.0, 1.0)),
        ("desk", "Desk", "t", 5.0, (2.0, 2.0, 1.0)),
    ]
    assert monitor.zones_with("t") == [desk, HALL]
    left = monitor.set_zones((desk, square("other")), 9.0)
    assert [(one.zone, one.kind, one.unix_s) for one in left] == [("hall", "leave", 9.0)]
    assert [(one.zone, one.kind) for one in monitor.update(at(2.0, 2.0))] == [("other", "enter")]
    gone = monitor.remove_tag("t", 11.0)
    assert [(one.zone, one.kind, one.unix_s) for one in gone] == [("desk", "leave", 11.0), ("other", "leave", 11.0)]


# Floors


FLOORS = (FloorSite(-1, -3.0), FloorSite(0, 0.0), FloorSite(2, 6.0))


@given(st.floats(-20.0, 20.0), st.floats(0.0, 5.0))
def test_a_tag_without_a_past_is_on_the_floor_below_it(z_m, std_m):
    expected = -1 if z_m < 0.0 else 0 if z_m < 6.0 else 2
    assert floor_at(FLOORS, z_m, std_m, None) == floor_at(FLOORS, z_m, std_m, 77) == expected
    assert floor_at((), z_m, std_m, 0) is None


@pytest.mark.parametrize(
    ("boundary_m", "std_m", "margin_m"),
    [(6.0, 0.25, 0.75), (0.0, 0.25, 0.75), (0.0, 0.01, 0.1), (0.0, 9.0, 1.0), (6.0, 9.0, 2.0)],
)
def test_a_tag_changes_floors_at_the_margin_of_three_sigma_that_is_neither_tiny_nor_above_a_third(
    boundary_m, std_m, margin_m
):
    low, high = (-1, 0) if boundary_m == 0.0 else (0, 2)
    within_m = margin_m - 1e-9
    assert [floor_at(FLOORS, boundary_m + within_m, std_m, one) for one in (low, high)] == [low, high]
    assert [floor_at(FLOORS, boundary_m - within_m, std_m, one) for one in (low, high)] == [low, high]
    assert floor_at(FLOORS, boundary_m + margin_m, std_m, low) == high
    assert floor_at(FLOORS, boundary_m - margin_m, std_m, high) == low


def test_a_tag_that_skips_a_floor_has_no_margin():
    assert floor_at(FLOORS, 6.0, 9.0, -1) == 2
    assert floor_at(FLOORS, -1e-9, 9.0, 2) == -1


def test_a_zone_on_a_floor_holds_its_tags_only():
    monitor = monitor_of(square("up", floor=2), square("all"))
    monitor.floors = FLOORS

    def happens(z, **fields):
        return {(event.zone, event.kind) for event in monitor.update(at(8.0, z=z, std_m=0.1, **fields))}

    assert happens(1.0) == {("all", "enter")}
    assert happens(7.0) == {("up", "enter")}
    assert happens(6.1) == set()  # within the margin, of the height's own deviation
    assert happens(1.0) == {("up", "leave")}
    assert happens(1.0, height_known=True) == {("up", "enter")}
