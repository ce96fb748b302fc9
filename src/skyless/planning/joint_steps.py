"""Steps of ``joint``'s covariance (``joint_sigma``): time that passes, a new packet, a reception of the tag or a relay.

States stand as in the filter (``positioning/joint_state``), all as of now: position and the offsets of the anchors'
clocks, then the rates of all these, then the noise of each anchor's last TX stamp.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyless.compiled import borrowing_kernel

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Integers = NDArray[np.int64]

WHITE, WALK, TX_VAR, RX_VAR = range(4)
"""Places in ``settings``: noise of one clock (m²/s, m²/s³), variances of stamps in m²."""

MOST_PLACES: Final = 5
"""States that a measurement is about."""


class Work(NamedTuple):
    """The covariance of a point, and what its updates need."""

    P: Matrix
    """Shape (states, states)."""
    gains: Matrix
    """Of all updates of a superframe, shape (packets + relays, states)."""
    places: Integers
    """Where the measurement at hand is not zero, ..."""
    h: Vector
    """... and what it is there; shapes (MOST_PLACES,)."""
    vector: Vector
    """Room for a product with P, or for a mean error; shape (states,)."""


@borrowing_kernel
def advance(P: Matrix, dim: int, half: int, dt_s: float, qa: float, settings: Vector) -> None:
    """Let time pass; the tag's own oscillator is in all offsets."""
    n = len(P)
    for value in range(half):
        for column in range(n):
            P[value, column] += dt_s * P[half + value, column]
    for row in range(n):
        for value in range(half):
            P[row, value] += dt_s * P[row, half + value]
    for axis in range(dim):
        _add_noise(P, axis, axis, half, dt_s, 0.0, qa)
    for one in range(dim, half):
        for other in range(dim, half):
            times = 2.0 if one == other else 1.0
            _add_noise(P, one, other, half, dt_s, times * settings[WHITE], times * settings[WALK])


@borrowing_kernel
def _add_noise(P: Matrix, one: int, other: int, half: int, dt_s: float, white: float, walk: float) -> None:
    """Noise that two values and their rates have in common."""
    cross = walk * dt_s * dt_s / 2.0
    P[one, other] += dt_s * (white + walk * dt_s * dt_s / 3.0)
    P[one, half + other] += cross
    P[half + one, other] += cross
    P[half + one, half + other] += walk * dt_s


@borrowing_kernel
def new_packet(P: Matrix, place: int, variance: float) -> None:
    """Forget the noise of an anchor's last TX stamp for that of a new one."""
    P[place, :] = 0.0
    P[:, place] = 0.0
    P[place, place] = variance


@borrowing_kernel
def by_tag(sight: Vector, dim: int, half: int, place: int, places: Integers, h: Vector) -> int:
    """The tag's reception of the anchor in this place of the list: R − T = range + b + w; how many states it is of."""
    for axis in range(dim):
        places[axis], h[axis] = axis, sight[axis]
    places[dim], h[dim] = dim + place, 1.0
    places[dim + 1], h[dim + 1] = 2 * half + place, 1.0
    return dim + 2


@borrowing_kernel
def by_anchor(dim: int, half: int, listener: int, heard: int, age_s: float, places: Integers, h: Vector) -> int:
    """An anchor's reception of another, so long ago: S − T = distance + b_heard − b_listener + w_heard."""
    places[0], h[0] = dim + heard, 1.0
    places[1], h[1] = dim + listener, -1.0
    places[2], h[2] = half + dim + heard, -age_s
    places[3], h[3] = half + dim + listener, age_s
    places[4], h[4] = 2 * half + heard, 1.0
    return MOST_PLACES


@borrowing_kernel
def relay_variance(age_s: float, settings: Vector) -> float:
    """Of a relayed reception: its stamp, and what two oscillators have done since."""
    return float(settings[RX_VAR] + 2.0 * age_s * (settings[WHITE] + settings[WALK] * age_s * age_s / 3.0))


@borrowing_kernel
def correct(P: Matrix, places: Integers, h: Vector, count: int, variance: float, ph: Vector, gain: Vector) -> None:
    """Take a measurement of so many states; fill ``gain`` with its gain."""
    n = len(P)
    ph[:] = 0.0
    for k in range(count):
        weight, row = h[k], places[k]
        for column in range(n):
            ph[column] += weight * P[row, column]
    spread = variance
    for k in range(count):
        spread += h[k] * ph[places[k]]
    for row in range(n):
        gain[row] = ph[row] / spread
    for row in range(n):
        factor = gain[row]
        for column in range(n):
            P[row, column] -= factor * ph[column]


@borrowing_kernel
def back_through(adjoint: Matrix, places: Integers, h: Vector, count: int, gain: Vector) -> None:
    """Carry what errors will matter, rows of ``adjoint``, back through a measurement: λ(I − K·hᵀ)."""
    for row in range(len(adjoint)):
        along = 0.0
        for column in range(len(gain)):
            along += adjoint[row, column] * gain[column]
        for k in range(count):
            adjoint[row, places[k]] -= along * h[k]


@borrowing_kernel
def back_in_time(adjoint: Matrix, dim: int, half: int, dt_s: float, qa: float, caused: Vector) -> None:
    """Carry the rows of ``adjoint`` back in time; adds to ``caused`` the variances that accelerations then cause."""
    cube, square = qa * dt_s * dt_s * dt_s / 3.0, qa * dt_s * dt_s
    for row in range(len(adjoint)):
        for axis in range(dim):
            value, rate = adjoint[row, axis], adjoint[row, half + axis]
            caused[row] += value * value * cube + value * rate * square + rate * rate * qa * dt_s
        for value in range(half):
            adjoint[row, half + value] += dt_s * adjoint[row, value]


@borrowing_kernel
def shift_by(shift: Vector, places: Integers, h: Vector, count: int, late_m: float, gain: Vector) -> None:
    """What a measurement that is late by so much does to the mean error."""
    seen = late_m
    for k in range(count):
        seen -= h[k] * shift[places[k]]
    for row in range(len(shift)):
        shift[row] += gain[row] * seen
