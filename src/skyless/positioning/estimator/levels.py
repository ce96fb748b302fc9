"""Protection levels: how wrong a position may be, whatever is late (``docs/maths.md`` section 8).

Hypothesis: the tag's receptions of every anchor are late (or early) by a constant of its own, all at once. With the
faults b̂ and their sensitivities V (``faults``) the estimate under the hypothesis and its covariance are

    x + V·b̂        P + V·(M + I/σ_f²)⁻¹·Vᵀ

so the error exceeds |V·b̂| + k·σ with the stated risk only, whichever anchors are at fault. Two kinds are considered:
constants since an anchor joined, and what has begun lately. What is larger than σ_f shows, as a jump or in
yᵀ·(M + I/σ_f²)⁻¹·y, which is χ² without faults; then there is no number.
"""

from typing import Final

import numpy as np

from skyless.constants import TICK_S
from skyless.kernels.arrays import Vector
from skyless.kernels.compiled import step
from skyless.positioning.estimator.faults import SURE_CHI2, whiten
from skyless.positioning.estimator.monitor import covariance_scale
from skyless.positioning.estimator.state import LASTING_STD_M, EstimatorState
from skyless.positioning.integrity import CONTRADICTED, HPL, OBSTRUCTED, SOUND, UNAVAILABLE, VPL

RECENT_STD_M: Final = 0.08
"""Of a fault that has begun lately without a jump that shows."""

LASTING_CHI2, RECENT_CHI2 = 2, 3
"""What ``protect`` writes after ``HPL`` and ``VPL``."""

LEVELS: Final = 4


@step
def protect(s: EstimatorState, levels: Vector) -> None:
    """Write the levels in metres and the tests of faults."""
    settings = s.settings[0]
    dim, count = settings["dim"], len(s.anchors)
    scale = covariance_scale(s)
    levels[HPL] = levels[VPL] = 0.0
    for bank in range(2):
        std_m = s.status[0]["fault_std_m"] if bank == 0 else RECENT_STD_M
        begin = bank * count
        for one in range(count):
            for other in range(count):
                s.work[one, other] = s.information[bank, one, other]
            s.work[one, one] += 1.0 / (std_m * std_m)
            s.work[count, one] = s.evidence[bank, one]
            for axis in range(dim):
                s.work[count + 1 + axis, one] = s.V[begin + one, axis]
        whiten(s.work, count, 1 + dim)
        chi2, shift_x, shift_y, shift_z = 0.0, 0.0, 0.0, 0.0
        xx, xy, yy, zz = scale * s.P[0, 0], scale * s.P[0, 1], scale * s.P[1, 1], 0.0
        for one in range(count):
            fault, vx, vy = s.work[count, one], s.work[count + 1, one], s.work[count + 2, one]
            chi2 += fault * fault
            shift_x += vx * fault
            shift_y += vy * fault
            xx += vx * vx
            xy += vx * vy
            yy += vy * vy
            if dim == 3:
                vz = s.work[count + 3, one]
                shift_z += vz * fault
                zz += vz * vz
        largest = 0.5 * (xx + yy) + np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        levels[HPL] = max(levels[HPL], np.hypot(shift_x, shift_y) + settings["horizontal_k"] * np.sqrt(largest))
        if dim == 3:
            levels[VPL] = max(levels[VPL], abs(shift_z) + settings["vertical_k"] * np.sqrt(scale * s.P[2, 2] + zz))
        levels[LASTING_CHI2 + bank] = chi2
    squared, up = 0.0, 0.0
    for column in range(2 * count, 2 * count + dim):
        squared += s.V[column, 0] ** 2 + s.V[column, 1] ** 2
        if dim == 3:
            up += s.V[column, 2] ** 2
    levels[HPL] += s.settings[0]["max_acceleration_mps2"] * np.sqrt(squared)
    levels[VPL] += s.settings[0]["max_acceleration_mps2"] * np.sqrt(up)


# Whether the anchors determine the height


PROBE_M: Final = 1.0
"""Least distance from the plane at which the two sides are compared; for a tag that is farther off it is its own."""

SIDES_CHI2: Final = 25.0
"""The sides differ where their ranges' squared differences, over the variance of range errors, sum to more."""

LEAST_ANCHORS: Final = 3

SENSOR_VALID_S: Final = 1.0
"""Time for which a sensor's height resolves which side it is."""


def fit_plane(s: EstimatorState) -> None:
    """Find the plane of least squares through the anchors, where the height is estimated."""
    status, anchors_m = s.status[0], s.anchors["position_m"]
    status["plane_normal"] = 0.0
    if s.settings[0]["dim"] == 3 and len(anchors_m) >= LEAST_ANCHORS:
        status["plane_m"] = anchors_m.mean(axis=0)
        status["plane_normal"] = np.linalg.svd(anchors_m - status["plane_m"], full_matrices=False)[2][2]


