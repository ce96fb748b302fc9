"""Which measurements are used, and how process noise adapts to innovations.

Covered are

1. single late receptions, as paths are blocked for a moment: the gate;
2. an anchor behind a new obstacle, and its return: its range error jumps and is estimated again;
3. a person or a wall that obstructs several anchors in turn: a jump raises the process noise of all range errors;
4. reflections that change as the tag walks: learnt from the differences of range errors from step to step;
5. a tag that moves more than assumed: innovations along an axis stay on one side;
6. the tag's oscillator warming up, suddenly or slowly: innovations of all anchors are on one side;
7. an anchor's oscillator warming up, or its counter jumping: relays show it;
8. a tag at rest, which noise must not move;
9. everything else: covariances grow with the mean NIS.

Anchors that are late from the start, or increasingly late without a jump, are found by ``faults``.
``docs/estimator_table.md`` shows what each mechanism buys.
"""

from typing import Final

from skyless.core.estimator.faults import begin_obstruction, is_late_often
from skyless.core.estimator.hypotheses import scatter
from skyless.core.estimator.kalman import clear_variance, finish_updates, follows_cycles, jump_share
from skyless.core.estimator.state import CHANGING_RANGE_ERRORS, State, at, make_uncertain
from skyless.core.native.arithmetic import log, sqrt, square
from skyless.core.native.records import MOTION_STATES, PHASE_STATES
from skyless.core.ticks import TICK_M, TICK_S

_PLACE_LIMIT: Final = 2.0
"""Squared differences of range errors are limited to this multiple of their mean, as jumps are not multipath."""
_PLACE_LIMITED_MEAN: Final = 0.7421917  # mean of χ² with one degree of freedom, limited to that


def is_warm(s: State) -> bool:
    """Whether two packets of each anchor have been processed since the start."""
    return s.status.packets > 2 * s.count


def note_outlier(s: State, anchor: int, innovation: float, innovation_variance: float) -> None:
    """Count consecutive receptions of an anchor that are off by the same amount."""
    a, tuning, settings = s.anchors[anchor], s.tuning, s.settings
    if innovation * innovation <= square(tuning.suspect) * innovation_variance:
        a.outliers_in_row = 0
    else:
        stamps = 2.0 * (settings.tx_variance_m2 + settings.rx_variance_m2)
        apart, both = innovation - a.outlier_m, innovation + a.outlier_m
        agrees = a.outliers_in_row > 0 and apart * apart <= square(tuning.suspect) * stamps
        agrees = agrees and both * both > square(tuning.together) * innovation_variance
        a.outliers_in_row = a.outliers_in_row + 1 if agrees else 1
        a.outlier_m = innovation


def has_jumped(s: State, anchor: int) -> bool:
    """Whether enough consecutive receptions are off to show that the anchor's range error has jumped."""
    needed = s.tuning.in_row_where_late if is_late_often(s) else s.tuning.in_row
    return s.anchors[anchor].outliers_in_row >= needed


def is_common(s: State, normalised: float) -> bool:
    """Whether the newest innovations of all anchors but at most one small one are on the side of this innovation.

    The tag's clock is the cause then. A faulty anchor draws the others to the opposite side of its own. While phases
    determine the clock, stamps of all anchors may well err to one side.
    """
    others, limit = 0, s.tuning.suspect if follows_cycles(s) else s.tuning.common
    if abs(normalised) <= limit:
        return False
    for anchor in range(s.count):
        newest = s.anchors[anchor].innovation
        if abs(newest) <= limit:
            others += 1
        elif newest * normalised <= 0.0:
            others += 2
    return s.count > s.dim and others <= 1


def is_of_clock(s: State, anchor: int, innovation: float) -> bool:
    """Whether the anchor's clock has jumped rather than its range error.

    The mean of its relays' innovations is then off zero with the sign of its reception's. After a jump of the range
    error the sign is opposite: the receptions have pulled the clock's estimate away from what relays show.
    """
    relay_mean = s.anchors[anchor].relay_mean
    return _is_off_zero(s, relay_mean) and relay_mean * innovation > 0.0


def open_range_error(s: State, anchor: int, innovation: float) -> None:
    """Estimate an anchor's range error again after a jump."""
    change = s.layout.change + anchor
    s.status.obstructions += 1
    begin_obstruction(s, anchor)
    s.P[at(change, change)] += innovation * innovation
    make_uncertain(s, CHANGING_RANGE_ERRORS)


