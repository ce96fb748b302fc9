"""The engine of alarms at exact times: each kind of rule, hours, what is unknown, what is kept, and near tags."""

import math
import random
from itertools import combinations

import pytest
from alarm_site import EPOCH_S, HALL, IN, OUT, Site
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.site import AlarmRule
from skyless.run import alarms
from skyless.run.alarms import EVALUATION_S, STOREY_M, Concerned, is_over, near_tags
from skyless.run.mqtt.messages import AlarmMessage, Asset, WatchFinding, WatchMessage
from skyless.run.site_table import THRESHOLDS

INSIDE = AlarmRule("r", "inside", zone="hall", clear_after_s=0.0)


def changes(site):
    """Kind and sentence of all changes."""
    return [(what, one.sentence) for what, one in site.happened]


# Times


def test_an_alarm_is_raised_after_its_time_updated_and_ended_after_its_time():
    site = Site(replace(INSIDE, name="Too long", severity="critical", after_s=5.0, clear_after_s=2.0))
    site.places["t"] = IN
    assert site.run(5.25) == [(5.25, "raised", "r", "t")]
    raised = AlarmMessage(
        f"r/t/{round(1000 * site.unix_s)}", "r", "Too long", "inside", "critical", "t", EPOCH_S + 0.25, site.unix_s,
        "t has been in Hall for 5 s", ("t",), "hall", "Hall", IN, worst=5.0,
    )  # fmt: skip
    assert site.happened == [("raised", raised)]
    assert site.run(4.75) == []
    site.places["t"] = OUT
    assert site.run(2.25) == [(2.25, "ended", "r", "t")]
    assert site.happened[1:] == [
        ("updated", replace(raised, sentence="t has been in Hall for 7 s", worst=7.0)),  # a second and a tenth longer
        ("updated", replace(raised, sentence="t has been in Hall for 9 s", worst=9.0)),
        ("ended", replace(raised, sentence="t was in Hall for 10 s", worst=9.75, ended_unix_s=site.unix_s)),
    ]


def test_a_short_stay_and_a_short_absence_do_not_count():
    site = Site(replace(INSIDE, after_s=5.0, clear_after_s=3.0))
    for _ in range(2):
        site.places["t"] = IN
        assert site.run(5.0) == []
        site.places["t"] = OUT
        assert site.run(0.25) == []
    site.places["t"] = IN
    assert site.run(6.0) == [(5.25, "raised", "r", "t")]
    for place in (OUT, IN, OUT, IN):
        site.places["t"] = place
        assert site.run(3.0) == []
    assert site.last.worst > 15.0  # since it was first inside


def test_conditions_are_evaluated_five_times_a_second_and_sentences_once():
    site = Site(AlarmRule("off", "anchor-offline"))
    site.engine.on_anchors(["3"], None)
    site.run(3.5)
    assert [one.worst for _, one in site.happened] == [0.0, 1.0, 3.0]
    site = Site(*site.engine.rules)
    site.now_s = 0.0
    site.tick()
    site.engine.on_anchors(["4"], None)
    site.now_s = EVALUATION_S - 1e-9
    assert site.tick() == []
    site.now_s = EVALUATION_S
    assert [one.subject for _, one in site.tick()] == ["anchor-4"]


def test_a_tag_that_crosses_a_zone_between_two_evaluations_is_found():
    site = Site(INSIDE)
    site.places["t"] = OUT
    site.run(1.0)
    site.send("t", IN)
    assert site.engine.has_changes
    site.send("t", OUT)
    assert [what for what, _ in site.tick()] == ["raised", "ended"]
    assert not site.engine.has_changes


def test_hours_end_an_alarm_and_begin_its_time():
    site = Site(replace(INSIDE, after_s=3.0, hours="02:01-02:02, thu 02:04-02:05"))
    site.places["t"] = IN
    assert site.run(300.0) == [
        (63.0, "raised", "r", "t"), (120.0, "ended", "r", "t"), (243.0, "raised", "r", "t"), (300.0, "ended", "r", "t"),
    ]  # fmt: skip
    assert [one.worst for what, one in site.happened if what == "ended"] == [119.5, 299.5]


