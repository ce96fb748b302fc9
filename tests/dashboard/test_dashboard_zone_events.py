"""One of several dashboards speaks, and the next when it is dead."""

from dashboard_builders import status
from msgspec.structs import replace

from skyless.dashboard.zone_events import PATIENCE_S, EventDesk, place_in_line
from skyless.mqtt.messages import ZoneEvent

EVENT = ZoneEvent("desk", "Desk", "t1", "enter", 1000.0, (1.0, 2.0, 3.0))


def test_the_eldest_that_is_online_is_first():
    line = [
        status("dashboard", "dead", online=False, unix_s=1.0),
        status("dashboard", "young", unix_s=9.0),
        status("dashboard", "old", unix_s=5.0),
    ]
    assert place_in_line("old", line) == 0
    assert place_in_line("young", line) == 1
    assert place_in_line("not yet told", line) == 0
    assert place_in_line("alone", []) == 0


def test_the_first_speaks_at_once_and_ignores_its_echo():
    desk = EventDesk()
    desk.hold([EVENT], 0, 10.0)
    assert desk.due(10.0) == [EVENT]
    assert desk.due(11.0) == []
    assert not desk.heard(EVENT)
    assert list(desk.recent) == [EVENT]


def test_the_second_stays_silent_when_the_first_has_spoken():
    desk = EventDesk()
    desk.hold([EVENT], 1, 10.0)
    assert desk.due(10.0 + 0.9 * PATIENCE_S) == []
    others = replace(EVENT, unix_s=1000.1)
    assert desk.heard(others)
    assert desk.due(100.0) == []
    assert list(desk.recent) == [others]


def test_the_second_speaks_when_the_first_does_not():
    desk = EventDesk()
    desk.hold([EVENT, replace(EVENT, tag="t2")], 1, 10.0)
    assert desk.heard(replace(EVENT, kind="leave"))
    assert desk.due(10.0 + PATIENCE_S) == [EVENT, replace(EVENT, tag="t2")]


def test_the_same_event_twice_counts_once():
    desk = EventDesk()
    assert desk.heard(EVENT)
    assert not desk.heard(EVENT)
