"""The list of events: what happens once stands there once, in order; what was there before is no event."""

import msgspec
import pytest
from dashboard_builders import SQUARE, Wire, fix, status
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from test_dashboard_condition import anchor_health

from skyless.page.events import ALERT_INTERVAL_S, MAX_LOGGED, TAKEOVER_S, EventLog, EventQueue, Kept, publisher_rank
from skyless.run.condition.monitor import Condition, Reason
from skyless.run.mqtt import messages
from skyless.run.site_table import THRESHOLDS, SiteTable
from skyless.run.zones import read_zones
from skyless.site.survey.facts import Facts
from support.site_messages import tag_health

NOW = 1000.0


class Log(EventLog):
    """A log with its table, as a page has them."""

    def __init__(self, *given, **more):
        super().__init__(SiteTable(0.0), *given, **more)

    def on_status(self, status, now_s):
        super().on_status(status, self._table.add(status.kind, status.name, sends=True).status, now_s)
        self._table.add_status(status, now_s)

    def on_health(self, kind, name, health, now_s):
        super().on_health(kind, name, health, now_s)
        self._table.add_health(kind, name, health, now_s)


def texts(log, serial=0):
    return [event.text for event in log.events if event.serial > serial]


def test_statuses_that_the_broker_kept_are_no_events_and_changes_are():
    log = Log()
    log.on_status(status("anchor", "3", unix_s=NOW - 500), NOW)
    log.on_status(status("anchor", "4", online=False), NOW)
    assert not log.events
    log.on_status(status("anchor", "3", online=False), NOW + 1)
    log.on_status(status("anchor", "4", unix_s=NOW + 2), NOW + 2)
    log.on_status(status("recorder", "demo", unix_s=NOW + 2), NOW + 2)
    assert texts(log) == ["anchor 3 is offline", "anchor 4 is online", "recorder demo started"]
    assert [(event.serial, event.kind, event.level, event.name) for event in list(log.events)[1:]] == [
        (2, "anchor", "good", "anchor/4"),
        (3, "program", "note", "recorder/demo"),
    ]
    log.on_status(replace(status("recorder", "demo"), pid=7), NOW + 3)
    log.on_status(status("recorder", "demo", online=False), NOW + 4)
    assert texts(log, 3) == ["recorder demo started again", "recorder demo ended"]


def test_a_node_that_reports_no_more_is_offline_once_and_comes_back():
    log = Log()
    log.on_status(status("anchor", "3", unix_s=1.0), NOW)
    log.on_health("anchor", "3", anchor_health(3, NOW), NOW)
    log.tick(NOW + THRESHOLDS.report_s)
    assert not log.events
    log.tick(NOW + THRESHOLDS.report_s + 0.1)
    log.on_status(status("anchor", "3", online=False), NOW + 15)  # the broker's last will, for the same reason
    log.tick(NOW + 20)
    assert texts(log) == ["anchor 3 does not report any more"]
    log.on_status(status("anchor", "3", unix_s=NOW + 30), NOW + 30)
    log.on_health("anchor", "3", anchor_health(3, NOW), NOW + 31)
    log.tick(NOW + 36)
    log.on_health("anchor", "3", anchor_health(3, NOW), NOW + 37)
    assert texts(log, 1) == ["anchor 3 is online", "anchor 3 does not report any more", "anchor 3 reports again"]


def test_a_tag_that_sleeps_or_sends_rarely_is_not_missed_between_its_reports():
    log = Log()
    for name, stated in (("asleep", {"sleeps_s": 60.0}), ("rare", {"interval_s": 10.0}), ("ends", {})):
        log.on_status(status("tag", name), NOW)
        log.on_health("tag", name, tag_health(name, **stated), NOW)
        log._table.add_fix(fix(name, NOW), NOW)
    for second in range(24):
        log.tick(NOW + second)
    assert texts(log) == ["tag ends does not report any more"]


@pytest.mark.parametrize("disconnects", [True, False])
def test_a_tag_that_wakes_a_little_late_is_not_missed_and_one_that_does_not_wake_is_once(disconnects):
    log, now_s = Log(), NOW
    log.on_status(status("tag", "t1", unix_s=now_s), now_s)
    log.on_health("tag", "t1", tag_health(), now_s)
    before = log.serial
    for cycle in range(5):
        if disconnects and cycle:
            log.on_status(status("tag", "t1", unix_s=now_s), now_s)
        log._table.add_fix(fix("t1", now_s, serial=cycle + 1), now_s)
        log.on_health("tag", "t1", tag_health(sleeps_s=60.0), now_s)
        if disconnects:
            log.on_status(status("tag", "t1", online=False), now_s + 0.1)
        for second in range(1, 63):
            log.tick(now_s + second)
        now_s += 62.5
    assert texts(log, before) == []
    log.tick(now_s + 2.0)
    log.tick(now_s + 9.0)
    log.on_status(status("tag", "t1", unix_s=now_s + 20), now_s + 20)
    log.on_health("tag", "t1", tag_health(), now_s + 20)
    back = "tag t1 is online" if disconnects else "tag t1 reports again"
    assert texts(log, before) == ["tag t1 does not report any more", back]


