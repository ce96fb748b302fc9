"""The filter itself: time update and scalar measurement update of state, covariance and fault sensitivities.

All loops run over the states that are not exact (``State.n``); what stands behind them stays as it is.
"""

from typing import Final

from skyless.core.estimator.state import (
    CHANGING_RANGE_ERRORS,
    FAULT_KINDS,
    State,
    at,
    learn_lasting,
    make_uncertain,
    row_end,
    row_of,
    set_covariance,
)
from skyless.core.native.arithmetic import exp, sqrt, square
from skyless.core.native.records import MOST_WAITING, MOTION_STATES, PACKED, PHASE_STATES, Reals, Ticks
from skyless.core.ticks import TICK_S

LONGEST_S: Final = 1000.0
"""Longest time update: beyond it, squares of variances overflow in single precision."""

# Time update


def predict(s: State, rx_ticks: Ticks) -> None:
    """Time update to a tag time: F·P·Fᵀ + Q for constant velocity and constant clock rates.

    All offsets contain the tag's oscillator, so its noise is common to them.
    """
    status, settings, where = s.status, s.settings, s.layout
    dt = min((rx_ticks - status.epoch_ticks) * TICK_S, LONGEST_S)
    status.walked_m += sqrt(speed_squared(s)) * dt
    if status.obstruction > 0.0:
        status.obstruction *= exp(-dt / s.tuning.obstruction_memory_s)
    if PHASE_STATES > 0:
        for axis in range(s.dim):
            status.line_m[axis] += s.x[where.velocity + axis] * dt
        status.recent_square = max(status.recent_square * exp(-dt / s.tuning.speed_memory_s), speed_squared(s))
    _advance(s, dt)
    motion, white_m2 = motion_noise(s), settings.white * dt
    if MOTION_STATES > 0 and s.motion.is_used:
        motion = _unseen_noise(s)
    if is_stationary(s):
        motion *= s.tuning.stationary_noise_share
    square_s, cube_s = dt * dt / 2.0, dt * dt * dt / 3.0
    for axis in range(s.dim):
        _add_noise(s, axis, axis, motion * cube_s, motion * square_s, motion * dt)
    if not has_order(s):
        for anchor in range(s.count):
            offset = where.offset + anchor
            walk = settings.walk * s.anchors[anchor].walk_scale
            _add_noise(s, offset, offset, white_m2 + walk * cube_s, walk * square_s, walk * dt)
    walk = settings.walk * status.walk_scale
    for one in range(where.offset, where.velocity):
        for other in range(where.offset, one + 1):
            _add_noise(s, one, other, white_m2 + walk * cube_s, walk * square_s, walk * dt)
    status.epoch_ticks = rx_ticks


def has_order(s: State) -> bool:
    """Whether relays are processed before the reception of the packet that brings them, the oldest first."""
    return PHASE_STATES > 0 and s.status.is_in_order


def add_clock_noise(s: State, anchor: int, until_ticks: Ticks) -> None:
    """Add the noise of an anchor's own clock up to a tag time, as it acts on the state at the newest packet.

    Before the next packet nothing is known of this clock. So its noise is added when that comes, from relay to relay:
    each tells of the clock at the time of an earlier packet, and after it only the noise of the rest is unknown.
    """
    a, settings, offset = s.anchors[anchor], s.settings, s.layout.offset + anchor
    dt, lead = (until_ticks - a.noise_ticks) * TICK_S, (s.status.epoch_ticks - until_ticks) * TICK_S
    if dt > 0.0:
        walk = settings.walk * a.walk_scale
        of_both = walk * dt * (dt / 2.0 + lead)
        of_values = settings.white * dt + walk * dt * (dt * dt / 3.0 + lead * (dt + lead))
        _add_noise(s, offset, offset, of_values, of_both, walk * dt)
        a.noise_ticks = until_ticks


def speed_squared(s: State) -> float:
    """Square of the tag's speed."""
    total = 0.0
    for axis in range(s.dim):
        total += square(s.x[s.layout.velocity + axis])
    return total


def motion_noise(s: State) -> float:
    """Spectral density of the tag's acceleration, m²/s³: as innovations require, and what a fast tag's turns need.

    Hypotheses on cycles need it to be large beforehand: if it is too small, wrong cycles explain the motion.
    """
    tuning, status, least = s.tuning, s.status, speed_squared(s) / square(s.tuning.walking_mps)
    if are_phases_reliable(s):
        least = status.recent_square / square(tuning.phase_walking_mps)
    return s.settings.qa * max(status.q_scale, least)


def has_phase(s: State, anchor: int) -> bool:
    """Whether an anchor's phases are in use: its ambiguity is confirmed, and phases still come and are not rejected."""
    own, tuning = s.anchors[anchor].own, s.tuning
    is_recent = (s.status.epoch_ticks - own.ticks) * TICK_S < 2.0 * tuning.rate_s
    return own.is_known and is_recent and own.refused_in_row < int(tuning.phases_in_row) - 1


