"""Which measurements are used, and how process noise is adapted to innovations.

It must handle

1. single late receptions, as paths are blocked for a moment: the gate, which narrows where they are frequent;
2. an anchor behind an obstacle from now on, and its return: its range error jumps, and is estimated again;
3. a person or a wall that obstructs several anchors in turn: a jump raises the process noise of all range errors;
4. reflections that change as the tag walks: learnt from what range errors differ by from step to step;
5. a tag that moves more than assumed: innovations stay on one side along an axis;
6. the tag's oscillator that warms up, at once or slowly: innovations of all anchors are on one side;
7. an anchor's oscillator that warms up, or its counter that jumps: relays show it;
8. a tag that stands still, so that noise does not move it;
9. all that does not fit any of these: covariances grow with the mean NIS.

Anchors that are late from the start, or ever more, without a jump are found by ``faults``. ``docs/estimator_table.md``
says what each of these buys.
"""

import numpy as np

from skyless.core.estimator.faults import begin_obstruction
from skyless.core.estimator.kalman import jump_share
from skyless.core.estimator.state import CHANGING_RANGE_ERRORS, EstimatorState, layout
from skyless.core.kernels.compiled import step


@step
def gate_of(s: EstimatorState) -> float:
    """Beyond how many standard deviations a reception is more likely late than not."""
    settings = s.settings[0]
    late = min(s.status[0]["late_share"], 0.9)
    odds = late * settings["late_probability_density"] * 2.5066282746310002 / (1.0 - late)
    gate = s.settings[0]["gate"]
    return float(min(gate, np.sqrt(-2.0 * np.log(odds)))) if odds > 1e-6 else float(gate)


@step
def is_warm(s: EstimatorState) -> bool:
    """Whether two packets of each anchor have been processed since the start."""
    return bool(s.status[0]["packets"] > 2 * len(s.anchors))


@step
def has_jumped(s: EstimatorState, anchor: int, innovation: float, innovation_variance: float) -> bool:
    """Whether this reception and those before it show that an anchor's range error has jumped."""
    a, status, settings = s.anchors[anchor], s.status[0], s.settings[0]
    clear = 0
    for other in range(len(s.anchors)):
        clear += 0 if s.anchors[other]["is_obstructed"] else 1
    is_easy = clear > settings["dim"] + 1 and a["walk_scale"] <= settings["steady_walk_scale"]
    share = jump_share(s) if is_easy else 0.0  # else clocks, which all anchors share or which wander, would open all
    suspect = settings["suspect"] + share * (settings["obstructed_suspect"] - settings["suspect"])
    together = settings["together"] + share * (settings["obstructed_together"] - settings["together"])
    if innovation * innovation <= suspect * suspect * innovation_variance:
        a["outliers_in_row"] = 0
    else:
        stamps = 2.0 * (settings["tx_variance_m2"] + settings["rx_variance_m2"])
        apart, both = innovation - a["outlier_m"], innovation + a["outlier_m"]
        agrees = a["outliers_in_row"] > 0 and apart * apart <= settings["suspect"] ** 2 * stamps
        agrees = agrees and both * both > together * together * innovation_variance
        a["outliers_in_row"] = a["outliers_in_row"] + 1 if agrees else 1
        a["outlier_m"] = innovation
    often = status["late_share"] > settings["late_often_share"]
    return bool(a["outliers_in_row"] >= (settings["in_row_where_late"] if often else settings["in_row"]))


@step
def is_common(s: EstimatorState, normalised: float) -> bool:
    """Whether the newest innovations of all anchors but one, which may show nothing, lie on the side of this one.

    The tag's clock it is then. A faulty anchor draws the others to the opposite side of its own.
    """
    settings = s.settings[0]
    others = 0
    for anchor in range(len(s.anchors)):
        newest = s.anchors[anchor]["innovation"]
        if abs(newest) <= settings["common"]:
            others += 1
        elif newest * normalised <= 0.0:
            others += 2
    return bool(len(s.anchors) > s.settings[0]["dim"] and others <= 1)


@step
def open_range_error(s: EstimatorState, anchor: int, innovation: float) -> None:
    """Let an anchor's range error be estimated again from a jump on."""
    settings = s.settings[0]
    change = layout(s.settings[0]["dim"], len(s.anchors)).change + anchor
    s.status[0]["obstructions"] += 1
    begin_obstruction(s, anchor)
    s.P[change, change] += max(settings["jump_std_m"] ** 2, innovation * innovation)
    s.status[0]["range_errors"] = max(s.status[0]["range_errors"], CHANGING_RANGE_ERRORS)


