"""The truth of a recording: carried to the antenna, interpolated, and shifted in time."""

from bisect import bisect_right
from typing import Final

import numpy as np

from skyless.core.arrays import Array, Matrix, Vector
from skyless.site.tables import Truth

Triple = tuple[float, float, float]

FLIGHT_M: Final = 0.3
"""Above this height a drone flies."""

MAX_GAP_S: Final = 1.0
"""There is no truth within longer gaps of its table."""

_WIDEST_OFFSET_S: Final = 5.0
_OFFSET_STEPS_S: Final = (0.1, 0.01, 0.001)
_OFFSET_ROWS: Final = 5_000
"""Fixes with which an offset is estimated, an even sample."""


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


def truth_at(truth: Truth | None, times_s: Vector) -> Matrix:
    """True positions by linear interpolation, shape (n, 3): NaN outside the table and within its gaps."""
    times_s = np.asarray(times_s, dtype=np.float64)
    if truth is None or len(truth.t_s) == 0:
        return np.full((len(times_s), 3), np.nan)
    known_s = truth.t_s
    places_m = np.column_stack([np.interp(times_s, known_s, axis, np.nan, np.nan) for axis in truth.position_m.T])
    after = np.searchsorted(known_s, times_s).clip(1, max(len(known_s) - 1, 1))
    if len(known_s) > 1:
        in_gap = (known_s[after] - known_s[after - 1] > MAX_GAP_S) & ~np.isin(times_s, known_s)
        places_m[in_gap] = np.nan
    return places_m


class TruthTrack:
    """``truth_at`` for one time after the other, which takes a tenth of the time of arrays of one."""

    def __init__(self, truth: Truth | None) -> None:
        self._times: list[float] = [] if truth is None else truth.t_s.tolist()
        self._places: Array = np.empty((0, 3)) if truth is None else truth.position_m

    def at(self, time_s: float) -> Triple | None:
        """True position, None outside the table and within its gaps."""
        times = self._times
        if not times or not times[0] <= time_s <= times[-1]:
            return None
        after = min(bisect_right(times, time_s), len(times) - 1)
        before_s, span_s = times[after - 1], times[after] - times[after - 1]
        if span_s > MAX_GAP_S and time_s not in (before_s, times[after]):
            return None
        part = (time_s - before_s) / span_s if span_s > 0.0 else 0.0
        x, y, z = (self._places[after - 1] + part * (self._places[after] - self._places[after - 1])).tolist()
        return x, y, z


def shifted(truth: Truth, offset_s: float) -> Truth:
    """The truth with ``offset_s`` added to its times."""
    return Truth(truth.t_s + offset_s, truth.position_m, truth.quaternion)


def estimated_offset_s(truth: Truth, times_s: Vector, position_m: Matrix) -> float | None:
    """What is to be added to the truth's times so that it fits positions of shape (n, 3) best; None where none shows.

    The median horizontal error is least there, up to five seconds away. A tag at rest shows none.
    """
    kept = slice(None, None, max(len(times_s) // _OFFSET_ROWS, 1))
    times_s, position_m = times_s[kept], position_m[kept]

    def misfit_m(offset_s: float) -> float:
        error_m = np.linalg.norm((position_m - truth_at(truth, times_s - offset_s))[:, :2], axis=1)
        known = np.isfinite(error_m)
        return float(np.median(error_m[known])) if 2 * known.sum() > len(error_m) else np.inf

    best_s, around_s, misfits = 0.0, _WIDEST_OFFSET_S, [np.inf]
    for step_s in _OFFSET_STEPS_S:
        offsets_s = best_s + np.arange(-around_s, around_s + step_s / 2.0, step_s)
        found = [misfit_m(offset_s) for offset_s in offsets_s]
        misfits = found if around_s == _WIDEST_OFFSET_S else misfits
        best_s, around_s = float(offsets_s[int(np.argmin(found))]), step_s
    known = np.array(misfits)[np.isfinite(misfits)]
    return best_s if len(known) and np.min(known) < 0.5 * np.median(known) else None