def follows_cycles(s: State) -> bool:
    """Whether phases of enough anchors are in use to determine the tag's clock."""
    found = 0
    for anchor in range(s.count):
        if has_phase(s, anchor):
            found += 1
    return PHASE_STATES > 0 and found > s.dim


def are_phases_reliable(s: State) -> bool:
    """Whether phases may be taken at several cycles: they are rarely wild, and no range error has jumped recently."""
    has_phases = PHASE_STATES > 0 and s.status.has_phases
    return has_phases and s.status.wild_share < s.tuning.most_wild and jump_share(s) < 1.0


def _unseen_noise(s: State) -> float:
    """The same of what a motion sensor does not show."""
    tuning = s.tuning
    known = min(square(s.x[s.layout.heading]) + square(s.x[s.layout.heading + 1]), 1.0)
    unknown = tuning.headless_noise + known * (tuning.sensor_noise - tuning.headless_noise)
    return unknown * s.status.q_scale + s.settings.qa * square(s.status.rejected_share / tuning.lost_share)


def is_stationary(s: State) -> bool:
    """Whether the tag has shown no motion for long enough to count as stationary.

    Never while phases are in use: they show rest by themselves, and ambiguities would absorb the onset of motion.
    """
    return 0.0 < s.settings.stationary_s < s.status.stationary_s and not s.status.has_phases


def _advance(s: State, dt: float) -> None:
    """Add dt·(rates) to the values; the values are the first states, their rates follow in the same order. F·P·Fᵀ."""
    values = s.layout.velocity
    for value in range(values):
        s.x[value] += dt * s.x[values + value]
        effects, of_rate = s.V[value], s.V[values + value]
        for fault in range(s.rows):
            effects[fault] += dt * of_rate[fault]
    if PACKED:
        _advance_packed(s, values, dt)
        return
    for state in range(s.used):
        row = row_of(state)
        for value in range(values):
            s.P[row + value] += dt * s.P[row + values + value]
    for value in range(values):
        row, rates = row_of(value), row_of(values + value)
        for state in range(s.n):
            s.P[row + state] += dt * s.P[rates + state]
    for value in range(values):
        for other in range(value):
            s.P[at(value, other)] = s.P[at(other, value)]


def _advance_packed(s: State, values: int, dt: float) -> None:
    """``_advance`` for a lower triangle: values among each other in two steps, between which their rates change."""
    for value in range(values):
        row, rates = row_of(value), row_of(values + value)
        for other in range(value + 1):
            s.P[row + other] += dt * s.P[rates + other]
    for state in range(values, s.used):
        row, within = row_of(state), max(min(values, state - values + 1), 0)
        for value in range(within):
            s.P[row + value] += dt * s.P[row + values + value]
        for value in range(within, values):
            s.P[row + value] += dt * s.P[row_of(values + value) + state]
    for value in range(values):
        for other in range(value + 1):
            s.P[at(value, other)] += dt * s.P[at(values + other, value)]


def _add_noise(s: State, value: int, other: int, of_values: float, of_both: float, of_rates: float) -> None:
    """Add Q of a value and its rate, or of two such pairs with common noise: white for values, a walk for rates."""
    rate, other_rate = s.layout.velocity + value, s.layout.velocity + other
    set_covariance(s, value, other, s.P[at(value, other)] + of_values)
    set_covariance(s, rate, other, s.P[at(rate, other)] + of_both)
    if value != other:
        set_covariance(s, value, other_rate, s.P[at(value, other_rate)] + of_both)
    set_covariance(s, rate, other_rate, s.P[at(rate, other_rate)] + of_rates)


# Range errors that change


def jump_share(s: State) -> float:
    """1 if range errors have jumped recently, 0 if none has."""
    return min(s.status.obstruction, 1.0)


def clear_variance(s: State, anchor: int) -> float:
    """Variance of the changing part of a range error that has not jumped."""
    usual = max(s.anchors[anchor].change_variance_m2, s.status.place_variance_m2)
    return usual + jump_share(s) * square(s.tuning.obstructed_std_m)


