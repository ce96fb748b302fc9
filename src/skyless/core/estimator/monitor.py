"""Which measurements are used, and how process noise is adapted to innovations.

Late receptions are the rule where paths are blocked, early ones are not. A single late one is rejected; where those
that follow agree with it, the range error has jumped, and is estimated again from there. What is systematic in the
innovations along an axis is motion, what all anchors have in common is the tag's clock, and what relays show of one
anchor's clock is that clock.
"""

from typing import Final

import numpy as np

from skyless.core.estimator.faults import begin_obstruction
from skyless.core.estimator.kalman import jump_share
from skyless.core.estimator.state import CHANGING_RANGE_ERRORS, EstimatorState, layout
from skyless.core.kernels.compiled import step

# All innovations: weight of the newest in the running means, about the last 50.
FORGETTING: Final = 0.02
INCONSISTENT_NIS: Final = 1.6  # mean normalised square beyond which the tag moves more than assumed (noise alone: 1)

# A range error has jumped where IN_ROW innovations of an anchor lie beyond SUSPECT standard deviations, together beyond
# TOGETHER (by chance once in some million packets), and agree within AGREEMENT standard deviations of two receptions.
SUSPECT: Final = 3.0
IN_ROW: Final = 2
IN_ROW_WHERE_LATE: Final = 5  # the same where more than LATE_OFTEN_SHARE of all receptions are late
LATE_OFTEN_SHARE: Final = 0.02
TOGETHER: Final = 7.0
AGREEMENT: Final = 3.0
# Where range errors have jumped recently, more jumps are to be expected and less evidence is enough (by chance once in
# some thousand packets), while enough other anchors are clear: else the tag's clock, which all share, would open all.
OBSTRUCTED_SUSPECT: Final = 2.2
OBSTRUCTED_TOGETHER: Final = 5.0

# After a jump: the error's standard deviation, unless it has jumped by more. Its process noise is scaled up by GROWTH
# with each packet while the squared running mean of its innovations, 1 where it wanders as expected, exceeds LIMIT.
JUMP_STD_M: Final = 0.2
CHANGE_GAIN: Final = 0.1
CHANGE_LIMIT: Final = 4.0
CHANGE_GROWTH: Final = 1.2
CHANGE_LOSS: Final = 0.97
MAX_CHANGE_SCALE: Final = 250.0  # then it changes by 1 m in a second at most
# An obstruction has ended where the error is known to this, and within this number of standard deviations of 0.
ENDED_STD_M: Final = 0.05
ENDED: Final = 2.0
SETTLED_CHANGE_SCALE: Final = 2.0  # a range error whose process noise is raised by less does not change any more

# Late receptions: density of their normalised innovations (a standard deviation of 5 cm, a metre late), and the number
# of standard deviations beyond which innovations have less weight, of receptions where they are late often, of
# differences always.
LATE_FORGETTING: Final = 0.005
LATE_PROBABILITY_DENSITY: Final = 0.05
RECEPTION_HUBER: Final = 1.5
DIFFERENCE_HUBER: Final = 1.0

# Multipath: range errors are compared after each step of the tag and after two. As jumps are not multipath, a
# comparison counts as PLACE_LIMIT times their mean at most, which leaves PLACE_LIMITED_MEAN of a normal mean square.
# PLACE_FIRST comparisons stand for the stamps' noise beforehand; PLACE_SAMPLES are needed, and PLACE_MEMORY
# remembered.
PLACE_STEP_M: Final = 0.1
PLACE_LIMIT: Final = 2.0
PLACE_LIMITED_MEAN: Final = 0.742
PLACE_FIRST: Final = 20
PLACE_SAMPLES: Final = 100
PLACE_MEMORY: Final = 1000
PLACE_MOVING: Final = 2.0  # standard deviations of a velocity beyond which a tag walks
PLACE_MIN_M2: Final = 12e-4  # mean square beyond the stamps' noise that is more than the site file states
PLACE_ABSORBED: Final = 1.3  # factor for what position and clock absorb of it (simulated, six anchors)
PLACE_MIN_KEPT: Final = 0.1  # least and largest correlation after one step
PLACE_MAX_KEPT: Final = 0.9
MAX_CHANGE_STD_M: Final = 0.5  # largest standard deviation of the part of range errors that changes as the tag moves

