"""The filter itself: time update and scalar measurement update of state, covariance and fault sensitivities."""

import numpy as np

from skyless.core.constants import TICK_S
from skyless.core.estimator.state import CHANGING_RANGE_ERRORS, FAULT_KINDS, EstimatorState, layout, uncertain_states
from skyless.core.kernels.compiled import step
from skyless.core.kernels.covariance import (
    add_process_noise,
    decay_state,
    integrate_rates,
    multiply_ph,
    reset_covariance,
    subtract_information,
)


@step
def predict(s: EstimatorState, rx_ticks: int) -> None:
    """Time update to a reading of the tag: F·P·Fᵀ + Q for constant velocity and constant clock rates.

    The tag's oscillator is in all offsets, so its noise is common to them.
    """
    status, settings = s.status[0], s.settings[0]
    dim, count = settings["dim"], len(s.anchors)
    where = layout(dim, count)
    dt = (rx_ticks - status["epoch_ticks"]) * TICK_S
    speed_squared = 0.0
    for axis in range(dim):
        speed_squared += s.x[where.velocity + axis] ** 2
    status["walked_m"] += np.sqrt(speed_squared) * dt
    if status["obstruction"] > 0.0:
        status["obstruction"] *= np.exp(-dt / settings["obstruction_memory_s"])
    _advance(s, where.velocity, dt)
    motion = settings["qa"] * status["q_scale"]
    if is_stationary(s):
        motion *= settings["stationary_noise_share"]
    for axis in range(dim):
        add_process_noise(s.P, axis, where.velocity + axis, axis, where.velocity + axis, dt, 0.0, motion)
        s.V[FAULT_KINDS * count + axis, axis] -= 0.5 * dt * dt  # an acceleration that the filter does not know of
        s.V[FAULT_KINDS * count + axis, where.velocity + axis] -= dt
    walk = settings["walk"]
    for anchor in range(count):
        offset, rate = where.offset + anchor, where.rate + anchor
        add_process_noise(
            s.P, offset, rate, offset, rate, dt, settings["white"], walk * s.anchors[anchor]["walk_scale"]
        )
    common = walk * status["walk_scale"]
    for i in range(where.offset, where.offset + count):
        for j in range(where.offset, where.offset + count):
            add_process_noise(s.P, i, where.velocity + i, j, where.velocity + j, dt, settings["white"], common)
    s.status[0]["epoch_ticks"] = rx_ticks


@step
def is_stationary(s: EstimatorState) -> bool:
    """Whether the tag has shown no motion for long enough to count as stationary."""
    stationary_s = s.settings[0]["stationary_s"]
    return bool(0.0 < stationary_s < s.status[0]["stationary_s"])


@step
def _advance(s: EstimatorState, values: int, dt: float) -> None:
    """The first states gain dt·(their rates), which follow them."""
    n = uncertain_states(s)
    for value in range(values):
        s.x[value] += dt * s.x[values + value]
    integrate_rates(s.P, n, values, dt)
    for fault in range(len(s.fault_input)):
        for value in range(values):
            s.V[fault, value] += dt * s.V[fault, values + value]


@step
def jump_share(s: EstimatorState) -> float:
    """1 where range errors have jumped recently, 0 where none has or learnt multipath is as large as a jump."""
    status, multipath_m2 = s.status[0], s.settings[0]["multipath_std_m"] ** 2
    return float(min(status["obstruction"], 1.0) if status["place_variance_m2"] < multipath_m2 else 0.0)


@step
def range_error_decay(s: EstimatorState, anchor: int, dt: float, walked_m: float) -> tuple[float, float, float]:
    """What an anchor's range errors keep over what has passed and was walked since its newest packet.

    Of the changing part: the share that is kept and its variance in the long run; then the share of the constant part.
    The changing part is a Gauss–Markov process of walked distance and of time. Where range errors jump, both parts
    forget within seconds; one that has jumped itself wanders and returns to zero.
    """
    status, settings, share = s.status[0], s.settings[0], jump_share(s)
    obstructed = share * dt / settings["obstructed_s"]
    if s.anchors[anchor]["is_obstructed"]:
        change_m = s.x[layout(settings["dim"], len(s.anchors)).change + anchor]
        memory_s = settings["obstruction_memory_s"] * max(1.0, abs(change_m) / settings["obstruction_return_m"])
        variance = 0.5 * memory_s * settings["obstructed_walk"] * s.anchors[anchor]["change_scale"]
        kept = np.exp(-dt / memory_s)
    else:
        place_variance = max(s.anchors[anchor]["change_variance_m2"], status["place_variance_m2"])
        variance = place_variance + share * settings["obstructed_std_m"] ** 2
        usual = dt / settings["place_time_s"] + walked_m / status["place_distance_m"]
        kept = np.exp(-obstructed - (1.0 - share) * usual)
    kept_constant = 1.0
    if obstructed > 1e-6 and settings["range_std_m"] > 0.0:
        kept_constant = np.exp(-obstructed)
    return float(kept), float(variance), float(kept_constant)


@step
def relax_range_error(s: EstimatorState, anchor: int, dt: float, walked_m: float) -> None:
    """Time update of an anchor's range errors since its newest packet, by what ``range_error_decay`` says."""
    where = layout(s.settings[0]["dim"], len(s.anchors))
    kept, variance, kept_constant = range_error_decay(s, anchor, dt, walked_m)
    if variance > 0.0:  # also where the site calls ranges exact: multipath is learnt there as well
        s.status[0]["range_errors"] = max(s.status[0]["range_errors"], CHANGING_RANGE_ERRORS)
        _decay(s, where.change + anchor, kept, variance)
    if kept_constant < 1.0:
        _decay(s, where.constant + anchor, kept_constant, s.settings[0]["range_std_m"] ** 2)


@step
def _decay(s: EstimatorState, state: int, kept: float, variance: float) -> None:
    """A state decays towards zero and keeps, in the long run, that variance."""
    s.x[state] *= kept
    decay_state(s.P, uncertain_states(s), state, kept, variance)
    for fault in range(len(s.fault_input)):
        s.V[fault, state] *= kept


@step
def reset_state(s: EstimatorState, state: int, variance: float) -> None:
    """Forget a state: zero, uncorrelated, with that variance."""
    s.x[state] = 0.0
    reset_covariance(s.P, uncertain_states(s), state, variance)
    for fault in range(len(s.fault_input)):
        s.V[fault, state] = 0.0


@step
def compute_ph(s: EstimatorState, terms: int) -> float:
    """Compute P·h of a measurement with ``terms`` terms; returns hᵀ·P·h."""
    return multiply_ph(s.P, uncertain_states(s), s.h, s.h_index, terms, s.ph)


@step
def update(s: EstimatorState, innovation: float, innovation_variance: float, gain_scale: float = 1.0) -> None:
    """Scalar update by the measurement in ``h`` with P·h in ``ph``.

    K = gain_scale·P·h/S. A scale of 1 is the Kalman gain; a measurement whose variance counts more has the S that
    follows, and 1. P changes by −u·uᵀ with u = P·h/√S, which is symmetric to the bit.
    """
    x, V, u, fault_input, n = s.x, s.V, s.ph, s.fault_input, uncertain_states(s)
    root = subtract_information(s.P, n, u, innovation_variance)
    step = gain_scale * innovation / root
    for state in range(n):
        x[state] += u[state] * step
    for fault in range(V.shape[0]):
        gain = gain_scale * fault_input[fault] / root
        for state in range(n):
            V[fault, state] += gain * u[state]