@pytest.mark.parametrize(
    ("seconds", "words"), [(1, "1 s"), (119, "119 s"), (120, "2 min"), (7199, "120 min"), (7200, "2.0 h")]
)
def test_times_are_said_in_seconds_minutes_and_hours(seconds, words):
    site = Site(AlarmRule("r", "silent", tags=("t",), after_s=seconds))
    site.run(seconds + 2.0, 1.0)
    assert changes(site) == [("raised", f"t has sent no fixes for {words}")]


# Kinds of rules


@pytest.mark.parametrize(
    ("kind", "values", "sentence"),
    [
        ("near", (2.0, 1.9375, 2.9375, 3.0), "t and u {are} 1.9 m apart{least}; at least 2 m is right"),
        ("crowded", (2, 3, 2, 1), "3 tags {are} in Hall{most}; at most 2 are allowed"),
        ("protection-level", (2.0, 2.0625, 1.0625, 1.0),
         "the protection level of t {is} 2.06 m{most}; at most 2 m is allowed"),
        ("battery", (2.0, 1.75, 2.75, 3.0), "the battery of t {is} at 175%{least}; 200% is the least"),
    ],
)  # fmt: skip
def test_a_limit_is_crossed_beyond_it_and_the_alarm_ends_at_the_hysteresis(kind, values, sentence):
    site = Site(AlarmRule("r", kind, zone="hall", limit=2.0, hysteresis=1.0, after_s=0.5, clear_after_s=0.5))
    expected = (), ("raised",), (), ("ended",)
    for value, what in zip(values, expected, strict=True):
        site.measure(kind, value)
        assert [(at_s, one) for at_s, one, *_ in site.run(THRESHOLDS.grace_s)] == [(0.75, one) for one in what]
    now = {"are": "are", "is": "is", "most": "", "least": ""}
    then = {"are": "were", "is": "was", "most": " at the most", "least": " at the least"}
    assert changes(site) == [("raised", sentence.format(**now)), ("ended", sentence.format(**then))]
    assert site.last.worst == values[1]


@pytest.mark.parametrize(
    ("kind", "worst", "end"),
    [("near", min, 9.0), ("protection-level", max, 0.125), ("battery", min, 1.0), ("crowded", max, 0)],
)
@given(steps=st.lists(st.integers(1, 3), min_size=1, max_size=12))
@settings(max_examples=20, deadline=None)
def test_an_alarm_has_the_worst_value_so_far_at_most_once_a_second_and_keeps_it(kind, worst, end, steps):
    values = steps if kind == "crowded" else [0.5 + 0.125 * step for step in steps]
    limit = {"near": 2.0, "battery": 0.9, "protection-level": 0.25, "crowded": 0.0}[kind]
    site = Site(AlarmRule("r", kind, zone="hall", limit=limit))
    for value in [*values, end]:
        site.measure(kind, value)
        site.run(0.5)
    site.run(6.0)
    what = [what for what, _ in site.happened]
    assert (what[0], what[-1], {*what[1:-1]} - {"updated"}) == ("raised", "ended", set())
    assert len(what) - 2 <= len(values) / 2 + 1
    said = [one.worst for _, one in site.happened]
    assert said == sorted(said, reverse=worst is min)
    assert site.last.worst == worst(values)


def test_outside_holds_for_a_tag_that_is_seen_elsewhere_and_not_for_one_that_is_not_seen():
    rule = AlarmRule("r", "outside", zone="hall")
    site = Site(replace(rule, clear_after_s=0.0), replace(rule, id="long", after_s=2.0))
    site.places = {"a": IN, "b": OUT}
    assert site.run(3.0) == [(0.75, "raised", "r", "b"), (2.75, "raised", "long", "b")]
    assert site.last.place == "at x 25.0, y 5.0 m"
    site.places = {}  # it is not known whether b has come back
    assert site.run(20.0) == []
    site.places["b"] = IN
    assert site.run(3.0) == [(0.25, "ended", "r", "b"), (1.25, "ended", "long", "b")]
    site.end("b")
    assert site.run(5.0) == []
    assert [one for one in changes(site) if one[0] != "updated"] == [
        ("raised", "b is not in Hall"),
        ("raised", "b has not been in Hall for 2 s"),
        *[("ended", "b was not in Hall for 22 s")] * 2,
    ]