@step
def adapt_change_noise(s: EstimatorState, anchor: int, normalised: float) -> None:
    """Adapt the process noise of an obstructed anchor's range error to an innovation."""
    settings, a = s.settings[0], s.anchors[anchor]
    a["change_mean"] += settings["mean_gain"] * (normalised - a["change_mean"])
    if _is_off_zero(s, a["change_mean"]):
        a["change_scale"] = min(a["change_scale"] * settings["change_growth"], settings["max_scale"])
    else:
        a["change_scale"] = max(a["change_scale"] * settings["change_loss"], 1.0)


@step
def _is_off_zero(s: EstimatorState, mean: float) -> bool:
    """Whether a running mean of normalised innovations is further off zero than chance makes it."""
    settings = s.settings[0]
    return bool(mean * mean * (2.0 - settings["mean_gain"]) / settings["mean_gain"] > settings["mean_limit"])


@step
def end_small_obstruction(s: EstimatorState, anchor: int) -> None:
    """End an obstruction that has gone without a jump back: the range error is known, and is hardly there."""
    settings = s.settings[0]
    a, change = s.anchors[anchor], layout(s.settings[0]["dim"], len(s.anchors)).change + anchor
    error_m, variance, usual = s.x[change], s.P[change, change], s.status[0]["place_variance_m2"]
    settled = a["is_obstructed"] and variance < settings["ended_std_m"] ** 2 + usual
    if settled and error_m * error_m < settings["ended"] ** 2 * (variance + usual):
        a["is_obstructed"] = 0
        s.status[0]["ends_of_obstructions"] += 1


@step
def variance_scale(s: EstimatorState, innovation: float, innovation_variance: float, is_difference: bool) -> float:
    """Factor on an innovation's variance; 0 if the measurement is not to be used. Counts it.

    Large innovations have less weight where receptions are late often, and always in time differences, of which
    either anchor may be late.
    """
    status, settings, forgetting = s.status[0], s.settings[0], s.settings[0]["forgetting"]
    normalised = innovation / np.sqrt(innovation_variance)
    beyond = 0.0 if -settings["gate"] <= normalised <= settings["gate"] else 1.0
    if not is_difference:
        status["late_share"] += settings["late_forgetting"] * (beyond - status["late_share"])
    used = beyond == 0.0 and (is_difference or normalised <= gate_of(s))
    has_less_weight = is_difference or status["late_share"] > settings["late_often_share"]
    limit = settings["difference_huber"] if is_difference else settings["reception_huber"]
    scale = max(1.0, abs(normalised) / limit) if used and has_less_weight else 1.0 if used else 0.0
    if used:
        status["accepted"] += 1
        status["rejected_in_row"] = 0
        status["mean_nis"] += forgetting * (normalised * normalised - status["mean_nis"])
        status["mean_square_m2"] += forgetting * (innovation * innovation - status["mean_square_m2"])
    else:
        status["rejected"] += 1
        status["rejected_in_row"] += int(beyond)
    s.status[0]["rejected_share"] += forgetting * (beyond - status["rejected_share"])
    return float(scale)


@step
def adapt_change_variance(s: EstimatorState, anchor: int, elapsed_s: float) -> None:
    """Let the variance of an anchor's changing range error track its estimate: the mean of its square.

    The maximisation step of expectation maximisation (Shumway and Stoffer 1982) with a memory that fades.
    """
    settings, a = s.settings[0], s.anchors[anchor]
    memory_s = settings["change_memory_s"]
    if memory_s > 0.0:
        change = layout(settings["dim"], len(s.anchors)).change + anchor
        square = s.x[change] ** 2 + s.P[change, change]
        variance = a["change_variance_m2"] + min(elapsed_s / memory_s, 0.5) * (square - a["change_variance_m2"])
        a["change_variance_m2"] = min(
            max(variance, settings["least_change_std_m"] ** 2), settings["max_change_std_m"] ** 2
        )


