"""The tracker for systems that give time differences of pairs of anchors instead of stamps on one master's scale.

Position, velocity and what each anchor is off are its state (``pair_state``); the tag's clock has dropped out with the
difference. The measurement is d = |p − b| − |p − a| + what b is off − what a is off (``docs/maths.md`` section 6).
"""

from typing import Final

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from skyless.compiled import borrowing_kernel
from skyless.positioning.kalman import horizontal_variance, predict_motion, range_and_direction
from skyless.positioning.pair_calibration import KNOWN_STD_M, NEAREST_M, PairCalibration
from skyless.positioning.pair_monitor import (
    MISFIT_MOST,
    exclude,
    follow_faults,
    follow_motion,
    gather,
    judge_pair,
    spread_factor,
    watch_excluded,
)
from skyless.positioning.pair_state import (
    AGE_S,
    BEYOND_REPAIR,
    BIAS,
    CONSTANT,
    DIM,
    HEIGHT,
    MISFIT,
    MOST_SLOTS,
    PLACE,
    QA,
    SLOPE,
    SLOTS,
    VARIANCE,
    Matrix,
    PairArrays,
    PairSettings,
    Vector,
    along,
    constant_of,
    forget_slot,
    new_arrays,
    states,
)
from skyless.positioning.tracker import AGILITY, LOST_SHARE, REJECTED_SHARE

CONSTANT_S: Final = 30.0
"""Antenna delays last, but a filter that held them for certain would hold what it took for them as well."""

PLACE_M: Final = 0.5
PLACE_S: Final = 100.0
"""What reflections add changes when the tag goes so far, or when people and things have moved for so long."""


@borrowing_kernel
def pair_update(s: PairArrays, a: int, b: int, a_m: Vector, b_m: Vector, dt_s: float, tdoa_m: float) -> bool:
    """Advance by ``dt_s`` and take one difference of the slots a and b; False if it is not used."""
    _predict(s, dt_s)
    s.slots[a, AGE_S] = s.slots[b, AGE_S] = 0.0
    innovation = tdoa_m - _expected(s, a, b, a_m, b_m)
    n, spread = states(s), s.settings[VARIANCE]
    for row in range(n):
        s.ph[row] = along(s, a, b, s.P, row)
    for axis in range(int(s.settings[DIM])):
        spread += s.h[axis] * s.ph[axis]
    at_a, at_b = constant_of(s, a), constant_of(s, b)
    spread += s.ph[at_b] + s.ph[at_b + 1] - s.ph[at_a] - s.ph[at_a + 1]
    spread *= spread_factor(s)
    if s.excluded[a] or s.excluded[b]:
        if not (s.excluded[a] and s.excluded[b]):
            watch_excluded(s, a if s.excluded[a] else b, innovation / np.sqrt(spread))
        return False
    faulty = gather(s, a, b, dt_s, innovation, spread)
    factor = judge_pair(s, innovation, spread)
    if factor > 0.0:
        follow_motion(s, innovation / np.sqrt(spread) / factor)
        _correct(s, innovation, spread * factor)
    follow_faults(s, dt_s, factor > 0.0, spread * factor)
    if faulty >= 0:
        exclude(s, faulty)
    return bool(factor > 0.0)


