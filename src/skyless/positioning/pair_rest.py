"""Whether a tag stands still, and where: beside the filter that lets it move runs one that does not.

Standing still, all differences are of one place, and what they scatter averages away for as long as it lasts. The
filter at rest is the other one without its velocity. When its innovations lean to one side, or two in a row do not fit,
the tag moves, and it begins anew from where the other one is.
"""

from typing import Final

from skyless.positioning.estimator.monitor import LAG_LIMIT
from skyless.positioning.pair_state import LAG_SQUARED, QA, Vector, new_arrays
from skyless.positioning.pair_tracker import PairTracker, pair_update
from skyless.positioning.tracker import REJECTED_IN_ROW

REST_QA: Final = 1e-7
"""Spectral density of the acceleration, m²/s³: 5 cm within half a minute."""

REST_S: Final = 8.0
REST_COUNT: Final = 20
"""A tag that stood still for so long and so many differences is at rest."""

ASTRAY_IN_ROW: Final = 2


class Rest:
    """The filter at rest of one tag."""

    def __init__(self, tracker: PairTracker) -> None:
        self._tracker = tracker
        self.arrays = new_arrays(tracker.settings)
        self.since_s = 0.0
        self.count = 0
        """How long the tag has stood still, and how many differences."""
        self._slots_given = 0

    @property
    def lasts(self) -> bool:
        """Whether the tag is at rest."""
        return self.since_s > REST_S and self.count > REST_COUNT

    def begin(self) -> None:
        """Begin where the tracker is."""
        dim = self._tracker.dim
        for mine, its in zip(self.arrays, self._tracker.arrays, strict=True):
            mine[...] = its
        self.arrays.settings[QA] = REST_QA
        self.arrays.x[dim : 2 * dim] = 0.0
        self.arrays.P[dim : 2 * dim] = 0.0
        self.arrays.P[:, dim : 2 * dim] = 0.0
        self.arrays.statistics[LAG_SQUARED:] = 0.0
        self.since_s, self.count = 0.0, 0
        self._slots_given = self._tracker.slots_given

    def hear(self, a: int, b: int, a_m: Vector, b_m: Vector, dt_s: float, tdoa_m: float) -> None:
        """Take what the tracker has just taken."""
        s = self.arrays
        if self._slots_given != self._tracker.slots_given:
            self.begin()
            return
        pair_update(s, a, b, a_m, b_m, dt_s, tdoa_m)
        self.since_s += dt_s
        self.count += 1
        if s.statistics[LAG_SQUARED] > LAG_LIMIT or s.counts[REJECTED_IN_ROW] >= ASTRAY_IN_ROW:
            self.begin()