def range_error_decay(s: State, anchor: int, dt: float, walked_m: float) -> tuple[float, float, float]:
    """Decay of an anchor's range errors over the time and the walked distance since its newest packet.

    Returns the kept share of the changing part, its long-term variance, and the kept share of the constant part. The
    changing part is a Gauss–Markov process of walked distance and time. Where range errors jump, a part of its variance
    and the constant part are forgotten within seconds; one that has jumped itself wanders and returns to zero.
    """
    status, tuning, settings, a = s.status, s.tuning, s.settings, s.anchors[anchor]
    share = jump_share(s)
    obstructed = share * dt / tuning.obstructed_s
    if a.is_obstructed:
        change_m = s.x[s.layout.change + anchor]
        memory_s = tuning.obstruction_memory_s * max(1.0, abs(change_m) / tuning.obstruction_return_m)
        variance = 0.5 * memory_s * tuning.obstructed_walk * a.change_scale
        kept = exp(-dt / memory_s)
    else:
        variance = clear_variance(s, anchor)  # of two processes as one, whose rates are weighted by their variances
        after_jumps = share * square(tuning.obstructed_std_m) / max(variance, 1e-9)
        usual = dt / settings.place_time_s + walked_m / status.place_distance_m
        kept = exp(-after_jumps * dt / tuning.obstructed_s - (1.0 - after_jumps) * usual)
    kept_constant = exp(-obstructed) if obstructed > 1e-6 and settings.range_std_m > 0.0 else 1.0
    return kept, variance, kept_constant


def relax_range_error(s: State, anchor: int, dt: float, walked_m: float) -> None:
    """Time update of an anchor's range errors since its newest packet, by ``range_error_decay``."""
    kept, variance, kept_constant = range_error_decay(s, anchor, dt, walked_m)
    if variance > 0.0:  # also if the site states exact ranges: multipath is learnt there too
        make_uncertain(s, CHANGING_RANGE_ERRORS)
        decay(s, s.layout.change + anchor, kept, variance)
    if kept_constant < 1.0:
        decay(s, s.layout.constant + anchor, kept_constant, square(s.settings.range_std_m))


def decay(s: State, state: int, kept: float, variance: float) -> None:
    """Decay a state towards zero with the given long-term variance (Gauss–Markov)."""
    s.x[state] *= kept
    for other in range(s.used):
        set_covariance(s, state, other, s.P[at(state, other)] * kept)
    s.P[at(state, state)] = kept * s.P[at(state, state)] + (1.0 - kept * kept) * variance
    for fault in range(s.rows):
        s.V[state][fault] *= kept


def reset_state(s: State, state: int, variance: float) -> None:
    """Reset a state to zero, uncorrelated, with the given variance."""
    s.x[state] = 0.0
    for other in range(s.used):
        set_covariance(s, state, other, 0.0)
    s.P[at(state, state)] = variance
    for fault in range(s.rows):
        s.V[state][fault] = 0.0


def open_direction(s: State, variance: float, faults: int) -> None:
    """Add uncertainty along the first of ``U``, which depends on each fault by the first of ``G``."""
    opened, shared = s.U[0], s.G[0]
    for one in range(s.used):
        row = row_of(one)
        for other in range(row_end(one, s.n)):
            s.P[row + other] += opened[one] * opened[other] * variance
        for fault in range(faults):
            s.V[one][fault] += shared[fault] * opened[one]


# Measurement update


def compute_ph(s: State) -> float:
    """Write P·h of the measurement in ``h`` into the next of ``U``, including queued updates. Returns hᵀ·P·h."""
    if s.waiting == MOST_WAITING:
        finish_updates(s)
    ph = s.U[s.waiting]
    for state in range(s.n):
        ph[state] = 0.0
    for term in range(s.terms):
        if s.h_index[term] < s.n:
            weight, index = s.h[term], s.h_index[term]
            row, end = row_of(index), row_end(index, s.n)
            for state in range(end):
                ph[state] += weight * s.P[row + state]
            for state in range(end, s.n):
                ph[state] += weight * s.P[row_of(state) + index]
    for one in range(s.waiting):
        weight, u = _h_dot(s, s.U[one]), s.U[one]
        for state in range(s.n):
            ph[state] -= weight * u[state]
    return _h_dot(s, ph)


def _h_dot(s: State, states: Reals) -> float:
    """The scalar product of ``h`` and a vector over the states."""
    total = 0.0
    for term in range(s.terms):
        if s.h_index[term] < s.n:
            total += s.h[term] * states[s.h_index[term]]
    return total


def compute_fault_input(s: State, own: int) -> None:
    """Write s = [own reception] − h·V into the next of ``G``; ``own`` is the anchor that the tag received, or −1."""
    shares = s.G[s.waiting]
    for fault in range(s.rows):
        shares[fault] = 0.0
    for term in range(s.terms):
        weight, effects = s.h[term], s.V[s.h_index[term]]
        for fault in range(s.rows):
            shares[fault] -= weight * effects[fault]
    for one in range(s.waiting):
        weight, effects = _h_dot(s, s.U[one]), s.G[one]
        for fault in range(s.rows):
            shares[fault] -= weight * effects[fault]
    if own >= 0:
        for kind in range(FAULT_KINDS):
            shares[kind * s.count + own] += 1.0


