"""Events out of messages: each once, however often its message comes."""

from itertools import pairwise

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from skyless.run.history.tables import EventLog
from skyless.run.mqtt.messages import AlarmMessage, StatusMessage, ZoneEvent

NOW_S = 1_795_154_400.0
ALARM = AlarmMessage(
    *("cold/tag7/1", "cold", "Cold store", "inside", "critical", "tag7", NOW_S, NOW_S + 1.0, "tag7 is in Cold store"),
    tags=("tag7",),
    zone="z1",
)
ENDED = msgspec.structs.replace(ALARM, ended_unix_s=NOW_S + 2.0)
SEEN = msgspec.structs.replace(ENDED, acknowledged_unix_s=NOW_S + 3.0, acknowledged_by="Ada")


def enter(tag="ann", zone="z1", kind="enter", unix_s=NOW_S):
    return ZoneEvent(zone, "door", tag, kind, unix_s, (0.0, 0.0, 0.0))


def status(*, online, name="4", kind="anchor", unix_s=0.0):
    return StatusMessage(online, kind, name, unix_s=unix_s)


def ms(event):
    return round(1000 * event.t.timestamp())


def new_events(log, message):
    return log.of(message, NOW_S)


def test_what_the_columns_hold():
    log = EventLog()
    (zone,) = new_events(log, enter())
    assert (ms(zone), zone.kind, zone.tag, zone.zone) == (round(1000 * NOW_S), "enter", "ann", "z1")
    assert (zone.subject, zone.alarm, zone.text) == (None, None, "ann entered door")
    raised, ended, seen = new_events(log, SEEN)
    assert [event.kind for event in (raised, ended, seen)] == ["alarm-raised", "alarm-ended", "alarm-acknowledged"]
    assert [ms(event) / 1000 - NOW_S for event in (raised, ended, seen)] == [1.0, 2.0, 3.0]
    assert (raised.tag, raised.zone, raised.subject, raised.alarm) == ("tag7", "z1", "tag7", "cold/tag7/1")
    assert (raised.text, seen.text) == ("tag7 is in Cold store", "Ada")
    (gone,) = log.of(status(online=False), NOW_S)
    assert (ms(gone), gone.kind, gone.tag, gone.subject) == (round(1000 * NOW_S), "offline", None, "anchor-4")
    (come,) = log.of(status(online=True, name="ann", kind="tag", unix_s=NOW_S - 5.0), NOW_S)
    assert (ms(come), come.kind, come.tag, come.subject) == (round(1000 * (NOW_S - 5)), "online", "ann", None)


MESSAGES = st.lists(
    st.sampled_from(
        [ALARM, ENDED, SEEN, *(enter(tag, kind=kind) for tag in "ab" for kind in ("enter", "leave"))]
        + [status(online=s > 0.0, name=name, unix_s=s) for s in (0.0, NOW_S, NOW_S + 1.0) for name in "12"]
    )
)


@given(MESSAGES, st.integers(0, 20))
def test_a_message_that_comes_again_tells_nothing_even_after_a_restart(messages, restart):
    past, log = [], EventLog()
    for count, message in enumerate(messages):
        if count == restart:
            log = EventLog(past)
        past += new_events(log, message)
        assert new_events(log, message) == []
    of_alarms = [event.kind for event in past if event.alarm]
    assert len(of_alarms) == len(set(of_alarms))
    for subject in ("anchor-1", "anchor-2"):
        states = [event.kind for event in past if event.subject == subject]
        assert all(one != other for one, other in pairwise(states))


def test_a_late_copy_of_online_does_not_bring_a_node_back():
    log = EventLog()
    before = status(online=True, unix_s=NOW_S - 9.0)
    assert len(log.of(before, NOW_S)) == len(log.of(status(online=False), NOW_S)) == 1
    assert log.of(before, NOW_S + 1.0) == []
    (event,) = log.of(status(online=True, unix_s=NOW_S + 1.0), NOW_S + 1.0)
    assert event.kind == "online"


def test_times_that_are_none_give_no_event():
    assert new_events(EventLog(), enter(unix_s=1e300)) == new_events(EventLog(), enter(unix_s=-1.0)) == []