# Motion: a tag moves where the mean square of its way, over the variances, exceeds MOVED. Process noise grows while the
# mean square of the innovations' running means along the axes, 1 where the filter is right, exceeds LAG_LIMIT.
MOVED: Final = 1.0
BETTER_KNOWN: Final = 0.8  # part of the variance of a place below which the newest estimate replaces it
LAG_GAIN: Final = 0.05
LAG_FORGETTING: Final = 0.01
LAG_LIMIT: Final = 2.6
Q_SCALE_GAIN: Final = 1.05
Q_SCALE_LOSS: Final = 0.99
MAX_Q_SCALE: Final = 100.0

# The tag's clock: limit of the squared running mean of all innovations. Where the newest of all anchors lie beyond
# COMMON standard deviations on one side, it has left its rate: nothing else makes all late, or early, at once.
COMMON_GAIN: Final = 0.05
COMMON_LIMIT: Final = 9.0
COMMON: Final = 1.5
WALK_GAIN: Final = 1.1
WALK_LOSS: Final = 0.99
# Each anchor's clock: limit of the squared running mean of what relays show of it.
RELAY_GAIN: Final = 0.05
RELAY_LIMIT: Final = 9.0
RELAY_WALK_GAIN: Final = 1.2
RELAY_WALK_LOSS: Final = 0.99


@step
def gate_of(s: EstimatorState) -> float:
    """Beyond how many standard deviations a reception is more likely late than not."""
    late = min(s.status[0]["late_share"], 0.9)
    odds = late * LATE_PROBABILITY_DENSITY * 2.5066282746310002 / (1.0 - late)
    gate = s.settings[0]["gate"]
    return float(min(gate, np.sqrt(-2.0 * np.log(odds)))) if odds > 1e-6 else float(gate)


@step
def is_warm(s: EstimatorState) -> bool:
    """Whether two packets of each anchor have been processed since the start."""
    return bool(s.status[0]["packets"] > 2 * len(s.anchors))


@step
def has_jumped(s: EstimatorState, anchor: int, innovation: float, innovation_variance: float) -> bool:
    """Whether this reception and those before it show that an anchor's range error has jumped."""
    a, status = s.anchors[anchor], s.status[0]
    free = 0
    for other in range(len(s.anchors)):
        free += 0 if s.anchors[other]["is_obstructed"] else 1
    share = jump_share(s) * (1.0 if free > s.settings[0]["dim"] + 1 else 0.0)
    suspect = SUSPECT + share * (OBSTRUCTED_SUSPECT - SUSPECT)
    together = TOGETHER + share * (OBSTRUCTED_TOGETHER - TOGETHER)
    if innovation * innovation <= suspect * suspect * innovation_variance:
        a["outliers_in_row"] = 0
    else:
        settings = s.settings[0]
        stamps = 2.0 * (settings["tx_variance_m2"] + settings["rx_variance_m2"])
        apart = innovation - a["outlier_m"]
        both = innovation + a["outlier_m"]
        agrees = a["outliers_in_row"] > 0 and apart * apart <= AGREEMENT * AGREEMENT * stamps
        agrees = agrees and both * both > together * together * innovation_variance
        a["outliers_in_row"] = a["outliers_in_row"] + 1 if agrees else 1
        a["outlier_m"] = innovation
    needed = IN_ROW_WHERE_LATE if status["late_share"] > LATE_OFTEN_SHARE else IN_ROW
    return bool(a["outliers_in_row"] >= needed)


@step
def is_common(s: EstimatorState, normalised: float) -> bool:
    """Whether the newest innovations of all anchors but one, which may show nothing, lie on the side of this one.

    The tag's clock it is then. A faulty anchor draws the others to the opposite side of its own.
    """
    others = 0
    for anchor in range(len(s.anchors)):
        newest = s.anchors[anchor]["innovation"]
        if abs(newest) <= COMMON:
            others += 1
        elif newest * normalised <= 0.0:
            others += 2
    return bool(len(s.anchors) > s.settings[0]["dim"] and others <= 1)


@step
def open_range_error(s: EstimatorState, anchor: int, innovation: float) -> None:
    """Let an anchor's range error be estimated again from a jump on."""
    change = layout(s.settings[0]["dim"], len(s.anchors)).change + anchor
    s.status[0]["obstructions"] += 1
    begin_obstruction(s, anchor)
    s.P[change, change] += max(JUMP_STD_M**2, innovation * innovation)
    s.status[0]["range_errors"] = max(s.status[0]["range_errors"], CHANGING_RANGE_ERRORS)


@step
def adapt_change_noise(s: EstimatorState, anchor: int, normalised: float) -> None:
    """Raise the process noise of an obstructed anchor's range error where its innovations stay on one side."""
    a = s.anchors[anchor]
    a["change_mean"] += CHANGE_GAIN * (normalised - a["change_mean"])
    if a["change_mean"] ** 2 * (2.0 - CHANGE_GAIN) / CHANGE_GAIN > CHANGE_LIMIT:
        a["change_scale"] = min(a["change_scale"] * CHANGE_GROWTH, MAX_CHANGE_SCALE)
    else:
        a["change_scale"] = max(a["change_scale"] * CHANGE_LOSS, 1.0)


