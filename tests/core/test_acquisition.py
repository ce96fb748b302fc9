"""Each rule of the search for a tag's first position, at the very number from which it holds."""

import math

import numpy as np
import pytest
from pseudoranges import located

from skyless.core.estimator.process import Packet, Place, Relay, Relays
from skyless.core.estimator.settings import TUNING
from skyless.core.native.records import MAX_ANCHORS, first
from skyless.core.native.views import view
from skyless.core.tag import acquisition
from skyless.core.tag.acquisition import (
    ACQUIRING,
    MAX_LINKS,
    TOO_FEW_ANCHORS,
    UNUSABLE,
    Acquisition,
    HeardAnchor,
    forget_all,
    forget_packets,
    gather_packet,
    try_start,
)
from skyless.core.tag.position import FOUND, MIRROR, RESIDUALS
from skyless.core.tag.search import LARGEST
from skyless.core.ticks import MAX_DRIFT, NEVER, SPEED_OF_LIGHT_MPS, TICK_M, TICK_RATE_HZ, TICK_S, from_seconds

MS = from_seconds(1e-3)
PLACE_M = np.array([3.0, 4.0, 1.0])
ANCHORS_M = np.array([[0, 0, 3.0], [10, 0, 2.5], [10, 8, 5.0], [0, 8, 0.0], [5, -1, 2.8], [5, 9, 2.2]])
CLOCKS = [(10**12, 15e-6), (5, -9e-6), (10**11, 18e-6), (77, 2e-6), (10**9, -19e-6), (10**8, 7e-6), (10**7, 1e-6)]
"""Reading at the time 0 and drift of the tag's clock, and of each anchor's."""


def reading(clock, at_s):
    begin, drift = CLOCKS[clock]
    return begin + round((1.0 + drift) * at_s * TICK_RATE_HZ)


def sent_s(anchor, turn):
    return 0.1 * turn + 0.01 * anchor


def sent(anchor, turn, late_m=0.0):
    """An anchor's packet as the tag receives it."""
    position_m, at_s = ANCHORS_M[anchor - 1], sent_s(anchor, turn)
    rx_ticks = reading(0, at_s + (np.linalg.norm(position_m - PLACE_M) + late_m) / SPEED_OF_LIGHT_MPS)
    place = Place(anchor=anchor, position_m=tuple(position_m))
    return Packet(place=place, sequence=turn, rx_ticks=rx_ticks, tx_ticks=reading(anchor, at_s), variance_factor=1.0)


def relayed_by(anchor, turn, others):
    """All that an anchor has received since its last packet."""
    relays = Relays()
    for other in others:
        then = turn if other < anchor else turn - 1
        if other != anchor and then >= 0:
            apart_m = np.linalg.norm(ANCHORS_M[anchor - 1] - ANCHORS_M[other - 1])
            rx_ticks = reading(anchor, sent_s(other, then) + apart_m / SPEED_OF_LIGHT_MPS)
            relays.rows[relays.count] = Relay(listener=anchor, anchor=other, sequence=then, rx_ticks=rx_ticks)
            relays.count += 1
    return relays


def search(count=0, *, turns=2, height_m=1.0, late=0, late_m=0.0):
    """A search after this number of turns of the anchors' packets; those of one may be late."""
    q = Acquisition(
        knows_height=height_m is not None, height_m=height_m or 0.0, variance_m2=0.0008, max_age_s=0.5, start_age_s=0.5,
        speed_std_mps=2.0, error_variance_m2=0.0001, tuning=TUNING,
    )  # fmt: skip
    for turn in range(turns):
        for anchor in range(1, count + 1):
            packet = sent(anchor, turn, late_m if anchor == late else 0.0)
            gather_packet(q, packet, relayed_by(anchor, turn, range(1, count + 1)))
    return q


def go_on(q, anchor, count, turn=2):
    return try_start(q, sent(anchor, turn), relayed_by(anchor, turn, range(1, count + 1)))


def packet_of(anchor, rx_ticks=0, *, tx_ticks=0, sequence=0, position_m=(0.0, 0.0, 0.0)):
    place = Place(anchor=anchor, position_m=position_m)
    return Packet(place=place, sequence=sequence, rx_ticks=rx_ticks, tx_ticks=tx_ticks, variance_factor=1.0)


