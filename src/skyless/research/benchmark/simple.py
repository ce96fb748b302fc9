"""Estimators without a filter, as they are written in an afternoon: a gradient, and least squares over a window."""

from typing import Final

import numpy as np

from skyless.core.air.masterless_packets import PairTdoa
from skyless.core.arrays import Array, Vector
from skyless.core.fix import Fix

_STEP: Final = 0.2
"""Share of a difference's error that a step takes away."""

_WINDOW, _BETWEEN, _ITERATIONS = 30, 10, 5
"""Differences that are fitted at a time, those from one fit to the next, and iterations of each."""


class Gradient:
    """Goes a step down the gradient of each difference's error, from the middle of the first two anchors."""

    def __init__(self) -> None:
        self._position_m: Vector | None = None

    def hear(self, observation: PairTdoa) -> Fix | None:
        """Process one time difference; see ``OwnEstimator``."""
        a_m, b_m = np.array([observation.a_m]), np.array([observation.b_m])
        if self._position_m is None:
            self._position_m = (a_m + b_m)[0] / 2.0
        (error_m,), (slope,) = _errors(self._position_m, a_m, b_m, np.array([observation.tdoa_m]))
        self._position_m += _STEP * error_m * slope / max(float(slope @ slope), 0.1)
        return Fix.of(observation.time_s, self._position_m.tolist())


class LeastSquares:
    """Fits a position to the newest differences, by Gauss and Newton from the one before."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []
        self._position_m: Vector | None = None

    def hear(self, observation: PairTdoa) -> Fix | None:
        """Process one time difference; see ``OwnEstimator``."""
        self._rows.append((*(observation.a_m or ()), *(observation.b_m or ()), observation.tdoa_m))
        if len(self._rows) < _WINDOW:
            return None
        rows = np.array(self._rows)
        del self._rows[:_BETWEEN]
        position_m = rows[:, :3].mean(axis=0) if self._position_m is None else self._position_m.copy()
        for _ in range(_ITERATIONS):
            errors_m, slopes = _errors(position_m, rows[:, :3], rows[:, 3:6], rows[:, 6])
            position_m += np.linalg.lstsq(slopes, errors_m, rcond=1e-2)[0]
        self._position_m = position_m
        return Fix.of(observation.time_s, position_m.tolist())


def _errors(position_m: Vector, a_m: Array, b_m: Array, tdoa_m: Vector) -> tuple[Vector, Array]:
    """Differences less those at a position, shape (n,), and their slopes there, shape (n, 3)."""
    to_a, to_b = position_m - a_m, position_m - b_m
    range_a, range_b = (np.maximum(np.linalg.norm(to, axis=1), 1e-3) for to in (to_a, to_b))
    return tdoa_m - (range_b - range_a), to_b / range_b[:, None] - to_a / range_a[:, None]
