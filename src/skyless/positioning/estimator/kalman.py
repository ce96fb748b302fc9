"""The filter itself: time update, scalar measurement update, and what faults that nobody sees do to the state.

Faults follow the recursion of Friedland (1969): where all that the tag receives of anchor j is late by b metres, the
estimate errs by V_j·b besides, and the innovation of a measurement h holds s_j·b,

    s = [own reception of j] − h·V        V ← F·V  (time)        V ← V + K·s  (update)

so that b can be estimated from the innovations, and levels can be given whatever b is (``levels``).
"""

from typing import Final

import numpy as np

from skyless.compiled import kernel
from skyless.constants import TICK_S
from skyless.positioning.estimator.state import (
    CHANGE,
    CONSTANT,
    OFFSET,
    RATE,
    EstimatorState,
    Integers,
    Matrix,
    Vector,
    anchor_state,
    slope_state,
)

RECENT_PACKETS: Final = 24.0
"""Faults of so many packets of each anchor are recent."""

OBSTRUCTED_STD_M: Final = 0.08
"""Where range errors jump, those of all anchors change with this standard deviation, ..."""

OBSTRUCTED_S: Final = 5.0
"""... within this time, ..."""

OBSTRUCTED_WALK: Final = 0.004
"""... and one that has jumped wanders with this density, m²/s."""

OBSTRUCTION_MEMORY_S: Final = 10.0


@kernel
def predict(s: EstimatorState, rx_ticks: int) -> None:
    """Time update to a reading of the tag: F·P·Fᵀ + Q for constant velocity and constant clock rates.

    The tag's oscillator is in all offsets, so its noise is common to them.
    """
    status, settings = s.status[0], s.settings[0]
    x, P, V = s.x, s.P, s.V
    dim, count = settings["dim"], len(s.anchors)
    dt = (rx_ticks - status["epoch_ticks"]) * TICK_S
    status["epoch_ticks"] = rx_ticks
    speed_squared = 0.0
    for axis in range(dim):
        speed_squared += x[dim + axis] ** 2
    status["walked_m"] += np.sqrt(speed_squared) * dt
    status["obstruction"] *= np.exp(-dt / OBSTRUCTION_MEMORY_S)
    motion = settings["qa"] * status["q_scale"]
    for axis in range(dim):
        _advance(x, P, V, axis, dim + axis, dt, 0.0, motion)
    first_acceleration = 2 * count
    for axis in range(dim):  # an acceleration that the filter does not know of
        V[axis, first_acceleration + axis] -= 0.5 * dt * dt
        V[dim + axis, first_acceleration + axis] -= dt
    walk = settings["walk"]
    for anchor in range(count):
        offset = anchor_state(dim, anchor) + OFFSET
        scale = s.anchors[anchor]["walk_scale"]
        _advance(x, P, V, offset, offset - OFFSET + RATE, dt, settings["white"], walk * scale)
    common = walk * status["walk_scale"]
    value, cross, rate = settings["white"] * dt + common * dt**3 / 3.0, common * dt**2 / 2.0, common * dt
    for one in range(count):
        i = anchor_state(dim, one)
        for other in range(count):
            j = anchor_state(dim, other)
            P[i + OFFSET, j + OFFSET] += value
            P[i + OFFSET, j + RATE] += cross
            P[i + RATE, j + OFFSET] += cross
            P[i + RATE, j + RATE] += rate


@kernel
def _advance(x: Vector, P: Matrix, V: Matrix, value: int, rate: int, dt: float, white: float, walk: float) -> None:
    """State ``value`` gains dt·(state ``rate``), and both their process noise."""
    x[value] += dt * x[rate]
    for column in range(P.shape[1]):
        P[value, column] += dt * P[rate, column]
    for row in range(P.shape[0]):
        P[row, value] += dt * P[row, rate]
    for column in range(V.shape[1]):
        V[value, column] += dt * V[rate, column]
    P[value, value] += white * dt + walk * dt**3 / 3.0
    P[value, rate] += walk * dt**2 / 2.0
    P[rate, value] += walk * dt**2 / 2.0
    P[rate, rate] += walk * dt


@kernel
def relax_range_error(s: EstimatorState, anchor: int, dt: float, walked_m: float) -> None:
    """Time update of an anchor's range errors over what has passed and was walked since its newest packet.

    The changing part is a Gauss–Markov process of the way and of time. Where range errors jump, both parts forget
    within seconds; one that has jumped itself wanders from where it is.
    """
    status, settings = s.status[0], s.settings[0]
    first, share = anchor_state(settings["dim"], anchor), min(status["obstruction"], 1.0)
    change, constant = first + CHANGE, first + CONSTANT
    obstructed = share * dt / OBSTRUCTED_S
    if s.anchors[anchor]["is_obstructed"]:
        s.P[change, change] += OBSTRUCTED_WALK * dt
    else:
        variance = settings["place_std_m"] ** 2 + share * OBSTRUCTED_STD_M**2
        usual = dt / settings["place_time_s"] + walked_m / settings["place_distance_m"]
        if variance > 0.0:
            _decay(s, change, np.exp(-obstructed - (1.0 - share) * usual), variance)
    if obstructed > 1e-6 and settings["range_std_m"] > 0.0:
        _decay(s, constant, np.exp(-obstructed), settings["range_std_m"] ** 2)


