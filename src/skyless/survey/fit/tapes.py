"""Which distance, measured by tape or laser, would help a survey most.

The best one cuts the trace of the position covariance most; the next one is chosen with the first one measured.
"""

from typing import Final

import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Array, Mask
from skyless.survey.fit.determined import most_std_m, position_stds_m
from skyless.survey.fit.links import adjacency
from skyless.survey.fit.problem import Problem, unit_vectors

TAPE_STD_M: Final = 0.005
"""Of a distance that has not been measured yet."""

_LEAST_GAIN: Final = 0.02
"""Part of the standard deviation that a tape must save to be named."""


_AS_GOOD: Final = 0.98
_AS_LITTLE: Final = 1.2
"""Gain, as a part of the best one, and what remains, as a multiple of the least, that are no worse.

Of equal tapes the first is named, whatever the noise.
"""


class TapeChoice(Struct, frozen=True, eq=False):
    """A distance, by indices, and what it would change."""

    first: int
    second: int
    std_before_m: float
    std_after_m: float
    """rms over the anchors of the core."""
    worst_after_m: float
    """Standard deviation of the least determined anchor of the core."""


def best_tapes(
    problem: Problem, position_m: Array, covariance_m2: Array, core: Mask, most: int = 3, until_m: float = 0.0
) -> list[TapeChoice]:
    """The best distances one after another, until the worst anchor has a standard deviation of ``until_m`` or less.

    ``covariance_m2``: after alignment over the core, shape (4 n, 4 n).
    """
    n = len(position_m)
    first, second = np.triu_indices(n, 1)
    has_tape = adjacency(n, problem.tape_first, problem.tape_second)
    usable = core[first] & core[second] & ~has_tape[first, second]
    first, second = first[usable], second[usable]
    unit = unit_vectors(position_m, first, second)
    inside = np.repeat(core, 3)
    covariance = covariance_m2.copy()
    chosen: list[TapeChoice] = []
    while first.size and len(chosen) < most:
        columns = np.zeros((len(covariance), len(first)))
        for axis in range(3):
            a, b = covariance[:, 3 * first + axis], covariance[:, 3 * second + axis]
            columns += unit[:, axis] * (a - b)
        number = np.arange(len(first))
        variance = sum(
            unit[:, axis] * (columns[3 * first + axis, number] - columns[3 * second + axis, number])
            for axis in range(3)
        )
        variance = np.maximum(variance, 0.0) + TAPE_STD_M**2
        gain = np.sum(columns[: 3 * n][inside] ** 2, axis=0) / variance
        left = max(float(np.diag(covariance)[: 3 * n][inside].sum()), 0.0) - gain
        as_good = (gain >= _AS_GOOD * gain.max()) & (left <= _AS_LITTLE * left.min() + 1e-12)
        best = int(np.flatnonzero(as_good | (gain == gain.max()))[0])
        before = _rms(position_stds_m(problem, covariance)[core])
        covariance = covariance - np.outer(columns[:, best], columns[:, best]) / variance[best]
        stds = position_stds_m(problem, covariance)[core]
        after = _rms(stds)
        if after > before * (1.0 - _LEAST_GAIN):
            break
        chosen.append(TapeChoice(int(first[best]), int(second[best]), before, after, float(stds.max())))
        first, second, unit = np.delete(first, best), np.delete(second, best), np.delete(unit, best, axis=0)
        if chosen[-1].worst_after_m <= until_m:
            break
    return chosen


def mending_tapes(problem: Problem, position_m: Array, covariance_m2: Array, core: Mask) -> list[TapeChoice]:
    """The distances after which every anchor of the core is determined; empty where a few do not suffice."""
    most_m = most_std_m(problem)
    chosen = best_tapes(problem, position_m, covariance_m2, core, most=6, until_m=most_m)
    return chosen if chosen and chosen[-1].worst_after_m <= most_m else []


def _rms(stds_m: Array) -> float:
    return float(np.sqrt(np.mean(stds_m**2))) if stds_m.size else 0.0
