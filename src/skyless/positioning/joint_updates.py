"""Inner steps of ``joint``: time passes, an anchor joins, a reception of the tag, a reception that an anchor relays.

The covariance is changed by rank-one steps P − u·uᵀ over whole rows, so that it stays symmetric to the bit. It
stays positive as every state gains noise all the time (``docs/maths.md`` section 6).
"""

from typing import Final

import numpy as np

from skyless.compiled import borrowing_kernel
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.positioning.joint_state import (
    ACCEPTED,
    BASE,
    DIM,
    EPOCH,
    GATE,
    HEIGHT,
    INNOVATION,
    IN_ROW,
    NOISE,
    QA,
    RANGE,
    RATE_VARIANCE,
    REJECTED,
    RELAYS_REJECTED,
    RELAYS_USED,
    RX,
    RX_VARIANCE,
    SCORE,
    SLOTS,
    TX,
    TX_VARIANCE,
    WALK,
    WEIGHT,
    WHITE,
    WHOLE,
    JointArrays,
    Matrix,
    Vector,
    states,
    values,
    width,
)
from skyless.positioning.tracker import AGILITY, judge

REBASE_S: Final = 0.015
"""Age at which the base of the values is moved on; the offsets move by tens of metres until then."""

SCORE_GAIN: Final = 0.1

SMALL: Final = 0.1
"""Clock noise above this part of a stamp's variance is no small correction any more."""


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
    dim, half = int(s.settings[DIM]), values(s)
    rate = s.settings[QA] * s.statistics[AGILITY] * dt_s
    cross, value = _noise_at_base(0.0, rate, dt_s, tau_s)
    P = s.P
    for axis in range(dim):
        P[axis, axis] += value
        P[axis, half + axis] += cross
        P[half + axis, axis] += cross
        P[half + axis, half + axis] += rate
    rate = s.settings[WALK] * dt_s
    cross, value = _noise_at_base(s.settings[WHITE] * dt_s, rate, dt_s, tau_s)
    for one in range(dim, half):
        for other in range(dim, half):  # the tag's oscillator, which all offsets share
            P[one, other] += value
            P[one, half + other] += cross
        for other in range(dim, half):
            P[half + one, other] += cross
            P[half + one, half + other] += rate
        P[one, one] += value
        P[one, half + one] += cross
        P[half + one, one] += cross
        P[half + one, half + one] += rate


@borrowing_kernel
def _noise_at_base(white: float, rate: float, dt_s: float, tau_s: float) -> tuple[float, float]:
    """Covariance with the rate, and variance, of what a value as of the base gains in the last ``dt_s``.

    ``rate`` is the variance that the rate gains. At the end of the interval the covariance would be rate·dt/2.
    """
    cross = rate * (0.5 * dt_s - tau_s)
    value = white + rate * (dt_s * dt_s / 3.0 - tau_s * dt_s + tau_s * tau_s)
    return cross, value


@borrowing_kernel
def _move_base(s: JointArrays, tau_s: float) -> None:
    """Give all values as of a base later by ``tau_s``: F·P·Fᵀ."""
    x, P, half, n = s.x, s.P, values(s), states(s)
    for place in range(half):
        x[place] += tau_s * x[half + place]
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


@borrowing_kernel
def _take(s: JointArrays, innovation: float, spread: float) -> None:
    """Kalman update with gain ``ph`` / spread."""
    x, P, u, n, columns = s.x, s.P, s.ph, states(s), width(s)
    scale = 1.0 / np.sqrt(spread)
    step = innovation * scale
    for column in range(columns):
        u[column] *= scale
    for column in range(columns):
        x[column] += u[column] * step
    for row in range(n):
        factor = u[row]
        for column in range(columns):
            P[row, column] -= factor * u[column]


@borrowing_kernel
def new_packet(s: JointArrays, slot: int) -> None:
    """Forget the noise of an anchor's last TX stamp for that of a new one."""
    if s.slots[slot, NOISE] >= 0:
        place = 2 * values(s) + s.slots[slot, NOISE]
        s.x[place] = 0.0
        for column in range(width(s)):
            s.P[place, column] = 0.0
        for row in range(states(s)):
            s.P[row, place] = 0.0
        s.P[place, place] = s.settings[TX_VARIANCE]