@step
def end_small_obstruction(s: EstimatorState, anchor: int) -> None:
    """End an obstruction that has gone without a jump back: the range error is known, and is hardly there."""
    a, change = s.anchors[anchor], layout(s.settings[0]["dim"], len(s.anchors)).change + anchor
    error_m, variance, usual = s.x[change], s.P[change, change], s.status[0]["place_variance_m2"]
    settled = a["is_obstructed"] and a["change_scale"] < SETTLED_CHANGE_SCALE and variance < ENDED_STD_M**2 + usual
    if settled and error_m * error_m < ENDED * ENDED * (variance + usual):
        a["is_obstructed"] = 0
        s.status[0]["ends_of_obstructions"] += 1


@step
def variance_scale(s: EstimatorState, innovation: float, innovation_variance: float) -> float:
    """Factor on the innovation's variance of a reception of the tag; 0 if it is not to be used. Counts it."""
    status, settings = s.status[0], s.settings[0]
    normalised = innovation / np.sqrt(innovation_variance)
    within = -settings["gate"] <= normalised <= settings["gate"]
    status["late_share"] += LATE_FORGETTING * ((0.0 if within else 1.0) - status["late_share"])
    status["rejected_share"] *= 1.0 - FORGETTING
    scale, gate = 1.0, gate_of(s)
    if not within or normalised > gate:
        scale = 0.0
        status["rejected"] += 1
        if not within:
            status["rejected_in_row"] += 1
            status["rejected_share"] += FORGETTING
    else:
        status["accepted"] += 1
        status["rejected_in_row"] = 0
        status["mean_nis"] += FORGETTING * (normalised * normalised - status["mean_nis"])
        status["mean_square_m2"] += FORGETTING * (innovation * innovation - status["mean_square_m2"])
        if status["late_share"] > LATE_OFTEN_SHARE and abs(normalised) > RECEPTION_HUBER:
            scale = abs(normalised) / RECEPTION_HUBER
    return float(scale)


@step
def difference_scale(s: EstimatorState, innovation: float, innovation_variance: float) -> float:
    """Factor on the innovation's variance of a time difference; 0 if it is not to be used. Counts it.

    Either of its anchors may be late, so large ones have less weight on both sides.
    """
    status, normalised = s.status[0], abs(innovation) / np.sqrt(innovation_variance)
    used = normalised <= s.settings[0]["gate"]
    status["rejected_share"] *= 1.0 - FORGETTING
    if used:
        status["accepted"] += 1
        status["rejected_in_row"] = 0
        status["mean_nis"] += FORGETTING * (normalised * normalised - status["mean_nis"])
        status["mean_square_m2"] += FORGETTING * (innovation * innovation - status["mean_square_m2"])
    else:
        status["rejected"] += 1
        status["rejected_in_row"] += 1
        status["rejected_share"] += FORGETTING
    return float(max(1.0, normalised / DIFFERENCE_HUBER)) if used else 0.0


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
        a["change_variance_m2"] = min(max(variance, settings["least_change_std_m"] ** 2), MAX_CHANGE_STD_M**2)