def with_packets(*rx_ticks, **fields):
    """A search in which anchors 1, 2 ... have sent twice, the second time at these times."""
    q = Acquisition(tuning=TUNING, start_age_s=TUNING.start_age_s, **fields)
    for anchor, ticks in enumerate(rx_ticks, start=1):
        for before, sequence in ((10 * MS, 4), (0, 5)):
            gather_packet(q, packet_of(anchor, ticks - before, sequence=sequence), Relays())
    return q


def with_links(q, *pairs):
    for listener, sender in pairs:
        link = q.links[q.link_count]
        link.listener, link.sender, link.rx_ticks_tag, link.ticks = listener, sender, 0, 0
        q.link_count += 1
    return q


def anchors_of(q):
    return [one.newer.packet.place.anchor for one in first(q.heard, q.count)]


def pairs_of(q):
    return [acquisition._anchor_of(q, pair) for pair in range(q.pair_count)]


def links_of(q):
    return [(link.listener, link.sender) for link in first(q.links, q.link_count)]


def near(value):
    return pytest.approx(value, rel=1e-9, abs=1e-12)


# What is kept


def test_packets_and_links_of_an_anchor_are_forgotten():
    q = with_links(with_packets(0, 0, 0), (1, 2), (2, 3), (3, 1), (3, 2))
    forget_packets(q, 9)
    assert (anchors_of(q), len(links_of(q))) == ([1, 2, 3], 4)
    forget_packets(q, 1)
    assert (anchors_of(q), links_of(q)) == ([2, 3], [(2, 3), (3, 2)])
    forget_all(q)
    assert (q.count, q.link_count) == (0, 0)


def test_two_packets_of_each_anchor_are_kept():
    q = Acquisition()
    for turn, had_two in enumerate((False, False, True, True)):
        relays = Relays(count=1)
        relays.rows[0].anchor = 50 + turn
        assert gather_packet(q, packet_of(1, sequence=turn), relays) is had_two
        one = q.heard[0]
        assert (q.count, one.count, one.newer.packet.sequence) == (1, min(turn + 1, 2), turn)
        assert (one.newer.relay_count, one.newer.relays[0].anchor) == (1, 50 + turn)
        assert one.older.packet.sequence == max(turn - 1, 0)
    q.heard[0].fitted_ticks = 7
    forget_all(q)
    assert gather_packet(q, packet_of(2), Relays()) is False
    assert (q.heard[0].count, q.heard[0].fitted_ticks) == (1, NEVER)


@pytest.mark.parametrize("longest", [(0,), (1,), (MAX_ANCHORS - 1,), (3, 7)])
def test_one_anchor_too_many_replaces_the_first_of_those_that_have_not_fitted_for_longest(longest):
    q = with_packets(*[0] * MAX_ANCHORS)
    for place in range(MAX_ANCHORS):
        q.heard[place].fitted_ticks = 5 if place in longest else 6
    gather_packet(q, packet_of(99), Relays())
    assert anchors_of(q) == [one + 1 for one in range(MAX_ANCHORS) if one != longest[0]] + [99]


def test_packets_older_than_the_greatest_age_are_forgotten():
    age = 7 * MS
    q = with_packets(-1, 0, 0, -1, -1, max_age_s=age * TICK_S)
    acquisition._forget_old_packets(q, age)
    assert anchors_of(q) == [2, 3]
    assert try_start(q, packet_of(6, age + 1), Relays()) == TOO_FEW_ANCHORS
    assert anchors_of(q) == [6]


def test_links_are_kept_for_twice_that_age():
    age, q = 7 * MS, with_links(Acquisition(), (1, 2), (2, 3), (3, 1), (1, 3))
    q.max_age_s = age * TICK_S
    for link, ticks in zip(first(q.links, 4), (5, 6, 9, 5), strict=True):
        link.rx_ticks_tag = ticks
    acquisition._forget_links_before(q, 2 * age + 5)
    assert links_of(q) == [(2, 3), (3, 1)]


def test_pairs_are_the_anchors_with_two_packets_of_which_the_newer_is_recent():
    age = 7 * MS
    q = with_packets(0, 1, 2, 1, 9)
    q.heard[3].count, q.pair_count, q.start_age_s = 1, 4, age * TICK_S
    acquisition._choose_pairs(q, age)
    assert pairs_of(q) == [2, 3, 5]