def update(s: State, innovation: float, innovation_variance: float, gain_scale: float = 1.0) -> None:
    """Scalar update by the measurement whose P·h and fault inputs are the next of ``U`` and ``G``.

    K = gain_scale·P·h/S. A scale of 1 is the Kalman gain; an inflated variance is in S, with a scale of 1. P changes by
    −u·uᵀ with u = P·h/√S, which is symmetric to the bit. No updates may be queued.
    """
    _note_update(s, innovation, innovation_variance, gain_scale)
    _apply_updates(s)


def update_later(s: State, innovation: float, innovation_variance: float, shows_faults: bool = True) -> None:
    """Queue an update by a measurement. If it also shows faults: y ← y + s·ν/S and M ← M + s·sᵀ/S.

    P, V and M follow in ``finish_updates``; until then only ``compute_ph`` and ``compute_fault_input`` may read P and
    V. Lasting faults are updated at once.
    """
    g = s.G[s.waiting]
    normalised = innovation / sqrt(innovation_variance)
    s.shows_faults[s.waiting] = 1.0 if shows_faults else 0.0
    _note_update(s, innovation, innovation_variance, 1.0)
    if shows_faults:
        for fault in range(FAULT_KINDS * s.count):
            s.evidence[fault] += g[fault] * normalised
        learn_lasting(s, g, 1.0, normalised)


def _note_update(s: State, innovation: float, innovation_variance: float, gain_scale: float) -> None:
    """Update x, and scale the next of ``U`` and ``G`` to u = P·h/√S and g = s/√S for P and V."""
    inverse = 1.0 / sqrt(innovation_variance)
    step, u, g = gain_scale * inverse, s.U[s.waiting], s.G[s.waiting]
    for state in range(s.n):
        u[state] *= inverse
    for fault in range(s.rows):
        g[fault] *= step
    if PHASE_STATES > 0:
        for one in range(s.hypotheses.count):
            off = innovation * inverse + g[FAULT_KINDS * s.count + one]
            s.hypotheses.log_weight[one] -= min(0.5 * off * off, 1e6)  # a square may overflow
    step *= innovation
    for state in range(s.used):
        s.x[state] += u[state] * step
    s.waiting += 1


def finish_updates(s: State) -> None:
    """Apply the queued updates to P, V and M."""
    if s.waiting > 0:
        _inform(s)
        _apply_updates(s)


def _inform(s: State) -> None:
    """M ← M + Σ s·sᵀ/S over the queued updates that show faults; their s/√S are in ``G``."""
    faults = FAULT_KINDS * s.count
    for group in range(_fill_groups(s)):
        k = 4 * group
        for fault in range(faults):
            a, b = s.shows_faults[k] * s.G[k][fault], s.shows_faults[k + 1] * s.G[k + 1][fault]
            c, d = s.shows_faults[k + 2] * s.G[k + 2][fault], s.shows_faults[k + 3] * s.G[k + 3][fault]
            for other in range(fault + 1):
                s.information[fault][other] += (
                    a * s.G[k][other] + b * s.G[k + 1][other] + c * s.G[k + 2][other] + d * s.G[k + 3][other]
                )


def _fill_groups(s: State) -> int:
    """Pad the queued updates with zeros to a multiple of four. Returns the number of groups of four."""
    groups = (s.waiting + 3) // 4
    for one in range(s.waiting, 4 * groups):
        for state in range(s.n):
            s.U[one][state] = 0.0
        for fault in range(s.rows):
            s.G[one][fault] = 0.0
    return groups


def _apply_updates(s: State) -> None:
    """P ← P − Σ u·uᵀ and V ← V + Σ u·gᵀ over the queued updates, four at a time: P is read and written once."""
    if s.waiting <= 2:
        for one in range(s.waiting):
            _apply_one(s, one)
    else:
        for group in range(_fill_groups(s)):
            _apply_four(s, 4 * group)
    s.waiting = 0


def _apply_one(s: State, one: int) -> None:
    for state in range(s.used):
        u, row = s.U[one][state], row_of(state)
        for other in range(row_end(state, s.n)):
            s.P[row + other] -= u * s.U[one][other]
        for fault in range(s.rows):
            s.V[state][fault] += u * s.G[one][fault]


def _apply_four(s: State, k: int) -> None:
    for state in range(s.used):
        a, b, c, d = s.U[k][state], s.U[k + 1][state], s.U[k + 2][state], s.U[k + 3][state]
        row = row_of(state)
        for other in range(row_end(state, s.n)):
            s.P[row + other] -= (
                a * s.U[k][other] + b * s.U[k + 1][other] + c * s.U[k + 2][other] + d * s.U[k + 3][other]
            )
        for fault in range(s.rows):
            s.V[state][fault] += (
                a * s.G[k][fault] + b * s.G[k + 1][fault] + c * s.G[k + 2][fault] + d * s.G[k + 3][fault]
            )
