"""Ranges from stamps: against the truth of drawn clocks, whatever order and garbage they come in."""

import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from skyless.core.ticks import TICK_M, TICK_RATE_HZ
from skyless.site.survey.legs import Leg, bracketed_flight_ticks, earliest_cluster, half_sample_mode
from skyless.site.survey.pair_ranger import LEGS, PairRanger, flights_of

pytestmark = pytest.mark.site

POSITION_M = {1: (0.0, 0.0), 2: (7.0, 0.0), 3: (6.0, 5.0), 4: (-1.0, 6.0)}
SLOT_S = 2.5e-3
STAMP_TICKS = 100e-12 * TICK_RATE_HZ


def _distance_m(a, b):
    return math.dist(POSITION_M[a], POSITION_M[b])


def _legs(seconds, seed, *, bits=40, noise=STAMP_TICKS, late_m=None, restart=None):
    """Legs in the order of time: sender, receiver, TX and RX ticks, time. Crystals are of constant rate.

    ``late_m(a, b, t_s)``: extra path. ``restart``: an anchor and when its counter jumps.
    """
    rng = np.random.default_rng(seed)
    rate = {anchor: 1.0 + rng.uniform(-10e-6, 10e-6) for anchor in POSITION_M}
    offset = {anchor: int(rng.integers(1 << bits)) for anchor in POSITION_M}

    def counter(anchor, t_s):
        jump = 7_654_321_987 if restart is not None and anchor == restart[0] and t_s >= restart[1] else 0
        return (offset[anchor] + jump + round(t_s * TICK_RATE_HZ * rate[anchor])) % (1 << bits)

    for k in range(int(seconds / SLOT_S)):
        sender, t_s = list(POSITION_M)[k % 4], k * SLOT_S
        leaves_s = t_s + rng.normal(0.0, noise) / TICK_RATE_HZ
        for receiver in POSITION_M:
            if receiver != sender:
                path_m = _distance_m(sender, receiver)
                path_m += 0.0 if late_m is None else late_m(min(sender, receiver), max(sender, receiver), t_s)
                arrives_s = leaves_s + path_m / (TICK_M * TICK_RATE_HZ) + rng.normal(0.0, noise) / TICK_RATE_HZ
                yield sender, receiver, counter(sender, t_s), counter(receiver, arrives_s), t_s


def _ranged(legs, **options):
    ranger = PairRanger(**options)
    for leg in legs:
        ranger.add(*leg)
    ranger.finish()
    return ranger


def _errors_m(ranges):
    return np.array([pair.range_m - _distance_m(pair.a, pair.b) for pair in ranges.pairs])


# Brackets


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.integers(-300, 300), st.integers(-300, 300), st.booleans()),
        max_size=40,
        unique=True,
    )
)
def test_brackets_are_those_of_one_pair(rows):
    """Any legs: the same times of flight as the scalar function gives for the neighbours in order of time."""
    scale = 100_000
    legs = np.array([(pair, a * scale, a * scale + b, back, False, 0.0) for pair, a, b, back in rows], LEGS)
    pair, a_ticks, b_ticks, back = (legs[name] for name in ("pair", "a_ticks", "b_ticks", "is_back"))
    flights, _, _ = flights_of(legs, 1 << 40)
    got = dict(zip(flights["leg"].tolist(), flights["ticks"].tolist(), strict=True))
    for index, found in got.items():
        x, y = (a_ticks, b_ticks) if back[index] else (b_ticks, a_ticks)
        others = [k for k in range(len(rows)) if pair[k] == pair[index] and back[k] != back[index]]
        before = max((k for k in others if x[k] < x[index]), key=lambda k: x[k])
        after = min((k for k in others if x[k] > x[index]), key=lambda k: x[k])
        candidates = {
            bracketed_flight_ticks(
                Leg(int(x[before]), int(y[p])), Leg(int(y[index]), int(x[index])), Leg(int(x[after]), int(y[q])), 40
            )
            for p in others
            if x[p] == x[before]
            for q in others
            if x[q] == x[after]
        }
        assert any(value == pytest.approx(found, abs=1e-6) for value in candidates if value is not None)


# Statistics


def test_ranges_their_errors_and_what_pairs_share():
    """20 pieces of 2 s: squared errors over said variances are chi square; TX noise is found with 25 % or better."""
    squares, shares = 0.0, []
    for seed in range(20):
        ranger = _ranged(_legs(2.0, seed))
        ranges = ranger.ranges()
        shares.append(ranger.tx_stamp_std_m / (STAMP_TICKS * TICK_M))
        tx_m = np.array([ranges.tx_std_m[pair.a] ** 2 + ranges.tx_std_m[pair.b] ** 2 for pair in ranges.pairs])
        own_m = np.array([pair.std_m**2 for pair in ranges.pairs])
        ends = np.array([[anchor in {pair.a, pair.b} for anchor in POSITION_M] for pair in ranges.pairs], float)
        shared = ends @ np.diag([ranges.tx_std_m[anchor] ** 2 for anchor in POSITION_M]) @ ends.T
        error = _errors_m(ranges)
        assert np.allclose(np.diag(shared), tx_m)
        squares += error @ np.linalg.solve(np.diag(own_m) + shared, error)
        assert [pair.exchanges for pair in ranges.pairs] == pytest.approx([200] * 6, abs=3)
        assert {pair.late_share for pair in ranges.pairs} == {0.0}
        assert ranges.duration_s == pytest.approx(2.0, abs=0.01)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 20 * 6)
    assert low < squares < high
    assert np.mean(shares) == pytest.approx(1.0, abs=0.05)
    assert np.std(shares) < 0.25


