"""The engine: each kind of rule, hours, what is kept, groups, resuming, and near tags against all pairs."""

import math
import random
import time
from itertools import combinations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.core.alert import Alert
from skyless.core.site import AlarmRule
from skyless.run import alarms as engine_module
from skyless.run.alarms import EVALUATION_S, STOREY_M, AlarmEngine, Concerned, is_over, near_tags
from skyless.run.mqtt.messages import Asset, StatusMessage, WatchFinding, WatchMessage, Zone
from skyless.run.site_table import THRESHOLDS, SiteTable
from skyless.run.zones import ZoneMonitor
from support.site_messages import a_fix, diagonal, tag_health

HALL = Zone("hall", "Hall", ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)))
IN, OUT = (5.0, 5.0), (15.0, 5.0)
EPOCH_S = 1_795_000_000.0


def fix(tag, at_s, place, *, z=1.0, **more):
    given = {"unix_s": EPOCH_S + at_s, "position_m": (*place, z), "covariance_m2": diagonal(1e-4, 1e-4, 1e-4)}
    return a_fix(tag, **given | more)


class Site:
    """An engine with its monitor; time goes on while tags send fixes where they are."""

    def __init__(self, *rules, kept=(), assets=None, zones=(HALL,)):
        self.now_s = 0.0
        self.hour_shift_s = 0.0
        self.places = {}
        self.more = {}
        self.blind = False
        self.monitor = ZoneMonitor()
        self.table = SiteTable(0.0)
        self.engine = AlarmEngine(self.monitor, self.table, lambda unix_s: time.gmtime(unix_s + self.hour_shift_s))
        self.happened = []
        if assets:
            self.engine.set_assets({asset.tag: asset for asset in assets})
        self.set_zones(zones)
        self.engine.set_rules(rules)
        self.engine.resume(kept, 0.0, EPOCH_S)

    @property
    def unix_s(self):
        return EPOCH_S + self.now_s

    def set_zones(self, zones):
        self.engine.on_zone_events(self.monitor.set_zones(zones, self.unix_s), self.now_s)
        self.engine.set_zones(zones, self.now_s)

    def run(self, seconds):
        """Happenings of this time, as (what, rule, subject), without updates."""
        begin = len(self.happened)
        for _ in range(round(seconds / 0.05)):
            self.now_s += 0.05
            for tag, place in self.places.items():
                message = fix(
                    tag, self.now_s, place[:2], z=place[2] if len(place) > 2 else 1.0, **self.more.get(tag, {})
                )
                self.table.add_fix(message, self.now_s)
                self.engine.on_fix(tag)
                self.engine.on_zone_events(self.monitor.update(message), self.now_s)
            for tag in self.table.tick(self.now_s):
                self.engine.on_zone_events(self.monitor.remove_tag(tag, self.unix_s), self.now_s)
            self.happened += self.engine.tick(self.now_s, self.unix_s, blind=self.blind)
        return [(what, one.rule, one.subject) for what, one in self.happened[begin:] if what != "updated"]

    def hear_health(self, health):
        self.table.add_health("tag", health.tag, health, self.now_s)
        self.engine.on_health(health)

    def gone(self, tag):
        del self.places[tag]
        self.table.add_status(StatusMessage(online=False, kind="tag", name=tag), self.now_s)
        self.engine.on_zone_events(self.monitor.remove_tag(tag, self.unix_s), self.now_s)

    @property
    def last(self):
        return self.happened[-1][1]


def test_inside_is_raised_after_its_time_and_ends_after_its_time():
    site = Site(AlarmRule("r", "inside", zone="hall", after_s=5.0, clear_after_s=2.0, name="Too long"))
    site.places["t"] = IN
    assert site.run(4.0) == []
    assert site.run(2.0) == [("raised", "r", "t")]
    alarm = site.last
    assert (alarm.name, alarm.kind, alarm.severity, alarm.tags, alarm.zone) == (
        "Too long",
        "inside",
        "warning",
        ("t",),
        "hall",
    )
    assert alarm.sentence == "t has been in Hall for 5 s"
    assert (alarm.place, alarm.position_m) == ("Hall", (5.0, 5.0, 1.0))
    assert 5.0 - 1e-6 <= alarm.unix_s - alarm.since_unix_s <= 5.0 + EVALUATION_S + 0.06
    assert alarm.id == f"r/t/{round(1000 * alarm.unix_s)}"
    site.places["t"] = OUT
    assert site.run(1.9) == []
    assert site.run(0.5) == [("ended", "r", "t")]
    assert site.last.ended_unix_s == pytest.approx(site.unix_s, abs=0.6)