@borrowing_kernel
def hear_anchor(s: JointArrays, slot: int, rx_ticks: int, tx_ticks: int) -> bool:
    """Take the tag's reception of a packet; False if it lies beyond the gate.

    R − T = |p − a| + b + noise of the TX stamp + noise of the reception.
    """
    x, P, ph = s.x, s.P, s.ph
    dim, half, columns = int(s.settings[DIM]), values(s), width(s)
    tau_s = (s.counts[EPOCH] - s.counts[BASE]) * TICK_S
    offset, rate = dim + slot, half + dim + slot
    noise = s.slots[slot, NOISE]
    variance = s.settings[RX_VARIANCE]
    for column in range(columns):
        ph[column] = P[offset, column] + tau_s * P[rate, column]
    if noise >= 0:
        noise += 2 * half
        for column in range(columns):
            ph[column] += P[noise, column]
    else:
        variance += s.settings[TX_VARIANCE]
    range_m, ux, uy, uz = towards(s, slot, tau_s)
    _add_axis(P, ph, 0, half, ux, tau_s, columns)
    _add_axis(P, ph, 1, half + 1, uy, tau_s, columns)
    if dim == 3:
        _add_axis(P, ph, 2, half + 2, uz, tau_s, columns)
    spread = _along(ph, dim, half, ux, uy, uz, tau_s)
    spread += ph[offset] + tau_s * ph[rate] + variance * s.anchors[slot, WEIGHT]
    expected = range_m + x[offset] + tau_s * x[rate]
    if noise >= 0:
        spread += ph[noise]
        expected += x[noise]
    innovation = (rx_ticks - tx_ticks - s.slots[slot, WHOLE]) * TICK_M - expected
    s.anchors[slot, RANGE] = range_m
    s.anchors[slot, INNOVATION] = innovation
    s.anchors[slot, SCORE] += SCORE_GAIN * (innovation / np.sqrt(spread) - s.anchors[slot, SCORE])
    accepted = judge(s.counts, s.statistics, innovation, spread, s.settings[GATE])
    if accepted:
        s.slots[slot, IN_ROW] = 0
        _take(s, innovation, spread)
        steps = int(np.floor(x[offset] / TICK_M))
        s.slots[slot, WHOLE] += steps
        x[offset] -= steps * TICK_M
    else:
        s.slots[slot, IN_ROW] += 1
    return accepted


@borrowing_kernel
def _add_axis(P: Matrix, ph: Vector, axis: int, rate: int, factor: float, tau_s: float, columns: int) -> None:
    """Add to ``ph`` what the position along one axis has in common with all states."""
    both = factor * tau_s
    for column in range(columns):
        ph[column] += factor * P[axis, column] + both * P[rate, column]


@borrowing_kernel
def _along(ph: Vector, dim: int, half: int, ux: float, uy: float, uz: float, tau_s: float) -> float:
    """The part of hᵀ·P·h that comes of the position."""
    total = ux * (ph[0] + tau_s * ph[half]) + uy * (ph[1] + tau_s * ph[half + 1])
    if dim == 3:
        total += uz * (ph[2] + tau_s * ph[half + 2])
    return total


@borrowing_kernel
def towards(s: JointArrays, slot: int, tau_s: float) -> tuple[float, float, float, float]:
    """Range from the anchor to the tag, and its gradient with the tag's position."""
    x, dim, half = s.x, int(s.settings[DIM]), values(s)
    dx = x[0] + tau_s * x[half] - s.anchors[slot, 0]
    dy = x[1] + tau_s * x[half + 1] - s.anchors[slot, 1]
    z = x[2] + tau_s * x[half + 2] if dim == 3 else s.settings[HEIGHT]
    dz = z - s.anchors[slot, 2]
    range_m = np.sqrt(dx * dx + dy * dy + dz * dz)
    scale = 1.0 / max(range_m, 1e-6)
    return range_m, dx * scale, dy * scale, dz * scale