@step
def learn_place(s: EstimatorState, anchor: int, residual_m: float) -> None:
    """Learn how range errors change with the distance walked, from what they differ by after one and two steps.

    Half the mean square of the differences is noise + σ²·(1 − c) after one step and noise + σ²·(1 − c²) after two, for
    a Gauss–Markov process of variance σ² with the correlation c over a step (a semivariogram, Matheron 1963).
    """
    settings, status, a = s.settings[0], s.status[0], s.anchors[anchor]
    step_m = status["walked_m"] - a["place_walked_m"]
    if step_m >= settings["place_step_m"]:
        a["place_steps"] = a["place_steps"] + 1 if step_m < 2.0 * settings["place_step_m"] else 0
        if a["place_steps"] >= 2:
            status["place_samples"] = min(status["place_samples"] + 1, int(settings["place_memory"]))
            for lag in range(2):
                half = 0.5 * (residual_m - a["place_residual_m"][lag]) ** 2
                mean = status["place_square_m2"][lag]
                limited = min(half, settings["place_limit"] * mean) / settings["place_limited_mean"]
                status["place_square_m2"][lag] += (limited - mean) / (settings["place_first"] + status["place_samples"])
        a["place_residual_m"][1] = a["place_residual_m"][0]
        a["place_residual_m"][0] = residual_m
        a["place_walked_m"] = status["walked_m"]
        noise = settings["tx_variance_m2"] + settings["rx_variance_m2"]
        near, far = status["place_square_m2"][0] - noise, status["place_square_m2"][1] - noise
        status["place_variance_m2"], status["place_distance_m"] = 0.0, settings["place_distance_m"]
        if status["place_samples"] >= settings["place_samples"] and near > settings["place_min_m2"]:
            kept = min(max(far / near - 1.0, settings["place_kept"]), 1.0 - settings["place_kept"])
            variance = min(near / (1.0 - kept), settings["max_change_std_m"] ** 2)
            if variance > settings["place_std_m"] ** 2:
                status["place_variance_m2"], status["place_distance_m"] = (
                    variance,
                    -settings["place_step_m"] / np.log(kept),
                )


@step
def update_stationary(s: EstimatorState, dt: float) -> None:
    """Count for how long the tag has shown no motion: neither its position, nor innovations that stay on one side."""
    settings = s.settings[0]
    status, dim = s.status[0], s.settings[0]["dim"]
    square = 0.0
    for axis in range(dim):
        square += (s.x[axis] - status["stationary_m"][axis]) ** 2 / s.P[axis, axis]
    status["stationary_s"] += dt
    moved = square > dim or status["lag_square"] > settings["lag_limit"] or status["rejected_in_row"] > 1
    if moved:
        status["stationary_s"] = 0.0
    for axis in range(dim):  # a place that has become known better moves as well
        if moved or s.P[axis, axis] < settings["better_known"] * status["stationary_m2"][axis]:
            status["stationary_m"][axis], status["stationary_m2"][axis] = s.x[axis], s.P[axis, axis]


@step
def adapt_process_noise(s: EstimatorState, normalised: float) -> None:
    """Adapt the process noise of the tag's motion and clock to an innovation.

    The direction to the anchor stands in ``h``, the first of the measurement's terms.
    """
    settings, status = s.settings[0], s.status[0]
    gain, square = settings["mean_gain"], 0.0
    for axis in range(settings["dim"]):
        status["lag"][axis] += gain * (s.h[axis] * normalised - status["lag"][axis])
        square += status["lag"][axis] ** 2
    square *= (2.0 - gain) / gain
    status["lag_square"] += settings["lag_forgetting"] * (square - status["lag_square"])
    if status["lag_square"] > settings["lag_limit"]:
        status["q_scale"] = min(status["q_scale"] * settings["q_scale_gain"], settings["max_scale"])
    else:
        status["q_scale"] = max(status["q_scale"] * settings["scale_loss"], 1.0)
    status["common_mean"] += gain * (normalised - status["common_mean"])
    status["walk_scale"] = _walk_scale(s, status["walk_scale"], status["common_mean"])


@step
def adapt_clock_noise(s: EstimatorState, anchor: int, normalised: float) -> None:
    """Adapt the process noise of an anchor's clock to what a relay shows of it."""
    a = s.anchors[anchor]
    a["relay_mean"] += s.settings[0]["mean_gain"] * (normalised - a["relay_mean"])
    a["walk_scale"] = _walk_scale(s, a["walk_scale"], a["relay_mean"])


@step
def _walk_scale(s: EstimatorState, scale: float, mean: float) -> float:
    """Factor on the random walk of a clock: it grows while the running mean of its innovations is off zero."""
    settings = s.settings[0]
    scale *= settings["walk_scale_gain"] if _is_off_zero(s, mean) else settings["scale_loss"]
    return float(min(max(scale, 1.0), settings["max_walk_scale"]))


@step
def covariance_scale(s: EstimatorState) -> float:
    """Factor on the position's covariance while innovations are larger than the filter expects.

    Most of an innovation is the stamps' noise, so the state errs by more than the innovations show.
    """
    settings = s.settings[0]
    nis = s.status[0]["mean_nis"]
    return float(nis * nis) if nis > settings["inconsistent_nis"] else 1.0