def test_a_short_stay_and_a_short_absence_do_not_count():
    site = Site(AlarmRule("r", "inside", zone="hall", after_s=5.0, clear_after_s=3.0))
    for _ in range(3):
        site.places["t"] = IN
        assert site.run(4.0) == []
        site.places["t"] = OUT
        assert site.run(2.0) == []
    site.places["t"] = IN
    assert len(site.run(6.0)) == 1
    for _ in range(3):
        site.places["t"] = OUT
        assert site.run(2.0) == []
        site.places["t"] = IN
        assert site.run(2.0) == []


def test_outside_holds_for_a_tag_that_is_seen_elsewhere_and_not_for_one_that_is_not_seen():
    site = Site(AlarmRule("r", "outside", zone="hall"))
    site.places = {"a": IN, "b": OUT}
    assert site.run(2.0) == [("raised", "r", "b")]
    del site.places["a"]  # silent inside
    del site.places["b"]  # silent outside: nobody knows that it has come back
    assert site.run(10.0) == []
    site.places["b"] = IN
    assert site.run(3.0) == [("ended", "r", "b")]
    site.gone("b")
    assert site.run(5.0) == []


def test_outside_of_a_zone_that_is_not_drawn_is_nobody():
    site = Site(AlarmRule("r", "outside", zone="hall"), zones=())
    site.places["t"] = OUT
    assert site.run(5.0) == []
    site.set_zones((HALL,))
    assert site.run(2.0) == [("raised", "r", "t")]
    site.set_zones(())
    assert site.run(3.0) == [("ended", "r", "t")]


def test_silent_tags_those_named_and_those_heard():
    site = Site(AlarmRule("all", "silent", after_s=4.0), AlarmRule("one", "silent", after_s=6.0, tags=("never",)))
    site.places = {"a": IN, "b": IN}
    assert site.run(5.0) == []
    del site.places["a"]
    assert set(site.run(5.0)) == {("raised", "one", "never"), ("raised", "all", "a")}
    assert {one.sentence for what, one in site.happened if what == "raised"} == {
        "never has sent no fixes for 6 s",
        "a has sent no fixes for 4 s",
    }
    site.places |= {"a": IN, "never": IN}
    assert set(site.run(3.0)) == {("ended", "all", "a"), ("ended", "one", "never")}


def test_silence_while_messages_cannot_arrive_means_nothing():
    site = Site(
        AlarmRule("quiet", "silent", after_s=4.0),
        AlarmRule("in", "inside", zone="hall"),
        AlarmRule("near", "near", limit=2.0),
    )
    site.places = {"a": IN, "b": (6.0, 5.0)}
    assert len(site.run(3.0)) == 3
    places, site.places, site.blind = site.places, {}, True
    assert site.run(60.0) == []
    site.blind, site.places = False, places
    assert site.run(20.0) == []
    site.blind, site.places = True, {}
    site.run(10.0)
    site.blind, site.places = False, {"a": OUT, "b": IN}  # a has left meanwhile
    assert set(site.run(8.0)) == {("ended", "in", "a"), ("ended", "near", "a~b")}


def test_near_with_hysteresis_and_storeys():
    site = Site(AlarmRule("r", "near", limit=2.0, hysteresis=1.0, clear_after_s=0.0, tags=("fork",)))
    site.places = {
        "fork": (0.0, 0.0),
        "t1": (2.5, 0.0),
        "t2": (20.0, 0.0),
        "t3": (20.5, 0.0),
        "up": (0.0, 1.0, 1.0 + STOREY_M + 0.1),
    }
    assert site.run(1.0) == []
    site.places["t1"] = (1.9, 0.0)
    assert site.run(1.0) == [("raised", "r", "fork~t1")]
    assert site.last.sentence == "fork and t1 are 1.9 m apart; at least 2 m is right"
    site.places["t1"] = (2.9, 0.0)
    assert site.run(1.0) == []
    site.places["t1"] = (3.1, 0.0)
    assert site.run(1.0) == [("ended", "r", "fork~t1")]


