"""Zones: which are refused, when tags enter and leave, and which dashboard publishes that."""

import json

import numpy as np
import pytest
from dashboard_builders import SQUARE, fix, status
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path
from msgspec.structs import replace

from skyless.page.events import TAKEOVER_S, EventQueue, publisher_rank
from skyless.run.mqtt.messages import WrongMessageError, Zone, ZoneEvent, ZonesMessage
from skyless.run.zones import CROSSING_S, MIN_MARGIN_M, ZoneMonitor, read_zones, zones_of

INSIDE, OUTSIDE = (2.0, 2.0, 1.0), (8.0, 2.0, 1.0)


def monitor_of(*zones):
    monitor = ZoneMonitor()
    monitor.set_zones(zones or (SQUARE,), 0.0)
    return monitor


def walk(monitor, xs, begin_s=0.0, step_s=0.1, std_m=0.01):
    """Events of a tag that goes along y = 2."""
    events = []
    for k, x in enumerate(xs):
        at_s = begin_s + k * step_s
        events += monitor.update(fix(unix_s=at_s, position_m=(float(x), 2.0, 1.0), std_m=std_m))
    return events


def test_a_tag_that_walks_through_enters_once_and_leaves_once():
    events = walk(monitor_of(), np.arange(0.0, 5.0, 0.05))
    assert [(e.kind, e.zone, e.name, e.tag) for e in events] == [
        ("enter", "desk", "Desk", "t1"),
        ("leave", "desk", "Desk", "t1"),
    ]
    entered, left = events
    assert 1.0 < entered.position_m[0] <= 1.0 + MIN_MARGIN_M + 0.05
    assert 3.0 < left.position_m[0] <= 3.0 + MIN_MARGIN_M + 0.05


@given(st.lists(st.tuples(st.floats(-1.0, 5.0), st.floats(-1.0, 5.0)), max_size=40), st.floats(0.001, 2.0))
def test_events_alternate_and_agree_with_where_the_tag_was(places, std_m):
    """Against Matplotlib: a tag that enters is inside, one that leaves is outside, and never two of a kind in a row."""
    monitor = monitor_of()
    square = Path([*SQUARE.polygon_m, SQUARE.polygon_m[0]], closed=True)
    last = "leave"
    for k, (x, y) in enumerate(places):
        for event in monitor.update(fix(unix_s=k * 0.1, position_m=(x, y, 1.0), std_m=std_m)):
            assert event.kind != last
            assert square.contains_point((x, y)) == (event.kind == "enter")
            last = event.kind
    assert [event.kind for event in monitor.remove_tag("t1", 9.0)] == (["leave"] if last == "enter" else [])


@given(st.lists(st.floats(-0.024, 0.024), min_size=2, max_size=60))
def test_noise_smaller_than_half_of_the_margin_makes_no_event(noise):
    """On the edge, outside or inside before."""
    assert walk(monitor_of(), [1.0 + value for value in noise], std_m=0.01) == []
    monitor = monitor_of()
    walk(monitor, [2.0])
    assert walk(monitor, [1.0 + value for value in noise], begin_s=1.0) == []


def test_a_stationary_tag_on_an_edge_causes_few_events():
    """White noise of its own sigma, 10 fixes a second for 1000 s: a bare edge would be crossed 5000 times.

    An event needs three sigma at once (0.00135), or four fixes in a row beyond one and a half (0.0668 ** 4).
    """
    draws = np.random.default_rng(7).normal(0.0, 0.05, 10_000)
    events = walk(monitor_of(), 1.0 + draws, std_m=0.05 * 2**0.5)
    assert len(events) <= 25  # 10 000 · 0.00137 / 2 is 7 on the average


def test_little_beyond_the_edge_counts_after_a_while():
    monitor = monitor_of()
    events = walk(monitor, [0.5, *[1.0 + 0.6 * MIN_MARGIN_M] * 10])
    assert [event.kind for event in events] == ["enter"]
    assert events[0].unix_s == pytest.approx(0.1 + CROSSING_S)
    beyond = 3.0 + 0.6 * MIN_MARGIN_M
    assert walk(monitor, [beyond, beyond, 2.9, beyond, beyond, beyond], begin_s=10.0) == []
    assert [event.kind for event in walk(monitor, [beyond] * 2, begin_s=10.6)] == ["leave"]


def test_a_zone_smaller_than_the_error_can_be_entered_and_left():
    tiny = Zone("tiny", "Tiny", ((1.98, 1.98), (2.02, 1.98), (2.02, 2.02), (1.98, 2.02)))
    monitor = monitor_of(tiny)
    assert [event.kind for event in walk(monitor, [2.0], std_m=3.0)] == ["enter"]
    assert [event.kind for event in walk(monitor, [2.1], begin_s=1.0, std_m=3.0)] == ["leave"]


def test_the_margin_is_of_the_worst_direction():
    """The ellipse lies across the edge; its covariance shows that only off the diagonal."""
    monitor = monitor_of()
    turned = (0.01, 0.0099, 0.0, 0.0099, 0.01, 0.0, 0.0, 0.0, 0.0)  # sigma of 0.14 m along the diagonal
    at = fix(position_m=(1.2, 2.0, 1.0), covariance_m2=turned)
    assert monitor.update(at) == []
    assert len(monitor.update(replace(at, position_m=(1.5, 2.0, 1.0)))) == 1


