"""Tags whose fixes come in batches alone are seen as those of messages: zones, alarms, condition, lists."""

import msgspec
import pytest
from dashboard_builders import SITE, SITE_ID, SQUARE, Times, Wire, fix, status

from skyless.core.site import AlarmRule
from skyless.page._alarms import KEPT_WAIT_S
from skyless.page.live import LiveSite
from skyless.page.state import Sent
from skyless.run.fix_batch import FIELDS, fix_of, records_of
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import AlarmMessage, AlarmRulesMessage, ZoneEvent, ZonesMessage
from skyless.run.site_table import THRESHOLDS

RULES = (AlarmRule("in", "inside", zone=SQUARE.id), AlarmRule("quiet", "silent", after_s=4.0))
IN_M, OUT_M = (sum(x for x, _ in SQUARE.polygon_m) / 4, 2.5, 1.0), (9.0, 9.0, 1.0)


class Dashboard:
    """One that leads at a site with a zone and rules, and is given fixes in one of both ways."""

    def __init__(self, *, batched):
        self.times, self.wire, self.batched, self.number = Times(), Wire(), batched, 0
        self.live = LiveSite("here", "mqtt://b:1", SITE, lambda: self.times.now_s, lambda: self.times.unix_s)
        self.live.attach(self.wire, SITE_ID)
        self.live.on_connection(connected=True)
        self.wire.deliver(topics.zones_topic(SITE_ID), ZonesMessage((SQUARE,), SITE.site.name))
        self.wire.deliver(topics.alarm_rules_topic(SITE_ID), AlarmRulesMessage(RULES, SITE.site.name))
        self.wire.deliver(topics.status_topic(SITE_ID, "dashboard", "here"), status("dashboard", "here"))
        self.run(KEPT_WAIT_S + THRESHOLDS.grace_s)

    def run(self, seconds, **places):
        """Pass time, with a fix of each tag that has a place ten times a second."""
        for _ in range(round(10 * seconds)):
            self.times.move(0.1)
            self.number += 1
            at_s = self.times.unix_s - 0.05
            fixes = [fix(name, at_s, place, serial=self.number) for name, place in places.items()]
            for number, one in enumerate(fixes if self.batched else ()):
                (record,) = FIELDS.iter_unpack(records_of([(number, one)], simulated=False).tobytes())
                self.live.on_batched_fix(fix_of(one.tag, record), self.times.now_s)
            for one in () if self.batched else fixes:
                self.wire.deliver(topics.fix_topic(SITE_ID, one.tag), one)
            if self.batched:
                self.live.table.hear(places, self.times.now_s)
            self.live.tick()

    def said(self):
        """Zone events and alarms as published, those without updates, and the rows of the list."""
        events, alarms = [], []
        for topic, payload, _, _ in self.wire.published:
            if topic == topics.zone_event_topic(SITE_ID, SQUARE.id):
                event = msgspec.json.decode(payload, type=ZoneEvent)
                events.append((event.tag, event.kind, round(event.unix_s, 3)))
            elif topic.endswith("/state") and payload:
                alarm = msgspec.json.decode(payload, type=AlarmMessage)
                alarms.append((alarm.rule, alarm.subject, alarm.ended_unix_s is None, round(alarm.unix_s, 1)))
        rows = msgspec.json.decode(self.live.state.new_state(Sent()))["tags"]
        return events, list(dict.fromkeys(alarms)), sorted((row[0], *row[1:4], row[9], row[15]) for row in rows)


def test_zones_alarms_and_lists_are_those_of_messages():
    said = []
    for batched in (False, True):
        dashboard = Dashboard(batched=batched)
        dashboard.run(12.0, t1=OUT_M, t2=OUT_M)
        dashboard.run(2.0, t1=IN_M, t2=OUT_M)
        assert dashboard.live.condition.tags_with_fix == 2
        dashboard.run(THRESHOLDS.gone_s + 3.0, t2=OUT_M)
        assert (dashboard.live.condition.tags, dashboard.live.condition.tags_with_fix) == (2, 1)
        said.append(dashboard.said())
    events, alarms, rows = said[0]
    assert [event[:2] for event in events] == [("t1", "enter"), ("t1", "leave")]
    states = dict.fromkeys(alarm[:3] for alarm in alarms)  # while one lasts its sentence changes
    assert list(states) == [("in", "t1", True), ("quiet", "t1", True), ("in", "t1", False)]
    assert said[1][:2] == (events, alarms)
    for mine, other in zip(rows, said[1][2], strict=True):
        assert mine[0] == other[0]
        assert mine[1:] == pytest.approx(other[1:], abs=1e-3)


def test_the_condition_names_tags_that_batches_have_no_longer_and_forgets_them():
    dashboard = Dashboard(batched=True)
    dashboard.run(12.0, t1=OUT_M, t2=OUT_M)
    dashboard.run(THRESHOLDS.gone_s + 1.0, t1=OUT_M)
    condition = dashboard.live.condition
    found = {reason.kind: reason for reason in condition.reasons}
    assert "t2" in found["silent"].text
    assert found["silent"].names == ("tag/t2",)
    table, times = dashboard.live.table, dashboard.times
    table.set_connected(connected=False, now_s=times.now_s, batches=True)  # silence means nothing
    dashboard.run(10.0)
    assert "silent" not in {reason.kind for reason in dashboard.live.condition.reasons}
    table.set_connected(connected=True, now_s=times.now_s, batches=True)
    dashboard.run(THRESHOLDS.gone_s + 1.0)
    assert "no-fixes" in {reason.kind for reason in dashboard.live.condition.reasons}
    times.move(THRESHOLDS.longest_s)
    dashboard.run(4.0)
    assert {reason.kind for reason in dashboard.live.condition.reasons} == {"anchors"}