# Links


@pytest.mark.parametrize(
    ("sequence", "count", "link"), [(5, 2, 30 * MS), (4, 2, 20 * MS), (6, 2, None), (5, 1, 30 * MS), (4, 1, None)]
)
def test_a_relay_of_a_packet_that_the_tag_has_received_is_a_link(sequence, count, link):
    q = with_packets(20 * MS, 30 * MS)
    q.heard[1].count = count
    relays = Relays(count=2)
    relays.rows[0] = Relay(listener=9, anchor=77, sequence=5)
    relays.rows[1] = Relay(listener=9, anchor=2, sequence=sequence, rx_ticks=1000)
    gather_packet(q, packet_of(9, 40 * MS), relays)
    assert [one.rx_ticks_tag for one in first(q.links, q.link_count)] == ([] if link is None else [link])


@pytest.mark.parametrize("is_short", [False, True])
def test_a_link_is_the_listener_s_clock_minus_the_sender_s_less_the_flight(is_short):
    q, rx_ticks = Acquisition(), 10**12 + 123
    gather_packet(q, packet_of(1, 30 * MS, tx_ticks=7 * 10**9, position_m=(1.0, -2.0, 3.0)), Relays())
    for times in range(2):  # the same pair again replaces the link
        relays = Relays(count=1)
        stamp = (rx_ticks + times) % 2**32 if is_short else rx_ticks + times
        relays.rows[0] = Relay(listener=9, anchor=1, rx_ticks=stamp, is_short=is_short)
        packet = packet_of(9, 50 * MS, tx_ticks=rx_ticks + 20 * MS, position_m=(3.0, 1.0, -3.0))
        gather_packet(q, packet, relays)
        link = q.links[0]
        assert (q.link_count, link.listener, link.sender, link.rx_ticks_tag) == (1, 9, 1, 30 * MS)
        assert (link.ticks, link.fraction_ticks) == (rx_ticks + times - 7 * 10**9, near(-7.0 / TICK_M))
    relays.rows[0] = Relay(listener=8, anchor=1)
    gather_packet(q, packet_of(8, 60 * MS), relays)
    relays.rows[0] = Relay(listener=9, anchor=8)
    gather_packet(q, packet_of(9, 70 * MS), relays)
    assert links_of(q) == [(9, 1), (8, 1), (9, 8)]


@pytest.mark.parametrize("oldest", [(0,), (1,), (MAX_LINKS - 1,), (3, 7)])
def test_one_link_too_many_replaces_the_oldest(oldest):
    q = with_packets(30 * MS)
    with_links(q, *((100, 100 + index) for index in range(MAX_LINKS)))
    for index in range(MAX_LINKS):
        q.links[index].rx_ticks_tag = 5 if index in oldest else 6
    relays = Relays(count=1)
    relays.rows[0] = Relay(listener=9, anchor=1, sequence=5)
    gather_packet(q, packet_of(9, 40 * MS), relays)
    assert [index for index, pair in enumerate(links_of(q)) if pair == (9, 1)] == [oldest[0]]
    assert q.link_count == MAX_LINKS


# One scale


@pytest.mark.parametrize(
    ("links", "reached"),
    [
        ((), [1]),
        (((1, 2), (3, 4)), [1, 2]),
        (((1, 2), (3, 4), (5, 3)), [3, 4, 5]),
        (((5, 1), (4, 3), (3, 2)), [2, 3, 4]),
        (((1, 2), (2, 3), (3, 4), (5, 4)), [1, 2, 3, 4, 5]),
        (((2, 1), (3, 2), (77, 3), (4, 77), (1, 5)), [1, 2, 3, 5]),
    ],
)
def test_the_anchors_that_most_links_join_are_put_on_one_scale(links, reached):
    q = with_links(with_packets(*[20 * MS] * 5, max_age_s=1.0), *links)
    for _ in range(2):
        acquisition._choose_pairs(q, 30 * MS)
        acquisition._put_on_one_scale(q, 30 * MS)
        assert pairs_of(q) == reached
        assert (q.best.count, q.best.order[0] + 1) == (len(reached), reached[0])