def test_a_tag_is_outside_after_a_second_fix_and_half_a_second():
    site = Site(AlarmRule("r", "outside", zone="hall"))
    site.places["t"] = OUT
    site.run(0.25)
    del site.places["t"]
    assert site.run(3.0) == []
    site.places["t"] = OUT
    assert site.run(1.0) == [(0.25, "raised", "r", "t")]


def test_outside_of_a_zone_that_is_not_drawn_is_nobody():
    site = Site(AlarmRule("r", "outside", zone="hall"), zones=())
    site.places["t"] = OUT
    assert site.run(5.0) == []
    site.set_zones((HALL,))
    assert site.run(2.0) == [(0.5, "raised", "r", "t")]
    site.set_zones(())
    assert site.run(3.0) == [(1.25, "ended", "r", "t")]
    assert site.last.sentence == "t was not in hall for 2 s"


def test_silent_tags_those_named_and_those_heard():
    site = Site(
        AlarmRule("all", "silent", after_s=4.0), AlarmRule("one", "silent", after_s=6.0, tags=("never", "later")),
    )  # fmt: skip
    site.places = {"a": IN, "later": OUT}
    assert site.run(5.0) == []
    del site.places["a"]
    assert site.run(70.0) == [(1.25, "raised", "one", "never"), (4.0, "raised", "all", "a")]
    raised = [one.sentence for what, one in site.happened if what == "raised"]
    assert raised == ["never has sent no fixes for 6 s", "a has sent no fixes for 4 s"]
    site.places |= {"a": IN, "never": IN}
    assert site.run(3.0) == [(1.25, "ended", "all", "a"), (1.25, "ended", "one", "never")]
    assert site.last.sentence == "never sent no fixes for 75 s"


def test_near_tags_on_other_storeys_and_others_than_those_named_do_not_count():
    site = Site(AlarmRule("r", "near", limit=2.0, tags=("fork",), after_s=1.0))
    site.places = {"fork": IN, "up": (5.0, 5.0, 1.1 + STOREY_M), "t2": (8.0, 5.0, 1.0), "t3": (8.5, 5.0, 1.0)}
    assert site.run(2.0) == []
    site.places["t2"] = (6.0, 5.0, 1.0)
    assert site.run(2.0) == [(1.25, "raised", "r", "fork~t2")]
    assert (site.last.tags, site.last.position_m) == (("fork", "t2"), IN)
    site.places |= {"fork": (1e300, 0.0, 1.0), "t2": (1e300, 0.0, 1.0)}  # not on Earth
    assert site.run(2.0) == [(1.25, "ended", "r", "fork~t2")]


def test_a_crowd_is_of_the_tags_named_and_names_some_of_them():
    names = tuple(f"t{k:02}" for k in range(25))
    site = Site(AlarmRule("r", "crowded", zone="hall", limit=0.0, tags=names, after_s=0.5))
    site.places = {"other": IN}
    assert site.run(THRESHOLDS.grace_s + 1.0) == []
    site.places |= dict.fromkeys(reversed(names), IN)
    assert site.run(1.0) == [(0.75, "raised", "r", "zone-hall")]
    assert (site.last.place, site.last.tags) == ("Hall", names[:20])
    assert site.last.sentence == "25 tags are in Hall; at most 0 are allowed"


def test_a_protection_level_that_cannot_be_computed_is_the_worst_also_for_the_next_engine():
    rule = AlarmRule("r", "protection-level", limit=1.0)
    site = Site(rule)
    site.measure(rule.kind, math.inf)
    assert site.run(1.0) == [(0.25, "raised", "r", "t")]
    other = Site(rule, kept=[site.last])
    other.measure(rule.kind, 3.0)
    assert other.run(1.0) == []
    other.measure(rule.kind, None)  # of a method that has none
    assert other.run(2.0) == [(1.25, "ended", "r", "t")]
    assert changes(site) + changes(other) == [
        ("raised", "the protection level of t is unknown; at most 1 m is allowed"),
        ("updated", "the protection level of t was unknown; at most 1 m is allowed"),
        ("ended", "the protection level of t was unknown; at most 1 m is allowed"),
    ]


