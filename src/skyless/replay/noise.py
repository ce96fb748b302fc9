"""Noise of the time differences of a recording, pair by pair, in bounded memory."""

from collections.abc import Mapping
from math import dist
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.air.masterless_packets import PairTdoa, Point
from skyless.evaluation.judge import Judge
from skyless.evaluation.statistics import EvenSample

MOST_PAIRS: Final = 256
ROWS_PER_PAIR: Final = 4096
FEWEST: Final = 20
"""Differences of a pair from which its noise can be told."""


class PairNoise(Struct, frozen=True):
    """Differences of one pair of anchors."""

    anchor_a: int
    anchor_b: int
    count: int
    median_m: float
    """Of the difference, or of its error where the truth is known."""
    noise_m: float
    """1.4826 times the median absolute deviation, a standard deviation that outliers do not touch."""
    against_truth: bool


class NoiseByPair:
    """Keeps an even sample of every pair's differences, less what the truth predicts where it is known."""

    def __init__(self, judge: Judge, anchors_m: Mapping[int, Point]) -> None:
        self._judge = judge
        self._anchors_m = anchors_m
        self._samples: dict[tuple[int, int, bool], EvenSample] = {}

    def add(self, pair: PairTdoa) -> None:
        """Take one difference."""
        predicted_m = self._predicted_m(pair) if self._judge.has_truth else None
        key = (pair.anchor_a, pair.anchor_b, predicted_m is not None)
        sample = self._samples.get(key)
        if sample is None:
            if len(self._samples) >= MOST_PAIRS:
                return
            sample = self._samples[key] = EvenSample(1, ROWS_PER_PAIR)
        sample.add((pair.tdoa_m if predicted_m is None else pair.tdoa_m - predicted_m,))

    def _predicted_m(self, pair: PairTdoa) -> float | None:
        truth = self._judge.at(pair.time_s)
        a_m = pair.a_m or self._anchors_m.get(pair.anchor_a)
        b_m = pair.b_m or self._anchors_m.get(pair.anchor_b)
        if truth is None or a_m is None or b_m is None:
            return None
        return dist(truth, b_m) - dist(truth, a_m)

    def pairs(self) -> tuple[PairNoise, ...]:
        """What is known of each pair that was heard often enough."""
        found = []
        for (a, b, against_truth), sample in sorted(self._samples.items()):
            if len(sample.rows) >= FEWEST:
                median = float(np.median(sample.rows))
                noise = 1.4826 * float(np.median(np.abs(sample.rows - median)))
                found.append(PairNoise(a, b, sample.seen, median, noise, against_truth))
        return tuple(found)
