"""State of the filter of pair differences: the tag's motion, and by how much each anchor in view seems too far away.

    position (dim), velocity (dim), then for each slot: constant, place

An anchor seems too far by its antenna delays, which hardly change (*constant*), and by reflections and obstacles, which
change with the tag's place (*place*). Only differences between anchors show; what all have in common goes nowhere.
"""

from typing import Final, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.compiled import borrowing_kernel
from skyless.positioning.tracker import REJECTED_IN_ROW

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Integers = NDArray[np.int64]

QA, VARIANCE, GATE, HEIGHT, DIM, PLACE = range(6)
"""Places in ``settings``; the last is the variance of what changes with the place."""

SLOTS: Final = REJECTED_IN_ROW + 1
EXCLUSIONS, READMISSIONS, BEYOND_REPAIR = range(SLOTS + 1, SLOTS + 4)
"""Places in ``counts`` behind those of the tracker."""

WORTH, LAG_SQUARED, LAG = range(4, 7)
"""Places in ``statistics`` behind the tracker's: running mean of the normalised innovations squared, the wild ones too;
lag of the position, and its three components."""

BIAS, SLOPE, CONSTANT, AGE_S, SUM, INFORMATION, MISFIT = range(7)
"""Places in a row of ``slots``: what is known of the anchor, variance of its constant, time since it was heard, and
the evidence of a fault (``pair_monitor``)."""

MOST_SLOTS: Final = 16
"""Anchors in view; where there are more, the one unheard for longest gives way."""

START_STD_M: Final = 0.22
"""Of a difference with all that is wrong with it, where nothing has been learnt yet."""


class PairSettings(Struct, frozen=True):
    """What the filter of pair differences assumes."""

    qa: float = 1.0
    """Spectral density of the acceleration, m²/s³ per axis."""
    tdoa_std_m: float = 0.15
    """Of what is new in each time difference, in metres."""
    gate: float = 3.5
    """Innovations beyond so many standard deviations are not used."""
    constant_std_m: float = 0.07
    """Of an anchor's constant; a DW1000's antenna delays vary by so much between radios."""
    place_std_m: float = 0.07
    """Of what reflections add to an anchor's range at some place."""
    height_m: float | None = None
    """Height of the tag where it is given; None to estimate it."""

    @property
    def dim(self) -> int:
        """Dimensions of the position that are estimated."""
        return 3 if self.height_m is None else 2

    def array(self) -> Vector:
        """The settings as the kernels take them."""
        height_m = 0.0 if self.height_m is None else self.height_m
        return np.array([self.qa, self.tdoa_std_m**2, self.gate, height_m, self.dim, self.place_std_m**2])


class PairArrays(NamedTuple):
    """Everything that the kernels work on, for one tag; the states in use come first."""

    x: Vector
    """Shape (states,)."""
    P: Matrix
    """Shape (states, states)."""
    counts: Integers
    statistics: Vector
    settings: Vector
    h: Vector
    """Gradient of the measurement at hand by the position, shape (3,)."""
    ph: Vector
    slots: Matrix
    """Shape (MOST_SLOTS, 7)."""
    excluded: Integers
    """1 for slots that are left out, shape (MOST_SLOTS,)."""
    faults: Matrix
    """Shape (MOST_SLOTS, states): the states' errors for each metre by which a slot has lately been late."""
    parts: Vector
    """How much of such a fault shows in the innovation at hand, shape (MOST_SLOTS,)."""


def new_arrays(settings: PairSettings) -> PairArrays:
    """Empty arrays."""
    states = 2 * settings.dim + 2 * MOST_SLOTS
    return PairArrays(
        x=np.zeros(states),
        P=np.zeros((states, states)),
        counts=np.zeros(SLOTS + 4, np.int64),
        statistics=np.ones(LAG + 3),
        settings=settings.array(),
        h=np.zeros(3),
        ph=np.zeros(states),
        slots=np.zeros((MOST_SLOTS, 7)),
        excluded=np.zeros(MOST_SLOTS, np.int64),
        faults=np.zeros((MOST_SLOTS, states)),
        parts=np.zeros(MOST_SLOTS),
    )


@borrowing_kernel
def states(s: PairArrays) -> int:
    """How many states are in use."""
    return int(2 * (s.settings[DIM] + s.counts[SLOTS]))


@borrowing_kernel
def constant_of(s: PairArrays, slot: int) -> int:
    """Place of a slot's constant in the state; what changes with the place follows it."""
    return int(2 * (s.settings[DIM] + slot))


@borrowing_kernel
def along(s: PairArrays, a: int, b: int, rows: Matrix, row: int) -> float:
    """The product of a row with the gradient of the difference of slots a and b, of which few places are not zero."""
    total = 0.0
    for axis in range(int(s.settings[DIM])):
        total += rows[row, axis] * s.h[axis]
    at_a, at_b = constant_of(s, a), constant_of(s, b)
    return float(total + rows[row, at_b] + rows[row, at_b + 1] - rows[row, at_a] - rows[row, at_a + 1])


@borrowing_kernel
def forget_slot(s: PairArrays, slot: int) -> None:
    """Let an anchor begin, or begin anew, with what is known of any."""
    first = constant_of(s, slot)
    for state in range(first, first + 2):
        s.x[state] = 0.0
        for other in range(s.x.shape[0]):
            s.P[state, other] = 0.0
            s.P[other, state] = 0.0
        for other in range(s.faults.shape[0]):
            s.faults[other, state] = 0.0
    s.P[first, first] = s.slots[slot, CONSTANT]
    s.P[first + 1, first + 1] = s.settings[PLACE]
    s.excluded[slot] = 0
    forget_evidence(s, slot)


@borrowing_kernel
def forget_evidence(s: PairArrays, slot: int) -> None:
    """Nothing is held against an anchor any more."""
    s.slots[slot, SUM] = s.slots[slot, INFORMATION] = 0.0
    for state in range(s.x.shape[0]):
        s.faults[slot, state] = 0.0