def moved(anchor, sentence):
    kinds = (("moved", (anchor,)), ("delay", (9,)))
    findings = tuple(WatchFinding(kind, anchors, 0.3, 0.01, 0.0, sentence) for kind, anchors in kinds)
    return WatchMessage(0.0, "watching", findings, 10)


def test_anchors():
    site = Site(AlarmRule("off", "anchor-offline", after_s=2.0), AlarmRule("moved", "anchor-moved"))
    assert site.run(1.0) == []
    site.engine.on_anchors(["3"], moved(4, "Anchor 4 has moved by 0.30 m."))
    assert site.run(3.0) == [(0.25, "raised", "moved", "anchor-4"), (2.25, "raised", "off", "anchor-3")]
    site.engine.on_anchors(None, moved(4, "Anchor 4 has moved by 0.40 m."))
    site.run(1.0)
    site.engine.on_anchors(None, WatchMessage(0.0, "learning", (), 0))
    assert site.run(3.0) == []
    site.engine.on_anchors([], WatchMessage(0.0, "watching", (), 0))
    assert site.run(3.0) == [(1.25, "ended", "off", "anchor-3"), (1.25, "ended", "moved", "anchor-4")]
    sentences = [one.sentence for _, one in site.happened]
    assert sentences == [
        "Anchor 4 has moved by 0.30 m", "anchor 3 has been offline for 2 s", "Anchor 4 has moved by 0.40 m",
        "anchor 3 has been offline for 4 s", "anchor 3 has been offline for 6 s",
        "anchor 3 was offline for 7 s", "Anchor 4 has moved by 0.40 m",
    ]  # fmt: skip


def test_groups_and_names_of_assets():
    people = [Asset("t1", name="Ada", group="people"), Asset("t2", group="people"), Asset("t3", group="forks")]
    site = Site(replace(INSIDE, tags=("group:people", "t4")), assets=people)
    site.places = dict.fromkeys(("t1", "t3", "t4"), IN)
    assert site.run(1.0) == [(0.25, "raised", "r", "t1"), (0.25, "raised", "r", "t4")]
    assert [sentence for _, sentence in changes(site)] == ["Ada (t1) is in Hall", "t4 is in Hall"]
    site.engine.set_assets({"t3": Asset("t3", name="t3", group="people")})
    assert site.run(1.0) == [(0.25, "ended", "r", "t1"), (0.25, "raised", "r", "t3")]
    assert "t9" in Concerned((), {})
    assert "t9" not in Concerned(("group:nobody",), {})


# What is unknown


@pytest.mark.parametrize("kind", ["inside", "near", "crowded", "silent", "protection-level", "outside"])
def test_silence_while_messages_cannot_arrive_changes_nothing(kind):
    place = OUT if kind == "outside" else IN
    site = Site(AlarmRule("r", kind, zone="hall", limit=1.0, after_s=4.0))
    site.places = {"a": place, "b": place}
    site.levels_m["a"] = 1.5
    raised = len(site.run(6.0))
    assert (raised > 0) == (kind != "silent")
    places, site.places, site.blind = site.places, {}, True
    assert site.run(60.0) == []
    site.blind = False
    if kind == "silent":  # it counts from the last time when messages may have been missed
        assert [one[:2] for one in site.run(5.0)] == [(4.0, "raised")] * 2
        assert site.last.since_unix_s == site.unix_s - 5.0
        return
    assert site.run(3.75) == []
    site.places = places
    assert site.run(20.0) == []


@pytest.mark.parametrize("ends", [False, True])
def test_what_was_not_heard_since_messages_were_missed_ends_when_its_tag_would_be_gone(ends):
    """Ten seconds after the last time when messages may have been missed; at once if all its tags say that they end."""
    site = Site(AlarmRule("near", "near", limit=2.0), AlarmRule("level", "protection-level", limit=1.0))
    site.places, site.levels_m["a"] = {"a": IN, "b": IN}, 1.5
    assert len(site.run(20.0)) == 2
    site.levels_m.clear()
    site.blind = True
    assert site.run(0.25) == []
    site.places = {}
    assert site.run(4.0) == []
    site.blind = False
    if ends:
        site.end("a")
    ended_s = 1.25 if ends else 11.0
    assert sorted(site.run(12.0)) == [(ended_s, "ended", "level", "a"), (11.0, "ended", "near", "a~b")]