def adapt_change_noise(s: State, anchor: int, normalised: float) -> None:
    """Adapt the process noise of an anchor's range error to an innovation, if it is obstructed.

    It becomes smaller soon: if it were large, the error's end would look like another change.
    """
    a = s.anchors[anchor]
    if a.is_obstructed:
        a.change_mean += s.tuning.mean_gain * (normalised - a.change_mean)
        a.change_scale *= s.tuning.noise_growth if _is_off_zero(s, a.change_mean) else 1.0 - s.tuning.mean_gain
        a.change_scale = min(max(a.change_scale, 1.0), s.tuning.max_scale)


def _adapted(s: State, scale: float, is_too_small: bool, least: float, largest: float) -> float:
    """Factor on process noise after an innovation, which shows whether the noise is too small."""
    scale *= s.tuning.noise_growth if is_too_small else s.tuning.noise_loss
    return min(max(scale, least), largest)


def _is_off_zero(s: State, mean: float) -> bool:
    """Whether a running mean of normalised innovations is farther from zero than chance explains."""
    gain = s.tuning.mean_gain
    return mean * mean * (2.0 - gain) / gain > square(s.tuning.suspect)


def judge_end(s: State, anchor: int, sign: float, innovation: float, innovation_variance: float) -> bool:
    """Sum the evidence of a measurement that an obstruction has ended, and return whether its error must be reset.

    Measurements are then more likely without the range error: the logarithms of the ratios are summed from the first
    one on that favours the end (CUSUM, Page 1954), each squared error up to the gate, as single packets are late. An
    error that returns slowly ends as it is, once it is known and close to zero. P·h of the newest measurement, which
    contains the range error with ``sign``, is the first of ``U``.
    """
    a, change, tuning, most = s.anchors[anchor], s.layout.change + anchor, s.tuning, square(s.settings.gate)
    if not a.is_obstructed:
        return False
    error_m, variance = s.x[change], s.P[at(change, change)]
    left_variance = max(innovation_variance - 2.0 * sign * s.U[0][change] + variance, s.settings.rx_variance_m2)
    left_variance += clear_variance(s, anchor)
    shown = min(square(innovation) / innovation_variance, most)
    shown -= min(square(innovation + sign * error_m) / left_variance, most)
    a.ended_log_odds = max(0.0, a.ended_log_odds + 0.5 * (shown + log(innovation_variance / left_variance)))
    usual = s.status.place_variance_m2
    a.is_obstructed = variance >= square(tuning.ended_std_m) + usual or square(error_m) >= variance + usual
    return a.is_obstructed and a.ended_log_odds > tuning.ended_log_odds


def note_innovation(s: State, innovation: float, innovation_variance: float, is_difference: bool) -> None:
    """Count an innovation as rejected or accepted, and update the running means."""
    status, tuning = s.status, s.tuning
    forgetting = tuning.forgetting
    normalised = innovation / sqrt(innovation_variance)
    is_beyond = not is_within_gate(s, normalised)
    beyond = 1.0 if is_beyond else 0.0
    if not is_difference:
        status.late_share += tuning.slow_forgetting * (beyond - status.late_share)
    status.rejected_share += forgetting * (beyond - status.rejected_share)
    if is_beyond:
        status.rejected += 1
        status.rejected_in_row += 1
    else:
        status.accepted += 1
        status.rejected_in_row = 0
        status.mean_nis += forgetting * (normalised * normalised - status.mean_nis)
        status.mean_square_m2 += forgetting * (innovation * innovation - status.mean_square_m2)


def is_within_gate(s: State, normalised: float) -> bool:
    """Whether a normalised innovation is within the gate; False for NaN."""
    return -s.settings.gate <= normalised <= s.settings.gate


def variance_scale(s: State, normalised: float, is_difference: bool) -> float:
    """Factor on the variance of a measurement with this normalised innovation; 0 beyond the gate.

    Large innovations are down-weighted if receptions are often late or a range error has just jumped, as the next one
    may, and always in time differences, of which either anchor may be late.
    """
    tuning = s.tuning
    if not is_within_gate(s, normalised):
        return 0.0
    if is_difference:
        return max(1.0, abs(normalised) / tuning.difference_huber)
    may_be_late = is_late_often(s) or jump_share(s) > tuning.recent_jumps
    return max(1.0, abs(normalised) / tuning.reception_huber) if may_be_late else 1.0