def test_pairs_without_noise_are_exact():
    ranges = _ranged(_legs(1.2, 3, noise=0.0)).ranges()
    assert np.abs(_errors_m(ranges)).max() < 0.5 * TICK_M


def test_a_late_episode_is_left_out():
    """Pair 1–2 is 3.13 m late for 30 % of the time, half of that for the others of its time: the rest counts."""

    def late_m(a, b, t_s):
        return 3.13 if (a, b) == (1, 2) and 4.0 <= t_s < 7.6 else 0.0

    blocks = []
    ranges = _ranged(_legs(12.0, 5, late_m=late_m), on_block=blocks.append).ranges()
    assert np.abs(_errors_m(ranges)).max() < 5 * max(pair.std_m for pair in ranges.pairs)
    shares = {(pair.a, pair.b): pair.late_share for pair in ranges.pairs}
    assert shares.pop((1, 2)) == pytest.approx(0.3, abs=0.05)
    assert set(shares.values()) == {0.0}
    late = [block for block in blocks if (block.a, block.b) == (1, 2) and 4.0 < block.t_s < 7.0]
    assert [block.mean_m for block in late] == pytest.approx([7.0 + 3.13] * 3, abs=0.02)


def test_a_pair_that_wanders_has_a_larger_error():
    def late_m(a, b, t_s):
        return 0.05 * math.sin(2 * math.pi * t_s / 7.0) if (a, b) == (3, 4) else 0.0

    ranges = _ranged(_legs(20.0, 6, late_m=late_m)).ranges()
    stds = {(pair.a, pair.b): pair.std_m for pair in ranges.pairs}
    wandering = stds.pop((3, 4))
    assert wandering > 2.0 * max(stds.values())
    assert abs(_errors_m(ranges)[-1]) < 4.0 * wandering


def test_blocks_are_as_long_as_asked_and_their_errors_as_large_as_they_state():
    blocks = []
    _ranged(_legs(4.0, 7), block_s=0.1, on_block=blocks.append)
    assert len(blocks) == 6 * 40
    assert sorted({round(block.t_s, 6) for block in blocks}) == [round(0.05 + 0.1 * k, 6) for k in range(40)]
    late = [block for block in blocks if block.t_s > 0.5]
    error = np.array([(block.mean_m - _distance_m(block.a, block.b)) / block.std_m for block in late])
    # Pairs share TX noise (correlation 1/4), neighbouring blocks their legs at the seam: 216 values are worth half.
    assert np.mean(error**2) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / (len(late) / 2)))


# Order, repetition, restarts, garbage


def test_directions_that_come_one_after_the_other_give_the_same_ranges():
    """As anchors publish what they received: each a message a second, half a second apart."""
    legs = list(_legs(6.0, 8))
    order = {anchor: 0.25 * k for k, anchor in enumerate(POSITION_M)}
    published = sorted(legs, key=lambda leg: math.floor(leg[4] - order[leg[1]]) + 1.0 + order[leg[1]])
    arrived = [(*leg[:4], math.floor(leg[4] - order[leg[1]]) + 1.0 + order[leg[1]] + 1.7e9) for leg in published]
    plain, late = _ranged(legs).ranges(), _ranged(arrived).ranges()
    for one, other in zip(plain.pairs, late.pairs, strict=True):
        assert other.exchanges == pytest.approx(one.exchanges, abs=2)
        assert other.range_m == pytest.approx(one.range_m, abs=0.3 * one.std_m)


def test_repeated_legs_count_once():
    legs = list(_legs(2.0, 9))
    twice = [leg for one in legs for leg in (one, one)]
    assert _ranged(twice).ranges() == _ranged(legs).ranges()


@pytest.mark.parametrize("bits", [32, 40])
def test_counters_wrap(bits):
    """32 bits wrap 15 times a second, 40 bits once in 17 s."""
    ranges = _ranged(_legs(18.0 if bits == 40 else 2.0, 10, bits=bits), bits=bits).ranges()
    stds = [math.hypot(pair.std_m, ranges.tx_std_m[pair.a], ranges.tx_std_m[pair.b]) for pair in ranges.pairs]
    assert (np.abs(_errors_m(ranges)) / stds).max() < 4.5
    assert ranges.pairs[0].exchanges >= (195 if bits == 32 else 1790)