# What is kept


def test_an_alarm_is_kept_until_it_has_ended_and_is_acknowledged():
    site = Site(INSIDE)
    site.places["t"] = IN
    site.run(1.0)
    first = site.last
    assert site.engine.acknowledge("r", "u", first.id, "Ada", site.unix_s) is False
    assert site.engine.acknowledge("r", "t", "another", "Ada", site.unix_s) is False
    assert site.engine.acknowledge("r", "t", first.id, "Ada", site.unix_s) is True
    assert site.engine.acknowledge("r", "t", first.id, "Bob", site.unix_s) is False
    assert site.run(0.25) == [(0.25, "acknowledged", "r", "t")]
    kept = site.engine.messages["r", "t"]
    assert (kept.acknowledged_by, kept.acknowledged_unix_s) == ("Ada", site.unix_s - 0.25)
    site.places["t"] = OUT
    assert site.run(1.0) == [(0.25, "ended", "r", "t")]
    assert is_over(site.last)
    assert site.engine.messages == {}
    for place in (IN, OUT):
        site.places["t"] = place
        site.run(1.0)
    second = site.last
    assert list(site.engine.messages.values()) == [second]  # ended, and nobody has seen it
    site.places["t"] = IN
    assert site.run(1.0) == [(0.25, "raised", "r", "t")]
    assert len({first.id, second.id, site.last.id}) == 3
    assert not site.engine.acknowledge("r", "t", second.id, "Ada", site.unix_s)


def test_the_oldest_that_have_ended_make_room(monkeypatch):
    monkeypatch.setattr(alarms, "MAX_KEPT", 3)
    site = Site(INSIDE)
    site.places = dict.fromkeys("abcd", IN)
    assert site.run(1.0) == [(0.25, "raised", "r", tag) for tag in "abc"]
    site.places |= {"c": OUT}
    assert site.run(1.0) == [(0.25, "ended", "r", "c"), (0.25, "dropped", "r", "c"), (0.25, "raised", "r", "d")]
    assert set(site.engine.messages) == {("r", tag) for tag in "abd"}


def test_rules_that_change_keep_their_alarms_and_times_while_kind_and_zone_stay():
    rule = replace(INSIDE, after_s=2.0)
    site = Site(rule)
    site.places["t"] = IN
    assert site.run(1.0) == []
    site.engine.set_rules([replace(rule, severity="critical"), AlarmRule("x", "silent", after_s=1.0)])
    assert site.run(2.0) == [(1.25, "raised", "r", "t")]
    for other in ([replace(rule, zone="yard")], [AlarmRule("r", "battery", limit=0.5)], []):
        site.engine.set_rules(other)
        assert site.run(1.0) == [(0.25, "ended", "r", "t")]
        site.engine.set_rules([rule])
        assert site.run(3.0) == [(2.25, "raised", "r", "t")]


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
    site.places = {"a": IN, "b": (5.5, 5.0, 1.0), "c": OUT, "d": OUT}
    site.hear_health("a", 0.1)
    site.run(2.0)
    del site.places["d"]
    site.run(68.0)
    kept = dict(site.engine.messages)
    assert {key[0] for key in kept} == {rule.id for rule in RULES}
    again = Site(*RULES, kept=kept.values())
    again.places = dict(site.places)
    assert again.run(30.0) == []
    assert [one.id for one in again.engine.messages.values()] == [one.id for one in kept.values()]