def test_a_status_that_the_broker_repeats_is_no_start():
    log = Log()
    log.on_status(status("anchor", "3", unix_s=NOW), NOW)
    log.on_health("anchor", "3", anchor_health(3, NOW), NOW)
    log.tick(NOW + 10)
    log.on_status(status("anchor", "3", unix_s=NOW), NOW + 20)  # after a reconnect
    assert texts(log, 1) == ["anchor 3 does not report any more"]
    log.on_status(status("anchor", "3", unix_s=NOW + 30), NOW + 30)  # it has connected again itself
    log.tick(NOW + 30 + THRESHOLDS.report_s)
    log.on_health("anchor", "3", anchor_health(3, NOW), NOW + 40)
    log.tick(NOW + 50)
    log.on_status(replace(status("anchor", "3", unix_s=NOW + 51), pid=7), NOW + 60)
    assert texts(log, 2) == [
        "anchor 3 reports again", "anchor 3 does not report any more", "anchor 3 started again",
    ]  # fmt: skip


def test_nothing_ends_while_nothing_can_be_received():
    log = Log()
    log.on_health("tag", "t1", tag_health(), NOW)
    log.on_fix(fix(alert="alert-limit-exceeded"), NOW)
    log.pause(NOW + 60)
    log.tick(NOW + 60.5)
    assert texts(log) == ["tag t1: the protection level is above the alert limit"]
    log.tick(NOW + 70)
    assert texts(log, 1) == ["tag t1 does not report any more", "tag t1: integrity alert ended"]


def test_times_for_people_follow_their_clock_and_silence_does_not():
    log = Log(1e9)
    log.on_status(status("anchor", "3", unix_s=1e9 + NOW), NOW)
    log.on_health("anchor", "3", anchor_health(3, NOW), NOW)
    log.unix_offset_s = 2e9  # the clock has been set
    log.tick(NOW + 1)
    log.tick(NOW + 4)
    assert [(event.text, event.unix_s) for event in log.events] == [
        ("anchor 3 is online", 1e9 + NOW), ("anchor 3 does not report any more", 2e9 + NOW + 4)
    ]  # fmt: skip


def test_a_computer_that_is_busy_again_and_again_is_one_line():
    log = Log()
    busy = Reason("busy", "warning", "this computer is fully busy", "")
    for k in range(20):
        for reasons in ((), (busy,)):
            level, text = ("warning", reasons[0].text) if reasons else ("good", "")
            log.on_condition(Condition(level, text, reasons, None, None), NOW + k)
    log.on_condition(Condition("good", "", (), None, None), NOW + 30)
    assert [(one.text, one.count) for one in log.events] == [("condition good, after: this computer is fully busy", 40)]


def test_changes_of_the_master_in_a_row_are_one_line_with_their_number():
    read = []
    log = Log(add=read.append)
    for k in range(400):
        master = 1 + k % 3
        for anchor in (1, 2, 3):
            log.on_health("anchor", str(anchor), anchor_health(anchor, NOW, master, k), NOW + k)
    (event,) = log.events
    assert (event.count, event.first, event.serial, event.unix_s) == (399, 1, 399, NOW + 399)
    assert event.text == "anchor 1 is the master now, after anchor 3"
    assert (read[-1], {one.first for one in read}) == (event, {1}), "readers replace the line by its first serial"
    log.on_status(status("tag", "t1", unix_s=NOW + 400), NOW + 400)
    for anchor in (1, 2, 3):
        log.on_health("anchor", str(anchor), anchor_health(anchor, NOW, 2, 401), NOW + 401)
    assert [(one.kind, one.count, one.first) for one in log.events] == [
        ("master", 399, 1),
        ("tag", 1, 400),
        ("master", 1, 401),
    ]


