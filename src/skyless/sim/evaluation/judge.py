"""Fixes of a recording against its truth, in bounded memory."""

from bisect import bisect_right
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.kernels.arrays import Array
from skyless.sim.evaluation.statistics import ErrorStatistics, ErrorSummary, EvenSample
from skyless.site.tables import Truth

Triple = tuple[float, float, float]


class Judgement(Struct, frozen=True):
    """What the fixes were worth."""

    median_m: Triple | None
    std_m: Triple | None
    errors: ErrorSummary


FLIGHT_M: Final = 0.3
"""Above this height a drone flies."""


def flies(truth: Truth) -> bool:
    """Whether the tag begins on the floor and then spends most of its time well above it."""
    heights = truth.position_m[:, 2]
    return bool(heights[0] < FLIGHT_M and np.median(heights) > 2.0 * FLIGHT_M)


def antenna_truth(truth: Truth, lever_arm_m: Triple) -> Truth:
    """Carry the truth from the body to the antenna; without an attitude the body is taken to stay level.

    ``lever_arm_m`` is the antenna in the body's frame.
    """
    arm = np.array(lever_arm_m)
    if truth.quaternion is None:
        return Truth(truth.t_s, truth.position_m + arm, None)
    vector, scalar = truth.quaternion[:, :3], truth.quaternion[:, 3:]
    turned = arm + 2.0 * np.cross(vector, np.cross(vector, arm) + scalar * arm)
    return Truth(truth.t_s, truth.position_m + turned, truth.quaternion)


class Judge:
    """Compares positions with the truth at their time, once settled, and where the tag is high enough."""

    def __init__(
        self,
        truth: Truth | None,
        *,
        planar: bool,
        settle_s: float = 2.0,
        above_m: float | None = None,
        max_gap_s: float = 1.0,
    ) -> None:
        """``settle_s`` since the first record, ``above_m`` of the true height; truth with longer gaps is none."""
        self._settle_s = settle_s
        self._above_m = above_m
        self._max_gap_s = max_gap_s
        self._times: list[float] = [] if truth is None else truth.t_s.tolist()
        self._places: Array = np.empty((0, 3)) if truth is None else truth.position_m
        self._errors = ErrorStatistics(planar=planar)
        self._settled = ErrorStatistics(planar=planar)
        self._places_settled = EvenSample(3)
        self.track = EvenSample(7)
        """Rows of time, position, and true position (NaN where there is none)."""
        self.newest_truth_m: Triple | None = None
        """With which the newest position was compared."""

    def add(self, time_s: float, since_start_s: float, position_m: Triple) -> None:
        """Take one position; ``time_s`` is in the recording's own time."""
        self.newest_truth_m = truth = self.at(time_s) if self.has_truth else None
        self.track.add((time_s, *position_m, *(truth or (np.nan, np.nan, np.nan))))
        if since_start_s < self._settle_s:
            return
        self._settled.add(*position_m)
        self._places_settled.add(position_m)
        if truth is not None and (self._above_m is None or truth[2] > self._above_m):
            self._errors.add(position_m[0] - truth[0], position_m[1] - truth[1], position_m[2] - truth[2])

    @property
    def judged(self) -> int:
        """How many positions have been compared with the truth, and count."""
        return self._errors.count

    @property
    def has_truth(self) -> bool:
        """Whether there is anything to compare with."""
        return len(self._times) > 0

    def at(self, time_s: float) -> Triple | None:
        """Truth at a time by linear interpolation, None outside the table or in a gap of it."""
        times = self._times
        if not times or not times[0] <= time_s <= times[-1]:
            return None
        after = min(bisect_right(times, time_s), len(times) - 1)
        before_s, span_s = times[after - 1], times[after] - times[after - 1]
        at_a_row = time_s in (before_s, times[after])
        if span_s > self._max_gap_s and not at_a_row:
            return None
        part = (time_s - before_s) / span_s if span_s > 0.0 else 0.0
        x, y, z = (self._places[after - 1] + part * (self._places[after] - self._places[after - 1])).tolist()
        return x, y, z

    def judgement(self) -> Judgement:
        """What the positions come to."""
        if self._settled.count == 0:
            return Judgement(None, None, self._errors.summary())
        x, y, z = np.median(self._places_settled.rows, axis=0).tolist()
        return Judgement((x, y, z), self._settled.std(), self._errors.summary())
