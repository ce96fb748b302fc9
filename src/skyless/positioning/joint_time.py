"""What passing time does to ``joint``'s states: noise of motion and oscillators, and the base of the values."""

from typing import Final

from skyless.compiled import borrowing_kernel
from skyless.constants import TICK_S
from skyless.eights import EIGHT, add, load, store
from skyless.positioning.joint_algebra import settle
from skyless.positioning.joint_state import (
    BASE,
    CLOCK_AGILITY,
    CLOCK_CROSS,
    CLOCK_RATE,
    CLOCK_VALUE,
    EPOCH,
    MOTION_CROSS,
    MOTION_RATE,
    MOTION_VALUE,
    QA,
    WALK,
    WHITE,
    JointArrays,
    lanes,
    states,
    values,
)
from skyless.positioning.protection_updates import fade_evidence
from skyless.positioning.tracker import AGILITY

REBASE_S: Final = 0.05
"""Age at which the base of the values is moved on; the offsets move by hundreds of metres until then."""


@borrowing_kernel
def elapse(s: JointArrays, rx_ticks: int) -> None:
    """Let time pass up to a reading of the tag."""
    dt_s = (rx_ticks - s.counts[EPOCH]) * TICK_S
    tau_s = (rx_ticks - s.counts[BASE]) * TICK_S
    if tau_s > REBASE_S:
        move_base(s, rx_ticks)
        tau_s = 0.0
    s.counts[EPOCH] = rx_ticks
    fade_evidence(s)
    noise = s.noise
    rate = s.settings[QA] * s.statistics[AGILITY] * dt_s
    cross, value = _noise_at_base(0.0, rate, dt_s, tau_s)
    noise[MOTION_VALUE] += value
    noise[MOTION_CROSS] += cross
    noise[MOTION_RATE] += rate
    rate = s.settings[WALK] * s.statistics[CLOCK_AGILITY] * dt_s
    cross, value = _noise_at_base(s.settings[WHITE] * dt_s, rate, dt_s, tau_s)
    noise[CLOCK_VALUE] += value
    noise[CLOCK_CROSS] += cross
    noise[CLOCK_RATE] += rate


@borrowing_kernel
def _noise_at_base(white: float, rate: float, dt_s: float, tau_s: float) -> tuple[float, float]:
    """Covariance with the rate, and variance, of what a value as of the base gains in the last ``dt_s``.

    ``rate`` is the variance that the rate gains. At the end of the interval the covariance would be rate·dt/2.
    """
    cross = rate * (0.5 * dt_s - tau_s)
    value = white + rate * (dt_s * dt_s / 3.0 - tau_s * dt_s + tau_s * tau_s)
    return cross, value


@borrowing_kernel
def move_base(s: JointArrays, rx_ticks: int) -> None:
    """Give all values as of a later base: F·P·Fᵀ."""
    settle(s)
    tau_s = (rx_ticks - s.counts[BASE]) * TICK_S
    s.counts[BASE] = rx_ticks
    x, P, half, n = s.x, s.P, values(s), states(s)
    for place in range(half):
        x[place] += tau_s * x[half + place]
    V = s.sensitivities
    for place in range(half):
        for slots in range(0, lanes(s), EIGHT):
            store(V, (place, slots), add(load(V, (place, slots)), tau_s, load(V, (half + place, slots))))
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
