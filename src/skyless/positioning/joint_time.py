"""What passing time does to ``joint``'s states: noise of motion and oscillators, and the base of the values."""

from typing import Final

import numpy as np

from skyless.compiled import borrowing_kernel
from skyless.constants import TICK_S
from skyless.positioning.joint_algebra import new_term
from skyless.positioning.joint_state import (
    BASE,
    DIM,
    EPOCH,
    QA,
    SLOTS,
    TERMS,
    WALK,
    WHITE,
    JointArrays,
    states,
    values,
    width,
)
from skyless.positioning.protection_updates import fade_evidence
from skyless.positioning.tracker import AGILITY

REBASE_S: Final = 0.015
"""Age at which the base of the values is moved on; the offsets move by tens of metres until then."""


@borrowing_kernel
def elapse(s: JointArrays, rx_ticks: int) -> None:
    """Let time pass up to a reading of the tag."""
    dt_s = (rx_ticks - s.counts[EPOCH]) * TICK_S
    tau_s = (rx_ticks - s.counts[BASE]) * TICK_S
    if tau_s > REBASE_S:
        _move_base(s, tau_s)
        s.counts[BASE] = rx_ticks
        tau_s = 0.0
    s.counts[EPOCH] = rx_ticks
    fade_evidence(s)
    dim, half = int(s.settings[DIM]), values(s)
    rate = s.settings[QA] * s.statistics[AGILITY] * dt_s
    cross, value = _noise_at_base(0.0, rate, dt_s, tau_s)
    for place in range(dim):
        _add_noise(s, place, half + place, value, cross, rate)
    rate = s.settings[WALK] * dt_s
    cross, value = _noise_at_base(s.settings[WHITE] * dt_s, rate, dt_s, tau_s)
    for place in range(dim, half):
        _add_noise(s, place, half + place, value, cross, rate)
    if value > 0.0:
        _add_common_noise(s, dim, half, value, cross, rate)


@borrowing_kernel
def _noise_at_base(white: float, rate: float, dt_s: float, tau_s: float) -> tuple[float, float]:
    """Covariance with the rate, and variance, of what a value as of the base gains in the last ``dt_s``.

    ``rate`` is the variance that the rate gains. At the end of the interval the covariance would be rate·dt/2.
    """
    cross = rate * (0.5 * dt_s - tau_s)
    value = white + rate * (dt_s * dt_s / 3.0 - tau_s * dt_s + tau_s * tau_s)
    return cross, value


@borrowing_kernel
def _add_noise(s: JointArrays, place: int, rate_place: int, value: float, cross: float, rate: float) -> None:
    s.P[place, place] += value
    s.P[place, rate_place] += cross
    s.P[rate_place, place] += cross
    s.P[rate_place, rate_place] += rate


@borrowing_kernel
def _add_common_noise(s: JointArrays, dim: int, half: int, value: float, cross: float, rate: float) -> None:
    """Add the noise of the tag's own oscillator, which all offsets share, as two terms."""
    u, columns = s.terms, width(s)
    own = np.sqrt(value)
    shared = cross / own
    rest = np.sqrt(max(rate - shared * shared, 0.0))
    one = new_term(s, 1.0)
    s.counts[TERMS] = one + 1
    other = new_term(s, 1.0)
    s.counts[TERMS] = other + 1
    for column in range(columns):
        u[one, column] = 0.0
        u[other, column] = 0.0
    for place in range(dim, half):
        u[one, place] = own
        u[one, half + place] = shared
        u[other, half + place] = rest


@borrowing_kernel
def _move_base(s: JointArrays, tau_s: float) -> None:
    """Give all values as of a base later by ``tau_s``: F·P·Fᵀ."""
    x, P, half, n = s.x, s.P, values(s), states(s)
    for place in range(half):
        x[place] += tau_s * x[half + place]
    for slot in range(s.counts[SLOTS]):
        for place in range(half):
            s.sensitivities[slot, place] += tau_s * s.sensitivities[slot, half + place]
    for row in range(half):
        for column in range(n):
            P[row, column] += tau_s * P[half + row, column]
    for row in range(half):
        for column in range(row):  # as above the diagonal, to the bit
            P[row, column] = P[column, row]
        for column in range(row, half):
            P[row, column] += tau_s * P[row, half + column]
    for row in range(half):
        for column in range(half, n):
            P[column, row] = P[row, column]
