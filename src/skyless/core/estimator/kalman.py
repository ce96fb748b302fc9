"""The filter itself: time update and scalar measurement update of state, covariance and fault sensitivities.

All loops run over the states that are not exact (``State.n``); what stands behind them stays as it is.
"""

from skyless.core.constants import TICK_S
from skyless.core.estimator.state import CHANGING_RANGE_ERRORS, FAULT_KINDS, State, make_uncertain
from skyless.core.native.arithmetic import exp, sqrt, square
from skyless.core.native.records import Ticks

# Time update


def predict(s: State, rx_ticks: Ticks) -> None:
    """Time update to a reading of the tag: F·P·Fᵀ + Q for constant velocity and constant clock rates.

    The tag's oscillator is in all offsets, so its noise is common to them.
    """
    status, settings, where = s.status, s.settings, s.layout
    dt = (rx_ticks - status.epoch_ticks) * TICK_S
    speed_squared = 0.0
    for axis in range(s.dim):
        speed_squared += square(s.x[where.velocity + axis])
    status.walked_m += sqrt(speed_squared) * dt
    if status.obstruction > 0.0:
        status.obstruction *= exp(-dt / s.tuning.obstruction_memory_s)
    _advance(s, dt)
    motion = settings.qa * status.q_scale
    if is_stationary(s):
        motion *= s.tuning.stationary_noise_share
    for axis in range(s.dim):
        _add_noise(s, axis, axis, dt, 0.0, motion)
        unknown = FAULT_KINDS * s.count + axis  # an acceleration that the filter does not know of
        s.V[axis][unknown] -= 0.5 * dt * dt
        s.V[where.velocity + axis][unknown] -= dt
    for anchor in range(s.count):
        offset = where.offset + anchor
        _add_noise(s, offset, offset, dt, settings.white, settings.walk * s.anchors[anchor].walk_scale)
    for one in range(where.offset, where.velocity):
        for other in range(where.offset, where.velocity):
            _add_noise(s, one, other, dt, settings.white, settings.walk * status.walk_scale)
    status.epoch_ticks = rx_ticks


def is_stationary(s: State) -> bool:
    """Whether the tag has shown no motion for long enough to count as stationary."""
    return 0.0 < s.settings.stationary_s < s.status.stationary_s


def _advance(s: State, dt: float) -> None:
    """The values, which are the first states, gain dt·(their rates), which follow in the same order: F·P·Fᵀ."""
    values = s.layout.velocity
    for value in range(values):
        s.x[value] += dt * s.x[values + value]
        effects, of_rate = s.V[value], s.V[values + value]
        for fault in range(s.rows):
            effects[fault] += dt * of_rate[fault]
    for state in range(s.used):
        row = s.P[state]
        for value in range(values):
            row[value] += dt * row[values + value]
    for value in range(values):
        row, rates = s.P[value], s.P[values + value]
        for state in range(s.n):
            row[state] += dt * rates[state]
    for value in range(values):
        for other in range(value):
            s.P[value][other] = s.P[other][value]


def _add_noise(s: State, value: int, other: int, dt: float, white: float, walk: float) -> None:
    """Q of a value and its rate, or what two such pairs have in common: white noise of values, walk of rates."""
    rate, other_rate = s.layout.velocity + value, s.layout.velocity + other
    s.P[value][other] += white * dt + walk * dt * dt * dt / 3.0
    s.P[value][other_rate] += walk * dt * dt / 2.0
    s.P[rate][other] += walk * dt * dt / 2.0
    s.P[rate][other_rate] += walk * dt


# Range errors that change


def jump_share(s: State) -> float:
    """1 where range errors have jumped recently, 0 where none has or learnt multipath is as large as a jump."""
    status = s.status
    return min(status.obstruction, 1.0) if status.place_variance_m2 < square(s.tuning.multipath_std_m) else 0.0


def range_error_decay(s: State, anchor: int, dt: float, walked_m: float) -> tuple[float, float, float]:
    """What an anchor's range errors keep over what has passed and was walked since its newest packet.

    Of the changing part: the share that is kept and its variance in the long run; then the share of the constant part.
    The changing part is a Gauss–Markov process of walked distance and of time. Where range errors jump, both parts
    forget within seconds; one that has jumped itself wanders and returns to zero.
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
        place_variance = max(a.change_variance_m2, status.place_variance_m2)
        variance = place_variance + share * square(tuning.obstructed_std_m)
        usual = dt / settings.place_time_s + walked_m / status.place_distance_m
        kept = exp(-obstructed - (1.0 - share) * usual)
    kept_constant = exp(-obstructed) if obstructed > 1e-6 and settings.range_std_m > 0.0 else 1.0
    return kept, variance, kept_constant


def relax_range_error(s: State, anchor: int, dt: float, walked_m: float) -> None:
    """Time update of an anchor's range errors since its newest packet, by what ``range_error_decay`` says."""
    kept, variance, kept_constant = range_error_decay(s, anchor, dt, walked_m)
    if variance > 0.0:  # also where the site calls ranges exact: multipath is learnt there as well
        make_uncertain(s, CHANGING_RANGE_ERRORS)
        _decay(s, s.layout.change + anchor, kept, variance)
    if kept_constant < 1.0:
        _decay(s, s.layout.constant + anchor, kept_constant, square(s.settings.range_std_m))


def _decay(s: State, state: int, kept: float, variance: float) -> None:
    """A state decays towards zero and keeps, in the long run, that variance: Gauss–Markov."""
    s.x[state] *= kept
    row = s.P[state]
    for other in range(s.n):
        row[other] *= kept
    for other in range(s.used):
        s.P[other][state] = row[other]
    row[state] = kept * row[state] + (1.0 - kept * kept) * variance
    for fault in range(s.rows):
        s.V[state][fault] *= kept


def reset_state(s: State, state: int, variance: float) -> None:
    """Forget a state: zero, uncorrelated, with that variance."""
    s.x[state] = 0.0
    for other in range(s.n):
        s.P[state][other] = 0.0
        s.P[other][state] = 0.0
    s.P[state][state] = variance
    for fault in range(s.rows):
        s.V[state][fault] = 0.0


# Measurement update


def compute_ph(s: State) -> float:
    """Compute P·h of the measurement in ``h``; returns hᵀ·P·h."""
    for state in range(s.n):
        s.ph[state] = 0.0
    for term in range(s.terms):
        if s.h_index[term] < s.n:
            weight, row = s.h[term], s.P[s.h_index[term]]
            for state in range(s.n):
                s.ph[state] += weight * row[state]
    total = 0.0
    for term in range(s.terms):
        if s.h_index[term] < s.n:
            total += s.h[term] * s.ph[s.h_index[term]]
    return total


def update(s: State, innovation: float, innovation_variance: float, gain_scale: float = 1.0) -> None:
    """Scalar update by the measurement in ``h`` with P·h in ``ph``.

    K = gain_scale·P·h/S. A scale of 1 is the Kalman gain; a measurement whose variance counts more has the S that
    follows, and 1. P changes by −u·uᵀ with u = P·h/√S, which is symmetric to the bit.
    """
    inverse = 1.0 / sqrt(innovation_variance)
    for state in range(s.n):
        s.ph[state] *= inverse
    step = gain_scale * inverse
    for state in range(s.used):
        u, row, effects = s.ph[state], s.P[state], s.V[state]
        s.x[state] += u * step * innovation
        for other in range(s.n):
            row[other] -= u * s.ph[other]
        for fault in range(s.rows):
            effects[fault] += u * step * s.fault_input[fault]