@step
def learn_place(s: EstimatorState, anchor: int, residual_m: float) -> None:
    """Learn how range errors change with the distance walked, from what they differ by after one and two steps.

    Half the mean square of the differences is noise + σ²·(1 − c) after one step and noise + σ²·(1 − c²) after two, for
    a Gauss–Markov process of variance σ² with the correlation c over a step (a semivariogram, Matheron 1963).
    """
    settings, status, a = s.settings[0], s.status[0], s.anchors[anchor]
    step_m, velocity = status["walked_m"] - a["place_walked_m"], layout(settings["dim"], len(s.anchors)).velocity
    motion = 0.0  # beyond the estimate's noise
    for state in range(velocity, velocity + settings["dim"]):
        motion += s.x[state] ** 2 - PLACE_MOVING**2 * s.P[state, state]
    if step_m >= PLACE_STEP_M:
        a["place_steps"] = a["place_steps"] + 1 if step_m < 2.0 * PLACE_STEP_M and motion > 0.0 else 0
        if a["place_steps"] >= 2:
            status["place_samples"] = min(status["place_samples"] + 1, PLACE_MEMORY)
            for lag in range(2):
                half = 0.5 * (residual_m - a["place_residual_m"][lag]) ** 2
                mean = status["place_square_m2"][lag]
                limited = min(half, PLACE_LIMIT * mean) / PLACE_LIMITED_MEAN
                status["place_square_m2"][lag] += (limited - mean) / (PLACE_FIRST + status["place_samples"])
        a["place_residual_m"][1] = a["place_residual_m"][0]
        a["place_residual_m"][0] = residual_m
        a["place_walked_m"] = status["walked_m"]
        noise = settings["tx_variance_m2"] + settings["rx_variance_m2"]
        near, far = status["place_square_m2"][0] - noise, status["place_square_m2"][1] - noise
        status["place_variance_m2"], status["place_distance_m"] = 0.0, settings["place_distance_m"]
        if status["place_samples"] >= PLACE_SAMPLES and near > PLACE_MIN_M2:
            kept = min(max(far / near - 1.0, PLACE_MIN_KEPT), PLACE_MAX_KEPT)
            variance = min(PLACE_ABSORBED * near / (1.0 - kept), MAX_CHANGE_STD_M**2)
            if variance > settings["place_std_m"] ** 2:
                status["place_variance_m2"], status["place_distance_m"] = variance, -PLACE_STEP_M / np.log(kept)


@step
def update_stationary(s: EstimatorState, dt: float) -> None:
    """Count for how long the tag has shown no motion: neither its position, nor innovations that stay on one side."""
    status, dim = s.status[0], s.settings[0]["dim"]
    square = 0.0
    for axis in range(dim):
        square += (s.x[axis] - status["stationary_m"][axis]) ** 2 / s.P[axis, axis]
    status["stationary_s"] += dt
    moved = square > MOVED * dim or status["lag_square"] > LAG_LIMIT or status["rejected_in_row"] > 1
    if moved:
        status["stationary_s"] = 0.0
    for axis in range(dim):  # a place that has become known better moves as well
        if moved or s.P[axis, axis] < BETTER_KNOWN * status["stationary_m2"][axis]:
            status["stationary_m"][axis], status["stationary_m2"][axis] = s.x[axis], s.P[axis, axis]


@step
def adapt_process_noise(s: EstimatorState, normalised: float) -> None:
    """Raise the motion's and the tag clock's process noise where innovations stay on one side, else lower it.

    The direction to the anchor stands in ``h``, the first of the measurement's terms.
    """
    status, dim = s.status[0], s.settings[0]["dim"]
    square = 0.0
    for axis in range(dim):
        status["lag"][axis] += LAG_GAIN * (s.h[axis] * normalised - status["lag"][axis])
        square += status["lag"][axis] ** 2
    square *= (2.0 - LAG_GAIN) / LAG_GAIN
    status["lag_square"] += LAG_FORGETTING * (square - status["lag_square"])
    if status["lag_square"] > LAG_LIMIT:
        status["q_scale"] = min(status["q_scale"] * Q_SCALE_GAIN, MAX_Q_SCALE)
    else:
        status["q_scale"] = max(status["q_scale"] * Q_SCALE_LOSS, 1.0)
    status["common_mean"] += COMMON_GAIN * (normalised - status["common_mean"])
    if status["common_mean"] ** 2 * (2.0 - COMMON_GAIN) / COMMON_GAIN > COMMON_LIMIT:
        status["walk_scale"] = min(status["walk_scale"] * WALK_GAIN, s.settings[0]["max_walk_scale"])
    else:
        status["walk_scale"] = max(status["walk_scale"] * WALK_LOSS, 1.0)


@step
def covariance_scale(s: EstimatorState) -> float:
    """Factor on the position's covariance while innovations are larger than the filter expects.

    Most of an innovation is the stamps' noise, so the state errs by more than the innovations show.
    """
    nis = s.status[0]["mean_nis"]
    return float(nis * nis) if nis > INCONSISTENT_NIS else 1.0


@step
def adapt_clock_noise(s: EstimatorState, anchor: int, normalised: float) -> None:
    """Raise the process noise of an anchor's clock where what relays show of it stays on one side, else lower it."""
    a = s.anchors[anchor]
    a["relay_mean"] += RELAY_GAIN * (normalised - a["relay_mean"])
    if a["relay_mean"] ** 2 * (2.0 - RELAY_GAIN) / RELAY_GAIN > RELAY_LIMIT:
        a["walk_scale"] = min(a["walk_scale"] * RELAY_WALK_GAIN, s.settings[0]["max_walk_scale"])
    else:
        a["walk_scale"] = max(a["walk_scale"] * RELAY_WALK_LOSS, 1.0)
