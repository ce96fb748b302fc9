"""Errors of the ranges between anchors: late for good, for a while, drifting, or no reception at all.

Both directions of a pair share them, as a reflection or an obstacle has it. They are drawn for each pair alone.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final

from skyless.core.kernels.arrays import Array
from skyless.sim.impairments import PairError
from skyless.sim.streams import PAIR_KEY, stream

_BLOCKED_M: Final = math.inf
"""The error of a pair that does not receive one another."""

_KNOTS: Final = 20
"""In a drift's correlation time, as in ``range_errors``."""


class _Drift:
    """A Gauss–Markov process of time, drawn at knots and interpolated."""

    def __init__(self, error: PairError, seed: int, purpose: int) -> None:
        low, high = sorted((error.a, error.b))
        self._draw = stream(seed, PAIR_KEY, low << 16 | high, purpose)
        self._std_m, self._step_s, self._knot = error.drift_std_m, error.drift_time_s / _KNOTS, 0
        self._before_m = self._std_m * float(self._draw.standard_normal())
        self._after_m = self._next()

    def _next(self) -> float:
        kept = math.exp(-1.0 / _KNOTS)
        return kept * self._before_m + self._std_m * math.sqrt(1.0 - kept**2) * float(self._draw.standard_normal())

    def at(self, t_s: float) -> float:
        """The error at a true time, not before that of the last call."""
        while t_s >= (self._knot + 1) * self._step_s:
            self._knot += 1
            self._before_m, self._after_m = self._after_m, 0.0
            self._after_m = self._next()
        return self._before_m + (t_s / self._step_s - self._knot) * (self._after_m - self._before_m)


class AnchorPairErrors:
    """The present errors of all pairs of anchors."""

    def __init__(self, errors: Sequence[PairError], node_of: Mapping[int, int], seed: int) -> None:
        """``node_of``: nodes of the anchors, which stand in the rows and columns of the errors."""
        self._errors: list[tuple[int, int, PairError, _Drift | None]] = []
        counts: dict[frozenset[int], int] = {}
        for error in errors:
            pair = frozenset((error.a, error.b))
            purpose = counts[pair] = counts.get(pair, -1) + 1
            drift = _Drift(error, seed, purpose) if error.drift_std_m > 0.0 else None
            self._errors.append((node_of[error.a], node_of[error.b], error, drift))

    def set_present(self, t_s: float, present_m: Array) -> None:
        """Set the errors at a true time, not before the last one, in the rows of anchors, shape (nodes, anchors)."""
        for a, b, _, _ in self._errors:
            present_m[a, b] = present_m[b, a] = 0.0
        for a, b, error, drift in self._errors:
            drift_m = 0.0 if drift is None else drift.at(t_s)
            if error.from_s <= t_s < error.to_s:
                present_m[a, b] += _BLOCKED_M if error.blocked else error.late_m + drift_m
                present_m[b, a] = present_m[a, b]