@step
def _apart_m(s: EstimatorState, anchor: int, off_m: float, probe_m: float) -> float:
    """By how much an anchor is farther from a point above the tag's foot in the plane than from one below."""
    normal, a_m = s.status[0]["plane_normal"], s.anchors[anchor]["position_m"]
    above, below = 0.0, 0.0
    for axis in range(3):
        foot_m = s.x[axis] - off_m * normal[axis] - a_m[axis]
        above += (foot_m + probe_m * normal[axis]) ** 2
        below += (foot_m - probe_m * normal[axis]) ** 2
    return float(np.sqrt(above) - np.sqrt(below))


@step
def is_height_open(s: EstimatorState) -> bool:
    """Whether the tag and its mirror image behind the anchors' plane explain the ranges alike.

    Range errors make up for what is left of the difference, and what all ranges have in common is the tag's clock.
    Not where the image lies where the tag cannot be, nor while a sensor measures the height.
    """
    status, settings = s.status[0], s.settings[0]
    normal, count, off_m, square, total = status["plane_normal"], len(s.anchors), 0.0, 0.0, 0.0
    variance = settings["range_std_m"] ** 2 + settings["survey_std_m"] ** 2 + settings["rx_variance_m2"]
    if settings["dim"] == 3:
        for axis in range(3):
            off_m += normal[axis] * (s.x[axis] - status["plane_m"][axis])
        for anchor in range(count):
            apart_m = _apart_m(s, anchor, off_m, max(abs(off_m), PROBE_M))
            total += apart_m
            square += apart_m * apart_m
    is_flat = square - total * total / count < SIDES_CHI2 * variance
    image_z_m = s.x[2] - 2.0 * off_m * normal[2]
    is_image_possible = settings["lowest_m"] <= image_z_m <= settings["highest_m"]
    is_near = off_m * off_m * normal[2] ** 2 <= s.P[2, 2]
    has_sensor = (status["epoch_ticks"] - status["height_ticks"]) * TICK_S < SENSOR_VALID_S
    return bool(settings["dim"] == 3 and is_flat and not has_sensor and (is_image_possible or is_near))


# Whether a position can be relied on


UNCOVERED_CHI2: Final = 240.0
"""A test of faults beyond this shows one that the levels may not cover."""

FIRST_PACKETS: Final = 3
"""Of each anchor, before which there are no levels."""


MAX_LEVEL_STD: Final = 0.05
"""Part of the mean range; ranges are curved within positions of a larger standard deviation, which have no level."""

CONTRADICTED_START_S: Final = 5.0
"""There is no level for this time after a start whose packets contradicted each other: where several anchors are late,
the others may agree on a wrong position, until the tag has moved enough to show it."""

MAX_OPEN_LEVEL_STD: Final = 0.02
"""The same where all range errors are open: then only the tag's motion determines its position, by directions that
change, and a filter that is linearised at a wrong position becomes too certain (errors of 5 standard deviations)."""


@step
def _relative_std(s: EstimatorState) -> float:
    """The position's horizontal standard deviation as a part of the mean range; levels are of first order in it."""
    range_m = 0.0
    for anchor in range(len(s.anchors)):
        range_m += s.anchors[anchor]["range_m"] / len(s.anchors)
    return float(np.sqrt(s.P[0, 0] + s.P[1, 1]) / max(range_m, 1e-6))


@step
def integrity_state(s: EstimatorState, levels: Vector) -> int:
    """Whether a position's levels can be relied on: ``SOUND``, ``OBSTRUCTED``, ``CONTRADICTED`` or ``UNAVAILABLE``."""
    count, status = len(s.anchors), s.status[0]
    state = SOUND
    for anchor in range(count):
        if s.anchors[anchor]["is_obstructed"] or s.anchors[anchor]["has_fault"]:
            state = OBSTRUCTED
    was_contradicted = status["fault_std_m"] > LASTING_STD_M  # then none are selected
    limit = SURE_CHI2 if was_contradicted else UNCOVERED_CHI2
    share = _relative_std(s)
    if status["withholds_levels"] or max(levels[LASTING_CHI2], levels[RECENT_CHI2]) > limit:
        state = CONTRADICTED
    if was_contradicted and (status["epoch_ticks"] - status["start_ticks"]) * TICK_S < CONTRADICTED_START_S:
        state = CONTRADICTED
    if status["open_range_errors"] and share > MAX_OPEN_LEVEL_STD:
        state = CONTRADICTED
    is_new = count <= s.settings[0]["dim"] or status["packets"] < FIRST_PACKETS * count
    if is_new or share > MAX_LEVEL_STD or is_height_open(s):
        state = UNAVAILABLE
    return state