def test_each_anchor_is_reached_by_the_fewest_links():
    q = with_links(with_packets(*[20 * MS] * 4), (4, 1), (3, 2), (1, 2), (3, 4), (3, 1))
    acquisition._choose_pairs(q, 30 * MS)
    acquisition._reach_from(q, 2)
    tree = {q.reach.order[one]: one for one in range(q.reach.count)}
    assert list(tree) == [2, 1, 3, 0]
    assert [(q.reach.parent[pair], q.reach.link[pair], q.reach.sign[pair]) for pair in (0, 1, 3)] == [
        (2, 4, 1), (2, 1, 1), (2, 3, 1)
    ]  # fmt: skip
    assert q.reach.parent[2] < 0


def test_times_of_all_anchors_are_converted_to_the_first_one_s_clock():
    """Along two links from anchor 3 and one from anchor 2; anchor 4 has no link."""
    q = search(4)
    kept = {(1, 2): 0, (3, 2): 1}
    for link in first(q.links, q.link_count):
        if (link.listener, link.sender) in kept:
            q.links[kept[link.listener, link.sender]] = link
    q.link_count = 2
    acquisition._choose_pairs(q, sent(4, 1).rx_ticks)
    acquisition._put_on_one_scale(q, sent(4, 1).rx_ticks)
    assert pairs_of(q) == [1, 2, 3]
    rate_variance = 4.0 * q.variance_m2 / (0.1 * (1.0 + CLOCKS[0][1])) ** 2
    for pair in range(3):
        for turn, packet in enumerate((q.heard[pair].older, q.heard[pair].newer)):
            expected = reading(1, sent_s(pair + 1, turn))
            assert packet.scaled.ticks - expected + packet.scaled.fraction_ticks == pytest.approx(0.0, abs=6.0 * pair)
            assert 0.0 <= packet.scaled.fraction_ticks < 1.0
            ages_s = [(packet.packet.rx_ticks - q.links[link].rx_ticks_tag) * TICK_S for link in range(pair)]
            variance_m2 = sum(2.0 * q.variance_m2 + rate_variance * age_s**2 for age_s in ages_s)
            assert packet.scaled.variance_m2 == pytest.approx(variance_m2, rel=1e-5)
        assert q.clock_rates_mps[pair] == pytest.approx(24e-6 * SPEED_OF_LIGHT_MPS, abs=0.5)


@pytest.mark.parametrize(("elapsed", "rate"), [(-5, 0.0), (0, 0.0), (1, 6.0), (10, 0.6)])
def test_the_rate_of_a_clock_needs_two_packets_in_order(elapsed, rate):
    q = Acquisition(variance_m2=0.25)
    acquisition._measure_rate(q, 3, packet_of(1, 100, tx_ticks=40), packet_of(1, 100 + elapsed, tx_ticks=46 + elapsed))
    assert q.rates[3] == near(rate)
    assert q.rate_variances[3] == (near(0.5 / (elapsed * TICK_S) ** 2) if rate else 0.0)
    one = HeardAnchor()
    one.older.packet.rx_ticks, one.newer.packet.rx_ticks = 100, 100 + elapsed
    one.older.scaled.ticks, one.older.scaled.fraction_ticks = 40, 0.75
    one.newer.scaled.ticks, one.newer.scaled.fraction_ticks = 46 + elapsed, 0.5
    expected_mps = -5.75 / elapsed * SPEED_OF_LIGHT_MPS if rate else SPEED_OF_LIGHT_MPS
    assert acquisition._clock_rate_mps(one) == near(expected_mps)


def test_rates_that_no_crystal_has_are_dropped():
    q, most = with_packets(*[20 * MS] * 4), MAX_DRIFT * SPEED_OF_LIGHT_MPS
    acquisition._choose_pairs(q, 30 * MS)
    for pair, rate_mps in enumerate((math.nextafter(most, math.inf), most, -most, math.nextafter(-most, -math.inf))):
        q.clock_rates_mps[pair] = rate_mps
    acquisition._drop_impossible(q, 30 * MS)
    assert (pairs_of(q), first(q.clock_rates_mps, 2)) == ([2, 3], [most, -most])
    assert [one.fitted_ticks for one in first(q.heard, 4)] == [NEVER, 30 * MS, 30 * MS, NEVER]