def adapt_change_variance(s: State, anchor: int, elapsed_s: float) -> None:
    """Track the variance of an anchor's changing range error: the mean square of its estimate.

    The maximisation step of expectation maximisation (Shumway and Stoffer 1982) with fading memory.
    """
    tuning, settings, a = s.tuning, s.settings, s.anchors[anchor]
    memory_s = settings.change_memory_s
    if memory_s > 0.0:
        finish_updates(s)
        change = s.layout.change + anchor
        present = square(s.x[change]) + s.P[at(change, change)]
        variance = a.change_variance_m2 + min(elapsed_s / memory_s, 0.5) * (present - a.change_variance_m2)
        variance = max(variance, square(settings.least_change_std_m))
        a.change_variance_m2 = min(variance, square(tuning.max_change_std_m))


def learn_place(s: State, anchor: int, residual_m: float) -> None:
    """Learn how range errors change with walked distance, from their differences after one and after two steps.

    For a Gauss–Markov process of variance σ² with correlation c over a step, half the mean square difference is noise +
    σ²·(1 − c) after one step and noise + σ²·(1 − c²) after two (a semivariogram, Matheron 1963).
    """
    tuning, settings, status, a = s.tuning, s.settings, s.status, s.anchors[anchor]
    step_m = status.walked_m - a.place_walked_m
    if step_m < tuning.place_step_m:
        return
    a.place_steps = a.place_steps + 1 if step_m < 2.0 * tuning.place_step_m else 0
    if a.place_steps >= 2:
        status.place_samples = min(status.place_samples + 1, int(tuning.place_memory))
        for lag in range(2):
            half, mean = 0.5 * square(residual_m - a.place_residual_m[lag]), status.place_square_m2[lag]
            limited = min(half, _PLACE_LIMIT * mean) / _PLACE_LIMITED_MEAN
            status.place_square_m2[lag] += (limited - mean) / (tuning.place_first + status.place_samples)
    a.place_residual_m[1] = a.place_residual_m[0]
    a.place_residual_m[0] = residual_m
    a.place_walked_m = status.walked_m
    noise = settings.tx_variance_m2 + settings.rx_variance_m2
    near, far = status.place_square_m2[0] - noise, status.place_square_m2[1] - noise
    status.place_variance_m2 = 0.0
    status.place_distance_m = settings.place_distance_m
    if status.place_samples >= tuning.place_samples and near > tuning.place_min_m2:
        kept = min(max(far / near - 1.0, tuning.place_kept), 1.0 - tuning.place_kept)
        variance = min(near / (1.0 - kept), square(tuning.max_change_std_m))
        if variance > square(settings.place_std_m):
            status.place_variance_m2 = variance
            status.place_distance_m = -tuning.place_step_m / log(kept)


def update_stationary(s: State, dt: float) -> None:
    """Update the time without motion, shown by the position or by innovations that stay on one side."""
    status, tuning, chi2 = s.status, s.tuning, 0.0
    for axis in range(s.dim):
        chi2 += square(s.x[axis] - status.stationary_m[axis]) / s.P[at(axis, axis)]
    status.stationary_s += dt
    moved = chi2 > s.dim or status.lag_square > tuning.lag_limit or status.rejected_in_row > 1
    if MOTION_STATES > 0 and s.motion.has_effect:
        moved = moved or s.motion.rest_s < tuning.level_s
    if moved:
        status.stationary_s = 0.0
    for axis in range(s.dim):  # also if the position has become better known
        if moved or s.P[at(axis, axis)] < tuning.better_known * status.stationary_m2[axis]:
            status.stationary_m[axis] = s.x[axis]
            status.stationary_m2[axis] = s.P[at(axis, axis)]