def test_crowded():
    site = Site(
        AlarmRule("r", "crowded", zone="hall", limit=2.0, hysteresis=1.0, clear_after_s=0.0, tags=("a", "b", "c"))
    )
    site.places = {"a": IN, "b": IN, "d": IN}
    assert site.run(THRESHOLDS.grace_s) == []
    site.places["c"] = IN
    assert site.run(1.0) == [("raised", "r", "zone-hall")]
    assert site.last.sentence == "3 tags are in Hall; at most 2 are allowed"
    assert site.last.tags == ("a", "b", "c")
    site.places["c"] = OUT
    assert site.run(1.0) == []
    site.places["b"] = OUT
    assert site.run(1.0) == [("ended", "r", "zone-hall")]


def test_protection_levels():
    site = Site(AlarmRule("r", "protection-level", limit=1.0, hysteresis=0.2, clear_after_s=0.0))
    site.places = {"t": IN, "plain": IN}
    site.more["t"] = {"hpl_m": 0.9, "alert": Alert.NONE.value}
    assert site.run(1.0) == []
    site.more["t"] = {"hpl_m": 1.1, "alert": Alert.NONE.value}
    assert site.run(1.0) == [("raised", "r", "t")]
    site.more["t"] = {"hpl_m": 0.9, "alert": Alert.NONE.value}
    assert site.run(1.0) == []
    site.more["t"] = {"hpl_m": 0.7, "alert": Alert.NONE.value}
    assert site.run(1.0) == [("ended", "r", "t")]
    site.more["t"] = {"alert": Alert.NOT_EXCLUDED.value}  # no level can be given
    assert site.run(1.0) == [("raised", "r", "t")]
    assert "unknown" in site.last.sentence


def test_battery():
    site = Site(AlarmRule("r", "battery", limit=0.2, hysteresis=0.1))
    for share, expected in (
        (0.3, []),
        (None, []),
        (0.08, [("raised", "r", "t")]),
        (0.25, []),
        (0.4, [("ended", "r", "t")]),
    ):
        site.hear_health(tag_health("t", battery_share=share))
        assert site.run(2.0) == expected
    assert site.happened[0][1].sentence == "the battery of t is at 8%; 20% is the least"


def worst_of_levels(values):
    site = Site(AlarmRule("r", "protection-level", limit=0.4))
    site.places["t"] = IN
    for level_m in values:
        site.more["t"] = {"hpl_m": level_m, "alert": Alert.NONE.value}
        site.run(0.5)
    return site


def worst_of_batteries(values):
    site = Site(AlarmRule("r", "battery", limit=0.9))
    for share in values:
        site.hear_health(tag_health("t", battery_share=share))
        site.run(0.5)
    return site


def worst_of_distances(values):
    site = Site(AlarmRule("r", "near", limit=2.0))
    for distance_m in values:
        site.places |= {"t": IN, "u": (5.0, 5.0 + distance_m)}
        site.run(0.5)
    return site


@pytest.mark.parametrize(
    ("run", "worst", "words", "end"),
    [
        (worst_of_distances, min, "t and u were {:.1f} m apart at the least; at least 2 m is right", 9.0),
        (worst_of_levels, max, "the protection level of t was {:.2f} m at the most; at most 0.4 m is allowed", 0.1),
        (worst_of_batteries, min, "the battery of t was at {:.0%} at the least; 90% is the least", 1.0),
    ],
)
@given(values=st.lists(st.integers(41, 89), min_size=1, max_size=12))
@settings(max_examples=20, deadline=None)
def test_an_alarm_says_the_worst_value_at_most_once_a_second_and_keeps_it(run, worst, words, end, values):
    values = [value / 100.0 for value in values]
    site = run([*values, *[end] * 6])
    assert {kind for kind, _ in site.happened} - {"updated"} == {"raised", "ended"}
    ended = site.last
    assert ended.worst == pytest.approx(worst(values))
    assert ended.sentence == words.format(ended.worst)
    assert sum(kind == "updated" for kind, _ in site.happened) <= len(values) / 2 + 1


def test_a_stay_says_how_long_it_has_been_and_goes_on_with_the_next_engine():
    rule = AlarmRule("r", "inside", zone="hall", after_s=2.0)
    site = Site(rule)
    site.places["t"] = IN
    site.run(130.0)
    kept = site.last
    assert kept.sentence == "t has been in Hall for 2 min"
    assert sum(kind == "updated" for kind, _ in site.happened) < 50
    other = Site(rule, kept=[kept])
    other.places["t"] = OUT
    other.run(8.0)
    assert other.last.worst >= kept.worst
    assert other.last.sentence.replace("was", "has been") == kept.sentence
    site.places["t"] = OUT
    site.run(3.0)
    assert site.last.sentence == "t was in Hall for 2 min"
    assert site.last.worst == pytest.approx(130.0, abs=1.0)