@pytest.mark.parametrize(
    ("rule", "value", "ends_s"),
    [
        (AlarmRule("r", "inside", zone="hall"), 1, 21.25),
        (AlarmRule("r", "near", limit=2.0), 1.0, 21.25),
        (AlarmRule("r", "crowded", zone="hall", limit=1.0), 2, THRESHOLDS.grace_s + 1.25),
        (AlarmRule("r", "protection-level", limit=0.5), 1.0, 21.25),
        (AlarmRule("r", "battery", limit=0.2), 0.1, None),
    ],
)
def test_an_engine_that_hears_nothing_ends_alarms_when_their_tags_could_sleep_no_longer(rule, value, ends_s):
    """What has ended says the worst value that the engine before knew, and counts on from its beginning."""
    site = Site(rule)
    site.measure("crowded" if rule.kind == "inside" else rule.kind, value)
    site.run(6.0)
    kept = site.last
    cold = Site(rule, kept=[kept], longest_s=20.0)
    happened = cold.run(30.0)
    assert happened == ([] if ends_s is None else [(ends_s, "ended", "r", kept.subject)])
    if ends_s is not None:
        assert cold.last.id == kept.id
        assert cold.last.ended_unix_s == EPOCH_S + ends_s


def test_the_next_engine_counts_on_and_ends_alarms_of_rules_that_are_no_more():
    site = Site(INSIDE)
    site.places["t"] = IN
    site.run(30.25)
    over = replace(site.last, subject="u", ended_unix_s=1.0, acknowledged_unix_s=1.0)
    other = Site(INSIDE, kept=[site.last, over])
    assert set(other.engine.messages) == {("r", "t")}
    other.now_s += 40.0
    other.places["t"] = IN
    other.run(0.25)
    assert other.last.sentence == "t has been in Hall for 40 s"
    third = Site(AlarmRule("x", "silent", after_s=9.0), kept=[other.last])
    assert third.run(1.0) == [(0.25, "ended", "r", "t")]
    assert third.last.sentence == other.last.sentence


def test_an_alarm_of_unknown_value_keeps_its_sentence():
    site = Site(AlarmRule("r", "battery", limit=0.2))
    site.hear_health("t", 0.1)
    site.run(1.0)
    other = Site(*site.engine.rules, kept=[replace(site.last, worst=None)])
    other.hear_health("t", None)
    assert other.run(1.0) == []
    other.hear_health("t", 0.3)
    assert other.run(2.0) == [(1.25, "ended", "r", "t")]
    assert changes(other) == [("ended", site.last.sentence)]


def test_an_engine_that_follows_raises_nothing_and_one_that_leads_goes_on():
    first, second = Site(*RULES), Site(*RULES)
    second.engine.leading = False
    for site in (first, second):
        site.places = {"a": IN, "c": OUT}
    assert first.run(5.0) == [(0.25, "raised", "in", "a"), (0.75, "raised", "out", "c")]
    assert second.run(5.0) == []
    second.resume(first.engine.messages.values())
    assert second.run(5.0) == []
    for site in (first, second):
        site.engine.leading = False
        site.places["c"] = IN
        assert site.run(5.0) == []
    second.resume(first.engine.messages.values())
    assert {one[1:] for one in second.run(5.0)} == {
        ("ended", "out", "c"), ("raised", "in", "c"), ("raised", "near", "a~c"), ("raised", "many", "zone-hall"),
    }  # fmt: skip


def test_tags_are_forgotten_after_a_day_unless_a_rule_names_them():
    site = Site(AlarmRule("all", "silent", after_s=4.0), AlarmRule("one", "silent", after_s=4.0, tags=("t",)))
    site.places["t"] = IN
    site.run(1.0)
    site.places = {}
    assert len(site.run(5.0)) == 2
    assert site.run(THRESHOLDS.forgotten_s - 70.0, 30.0) == []
    assert [one[1:] for one in site.run(200.0, 30.0)] == [("ended", "all", "t")]


# Near tags


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


@pytest.mark.parametrize(
    ("x", "gap", "z", "near"),
    [(0.0, 2.0, 0.0, 0), (0.0, 1.9375, STOREY_M, 1), (999_999.0, 0.0, 0.0, 1), (1e6, 0.0, 0.0, 0)],
)
def test_near_is_less_than_the_reach_on_one_storey_and_on_earth(x, gap, z, near):
    everybody = Concerned((), {})
    for sign in (1.0, -1.0):
        a, b = sign * x, sign * x + gap
        assert len(near_tags({"a": (a, 0.0, 0.0), "b": (b, 0.0, z)}, everybody, everybody, 2.0)) == near
        assert len(near_tags({"a": (0.0, a, z), "b": (0.0, b, 0.0)}, everybody, everybody, 2.0)) == near