def adapt_process_noise(s: State, normalised: float) -> None:
    """Adapt the process noise of the tag's motion and clock to an innovation.

    The direction to the anchor is in the first terms of ``h``.
    """
    tuning, status = s.tuning, s.status
    gain, lag_square = tuning.mean_gain, 0.0
    for axis in range(s.dim):
        status.lag[axis] += gain * (s.h[axis] * normalised - status.lag[axis])
        lag_square += square(status.lag[axis])
    lag_square *= (2.0 - gain) / gain
    status.lag_square += tuning.forgetting * (lag_square - status.lag_square)
    if lag_square > tuning.sudden_lag:
        status.q_scale = min(2.0 * status.q_scale, tuning.max_scale)
    else:
        status.q_scale = _adapted(s, status.q_scale, status.lag_square > tuning.lag_limit, 1.0, tuning.max_scale)
    status.common_mean += gain * (normalised - status.common_mean)
    is_clock_off = _is_off_zero(s, status.common_mean) and not follows_cycles(s)
    least = max(_least_scale(s, status.tag_walk), _least_scale(s, status.anchors_walk))
    status.walk_scale = _adapted(s, status.walk_scale, is_clock_off, least, tuning.max_walk_scale)


def adapt_clock_noise(s: State, anchor: int, normalised: float) -> None:
    """Adapt the process noise of an anchor's clock to a relay's innovation."""
    a = s.anchors[anchor]
    a.relay_mean += s.tuning.mean_gain * (normalised - a.relay_mean)
    least, is_off = _least_scale(s, s.status.anchors_walk), _is_off_zero(s, a.relay_mean)
    if PHASE_STATES > 0 and a.mesh.is_known:  # rather than its clock wander, its cycles are wrong
        if _is_off_zero(s, a.relay_mean * s.tuning.suspect / s.settings.gate):
            offset = s.layout.offset + anchor
            s.P[at(offset, offset)] += square(s.tuning.slip_std_m)
            a.mesh.is_known = False
            a.relay_mean = 0.0
        is_off = False
    a.walk_scale = _adapted(s, a.walk_scale, is_off, least, s.tuning.max_walk_scale)


def _least_scale(s: State, walk: float) -> float:
    """Factor on the settings' random walk of a clock below which it is not adapted, by what its rates have shown."""
    if PHASE_STATES > 0 and s.status.rate_changes > 1 and s.settings.walk > 0.0:
        return min(max(walk / s.settings.walk, s.tuning.least_walk_scale), s.tuning.max_walk_scale)
    return 1.0


def learn_least_walk(s: State) -> None:
    """Learn how little the clocks wander, from the changes of their mean rates.

    From one interval τ to the next a rate changes with the variance 2/3·walk·τ; the stamps' noise only adds to it. The
    mean change of all offsets is the tag's clock, and the rest are the anchors'.
    """
    status, tuning = s.status, s.tuning
    elapsed_s = (status.epoch_ticks - status.rate_ticks) * TICK_S
    if elapsed_s < tuning.rate_s:
        return
    is_long, found, mean, square_sum = elapsed_s > 2.0 * tuning.rate_s, 0, 0.0, 0.0
    for anchor in range(s.count):
        a, offset_m = s.anchors[anchor], s.x[s.layout.offset + anchor]
        rate_mps = ((a.offset_ticks - a.rate_offset_ticks) * TICK_M + (offset_m - a.rate_offset_m)) / elapsed_s
        change_mps = rate_mps - a.mean_rate_mps
        a.rate_offset_ticks, a.rate_offset_m, a.mean_rate_mps = a.offset_ticks, offset_m, rate_mps
        a.rates = 1 if is_long or not a.has_rate else a.rates + 1
        if a.rates > 2:
            found += 1
            square_sum += square(change_mps - mean) * (found - 1) / found
            mean += (change_mps - mean) / found
    if found > s.dim:
        walk_s = 1.5 / elapsed_s
        status.rate_changes += 1
        gain = 1.0 / min(status.rate_changes, int(tuning.rate_changes))
        status.tag_walk += gain * (square(mean) * walk_s - status.tag_walk)
        status.anchors_walk += gain * (square_sum / (found - 1) * walk_s - status.anchors_walk)
    status.rate_ticks = status.epoch_ticks


def covariance_scale(s: State) -> float:
    """Factor on the position's covariance while innovations are larger than expected.

    Most of an innovation is the stamps' noise, so the state errs by more than the innovations show.
    """
    nis = s.status.mean_nis
    return nis * nis if nis > s.tuning.wrong_nis else 1.0


def motion_covariance(s: State, state: int, other: int) -> float:
    """Covariance of two states of position or velocity, as a fix and its levels state it."""
    return covariance_scale(s) * s.P[at(state, other)] + scatter(s, state, other)
