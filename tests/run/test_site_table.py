"""Who is there: tags of every rate, asleep or gone, bad input of every kind, and what views make of it."""

import math
import time
import tracemalloc

import pytest
from dashboard_builders import fix, status
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.site import AlarmRule
from skyless.run.alarms import AlarmEngine
from skyless.run.mqtt.messages import Zone
from skyless.run.site_table import THRESHOLDS, SiteTable
from skyless.run.zones import ZoneMonitor
from support.site_messages import tag_health

REST_S = 600.0
RATES_S = (0.02, 1.0, 5.0, 10.0, 60.0)
BURSTS = "bursts"
ROOMS = tuple(
    Zone(name, name, ((x, 0.0), (x + 10.0, 0.0), (x + 10.0, 10.0), (x, 10.0)))
    for name, x in (("a", 0.0), ("b", 20.0), ("c", 40.0))
)


def instants(rate, until_s):
    """When a tag of a rate has its fixes: each interval, or a second of ten fixes every half minute."""
    if rate == BURSTS:
        return [30.0 * k + 0.1 * n for k in range(int(until_s / 30.0)) for n in range(10)]
    return [rate * k for k in range(int(until_s / rate) + 1)]


class Hall:
    """Views of one table, in the order in which the page calls them."""

    def __init__(self, zones=ROOMS, rules=()):
        self.table, self.monitor = SiteTable(0.0), ZoneMonitor()
        self.engine = AlarmEngine(self.monitor, self.table, time.gmtime)
        self.monitor.set_zones(zones, 0.0)
        self.engine.set_zones(zones, 0.0)
        self.engine.set_rules(rules)
        self.engine.resume((), 0.0, 0.0)
        self.events, self.alarms, self.serial, self.now_s = [], [], 0, 0.0

    def take(self, events):
        self.events += [(self.now_s, event.kind, event.zone) for event in events]
        self.engine.on_zone_events(events, self.now_s)

    def run(self, fixes, until_s):
        """Pass time, with fixes at (seconds, x in m), and a tick ten times a second."""
        waiting = iter([*fixes, (math.inf, 0.0)])
        at_s, x = next(waiting)
        for step in range(round(10 * self.now_s), round(10 * until_s) + 1):
            while at_s <= 0.1 * step:
                self.now_s, self.serial = at_s, self.serial + 1
                one = fix(unix_s=1e9 + at_s, position_m=(x, 5.0, 1.0), serial=self.serial)
                if self.table.add_fix(one, at_s) is not None:
                    self.engine.on_fix("t1")
                    self.take(self.monitor.update(one))
                at_s, x = next(waiting)
            self.now_s = 0.1 * step
            for tag in self.table.tick(self.now_s):
                self.take(self.monitor.remove_tag(tag, self.now_s))
            self.alarms += [(self.now_s, what) for what, _ in self.engine.tick(self.now_s, self.now_s)]

    @property
    def kinds(self):
        return [(kind, zone) for _, kind, zone in self.events]


@pytest.mark.parametrize("rate", [*RATES_S, BURSTS])
def test_a_tag_at_rest_stays_in_its_zone_and_leaves_it_once_when_it_has_gone(rate):
    hall = Hall(rules=(AlarmRule("r", "inside", zone="a", after_s=60.0),))
    times_s = instants(rate, REST_S)
    hall.run([(at_s, 5.0) for at_s in times_s], REST_S)
    assert hall.kinds == [("enter", "a")]
    ((raised_s, _),) = [alarm for alarm in hall.alarms if alarm[1] == "raised"]
    assert 60.0 <= raised_s <= 61.0
    tag = hall.table.get("tag", "t1")
    gone_s = hall.table.gone_after_s(tag)
    interval_s = 30.0 if rate == BURSTS else rate
    assert gone_s == pytest.approx(max(THRESHOLDS.gone_s, THRESHOLDS.gone_intervals * interval_s), rel=0.05)
    hall.run([], REST_S + gone_s + 1.0)
    assert hall.kinds == [("enter", "a"), ("leave", "a")]
    assert hall.events[-1][0] - times_s[-1] == pytest.approx(gone_s, abs=0.2)


