"""Noise of the differences, pair by pair."""

from math import dist

import numpy as np
import pytest

from skyless.core.air.masterless_packets import PairTdoa
from skyless.research.replays.captures import MAX_PAIRS, MIN_PAIR_DIFFERENCES, ROWS_PER_PAIR, NoiseByPair
from skyless.sim.evaluation.figures import TruthTrack
from skyless.site.tables import Truth

ANCHORS_M = {1: (0.0, 0.0, 0.0), 2: (8.0, 0.0, 1.0), 3: (0.0, 6.0, 2.0)}


def moving(until_s):
    times_s = np.linspace(0.0, until_s, 200)
    return Truth(times_s, np.stack([1.0 + 0.05 * times_s, 2.0 - 0.02 * times_s, 0.0 * times_s + 1.0], axis=1), None)


def test_noise_about_the_truth_of_a_moving_tag_withstands_outliers():
    random = np.random.default_rng(11)
    track = TruthTrack(moving(100.0))
    book = NoiseByPair(moving(100.0), ANCHORS_M)
    count = 3000
    for time_s in np.linspace(0.0, 100.0, count):
        at_m = track.at(float(time_s))
        error_m = random.normal(0.3, 0.1) + (50.0 if random.random() < 0.05 else 0.0)
        book.add(PairTdoa(float(time_s), 1, 2, dist(at_m, ANCHORS_M[2]) - dist(at_m, ANCHORS_M[1]) + error_m))
    (pair,) = book.pairs()
    assert (pair.anchor_a, pair.anchor_b, pair.count, pair.against_truth) == (1, 2, count, True)
    # 5 % beyond one side move the median by 0.066 σ and the MAD by 8 %; then four standard errors of each.
    assert pair.median_m == pytest.approx(0.3 + 0.0066, abs=4 * 1.25 * 0.1 / count**0.5)
    assert pair.noise_m == pytest.approx(0.108, abs=4 * 1.17 * 0.1 / count**0.5)


def test_noise_without_truth_is_about_the_median():
    book = NoiseByPair(None, {})
    values = np.random.default_rng(2).normal(3.0, 0.05, 500)
    for value in values:
        book.add(PairTdoa(0.0, 7, 8, float(value)))
    (pair,) = book.pairs()
    assert not pair.against_truth
    assert pair.median_m == pytest.approx(np.median(values))
    assert pair.noise_m == pytest.approx(1.4826 * np.median(np.abs(values - np.median(values))))


def test_positions_that_come_with_the_difference_serve():
    book = NoiseByPair(moving(1.0), {})
    at_m = (1.0, 2.0, 1.0)
    for _ in range(MIN_PAIR_DIFFERENCES):
        book.add(PairTdoa(0.0, 7, 8, dist(at_m, (5.0, 5.0, 5.0)) - dist(at_m, (0.0, 0.0, 0.0)), (0.0,) * 3, (5.0,) * 3))
    (pair,) = book.pairs()
    assert pair.against_truth
    assert pair.median_m == pytest.approx(0.0, abs=1e-12)


def test_a_pair_heard_too_seldom_says_nothing():
    book = NoiseByPair(None, {})
    for _ in range(MIN_PAIR_DIFFERENCES - 1):
        book.add(PairTdoa(0.0, 1, 2, 0.0))
    assert book.pairs() == ()


def test_a_stream_of_any_length_and_of_any_identifiers_takes_bounded_memory():
    book = NoiseByPair(None, {})
    for k in range(3 * ROWS_PER_PAIR):
        book.add(PairTdoa(0.0, 1, 2, float(k % 2)))
    for k in range(100_000, 100_000 + 4 * MAX_PAIRS):
        book.add(PairTdoa(0.0, k, k + 1, 0.0))
    (pair,) = book.pairs()
    assert pair.count == 3 * ROWS_PER_PAIR
    assert sum(len(sample.rows) for sample in book._samples.values()) <= ROWS_PER_PAIR + MAX_PAIRS