def test_anchors():
    site = Site(AlarmRule("off", "anchor-offline", after_s=2.0), AlarmRule("moved", "anchor-moved"))
    watch = WatchMessage(
        0.0, "watching", (WatchFinding("moved", (4,), 0.3, 0.01, 0.0, "Anchor 4 has moved by 0.30 m."),), 10
    )
    site.engine.on_anchors(["3"], watch)
    assert site.run(3.0) == [("raised", "moved", "anchor-4"), ("raised", "off", "anchor-3")]
    assert [one.sentence for what, one in site.happened if what == "raised"] == [
        "Anchor 4 has moved by 0.30 m",
        "anchor 3 has been offline for 2 s",
    ]
    site.engine.on_anchors(None, WatchMessage(0.0, "learning", (), 0))
    assert site.run(3.0) == []
    site.engine.on_anchors([], WatchMessage(0.0, "watching", (), 0))
    assert set(site.run(3.0)) == {("ended", "off", "anchor-3"), ("ended", "moved", "anchor-4")}


def test_hours_end_an_alarm_and_begin_its_time():
    site = Site(AlarmRule("r", "inside", zone="hall", after_s=3.0, hours="06:00-22:00"))
    midnight_s = EPOCH_S % 86400.0
    site.hour_shift_s = -midnight_s + 22 * 3600.0 - 10.0
    site.places["t"] = IN
    assert site.run(5.0) == [("raised", "r", "t")]
    assert site.run(8.0) == [("ended", "r", "t")]
    assert site.run(20.0) == []
    site.hour_shift_s = -midnight_s + 30 * 3600.0 - site.now_s
    assert site.run(2.0) == []
    assert site.run(3.0) == [("raised", "r", "t")]


def test_an_alarm_is_kept_until_it_has_ended_and_is_acknowledged():
    site = Site(AlarmRule("r", "inside", zone="hall", clear_after_s=0.0))
    site.places["t"] = IN
    site.run(1.0)
    first = site.last
    assert not site.engine.acknowledge("r", "t", "another", "Ada", site.unix_s)
    assert site.engine.acknowledge("r", "t", first.id, "Ada", site.unix_s)
    assert not site.engine.acknowledge("r", "t", first.id, "Bob", site.unix_s)
    assert site.run(0.1) == [("acknowledged", "r", "t")]
    assert site.engine.messages["r", "t"].acknowledged_by == "Ada"
    site.places["t"] = OUT
    assert site.run(1.0) == [("ended", "r", "t")]
    assert is_over(site.last)
    assert site.engine.messages == {}
    site.places["t"] = IN
    site.run(1.0)
    site.places["t"] = OUT
    site.run(1.0)
    second = site.last
    assert list(site.engine.messages.values()) == [second]  # ended, and nobody has seen it
    site.places["t"] = IN
    assert site.run(1.0) == [("raised", "r", "t")]
    assert len({first.id, second.id, site.last.id}) == 3
    assert not site.engine.acknowledge("r", "t", second.id, "Ada", site.unix_s)


def test_groups_and_names_of_assets():
    people = [Asset("t1", name="Ada", group="people"), Asset("t2", group="people"), Asset("t3", group="forks")]
    site = Site(AlarmRule("r", "inside", zone="hall", tags=("group:people",)), assets=people)
    site.places = {"t1": IN, "t3": IN}
    assert site.run(1.0) == [("raised", "r", "t1")]
    assert site.last.sentence == "Ada (t1) is in Hall"
    site.engine.set_assets({"t3": Asset("t3", group="people")})
    assert set(site.run(3.0)) == {("raised", "r", "t3"), ("ended", "r", "t1")}


def test_rules_change():
    rule = AlarmRule("r", "inside", zone="hall")
    site = Site(rule)
    site.places["t"] = IN
    site.run(1.0)
    site.engine.set_rules(
        [AlarmRule("r", "inside", zone="hall", severity="critical"), AlarmRule("x", "silent", after_s=1.0)]
    )
    assert site.run(2.0) == []  # it goes on
    site.engine.set_rules([AlarmRule("r", "inside", zone="elsewhere")])
    assert site.run(0.1) == [("ended", "r", "t")]
    site.engine.set_rules([rule])
    assert site.run(1.0) == [("raised", "r", "t")]
    site.engine.set_rules([])
    assert site.run(1.0) == [("ended", "r", "t")]


