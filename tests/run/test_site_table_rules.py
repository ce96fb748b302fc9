"""Each rule of the table of a live site, at the very time from which it holds."""

import math
from collections import Counter

import pytest
from dashboard_builders import fix, status
from msgspec import UNSET
from msgspec.structs import replace

from skyless.run.mqtt.messages import Asset
from skyless.run.site_table import MAX_NAMES, THRESHOLDS, Node, SiteTable
from skyless.sim.lab import lab_site
from support.site_messages import anchor_health, tag_health

DAY_S = THRESHOLDS.forgotten_s


def table_with(*fixes_s, begin_s=0.0):
    """A table, and its tag t1 with fixes at these times."""
    table = SiteTable(begin_s)
    heard(table, *fixes_s)
    return table, table.get("tag", "t1")


def heard(table, *fixes_s):
    for at_s in fixes_s:
        table.add_fix(fix(unix_s=1e9 + at_s), at_s)


def each_second(begin_s, end_s):
    return [begin_s + second for second in range(round(end_s - begin_s) + 1)]


def test_of_a_new_node_nothing_is_known():
    node = Node("t1")
    assert (node.online, node.host, node.interval_s, node.row, node.fix) == (None, "", None, None, None)
    assert (node.ended_unix_s, node.serial, node.health_serial, node.status_serial) == (0.0, 0, 0, 0)
    table = SiteTable(0.0)
    assert (table.fixes_serial, table.healths_serial, table.statuses_serial, table.is_empty) == (0, 0, 0, True)


# The interval of a tag


def test_the_interval_of_a_tag_is_known_after_ten_seconds():
    table, tag = table_with(*each_second(100, 109), 109.9, begin_s=100.0)
    assert tag.interval_s is None
    heard(table, 110.0)
    assert tag.interval_s == 0.0


@pytest.mark.parametrize(
    ("fixes_s", "interval_s"),
    [
        ([*each_second(0, 51), 60.0], 9.0),  # a gap that fills 15 % of the time in which it is remembered
        ([*each_second(0, 52), 61.0], 0.0),
        ([*each_second(0, 85), 100.0], 0.0),  # it had gone
        ([1000.0, 1020.0, 1090.0], 70.0),  # of a tag that was not heard for longer
        ([1000.0, 1020.0, 1120.0], 20.0),  # it had gone after 80 s
        ([*each_second(0, 100), 108.0, 118.0], 10.0),  # 8 s are as long as 10 s
        ([*each_second(0, 100), 107.9, 117.9], 7.9),
        ([*each_second(0, 90), *each_second(100, 190), 200.0], 10.0),  # the first gap is remembered for 100 s
        ([*each_second(0, 90), *each_second(100, 191), 201.0], 0.0),
        ([*each_second(0, 86), 88.0, 90.0, 92.0, 102.0], 2.0),  # short gaps are nothing to a long one
    ],
)
def test_gaps_that_fill_a_share_of_the_remembered_time_are_the_interval(fixes_s, interval_s):
    _, tag = table_with(*fixes_s, begin_s=fixes_s[0])
    assert tag.interval_s == pytest.approx(interval_s, abs=1e-9)


def test_of_the_gaps_the_last_eight_are_remembered_for_ten_times_their_length():
    table, tag = table_with(*(2.0 * number for number in range(20)))
    assert len(tag.gaps) == 8
    heard(table, *each_second(39.0, 58.0))
    assert [gap.end_s for gap in tag.gaps] == [38.0]
    heard(table, 59.0)
    assert (tag.gaps, tag.interval_s) == ([], 0.0)


def test_a_tag_is_there_since_its_first_fix_after_it_was_last_gone():
    table, tag = table_with(*each_second(0, 20))
    assert tag.first_s == 0.0
    table.tick(40.0)
    heard(table, 50.0)
    assert tag.first_s == 50.0


def test_an_absence_is_no_rhythm_however_short_the_time_before_and_two_alike_are_one():
    table, serial = SiteTable(0.0), 0

    def stay(begin_s, end_s):
        nonlocal serial
        for step in range(round(10 * begin_s), round(10 * end_s)):
            serial += 1
            table.add_fix(fix(serial=serial, unix_s=0.1 * step), 0.1 * step)
            table.tick(0.1 * step)
        return table.gone_after_s(table.get("tag", "t1"))

    assert stay(0.0, 60.0) == THRESHOLDS.gone_s
    assert table.tick(200.0) == ["t1"]
    assert stay(360.0, 380.0) == THRESHOLDS.gone_s
    assert table.tick(391.0) == ["t1"]
    assert stay(680.0, 700.0) == THRESHOLDS.longest_s
    assert stay(10_000.0, 10_020.0) == THRESHOLDS.gone_s