@kernel
def _decay(s: EstimatorState, state: int, kept: float, variance: float) -> None:
    """A state decays towards zero and keeps, in the long run, that variance."""
    x, P, V = s.x, s.P, s.V
    x[state] *= kept
    for column in range(P.shape[1]):
        P[state, column] *= kept
    for row in range(P.shape[0]):
        P[row, state] = P[state, row]
    P[state, state] = kept * P[state, state] + (1.0 - kept * kept) * variance
    for column in range(V.shape[1]):
        V[state, column] *= kept


@kernel
def reset_state(s: EstimatorState, state: int, variance: float) -> None:
    """Forget a state: zero, uncorrelated, with that variance."""
    x, P, V = s.x, s.P, s.V
    x[state] = 0.0
    for column in range(P.shape[1]):
        P[state, column] = 0.0
    for row in range(P.shape[0]):
        P[row, state] = 0.0
    P[state, state] = variance
    for column in range(V.shape[1]):
        V[state, column] = 0.0


@kernel
def compute_ph(P: Matrix, h: Vector, h_index: Integers, terms: int, ph: Vector) -> float:
    """P·h of a measurement with so many terms; returns hᵀ·P·h."""
    n = P.shape[1]
    for column in range(n):
        ph[column] = 0.0
    for term in range(terms):
        row, weight = h_index[term], h[term]
        for column in range(n):
            ph[column] += weight * P[row, column]
    total = 0.0
    for term in range(terms):
        total += h[term] * ph[h_index[term]]
    return total


@kernel
def update(
    s: EstimatorState, terms: int, innovation: float, innovation_variance: float, gain_scale: float, updated: int
) -> None:
    """Scalar update of the first ``updated`` states by the measurement in ``h`` with P·h in ``ph``.

    K = gain_scale·P·h/S. A scale of 1 is the Kalman gain; a measurement whose variance counts more has the S that
    follows, and 1. P changes by −u·uᵀ with u = P·h/√S, which is symmetric to the bit.
    """
    x, P, V, u, fault_input = s.x, s.P, s.V, s.ph, s.fault_input
    n, faults = P.shape[0], V.shape[1]
    root = np.sqrt(innovation_variance)
    step = gain_scale * innovation / root
    for state in range(n):
        u[state] /= root
    for state in range(updated):
        factor = u[state]
        x[state] += factor * step
        for column in range(n):
            P[state, column] -= factor * u[column]
        gain = gain_scale * factor / root
        for fault in range(faults):
            V[state, fault] += gain * fault_input[fault]
    for state in range(updated, n):
        factor = u[state]
        for column in range(updated):
            P[state, column] -= factor * u[column]


@kernel
def compute_fault_input(s: EstimatorState, terms: int, own: int) -> None:
    """S = [own reception] − h·V; ``own`` is the anchor that the tag has received, or −1."""
    V, fault_input, h, h_index = s.V, s.fault_input, s.h, s.h_index
    faults, count = V.shape[1], len(s.anchors)
    for fault in range(faults):
        fault_input[fault] = 0.0
    if own >= 0:
        fault_input[own] = 1.0
        fault_input[count + own] = 1.0
    for term in range(terms):
        row, weight = h_index[term], h[term]
        for fault in range(faults):
            fault_input[fault] -= weight * V[row, fault]


@kernel
def gather_evidence(s: EstimatorState, innovation: float, innovation_variance: float) -> None:
    """What an innovation says of the anchors' faults: y ← y + s·ν/S and M ← M + s·sᵀ/S."""
    count = len(s.anchors)
    for bank in range(2):
        for one in range(count):
            weight = s.fault_input[bank * count + one] / innovation_variance
            s.evidence[bank, one] += weight * innovation
            for other in range(count):
                s.information[bank, one, other] += weight * s.fault_input[bank * count + other]


@kernel
def fade_recent_faults(s: EstimatorState) -> None:
    """Forget a share of what recent faults have done, and of the evidence for them, with every packet."""
    count = len(s.anchors)
    kept = 1.0 - 1.0 / (RECENT_PACKETS * count)
    V = s.V
    for state in range(V.shape[0]):
        for fault in range(count, 2 * count):
            V[state, fault] *= kept
    for one in range(count):
        s.evidence[1, one] *= kept
        for other in range(count):
            s.information[1, one, other] *= kept


@kernel
def dynamic_states(s: EstimatorState) -> int:
    """How many states all measurements update; those that follow only the tag's own receptions do."""
    return slope_state(s.settings[0]["dim"], len(s.anchors))