@borrowing_kernel
def join(s: JointArrays, slot: int, rx_ticks: int, tx_ticks: int) -> None:
    """Begin with an anchor's clock: what its first packet says, whatever is wrong with the position being in it.

    This is the limit of an update of an offset of which nothing was known.
    """
    x, P, ph = s.x, s.P, s.ph
    dim, half, columns = int(s.settings[DIM]), values(s), width(s)
    tau_s = (s.counts[EPOCH] - s.counts[BASE]) * TICK_S
    range_m, ux, uy, uz = towards(s, slot, tau_s)
    place, rate = dim + slot, half + dim + slot
    P[rate, rate] = s.settings[RATE_VARIANCE]
    for column in range(columns):
        ph[column] = -tau_s * P[rate, column]
    _add_axis(P, ph, 0, half, -ux, tau_s, columns)
    _add_axis(P, ph, 1, half + 1, -uy, tau_s, columns)
    if dim == 3:
        _add_axis(P, ph, 2, half + 2, -uz, tau_s, columns)
    variance = -_along(ph, dim, half, ux, uy, uz, tau_s) - tau_s * ph[rate]
    for column in range(columns):
        P[place, column] = ph[column]
    for row in range(states(s)):
        P[row, place] = ph[row]
    P[place, place] = variance + s.settings[TX_VARIANCE] + s.settings[RX_VARIANCE]
    whole = rx_ticks - tx_ticks - int(np.floor(range_m / TICK_M))
    x[place] = (rx_ticks - tx_ticks - whole) * TICK_M - range_m
    s.slots[slot, WHOLE] = whole
    s.anchors[slot, RANGE] = range_m


@borrowing_kernel
def hear_relay(
    s: JointArrays, listener: int, slot: int, packet_tx: int, packet_rx: int, relayed_rx: int
) -> bool:
    """Take the reception, by the anchor ``listener``, of a packet of the anchor ``slot``; False beyond the gate.

    S − T = |a_i − a_j| + b_j − b_i + noise of the TX stamp + noise of the reception, when the packet reached anchor i.
    Both values go back to that moment by their rates; what their oscillators have done since stands in the covariance, and
    is taken off the gain again. The tag's oscillator cancels.
    """
    x, P, ph = s.x, s.P, s.ph
    dim, half, columns = int(s.settings[DIM]), values(s), width(s)
    distance_m = 0.0
    for axis in range(3):
        distance_m += (s.anchors[slot, axis] - s.anchors[listener, axis]) ** 2
    distance_m = np.sqrt(distance_m)
    age_s = (s.counts[EPOCH] - packet_rx) * TICK_S + (s.anchors[slot, RANGE] - distance_m) / SPEED_OF_LIGHT_MPS
    tau_s = (s.counts[EPOCH] - s.counts[BASE]) * TICK_S - age_s
    one, other = dim + slot, dim + listener
    one_rate, other_rate = half + one, half + other
    for column in range(columns):
        ph[column] = P[one, column] - P[other, column] + tau_s * (P[one_rate, column] - P[other_rate, column])
    expected = distance_m + x[one] - x[other] + tau_s * (x[one_rate] - x[other_rate])
    variance = s.settings[RX_VARIANCE]
    noise = s.slots[slot, NOISE]
    if noise >= 0 and s.slots[slot, TX] == packet_tx:
        noise += 2 * half
        for column in range(columns):
            ph[column] += P[noise, column]
        expected += x[noise]
    else:
        noise = -1
        variance += s.settings[TX_VARIANCE]
    drift = s.settings[WALK] * age_s * age_s
    strayed = age_s * s.settings[WHITE] + drift * age_s / 3.0
    if strayed < SMALL * s.settings[RX_VARIANCE]:
        rate_since = -0.5 * drift
        value_since = strayed - 0.5 * drift * age_s - (tau_s + age_s) * rate_since
        ph[one] -= value_since
        ph[other] += value_since
        ph[one_rate] -= rate_since
        ph[other_rate] += rate_since
    else:
        variance += 2.0 * strayed
    spread = ph[one] - ph[other] + tau_s * (ph[one_rate] - ph[other_rate]) + variance
    if noise >= 0:
        spread += ph[noise]
    whole = s.slots[slot, WHOLE] - s.slots[listener, WHOLE]
    innovation = (relayed_rx - packet_tx - whole) * TICK_M - expected
    accepted = innovation * innovation <= s.settings[GATE] * s.settings[GATE] * spread
    if accepted:
        s.counts[RELAYS_USED] += 1
        _take(s, innovation, spread)
    else:
        s.counts[RELAYS_REJECTED] += 1
    return accepted