# Whether it is there


def test_a_tag_is_gone_from_the_time_on_that_its_silence_is_as_long_as_the_limit():
    table, tag = table_with(*each_second(0, 20))
    assert [table.tick(at_s) for at_s in (10.0, 20.0, 29.99)] == [[], [], []]
    assert (table.is_there(tag, 29.99), table.is_there(tag, 30.0)) == (True, False)
    assert table.tick(30.0) == ["t1"]
    table, _ = table_with(*each_second(0, 19))
    assert [table.tick(at_s) for at_s in (10.0, 20.0)] == [[], []]
    heard(table, 19.5)
    assert [table.tick(at_s) for at_s in (29.0, 29.5)] == [[], ["t1"]]


@pytest.mark.parametrize(("interval_s", "until_s"), [(None, 2.5), (10.0, 25.0)])
def test_a_fix_is_fresh_for_two_and_a_half_intervals(interval_s, until_s):
    table = SiteTable(100.0)
    table.add_health("tag", "t1", tag_health(interval_s=interval_s), 100.0)
    heard(table, 100.0)
    tag = table.get("tag", "t1")
    assert [table.is_fresh(tag, 100.0 + age_s) for age_s in (until_s - 0.01, until_s)] == [True, False]
    assert [table.presence(tag, 100.0 + age_s) for age_s in (until_s - 0.01, until_s)] == ["fresh", "late"]
    table.add_status(status(online=False), 101.0)
    assert table.is_fresh(tag, 101.0) is False


def test_a_tag_sleeps_until_the_time_that_it_stated():
    table, tag = table_with(*each_second(0, 20))
    serial = table.fixes_serial
    table.add_health("tag", "t1", tag_health(), 20.0)
    assert table.fixes_serial == serial, "nothing has changed for readers of fixes"
    table.add_health("tag", "t1", tag_health(sleeps_s=50.0), 20.0)
    assert (table.fixes_serial, tag.serial) == (serial + 1, serial + 1)
    assert [table.presence(tag, at_s) for at_s in (69.9, 70.0, 80.0)] == ["asleep", "late", "gone"]
    table.add_health("tag", "t1", tag_health(), 69.0)
    assert table.fixes_serial == serial + 2, "it is awake again"
    table.add_health("tag", "t1", tag_health(sleeps_s=1.0), 69.0)
    table.add_health("tag", "t1", tag_health(), 70.0)
    assert table.fixes_serial == serial + 3
    for stated_s, believed_s in ((None, 0.0), (-1.0, 0.0), (math.inf, DAY_S)):
        table.add_health("tag", "t1", tag_health(interval_s=stated_s), 80.0)
        assert tag.stated_s == believed_s


def test_a_sleep_is_no_gap_in_a_tag_s_rhythm():
    table, tag = table_with(*each_second(0, 20))
    table.add_health("tag", "t1", tag_health(sleeps_s=100.0), 20.0)
    assert table.tick(119.0) == []
    heard(table, 121.0)
    assert (tag.gaps, tag.fix_s) == ([], 121.0)


def test_silence_counts_as_long_as_both_feeds_can_bring_something():
    table, tag = table_with(*each_second(0, 50))
    table.set_connected(connected=True, now_s=51.0)
    assert table.ready_s == 0.0
    table.set_connected(connected=False, now_s=60.0, batches=True)
    assert (table.hears, table.connected, table.batches_connected) == (False, True, False)
    table.set_connected(connected=False, now_s=70.0)
    assert table.silent_s(tag, 100.0) == 10.0
    heard(table, 65.0)
    assert table.silent_s(tag, 100.0) == 0.0
    table.set_connected(connected=True, now_s=110.0)
    assert table.ready_s == 0.0, "batches are still missing"
    table.set_connected(connected=True, now_s=120.0, batches=True)
    assert (table.ready_s, table.silent_s(tag, 125.0)) == (120.0, 5.0)
    assert (table.in_grace(124.9), table.in_grace(125.0)) == (True, False)
    table.add_status(status("tag", "t2"), 122.0)
    assert [table.in_grace(126.9, node) for node in (tag, table.get("tag", "t2"))] == [False, True]


# Fixes, statuses, healths, anchors, batches


def test_a_late_or_repeated_fix_is_counted_and_changes_nothing_and_a_clock_set_back_is_followed():
    drops = Counter()
    table, first = SiteTable(0.0, drops=drops), fix(serial=5, unix_s=1000.0)
    assert table.add_fix(first, 0.0) is table.get("tag", "t1")
    for old in (first, replace(first, serial=4, unix_s=999.5)):
        assert table.add_fix(old, 0.5) is None
    assert (drops["late-fix"], table.get("tag", "t1").fix) == (2, first)
    for serial, unix_s in ((6, 995.0), (7, 1e9), (8, 1000.0), (1, 1.0), (2, 4e12)):  # set back, years ahead, restarted
        assert table.add_fix(fix(serial=serial, unix_s=unix_s), 1.0) is not None
    assert table.presence(table.get("tag", "t1"), 1.0) == "fresh"


