"""Noise of the time differences of a recording, pair by pair, in bounded memory."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.air.masterless_packets import PairTdoa, Point
from skyless.sim.evaluation.figures import EvenSample, truth_at
from skyless.site.tables import Truth

MAX_PAIRS: Final = 256
ROWS_PER_PAIR: Final = 2048
MIN_PAIR_DIFFERENCES: Final = 20
"""Differences of a pair from which its noise can be estimated."""

_NOWHERE: Final = (np.nan, np.nan, np.nan)


class PairNoise(Struct, frozen=True):
    """Differences of one pair of anchors."""

    anchor_a: int
    anchor_b: int
    count: int
    median_m: float
    """Median of the difference, or of its error where the truth is known."""
    noise_m: float
    """1.4826 times the median absolute deviation, a standard deviation that outliers do not touch."""
    against_truth: bool


class NoiseByPair:
    """Keeps an even sample of every pair's differences, less what the truth predicts where it is known."""

    def __init__(self, truth: Truth | None, anchors_m: Mapping[int, Point]) -> None:
        self.truth = truth
        self._anchors_m = anchors_m
        self._samples: dict[tuple[int, int], EvenSample] = {}

    def add(self, pair: PairTdoa) -> None:
        """Add one difference."""
        key = (pair.anchor_a, pair.anchor_b)
        sample = self._samples.get(key)
        if sample is None:
            if len(self._samples) >= MAX_PAIRS:
                return
            sample = self._samples[key] = EvenSample(8, ROWS_PER_PAIR)
        a_m = pair.a_m or self._anchors_m.get(pair.anchor_a, _NOWHERE)
        b_m = pair.b_m or self._anchors_m.get(pair.anchor_b, _NOWHERE)
        sample.add((pair.time_s, pair.tdoa_m, *a_m, *b_m))

    def pairs(self) -> tuple[PairNoise, ...]:
        """What is known of each pair that was heard often enough."""
        found = []
        for (a, b), sample in sorted(self._samples.items()):
            time_s, tdoa_m, places_m = sample.rows[:, 0], sample.rows[:, 1], sample.rows[:, 2:].reshape(-1, 2, 3)
            to_a_m, to_b_m = np.linalg.norm(truth_at(self.truth, time_s)[:, None] - places_m, axis=2).T
            errors_m = tdoa_m - (to_b_m - to_a_m)
            known = np.isfinite(errors_m)
            against_truth = bool(known.sum() >= MIN_PAIR_DIFFERENCES)
            values_m = errors_m[known] if against_truth else tdoa_m
            if len(values_m) >= MIN_PAIR_DIFFERENCES:
                median = float(np.median(values_m))
                noise = 1.4826 * float(np.median(np.abs(values_m - median)))
                found.append(PairNoise(a, b, sample.seen, median, noise, against_truth))
        return tuple(found)