@pytest.mark.parametrize("forgotten", [False, True])
def test_a_counter_that_restarts_costs_a_few_exchanges_and_no_error(forgotten):
    ranger = PairRanger()
    for leg in _legs(4.0, 11, restart=(2, 2.1)):
        if forgotten and leg[4] == 840 * SLOT_S:
            ranger.forget(2)
        ranger.add(*leg)
    ranger.finish()
    ranges = ranger.ranges()
    assert min(pair.exchanges for pair in ranges.pairs) > (380 if forgotten else 390)
    assert np.abs(_errors_m(ranges)).max() < 5.0 * max(math.hypot(pair.std_m, 0.002) for pair in ranges.pairs)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1 << 32))
def test_garbage_between_the_stamps_does_no_harm(seed):
    """A tenth of the stamps are of no counter, some come twice, late, or with impossible times."""
    rng, mixed = random.Random(seed), list(_LEGS)
    for _ in range(len(mixed) // 10):
        at = rng.randrange(len(mixed))
        sender, receiver, tx, rx, t_s = mixed[at]
        match rng.randrange(5):
            case 0:
                mixed.insert(at, (sender, receiver, rng.getrandbits(40), rx, t_s))
            case 1:
                mixed.insert(at, (sender, receiver, rng.getrandbits(40), rng.getrandbits(40), t_s))
            case 2:
                mixed.insert(at, (rng.choice([sender, receiver]), receiver, tx, rx, rng.choice([t_s, math.nan])))
            case 3:
                mixed.insert(at, mixed[max(0, at - rng.randrange(40))])
            case 4:
                del mixed[at]
    ranges = _ranged(mixed).ranges()
    assert len(ranges.pairs) == 6
    for pair in ranges.pairs:
        spread_m = math.hypot(pair.std_m, ranges.tx_std_m[pair.a], ranges.tx_std_m[pair.b])
        assert abs(pair.range_m - _distance_m(pair.a, pair.b)) < max(6.0 * spread_m, 0.03)


_LEGS = list(_legs(2.0, 12))


def test_a_clock_that_is_set_and_a_long_pause_do_no_harm():
    legs = list(_legs(9.0, 13))
    shifted = [(*leg[:4], leg[4] + (0.0 if leg[4] < 3.0 else 1e6 if leg[4] < 6.0 else -1e6)) for leg in legs]
    ranges = _ranged(shifted).ranges()
    assert min(pair.exchanges for pair in ranges.pairs) > 880
    assert np.abs(_errors_m(ranges)).max() < 0.005
    assert ranges.duration_s == pytest.approx(9.0, abs=0.1)


def test_nothing_and_a_single_direction_give_no_range():
    assert PairRanger().ranges().pairs == ()
    ranger = _ranged([leg for leg in _legs(1.0, 14) if leg[0] < leg[1]])
    assert ranger.ranges().pairs == ()
    assert ranger.ranges().anchors == (1, 2, 3, 4)


def test_memory_does_not_grow_with_time():
    """Blocks of 10 ms: 1000 of them, of which a tenth are late."""

    def late_m(a, b, t_s):
        return 2.0 if (a, b) == (1, 3) and t_s % 1.0 < 0.1 else 0.0

    ranger = _ranged(_legs(10.0, 15, late_m=late_m), block_s=0.02)
    assert all(len(history.blocks) <= 256 for history in ranger._histories)
    assert len(ranger._kept) < 100
    ranges = ranger.ranges()
    late = {(pair.a, pair.b): pair.late_share for pair in ranges.pairs}
    assert late[1, 3] == pytest.approx(0.1, abs=0.05)
    assert sum(late.values()) - late[1, 3] < 0.02
    assert np.abs(_errors_m(ranges)).max() < 0.01


# Clusters


def test_the_earliest_cluster_with_a_tenth_of_the_weight():
    rng = np.random.default_rng(1)
    early, middle, late = rng.normal(-2.0, 0.01, 5), rng.normal(0.0, 0.01, 30), rng.normal(1.5, 0.01, 65)
    value = np.concatenate([late, early, middle])
    inside = earliest_cluster(value, np.ones(100), 0.01)
    assert inside.tolist() == [False] * 70 + [True] * 30
    weight = np.concatenate([np.ones(65), 3.0 * np.ones(5), np.ones(30)])
    assert np.flatnonzero(earliest_cluster(value, weight, 0.01)).tolist() == [*range(65, 70)]
    assert np.flatnonzero(earliest_cluster(value, np.ones(100), 0.01, total=400.0)).tolist() == [*range(65)]


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=30), st.floats(1e-6, 1.0))
def test_a_cluster_is_never_empty(values, std):
    value = np.array(values)
    assert earliest_cluster(value, np.ones(len(value)), std).any()
    assert value.min() <= half_sample_mode(np.sort(value)) <= value.max()