def test_alerts_begin_and_end_and_are_not_repeated_often():
    log = Log()
    for k in range(40):
        log.on_fix(fix(alert="alert-limit-exceeded" if k % 10 < 2 else "none"), NOW + 0.5 * k)
        log.tick(NOW + 0.5 * k)
    assert [(event.level, event.text, event.unix_s - NOW) for event in log.events] == [
        ("bad", "tag t1: the protection level is above the alert limit", 0.0),
        ("good", "tag t1: integrity alert ended", 2.0),
        ("bad", "tag t1: the protection level is above the alert limit (1 more since the last one)", ALERT_INTERVAL_S),
        ("good", "tag t1: integrity alert ended", 12.0),
    ]


def test_findings_of_the_watch_begin_and_end():
    log = Log()
    moved = messages.WatchFinding("moved", (4,), 0.11, 0.01, 1.0, "anchor 4 has moved by about 11 cm.")
    for k, findings in enumerate(((), (moved,), (replace(moved, size_m=0.12),), ())):
        log.on_watch(messages.WatchMessage(1.0, "watching", findings, 15), NOW + k)
    assert texts(log) == ["anchor 4 has moved by about 11 cm", "no longer found: anchor 4 has moved by about 11 cm"]


def test_a_saved_survey_is_an_event_once():
    log = Log()
    survey = messages.SurveyMessage(1.0, 12, (1,), (), 1.0, (), Facts(), None, by="x")
    for saved in (None, 11, 11, 12):
        log.on_survey(replace(survey, saved_serial=saved, file="hall.toml"), NOW)
    log.on_survey(replace(survey, saved_serial=3, by="another"), NOW)
    assert texts(log) == [f"survey result {serial} saved to hall.toml" for serial in (11, 12)]


def test_the_condition_is_an_event_when_its_level_or_first_reason_changes():
    log = Log()
    lost = Reason("no-fix", "warning", "tag t1 has no fix", "")
    for condition in (
        Condition("waiting", "no tag is online", (), None, None),
        Condition("good", "", (), None, None),
        Condition("warning", lost.text, (lost,), None, None),
        Condition("warning", "tags t1 and t2 have no fix", (lost,), None, None),
        Condition("good", "", (), None, None),
    ):
        log.on_condition(condition, NOW)
    assert texts(log) == ["condition good", "warning: tag t1 has no fix", "condition good"]


@given(st.lists(st.tuples(st.booleans(), st.sampled_from("abc"), st.floats(0.0, 9.0)), max_size=60))
def test_readers_get_every_event_once_in_order(steps):
    events = []
    log, now = Log(add=events.append), NOW
    for online, name, wait_s in steps:
        now += wait_s
        log.on_status(status("tag", name, online, unix_s=now), now)
        log.on_health("tag", name, tag_health(name), now)
        log.tick(now)
    assert [event.serial for event in events] == list(range(1, log.serial + 1))
    assert [event.unix_s for event in events] == sorted(event.unix_s for event in events)
    assert list(log.events) == events


def test_the_newest_are_kept():
    log = Log()
    for k in range(2 * MAX_LOGGED):
        log.on_status(status("tag", "t1", online=bool(k % 2), unix_s=NOW), NOW)
    assert len(log.events) == MAX_LOGGED
    assert log.events[-1].serial == log.serial


MINE, THEIRS = (messages.ZonesMessage((replace(SQUARE, id=name),)) for name in ("mine", "theirs"))


def test_a_kept_list_is_what_was_stored_here_until_another_is_stored_after_it():
    wire, kept = Wire(), Kept(messages.ZonesMessage(()), read_zones)
    kept.store(MINE)
    kept.attach(wire, "zones")
    assert [(topic, qos, retain) for topic, _, qos, retain in wire.published] == [("zones", 1, True)]
    for message, is_new in ((THEIRS, False), (MINE, False), (THEIRS, True)):  # older, the echo, newer
        assert kept.receive(msgspec.json.encode(message)) == is_new
        assert kept.message == (THEIRS if is_new else MINE)
    assert wire.forgotten == ["zones"], "it must not come back after a reconnect"


def test_a_kept_list_that_cannot_be_read_or_is_not_that_of_the_site_shown_is_not_overwritten():
    kept = Kept(messages.ZonesMessage(()), read_zones)
    with pytest.raises(messages.WrongMessageError, match="'Lab'; it should be 'Hall'"):
        kept.check_store("Lab", "Hall")
    for payload in (b"{", b'{"zones": [{"id": "/"}]}'):
        with pytest.raises(messages.WrongMessageError):
            kept.receive(payload)
        with pytest.raises(messages.WrongMessageError, match="nothing was overwritten"):
            kept.check_store("Hall", "Hall")
    kept.receive(b"")
    kept.check_store("Hall", "Hall")


EVENT = messages.ZoneEvent("desk", "Desk", "t1", "enter", 1000.0, (1.0, 2.0, 3.0))


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