RULES = (
    AlarmRule("in", "inside", zone="hall"),
    AlarmRule("out", "outside", zone="hall"),
    AlarmRule("quiet", "silent", after_s=4.0),
    AlarmRule("near", "near", limit=2.0),
    AlarmRule("many", "crowded", zone="hall", limit=1.0),
    AlarmRule("low", "battery", limit=0.2),
)


def test_another_engine_goes_on_from_what_is_kept():
    site = Site(*RULES)
    site.places = {"a": IN, "b": (5.5, 5.0), "c": OUT, "d": OUT}
    site.hear_health(tag_health("a", battery_share=0.1))
    site.run(2.0)
    del site.places["d"]
    site.run(5.0)
    kept = dict(site.engine.messages)
    assert {key[0] for key in kept} == {rule.id for rule in RULES}
    again = Site(*RULES, kept=kept.values())
    again.places = dict(site.places)
    assert again.run(30.0) == []
    assert [one.id for one in again.engine.messages.values()] == [one.id for one in kept.values()]
    cold = Site(*RULES, kept=kept.values())
    cold.table.longest_s = 20.0  # for as long a tag may sleep
    assert ("ended", "in", "a") not in cold.run(20.0)
    cold.run(15.0)
    assert {what for what, _ in cold.happened} == {"ended", "updated"}
    ended = {one.rule for what, one in cold.happened if what == "ended"}
    assert ended == {"in", "near", "many"}  # the others hold until there is a sign against them
    gone = Site(*RULES[1:], kept=kept.values())
    assert ("ended", "in", "a") in gone.run(0.1)
    assert gone.happened[0][1].ended_unix_s == pytest.approx(EPOCH_S, abs=0.1)


def test_an_engine_that_follows_raises_nothing_and_one_that_leads_goes_on():
    first, second = Site(*RULES), Site(*RULES)
    second.engine.leading = False
    for site in (first, second):
        site.places = {"a": IN, "c": OUT}
    assert len(first.run(5.0)) == 2
    assert second.run(5.0) == []
    second.engine.resume(first.engine.messages.values(), second.now_s, second.unix_s)
    assert second.run(5.0) == []
    for site in (first, second):
        site.engine.leading = False
        site.places["c"] = IN
        assert site.run(5.0) == []
    second.engine.resume(first.engine.messages.values(), second.now_s, second.unix_s)
    assert set(second.run(5.0)) == {
        ("ended", "out", "c"),
        ("raised", "in", "c"),
        ("raised", "near", "a~c"),
        ("raised", "many", "zone-hall"),
    }


def test_the_oldest_that_have_ended_make_room(monkeypatch):
    monkeypatch.setattr(engine_module, "MAX_KEPT", 3)
    site = Site(AlarmRule("r", "inside", zone="hall", clear_after_s=0.0))
    site.places = dict.fromkeys("abcd", IN)
    assert len(site.run(1.0)) == 3
    left = site.happened[0][1].subject
    site.places[left] = OUT
    happened = site.run(1.0)
    assert [what for what, *_ in happened] == ["ended", "dropped", "raised"]
    assert happened[1][2] == left


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.floats(0.5, 6.0))
def test_near_tags_are_those_of_all_pairs(seed, reach_m):
    rng = random.Random(seed)
    first, others = Concerned([f"t{k}" for k in range(6)], {}), Concerned([f"t{k}" for k in range(4, 12)], {})
    where = {f"t{k}": (rng.uniform(-8, 8), rng.uniform(-8, 8), rng.choice((1.0, 1.0, 6.0))) for k in range(14)}
    expected = {}
    for a, b in combinations(sorted(where), 2):
        distance_m = math.dist(where[a][:2], where[b][:2])
        are_meant = (a in first and b in others) or (b in first and a in others)
        if are_meant and distance_m < reach_m and abs(where[a][2] - where[b][2]) <= STOREY_M:
            expected[a, b] = pytest.approx(distance_m)
    assert near_tags(where, first, others, reach_m) == expected


def test_positions_that_are_not_on_earth_do_not_stop_it():
    site = Site(AlarmRule("r", "near", limit=0.5))
    site.places = {"a": (1e300, 0.0), "b": (1e300, 0.0)}
    assert site.run(1.0) == []