def test_a_program_has_begun_with_its_first_online_status_or_health():
    table = SiteTable(0.0)
    table.add_health("tag", "t1", tag_health(), 1.0)
    tag = table.get("tag", "t1")
    table.add_health("tag", "t1", tag_health(), 2.0)
    assert (tag.since_s, tag.health_serial, table.healths_serial) == (1.0, 2, 2)
    found = []
    for now_s, online, started_s in (
        (3.0, True, 1.0),
        (4.0, True, 1.0),
        (5.0, True, 2.0),
        (6.0, False, 2.0),
        (7.0, True, 2.0),
    ):
        assert table.add_status(status(online=online, unix_s=started_s), now_s) is False
        found.append(tag.since_s)
        assert tag.online is online
    assert found == [3.0, 3.0, 5.0, 5.0, 7.0]
    assert (tag.status_serial, table.statuses_serial) == (5, 5)


def test_a_status_that_ends_a_program_keeps_its_host_and_ends_its_fixes():
    table, tag = table_with(*each_second(0, 20))
    table.add_status(replace(status(), host="one"), 20.0)
    serial = table.fixes_serial
    assert table.add_status(status(online=False), 21.0) is True
    assert (tag.host, tag.is_gone, tag.serial) == ("one", True, serial + 1)
    table.add_status(replace(status(), host="two"), 22.0)
    assert tag.host == "two"
    assert table.add_status(status(online=False), 22.0) is False, "it had gone"
    assert table.add_status(status("anchor", "1", online=False), 22.0) is False
    assert (table.get("anchor", "1").serial, table.fixes_serial) == (0, serial + 2)


def test_a_status_or_health_beyond_the_limit_of_names_is_nobody_s(monkeypatch):
    monkeypatch.setitem(MAX_NAMES, "tag", 1)
    table, _ = table_with(0.0)
    assert table.add_status(status("tag", "t2", online=False), 1.0) is False
    table.add_health("tag", "t2", tag_health("t2"), 1.0)
    assert table.add_fix(fix("t2"), 1.0) is None
    assert list(table.all("tag")) == ["t1"]
    assert table.roster.admits("tag", "t2") is False


def test_an_anchor_is_used_while_a_fix_that_used_it_is_fresh():
    table = SiteTable(0.0)
    table.add_health("anchor", "2", anchor_health(2), 0.0)
    table.add_fix(fix("often", anchors=(1, 2)), 1.0)
    assert [(name, node.used_until_s) for name, node in table.senders("anchor")] == [("1", 3.5), ("2", 3.5)]
    table.add_health("tag", "rare", tag_health("rare", interval_s=10.0), 2.0)
    table.add_fix(fix("rare", anchors=(2,)), 2.0)
    table.add_fix(fix("often", anchors=(2,), serial=2), 3.0)
    assert table.get("anchor", "2").used_until_s == 2.0 + 10.0 * THRESHOLDS.fresh_intervals


@pytest.mark.parametrize("said", [("health", "fix"), ("fix", "health"), ("fix",)])
def test_a_tag_that_wakes_early_and_stops_is_gone_after_its_own_time(said):
    """Its announced sleep counts neither as silence nor as its interval once it is awake."""
    table = SiteTable(0.0)
    for now_s in range(20):
        table.add_fix(fix(unix_s=float(now_s), serial=now_s), float(now_s))
    table.add_health("tag", "t1", tag_health(sleeps_s=28_800.0), 20.0)
    assert table.add_status(status("tag", "t1", online=False), 20.5) is False, "it disconnects to sleep"
    assert [table.tick(float(now_s)) for now_s in range(21, 600)] == [[]] * 579
    assert table.presence(table.get("tag", "t1"), 599.0) == "asleep"
    table.add_status(status("tag", "t1", online=True), 600.0)
    for word in said:
        if word == "health":
            table.add_health("tag", "t1", tag_health(), 600.0)
        else:
            table.add_fix(fix(unix_s=600.0, serial=600), 600.0)
    for now_s in range(601, 700):
        table.add_fix(fix(unix_s=float(now_s), serial=now_s), float(now_s))
        assert table.tick(float(now_s)) == []
    gone = {now_s: table.tick(float(now_s)) for now_s in range(700, 1700)}
    assert [now_s for now_s, tags in gone.items() if tags] == [709]