# Positions


def solvable(rates_mps, **fields):
    """A search whose packets have these clock rates, ages of 1, 2, ... ms, and places."""
    now, fields = 100 * MS, {"variance_m2": 0.01, "error_variance_m2": 0.3, "speed_std_mps": 1.5, **fields}
    q = with_packets(*(now - (n + 1) * MS for n in range(len(rates_mps))), max_age_s=0.5, knows_height=True, **fields)
    for n, rate_mps in enumerate(rates_mps):
        one = q.heard[n]
        elapsed = one.newer.packet.rx_ticks - one.older.packet.rx_ticks
        change = elapsed - rate_mps / SPEED_OF_LIGHT_MPS * elapsed
        one.newer.scaled.ticks, one.newer.scaled.fraction_ticks = one.newer.packet.rx_ticks - 1000 - 2 * n, 0.25 * n
        one.older.scaled.ticks = math.floor(one.newer.scaled.ticks - change)
        one.older.scaled.fraction_ticks = (one.newer.scaled.ticks - one.older.scaled.ticks) - change + 0.25 * n
        one.newer.scaled.variance_m2, one.newer.packet.variance_factor = 0.02 * n, 1.0 + n
        one.newer.packet.place.position_m[0], one.newer.packet.place.position_m[1] = 2.0 * n, 1.0 * (n % 3)
        q.pairs[n] = n
    q.pair_count = len(rates_mps)
    return q, now


@pytest.mark.parametrize("left_out", [-1, 0, 2])
@pytest.mark.parametrize("rates_mps", [(30.0, -10.0, 20.0, 70.0, -5.0), (30.0, -10.0, 20.0, 70.0, -5.0, 60.0)])
def test_ranges_are_propagated_to_now_with_the_median_rate(rates_mps, left_out):
    q, now = solvable(rates_mps)
    q.heard[1].older.packet.rx_ticks += 4 * MS  # 6 ms before the newer one
    rate_1_mps = acquisition._clock_rate_mps(q.heard[1])
    acquisition._solve_start(q, left_out, now, 0.0)
    used = [n for n in range(len(rates_mps)) if n != left_out]
    assert first(q.start.used, len(used)) == used
    median_mps = np.median([rate_1_mps if n == 1 else rates_mps[n] for n in used])
    rate_variance = 2.0 * 0.01 / 0.006**2 + 1.5**2
    for index, n in enumerate(used):
        age_s = 1e-3 * (n + 1)
        expected_m = (2 * (n - used[0]) - 0.25 * n) * TICK_M + median_mps * age_s
        assert q.ranges_m[index] == pytest.approx(expected_m, abs=1e-6)
        aged_m2 = age_s**2 * (rate_variance / len(used) + 1.5**2)
        assert q.variances_m2[index] == near((1.0 + n) * 0.01 + 0.02 * n + 0.3 + aged_m2)


@pytest.mark.parametrize(
    ("count", "left_out", "is_enough"), [(2, -1, False), (3, -1, True), (3, 0, False), (4, 0, True)]
)
def test_three_ranges_are_needed(count, left_out, is_enough):
    q, now = solvable([1.0] * count)
    assert (acquisition._solve_start(q, left_out, now, 0.0) != TOO_FEW_ANCHORS) is is_enough