def test_of_the_zones_that_a_tag_is_in_the_smallest_comes_first():
    hall = Zone("hall", "Hall", ((0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (0.0, 9.0)))
    monitor = monitor_of(hall, SQUARE)
    assert monitor.zones_with("t1") == []
    walk(monitor, [2.0])
    assert monitor.zones_with("t1") == [SQUARE, hall]
    walk(monitor, [4.0], begin_s=1.0)
    assert monitor.zones_with("t1") == [hall]


def test_tags_in_a_deleted_zone_leave_it():
    monitor = monitor_of()
    walk(monitor, [2.0])
    other = replace(SQUARE, id="other")
    events = monitor.set_zones((other,), 9.0)
    assert [(event.zone, event.kind) for event in events] == [("desk", "leave")]
    assert [(event.zone, event.kind) for event in walk(monitor, [2.0], begin_s=1.0)] == [("other", "enter")]


def test_a_host_that_sets_its_clock_back_does_not_hold_a_tag_out():
    monitor = monitor_of()
    at = fix(position_m=(1.03, 2.0, 1.0), unix_s=1000.0)
    monitor.update(at)
    events = [event for k in range(5) for event in monitor.update(replace(at, unix_s=10.0 + k * 0.1))]
    assert [event.kind for event in events] == ["enter"]


GOOD = {"id": "a", "name": "A", "polygon_m": [[0, 0], [1, 0], [1, 1]]}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"polygon_m": [[0, 0], [1, 0]]}, "2 corners"),
        ({"polygon_m": [[0, 0], [1, 1], [1, 0], [0, 1]]}, "crosses or touches itself"),
        ({"polygon_m": [[0, 0], [1e9, 0], [1, 1]]}, "farther than"),
        ({"polygon_m": [[k, k * k] for k in range(101)]}, "101 corners"),
        ({"id": "a/b"}, "id"),
        ({"id": "+"}, "id"),
        ({"id": ""}, "id"),
        ({"name": "x" * 101}, "name"),
        ({"colour": "red;background:url(x)"}, "colour"),
        ({"polygon_m": [[0, 0], [1, "x"], [1, 1]]}, "polygon_m"),
    ],
)
def test_invalid_zones_are_refused_with_a_reason(change, expected):
    with pytest.raises(WrongMessageError, match=expected):
        read_zones(json.dumps({"zones": [GOOD | change]}).encode())


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b'{"zones": 1}',
        b'{"zones":[{"id":"a","name":"A","polygon_m":[[0,0],[NaN,0],[1,1]]}]}',
        b'{"zones":[{"id":"\xff","name":"A","polygon_m":[[0,0],[1,0],[1,1]]}]}',
    ],
)
def test_anything_but_a_list_of_zones_is_refused(payload):
    with pytest.raises(WrongMessageError):
        read_zones(payload)


def test_ids_are_unique_and_zones_not_too_many():
    with pytest.raises(WrongMessageError, match="two zones"):
        read_zones(json.dumps({"zones": [GOOD, GOOD]}).encode())
    with pytest.raises(WrongMessageError, match="101 zones"):
        read_zones(json.dumps({"zones": [GOOD | {"id": str(k)} for k in range(101)]}).encode())
    assert read_zones(json.dumps({"zones": [GOOD, GOOD | {"id": "b"}]}).encode()).zones[1].id == "b"


EVENT = ZoneEvent("desk", "Desk", "t1", "enter", 1000.0, (1.0, 2.0, 3.0))


def test_the_dashboard_that_is_online_longest_publishes_first():
    dashboards = [
        status("dashboard", "dead", online=False, unix_s=1.0),
        status("dashboard", "young", unix_s=9.0),
        status("dashboard", "old", unix_s=5.0),
    ]
    assert publisher_rank("old", dashboards) == 0
    assert publisher_rank("young", dashboards) == 1
    assert publisher_rank("unknown", dashboards) == 0
    assert publisher_rank("alone", []) == 0


@pytest.mark.parametrize("rank", [0, 1])
def test_an_event_is_published_once_by_the_first_dashboard_or_else_by_the_next(rank):
    """Of one event another dashboard's is heard in time, of the other one only one that is not the same."""
    queue, other = EventQueue(), replace(EVENT, tag="t2")
    queue.schedule([EVENT, other], rank, 10.0)
    assert queue.pop_due(10.0 + 0.9 * TAKEOVER_S) == ([] if rank else [EVENT, other])
    heard = replace(EVENT, unix_s=1000.1) if rank else EVENT
    assert queue.add_published(heard) == bool(rank), "at first it is the echo"
    assert not queue.add_published(heard)
    assert queue.add_published(replace(other, kind="leave"))
    assert queue.pop_due(10.0 + TAKEOVER_S) == ([other] if rank else [])
    assert queue.pop_due(100.0) == []
    assert set(queue.recent) == {heard, other, replace(other, kind="leave")}


SITES = st.sampled_from(["Hall", "Lab", "Yard"])


@given(st.lists(st.tuples(SITES, st.booleans()), min_size=1, max_size=12))
def test_every_site_of_a_number_keeps_its_zones(steps):
    """Sites come and go; at some of them a zone is drawn; each finds what was drawn there last."""
    message, drawn = ZonesMessage(()), {}
    for count, (site, draws) in enumerate(steps):
        message = zones_of(message, site)
        assert message.zones == drawn.get(site, ())
        if draws:
            drawn[site] = (replace(SQUARE, id=f"z{count}"),)
            message = ZonesMessage(drawn[site], site, message.others)
    assert {message.site: message.zones} | {other.site: other.zones for other in message.others} == {
        message.site: drawn.get(message.site, ()),
        **{site: zones for site, zones in drawn.items() if site != message.site},
    }