def test_a_tag_that_sleeps_for_a_day_and_does_not_return_has_gone_before_it_is_forgotten():
    table = SiteTable(0.0)
    table.add_fix(fix(), 0.0)
    table.add_health("tag", "t1", tag_health(sleeps_s=DAY_S), 1.0)
    table.add_status(status("tag", "t1", online=False), 1.0)
    gone = {now_s: tags for now_s in range(0, 2 * round(DAY_S) + 3600, 60) if (tags := table.tick(float(now_s)))}
    assert [tags for now_s, tags in gone.items() if now_s > DAY_S] == [["t1"]]
    assert table.get("tag", "t1") is None


def test_nodes_are_in_natural_order():
    table = SiteTable(0.0)
    for name in ("b", "10", "9", "a"):
        table.add_status(status("anchor", name), 0.0)
    assert [name for name, _ in table.senders("anchor")] == ["9", "10", "a", "b"]


def test_an_anchor_s_beacons_have_codes_since_the_first_health_with_a_chain_and_no_fault():
    table = SiteTable(0.0)
    stated = [(None, None), (1, None), (1, None), (1, "no-time"), (None, "no-time"), (1, None)]
    found = []
    for now_s, (chain, fault) in enumerate(stated):
        table.add_health("anchor", "1", anchor_health(chain=chain, code_fault=fault), float(now_s))
        found.append(table.get("anchor", "1").codes_s)
        assert now_s or table.get("anchor", "1").codes_for_s(9.0) == 0.0
    assert found == [None, 1.0, 1.0, None, None, 5.0]
    assert table.get("anchor", "1").codes_for_s(8.0) == 3.0


def test_of_the_tags_in_a_batch_those_that_send_rarely_are_returned_with_their_limits():
    table = SiteTable(0.0)
    for second in range(21):
        assert table.hear(["often", *(["rare"] if second % 10 == 0 else [])], float(second)) == (
            {"rare": 40.0} if second in (10, 20) else {}
        )
    assert set(table.batched) == {"often", "rare"}


# What is forgotten


def test_what_has_been_silent_for_a_day_is_forgotten_within_a_minute_but_for_the_site_s_anchors():
    table = SiteTable(0.0)
    site = lab_site()
    table.set_site(site, 0.0)
    own = table.site_anchors[0]
    for kind, name in (("tag", "t1"), ("tag", own), ("anchor", "999"), ("anchor", own)):
        table.add_status(status(kind, name), 1.0)
        table.add_status(status(kind, name, online=False), 1.0)

    def known():
        return [(kind, name) for kind in ("tag", "anchor") for name in table.all(kind)]

    table.add_fix(fix(anchors=()), 1.0)
    table.hear(["t2"], 1.0)
    everything = known()
    table.tick(DAY_S + 1.0)
    assert known() == everything, "a day is over, and no more"
    table.tick(DAY_S + 60.9)
    assert known() == everything, "it is looked at once a minute"
    table.tick(DAY_S + 61.0)
    assert (known(), table.fixed, table.batched) == ([("anchor", own)], {}, {})


def test_names_that_are_refused_are_counted_up_to_the_limit_and_for_ten_seconds(monkeypatch):
    monkeypatch.setitem(MAX_NAMES, "tag", 10)
    table = SiteTable(0.0)
    assert table.roster.left_out("tag", 0.0) == 0
    table.hear([f"t{number}" for number in range(15)], 1.0)
    assert table.roster.left_out("tag", 1.0) == 5
    table.hear([f"t{number}" for number in range(50)], 2.0)
    assert table.roster.left_out("tag", 9.9) == 10
    assert table.roster.left_out("tag", 10.0) == 10
    assert table.roster.left_out("tag", 19.9) == 10
    assert table.roster.left_out("tag", 20.0) == 0


def test_a_site_states_its_anchors_and_the_longest_silences_of_all_and_of_groups():
    table, tag = table_with(0.0)
    table.set_assets({"t1": Asset("t1", group="vans")})
    site = lab_site()
    table.set_site(site, 5.0)
    assert (table.ready_s, table.longest_silence_s(tag)) == (5.0, THRESHOLDS.longest_s)
    assert table.site_anchors == tuple(str(anchor.id) for anchor in site.anchors)
    for groups_s, longest_s in ((UNSET, 60.0), ({"vans": 90.0}, 90.0)):
        tags = replace(site.tags, longest_silence_s=60.0, group_silence_s=groups_s)
        table.set_site(replace(site, tags=tags), 6.0)
        table.set_assets({"t1": Asset("t1", group="vans")})
        assert (table.ready_s, table.longest_silence_s(tag)) == (5.0, longest_s)