@pytest.mark.parametrize("height_m", [1.0, None])
def test_the_position_is_that_of_the_differences_to_the_first_range(height_m):
    q = search(6, height_m=height_m)
    q.start.is_contradicted = q.start.has_misfit = True
    assert go_on(q, 2, 6) == FOUND
    s = q.start
    assert (s.count, s.rx_ticks_tag, s.is_contradicted, s.has_misfit) == (6, sent(2, 2).rx_ticks, False, False)
    np.testing.assert_allclose(view(s.position_m), PLACE_M, atol=0.1)
    anchors_m, ranges_m = ANCHORS_M[view(s.used)[:6]], view(q.ranges_m)[:6]
    found = located(anchors_m, ranges_m, view(q.variances_m2)[:6], height_m=height_m)
    np.testing.assert_allclose(view(s.position_m), found.position_m, rtol=1e-9)
    np.testing.assert_allclose(view(s.covariance_m2), found.covariance_m2, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize(
    ("field", "value", "is_usable"),
    [
        ("ranges_m", -LARGEST, False),
        ("ranges_m", -0.999 * LARGEST, True),
        ("variances_m2", 0.0, False),
        ("variances_m2", 0.5, True),
        ("variances_m2", LARGEST, False),
        ("position_m", LARGEST, False),
        ("position_m", -0.999 * LARGEST, True),
    ],
)
def test_numbers_beyond_all_sites_are_not_used(field, value, is_usable):
    q, _ = solvable([1.0] * 4)
    for index in range(4):
        q.start.used[index], q.ranges_m[index], q.variances_m2[index] = index, 0.0, 0.1
    changed = q.heard[2].newer.packet.place.position_m if field == "position_m" else getattr(q, field)
    changed[0 if field == "position_m" else 2] = value
    assert (acquisition._locate(q, 4, 0.0) != UNUSABLE) is is_usable


# Whether a start is used


@pytest.mark.parametrize("knows_height", [True, False])
@pytest.mark.parametrize(("variance_m2", "is_wide"), [(7.0, True), (7.0 - 1e-12, False)])
def test_a_start_is_wide_if_its_curvature_is_as_large_as_the_noise(knows_height, variance_m2, is_wide):
    """Ranges of 5 m and 10 m in the plane, or 13 m and 26 m with the height."""
    q = with_packets(0, 0, knows_height=knows_height, variance_m2=0.75, error_variance_m2=0.25)
    for index, scale in enumerate((1.0, 2.0)):
        place = q.heard[index].newer.packet.place
        place.position_m[0], place.position_m[1], place.position_m[2] = 2.0 + 3 * scale, 1.0 - 4 * scale, 5 + 12 * scale
    q.start.used[1], q.start.count = 1, 2
    q.start.position_m[0], q.start.position_m[1], q.start.position_m[2] = 2.0, 1.0, 5.0
    factor = 1.0 if knows_height else 13.0 / 5.0
    for row, values in enumerate(((variance_m2, 50.0, 0.0), (60.0, 8.0, 0.0))):
        for column, value in enumerate(values):
            q.start.covariance_m2[row][column] = factor * value
    assert acquisition._is_wide(q) is is_wide


@pytest.mark.parametrize("knows_height", [True, False])
def test_a_wide_start_of_enough_anchors_is_used_after_a_while(knows_height):
    q, enough = Acquisition(knows_height=knows_height, wide_ticks=5), 4 if knows_height else 5
    q.tuning.start_patience_s = 7 * MS * TICK_S
    for q.start.count, q.start.rx_ticks_tag, is_worth_waiting in (
        (enough, 7 * MS + 5, True),
        (enough, 7 * MS + 6, False),
        (enough - 1, 7 * MS + 6, True),
    ):
        assert acquisition._is_worth_waiting(q) is is_worth_waiting


def with_reasons(monkeypatch, reasons, *, is_wide=False):
    """Let solutions end so: by the pair that is left out, −1 if none is. Returns the tails that were asked for."""
    tails = []

    def solved(q, left_out, now, residual_tail):
        tails.append((left_out, residual_tail))
        q.start.rx_ticks_tag, q.start.count = now, 100 + left_out
        q.start.has_misfit = q.start.is_contradicted = False
        return reasons.get(left_out, RESIDUALS)

    monkeypatch.setattr(acquisition, "_solve_start", solved)
    monkeypatch.setattr(acquisition, "_is_wide", lambda _: is_wide)
    return tails


@pytest.mark.parametrize(("height_m", "needed"), [(1.0, 3), (None, 4)])
def test_a_start_needs_two_packets_of_three_or_four_anchors(monkeypatch, height_m, needed):
    with_reasons(monkeypatch, {-1: FOUND})
    q = search(needed - 1, height_m=height_m)
    assert go_on(q, 1, needed - 1) == TOO_FEW_ANCHORS
    q = search(needed, turns=1, height_m=height_m)
    outcomes = [go_on(q, anchor, needed, turn) for turn in (1, 2) for anchor in range(1, needed + 1)]
    assert outcomes == [ACQUIRING] * needed + [FOUND] * needed


def test_two_positions_that_fit_are_tried_again_with_another_anchor_or_with_the_first(monkeypatch):
    reasons = {-1: MIRROR}
    tails = with_reasons(monkeypatch, reasons)
    q = search(5)
    assert [go_on(q, anchor, 5) for anchor in (2, 3)] == [MIRROR, MIRROR]
    assert (len(tails), q.rival_count) == (1, 5)
    assert go_on(q, 1, 5, 3) == MIRROR
    assert len(tails) == 2
    assert go_on(q, 6, 6, 3) == MIRROR, "it is its first packet"
    assert len(tails) == 2
    q.rival_count = 4
    reasons[-1] = FOUND
    assert (go_on(q, 4, 5, 3), q.rival_count) == (FOUND, 0)


def test_a_wide_start_waits_from_the_first_one_on(monkeypatch):
    with_reasons(monkeypatch, {-1: FOUND}, is_wide=True)
    q = search(5)
    q.tuning.start_patience_s = 0.05
    outcomes = [go_on(q, anchor, 5, turn) for turn, anchor in ((2, 2), (2, 4), (3, 1))]
    assert outcomes == [ACQUIRING, ACQUIRING, FOUND]
    assert (q.has_been_wide, q.wide_ticks) == (True, sent(2, 2).rx_ticks)


@pytest.mark.parametrize(
    ("count", "anchor", "reasons", "tried"),
    [
        (4, 1, {}, 1),  # too few remain to detect a misfit
        (5, 1, {}, 6),
        (5, 2, {}, 1),  # once a turn
        (5, 1, {-1: MIRROR}, 1),
    ],
)
def test_anchors_are_left_out_once_a_turn_if_enough_remain(monkeypatch, count, anchor, reasons, tried):
    tails = with_reasons(monkeypatch, reasons)
    assert go_on(search(count), anchor, count) == reasons.get(-1, RESIDUALS)
    assert tails == [(left_out, TUNING.start_tail) for left_out in range(-1, tried - 1)]


@pytest.mark.parametrize("others", [(), (4,)])
@pytest.mark.parametrize("is_late", [False, True])
def test_the_only_anchor_without_which_the_others_agree_is_excluded(monkeypatch, others, is_late):
    """If there is none, or more than one, all are used after a while, whatever the residuals."""
    tails = with_reasons(monkeypatch, {2: FOUND, **dict.fromkeys(others, FOUND)})
    q, now = search(5), sent(5, 1).rx_ticks
    acquisition._choose_pairs(q, now)
    q.tuning.start_patience_s = 7 * MS * TICK_S
    q.is_contradicted, q.contradicted_ticks = True, now - 7 * MS + (0 if is_late else 1)
    reason = acquisition._solve_without_one(q, now)
    if not others:
        assert (reason, q.start.has_misfit, q.start.misfit, q.start.is_contradicted) == (FOUND, True, 3, True)
        assert q.start.count == 102
    else:
        assert reason == RESIDUALS
        assert tails[5:] == ([(-1, 0.0)] if is_late else [])
        assert (q.start.has_misfit, q.start.is_contradicted) == (False, False)


def test_a_contradiction_begins_with_the_first_one_and_ends_with_a_start_from_all(monkeypatch):
    with_reasons(monkeypatch, {})
    q = search(5)
    assert acquisition._solve_without_one(q, 100) == RESIDUALS
    assert acquisition._solve_without_one(q, 200) == RESIDUALS
    assert (q.is_contradicted, q.contradicted_ticks) == (True, 100)
    with_reasons(monkeypatch, {-1: FOUND})
    assert acquisition._solve_without_one(q, 100 + from_seconds(TUNING.start_patience_s) + MS) == FOUND
    assert (q.start.is_contradicted, q.start.has_misfit) == (True, False)


def test_an_anchor_whose_stamps_are_10_m_late_is_found():
    q = search(6, late=3, late_m=10.0)
    assert go_on(q, 1, 6) == FOUND
    assert (q.start.has_misfit, q.start.misfit, q.start.count, q.start.is_contradicted) == (True, 3, 5, True)
    np.testing.assert_allclose(view(q.start.position_m), PLACE_M, atol=0.1)