@borrowing_kernel
def _predict(s: PairArrays, dt_s: float) -> None:
    """Let time pass: the tag moves on, and what its anchors are off fades, by its way and by time."""
    x, P, dim, n = s.x, s.P, int(s.settings[DIM]), states(s)
    predict_motion(x, P, dim, dt_s, s.settings[QA] * s.statistics[AGILITY])
    squared = 0.0
    for axis in range(dim):
        squared += x[dim + axis] ** 2
        for slot in range(s.counts[SLOTS]):
            s.faults[slot, axis] += dt_s * s.faults[slot, dim + axis]
    lasting = np.exp(-dt_s / CONSTANT_S)
    local = np.exp(-dt_s * (np.sqrt(squared) / PLACE_M + 1.0 / PLACE_S))
    for row in range(2 * dim, n):
        by_row = local if row % 2 else lasting
        x[row] *= by_row
        for column in range(2 * dim):
            P[row, column] *= by_row
            P[column, row] = P[row, column]
        for column in range(2 * dim, row + 1):
            P[row, column] *= by_row * (local if column % 2 else lasting)
            P[column, row] = P[row, column]
        P[row, row] += (1.0 - by_row * by_row) * (
            s.settings[PLACE] if row % 2 else s.slots[(row - 2 * dim) // 2, CONSTANT]
        )
        for slot in range(s.counts[SLOTS]):
            s.faults[slot, row] *= by_row
    for slot in range(s.counts[SLOTS]):
        s.slots[slot, AGE_S] += dt_s


@borrowing_kernel
def _expected(s: PairArrays, a: int, b: int, a_m: Vector, b_m: Vector) -> float:
    """The difference that the state lets expect; its gradient by the position goes to ``h``."""
    dim = int(s.settings[DIM])
    for axis in range(dim):
        s.h[axis] = 0.0
    range_b = range_and_direction(s.x, dim, s.settings[HEIGHT], b_m, s.h, 1.0)
    range_a = range_and_direction(s.x, dim, s.settings[HEIGHT], a_m, s.h, -1.0)
    at_a, at_b = constant_of(s, a), constant_of(s, b)
    off_b = s.x[at_b] + s.x[at_b + 1] + s.slots[b, BIAS] + s.slots[b, SLOPE] * np.log(max(range_b, NEAREST_M))
    off_a = s.x[at_a] + s.x[at_a + 1] + s.slots[a, BIAS] + s.slots[a, SLOPE] * np.log(max(range_a, NEAREST_M))
    return float(range_b - range_a + off_b - off_a)


@borrowing_kernel
def _correct(s: PairArrays, innovation: float, spread: float) -> None:
    """Scalar Kalman update of the states in use; the covariance stays exactly symmetric."""
    n = states(s)
    for row in range(n):
        gain = s.ph[row] / spread
        s.x[row] += gain * innovation
        for column in range(row, n):
            s.P[row, column] -= gain * s.ph[column]
            s.P[column, row] = s.P[row, column]


@borrowing_kernel
def track_pairs(
    s: PairArrays,
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    a_m: Matrix,
    b_m: Matrix,
    dt_s: Vector,
    tdoa_m: Vector,
    rows: Matrix,
) -> int:
    """Take many differences in one loop; row k of ``rows`` is the motion after difference k. Returns the accepted."""
    accepted = 0
    for k in range(tdoa_m.shape[0]):
        accepted += pair_update(s, a[k], b[k], a_m[k], b_m[k], dt_s[k], tdoa_m[k])
        for place in range(rows.shape[1]):
            rows[k, place] = s.x[place]
    return accepted


class PairTracker:
    """State of one tag's filter of pair differences."""

    def __init__(self, settings: PairSettings, calibration: PairCalibration | None = None) -> None:
        self.dim = settings.dim
        self._calibration = PairCalibration({}) if calibration is None else calibration
        tdoa_std_m = self._calibration.tdoa_std_m(settings.tdoa_std_m)
        self.settings = structs.replace(settings, tdoa_std_m=tdoa_std_m)
        self.arrays = new_arrays(self.settings)
        self.x, self.P, self.statistics = self.arrays.x, self.arrays.P, self.arrays.statistics
        self._constant_std_m = settings.constant_std_m
        self._slot_of: dict[int, int] = {}
        self._anchor_of: dict[int, int] = {}
        self.slots_given = 0
        """How often an anchor got a slot, a free one or another's."""

    def start(self, position_m: Vector, covariance_m2: Matrix, speed_variance: float) -> None:
        """Begin at a solved position, shapes (dim,) and (dim, dim); nothing is held against any anchor."""
        dim, s = self.dim, self.arrays
        self.x[:dim] = position_m
        self.x[dim:] = 0.0
        self.P[:] = 0.0
        self.P[:dim, :dim] = covariance_m2
        self.P[range(dim, 2 * dim), range(dim, 2 * dim)] = speed_variance
        slots = s.counts[SLOTS]
        s.counts[:] = 0
        s.counts[SLOTS] = slots
        s.statistics[:] = 0.0
        s.statistics[:4] = (1.0, s.settings[VARIANCE], 0.0, 1.0)
        s.faults[:] = 0.0
        for slot in range(slots):
            forget_slot(s, slot)

    def leave_out(self, anchor: int) -> None:
        """Exclude an anchor for a start, until its differences are ordinary."""
        slot = self.slot(anchor)
        self.arrays.excluded[slot] = 1
        self.arrays.slots[slot, MISFIT] = MISFIT_MOST

    def slot(self, anchor: int) -> int:
        """Slot of an anchor, a new one where it has none yet."""
        slot = self._slot_of.get(anchor)
        if slot is not None:
            return slot
        s = self.arrays
        slot = int(s.counts[SLOTS])
        if slot < MOST_SLOTS:
            s.counts[SLOTS] += 1
        else:
            slot = int(s.slots[:, AGE_S].argmax())
            del self._slot_of[self._anchor_of[slot]]
        known = self._calibration.of(anchor)
        std_m = KNOWN_STD_M if anchor in self._calibration.anchors else self._constant_std_m
        s.slots[slot] = (known.bias_m, known.slope_m, std_m**2, 0.0, 0.0, 0.0, 0.0)
        forget_slot(s, slot)
        self._slot_of[anchor], self._anchor_of[slot] = slot, anchor
        self.slots_given += 1
        return slot

    @property
    def excluded(self) -> tuple[int, ...]:
        """Anchors that are left out at present."""
        return tuple(self._anchor_of[int(slot)] for slot in np.flatnonzero(self.arrays.excluded))

    @property
    def lost(self) -> bool:
        """Whether so many differences do not fit, or so many anchors seem wrong, that the state must be wrong."""
        s = self.arrays
        return bool(s.statistics[REJECTED_SHARE] > LOST_SHARE or s.counts[BEYOND_REPAIR])

    def horizontal_variance_m2(self, ahead_s: float) -> float:
        """Sum of the variances of x and y so much later, if nothing is heard until then."""
        return horizontal_variance(self.P, self.dim, ahead_s, self.arrays.settings[QA] * self.statistics[AGILITY])

    def hear(self, anchor_a: int, anchor_b: int, a_m: Vector, b_m: Vector, dt_s: float, tdoa_m: float) -> bool:
        """Take one difference, ``dt_s`` after the last one (``pair_update``)."""
        a, b = self.slot(anchor_a), self.slot(anchor_b)
        return pair_update(self.arrays, a, b, a_m, b_m, dt_s, tdoa_m)