@pytest.mark.parametrize("rate", RATES_S)
def test_a_tag_that_walks_through_three_zones_enters_and_leaves_each_once(rate):
    """To and fro at the speed at which it has several fixes in each zone; a stay is as long as in truth, but for one
    interval.
    """
    speed_mps = min(1.0, 2.0 / rate)
    until_s = 50.0 / speed_mps
    hall = Hall()
    hall.run([(at_s, speed_mps * at_s) for at_s in instants(rate, until_s)], until_s)
    assert hall.kinds == [(kind, zone) for zone in "abc" for kind in ("enter", "leave")][: len(hall.kinds)]
    assert len(hall.kinds) >= 5
    stays_s = [
        left - entered for (entered, *_), (left, *_) in zip(hall.events[2:-1:2], hall.events[3::2], strict=False)
    ]
    assert stays_s == pytest.approx([10.0 / speed_mps] * len(stays_s), abs=rate + 0.5)


def test_a_tag_that_comes_and_goes_is_looked_at_once():
    table = SiteTable(0.0)
    for n in range(50):
        table.add_fix(fix(serial=n, unix_s=float(n)), 0.1 * n)
        table.add_status(status(online=False), 0.1 * n)
        table.add_status(status(), 0.1 * n)
    assert len(table._due) == 1
    assert table.tick(100.0) == []
    assert table._due == []


# Bad input: each has its sentence in docs/live_site.md


@pytest.mark.parametrize("batched", [False, True])
def test_two_feeds_of_one_site_give_each_fix_once(batched):
    hall, twice = Hall(), Hall()
    fixes = [(0.5 * k, 0.1 * k) for k in range(400)]
    hall.run(fixes, 200.0)
    for at_s, x in fixes:
        one = fix(unix_s=1e9 + at_s, position_m=(x, 5.0, 1.0), serial=round(2 * at_s) + 1)
        for repeated in (one, replace(one, serial=0) if batched else one):  # a batch has no serials
            if twice.table.add_fix(repeated, at_s, batched=batched and repeated is not one) is not None:
                twice.now_s = at_s
                twice.take(twice.monitor.update(one))
    assert twice.kinds == hall.kinds


def test_messages_of_unknown_tags_are_taken_up_to_a_limit_and_a_feed_that_stops_makes_all_gone(monkeypatch):
    monkeypatch.setattr("skyless.run.site_table.MAX_NAMES", {"tag": 100, "anchor": 10})
    monkeypatch.setattr("skyless.run.site_table.MAX_OTHERS", 3)
    table = SiteTable(0.0)
    for n in range(9):
        table.add_status(status(f"kind{n}", "a"), 0.0)
        table.add_status(status("ether", f"air{n}"), 0.0)
    assert sum(len(table.all(kind)) for kind in table.kinds) == 3 >= len(table._nodes)
    for second in range(12):
        for n in range(150):
            table.add_fix(fix(f"t{n}", serial=second + 1, unix_s=float(second), anchors=()), float(second))
    assert (len(table.fixed), table.roster.left_out("tag", 12.0)) == (100, 50)
    assert sorted(table.tick(30.0)) == sorted(table.fixed)
    assert table.tick(31.0) == []


@given(st.lists(st.tuples(st.floats(0.0, 2000.0), st.sampled_from(["fix", "tick", "lost", "back", "sleep", "off"]))))
def test_a_tag_is_never_gone_and_there_at_once(steps):
    """Whatever happens in whatever order: it goes once for each time that it came, and never while it is fresh."""
    table, now_s, serial, there = SiteTable(0.0), 0.0, 0, False
    for wait_s, what in steps:
        now_s += wait_s
        went = []
        if what == "fix":
            serial += 1
            table.add_fix(fix(serial=serial, unix_s=now_s), now_s)
            there = True
        elif what in ("lost", "back"):
            table.set_connected(connected=what == "back", now_s=now_s)
        elif what == "sleep":
            table.add_health("tag", "t1", tag_health(sleeps_s=100.0), now_s)
        elif what == "off":
            went = ["t1"] if table.add_status(status(online=False), now_s) else []
            table.add_status(status(), now_s)
        went += table.tick(now_s)
        assert went == [] or there
        there = there and not went
        tag = table.get("tag", "t1")
        if tag is not None and now_s - table.ready_s < THRESHOLDS.forgotten_s:
            assert not (went and table.is_there(tag, now_s))
            assert there or not table.is_there(tag, now_s)


@pytest.mark.site
def test_a_hundred_thousand_tags_take_some_bytes_each():
    names = [f"t{n}" for n in range(20_000)]
    tracemalloc.start()
    table = SiteTable(0.0)
    for second in range(3):
        table.hear(names, float(second))
    bytes_each = tracemalloc.get_traced_memory()[0] / len(names)
    tracemalloc.stop()
    assert bytes_each < 1200
    assert len(table.tick(3000.0)) == len(names)
