"""Ranges of all pairs in steps of a few seconds, from which it shows whether they stayed the same."""

import math
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Array
from skyless.survey.ranges import PairBlock

STEP_S: Final = 3.0
_MOST_STEPS: Final = 64
"""Of more, the older half is joined two by two: what is long ago needs no exact time."""

_MEDIAN_VARIANCE: Final = math.pi / 2.0


class StepTable(Struct, frozen=True, eq=False):
    """``k`` steps of ``m`` pairs, in the order of time."""

    start_s: Array
    """Shape (k,)."""
    pairs: tuple[tuple[int, int], ...]
    range_m: Array
    """Shape (k, m), NaN where a pair has no range."""
    variance_m2: Array
    """Shape (k, m), of stamps' noise."""


class _Step(Struct, frozen=True):
    start_s: float
    ranges: dict[tuple[int, int], tuple[float, float]]
    """Median and variance, by pair."""


class RangeSteps:
    """Gathers blocks; memory does not grow with time."""

    def __init__(self) -> None:
        self._steps: list[_Step] = []
        self._open: list[PairBlock] = []

    def add(self, block: PairBlock) -> None:
        """Add a block, in the order of time; a clock that was set back begins the steps again."""
        step = math.floor(block.t_s / STEP_S)
        if self._open:
            now = math.floor(self._open[0].t_s / STEP_S)
            if step < now:
                self._steps, self._open = [], []
            elif step > now:
                self.finish()
        self._open.append(block)

    def finish(self) -> None:
        """Close the step that is open."""
        if not self._open:
            return
        gathered: dict[tuple[int, int], list[PairBlock]] = {}
        for block in self._open:
            gathered.setdefault((block.a, block.b), []).append(block)
        ranges = {
            pair: (
                float(np.median([one.mean_m for one in blocks])),
                _MEDIAN_VARIANCE * float(np.mean([one.std_m**2 for one in blocks])) / len(blocks),
            )
            for pair, blocks in gathered.items()
        }
        self._steps.append(_Step(STEP_S * math.floor(self._open[0].t_s / STEP_S), ranges))
        self._open = []
        if len(self._steps) > _MOST_STEPS:
            old, new = self._steps[: _MOST_STEPS // 2], self._steps[_MOST_STEPS // 2 :]
            self._steps = [_joined(*old[index : index + 2]) for index in range(0, len(old), 2)] + new

    def drop_before(self, t_s: float) -> None:
        """Forget the steps that began earlier."""
        self._steps = [one for one in self._steps if one.start_s >= t_s]

    def table(self) -> StepTable:
        """The steps that are closed."""
        pairs = tuple(sorted({pair for one in self._steps for pair in one.ranges}))
        nothing = (math.nan, math.nan)
        both = np.array([[one.ranges.get(pair, nothing) for pair in pairs] for one in self._steps])
        both = both.reshape(len(self._steps), len(pairs), 2)
        return StepTable(np.array([one.start_s for one in self._steps]), pairs, both[..., 0], both[..., 1])


def _joined(one: _Step, other: _Step) -> _Step:
    """Two steps as one with their means."""
    ranges = one.ranges | other.ranges
    for pair in one.ranges.keys() & other.ranges.keys():
        (a_m, a_m2), (b_m, b_m2) = one.ranges[pair], other.ranges[pair]
        ranges[pair] = 0.5 * (a_m + b_m), 0.25 * (a_m2 + b_m2)
    return _Step(one.start_s, ranges)
