"""Protection levels: how wrong a position may be, even if receptions are late (``docs/maths.md`` section 8).

Hypothesis: the tag's receptions of every anchor are late (or early) by a constant of its own, all at once. With the
faults b̂ and their sensitivities V (``faults``) the estimate under the hypothesis and its covariance are

    x + V·b̂        P + V·(M + I/σ_f²)⁻¹·Vᵀ

so the error exceeds |V·b̂| + k·σ with the stated risk only, whichever anchors are at fault. Three kinds are considered:
constants since an anchor joined, what has begun recently, and what grows for seconds. What is larger than σ_f shows, as
a jump or in yᵀ·(M + I/σ_f²)⁻¹·y, which is χ² without faults; then there is no number.
"""

from typing import Final

import numpy as np

from skyless.core.constants import TICK_S
from skyless.core.estimator.faults import fault_chi2, whiten
from skyless.core.estimator.monitor import covariance_scale, is_warm
from skyless.core.estimator.state import FAULT_KINDS, LASTING, EstimatorState
from skyless.core.integrity import CONTRADICTED, HPL, OBSTRUCTED, SOUND, UNAVAILABLE, VPL
from skyless.core.kernels.arrays import Vector
from skyless.core.kernels.compiled import step

FIRST_TEST: Final = 2
"""Where ``protect`` writes the tests of all kinds of faults, after ``HPL`` and ``VPL``."""
LEVELS: Final = FIRST_TEST + FAULT_KINDS


@step
def protect(s: EstimatorState, levels: Vector) -> None:
    """Write the levels in metres and the tests of faults."""
    settings = s.settings[0]
    dim, count = settings["dim"], len(s.anchors)
    scale = covariance_scale(s)
    levels[HPL] = levels[VPL] = 0.0
    for kind in range(FAULT_KINDS):
        levels[FIRST_TEST + kind] = fault_chi2(s, kind, dim)
        shift_x, shift_y, shift_z = 0.0, 0.0, 0.0
        xx, xy, yy, zz = scale * s.P[0, 0], scale * s.P[0, 1], scale * s.P[1, 1], 0.0
        for one in range(count):
            fault, vx, vy = s.work[count, one], s.work[count + 1, one], s.work[count + 2, one]
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
    squared, up = 0.0, 0.0
    for column in range(FAULT_KINDS * count, FAULT_KINDS * count + dim):
        squared += s.V[column, 0] ** 2 + s.V[column, 1] ** 2
        if dim == 3:
            up += s.V[column, 2] ** 2
    levels[HPL] += s.settings[0]["max_acceleration_mps2"] * np.sqrt(squared)
    levels[VPL] += s.settings[0]["max_acceleration_mps2"] * np.sqrt(up)


# Whether the anchors determine on which side of them the tag is


def fit_plane(s: EstimatorState) -> None:
    """Find the plane of least squares through the anchors; where the height is given, the line on the floor plan."""
    status, dim = s.status[0], int(s.settings[0]["dim"])
    anchors_m = s.anchors["position_m"][:, :dim]
    status["plane_normal"] = 0.0
    if len(anchors_m) >= dim:
        status["plane_m"][:dim] = anchors_m.mean(axis=0)
        status["plane_normal"][:dim] = np.linalg.svd(anchors_m - status["plane_m"][:dim])[2][dim - 1]


@step
def is_side_open(s: EstimatorState) -> bool:
    """Whether the tag and its mirror image behind the anchors' plane, or in 2-D their line, explain the ranges alike.

    Range errors make up for what the tag's clock and a shift of the image, by least squares, leave of the difference.
    Not where the image lies where the tag cannot be, nor while a sensor measures the height.
    """
    status, settings, work, off_m, square = s.status[0], s.settings[0], s.work, 0.0, 0.0
    normal, dim, count = status["plane_normal"], settings["dim"], len(s.anchors)
    variance = settings["range_std_m"] ** 2 + settings["survey_std_m"] ** 2 + settings["rx_variance_m2"]
    for axis in range(dim):
        off_m += normal[axis] * (s.x[axis] - status["plane_m"][axis])
    probe_m = max(abs(off_m), settings["probe_m"]) * (1.0 if off_m > 0.0 else -1.0)
    if count > dim:
        for one in range(dim + 2):
            for other in range(dim + 1):
                work[one, other] = variance / (settings["shift_part"] * probe_m) ** 2 if one == other < dim else 0.0
        for anchor in range(count):
            tag_m = image_m = 0.0 if dim == 3 else (settings["height_m"] - s.anchors[anchor]["position_m"][2]) ** 2
            for axis in range(dim):
                foot_m = s.x[axis] - off_m * normal[axis] - s.anchors[anchor]["position_m"][axis]
                work[dim + 2, axis] = foot_m - probe_m * normal[axis]
                tag_m += (foot_m + probe_m * normal[axis]) ** 2
                image_m += (foot_m - probe_m * normal[axis]) ** 2
            apart_m, nearness, work[dim + 2, dim] = np.sqrt(image_m) - np.sqrt(tag_m), 1.0 / np.sqrt(image_m), 1.0
            square += apart_m * apart_m
            for one in range(dim + 1):
                work[dim + 2, one] *= nearness if one < dim else 1.0
                work[dim + 1, one] += work[dim + 2, one] * apart_m
                for other in range(one + 1):
                    work[one, other] += work[dim + 2, one] * work[dim + 2, other]
        whiten(work, dim + 1, 1)
        for one in range(dim + 1):
            square -= work[dim + 1, one] ** 2
    image_z_m = s.x[2] - 2.0 * off_m * normal[2]
    is_possible = dim == 2 or settings["lowest_m"] <= image_z_m <= settings["highest_m"]
    is_near = off_m * off_m * normal[2] ** 2 <= s.P[2, 2]
    has_sensor = (status["epoch_ticks"] - status["height_ticks"]) * TICK_S < settings["sensor_valid_s"]
    return bool(square < settings["apart_chi2"] * variance and not has_sensor and (is_possible or is_near))


# Whether a position can be relied on


@step
def integrity_state(s: EstimatorState, levels: Vector) -> int:
    """Whether a position's levels can be relied on: ``SOUND``, ``OBSTRUCTED``, ``CONTRADICTED`` or ``UNAVAILABLE``."""
    settings = s.settings[0]
    count, status = len(s.anchors), s.status[0]
    state, range_m = SOUND, 0.0
    for anchor in range(count):
        range_m += s.anchors[anchor]["range_m"] / count
        if s.anchors[anchor]["is_obstructed"] or s.anchors[anchor]["has_fault"]:
            state = OBSTRUCTED
    was_contradicted = status["fault_std_m"][LASTING] > settings["lasting_std_m"]  # then none are selected
    limit = settings["sure_chi2"] if was_contradicted else settings["uncovered_chi2"]
    share = np.sqrt(s.P[0, 0] + s.P[1, 1]) / max(range_m, 1e-6)  # levels are of first order in it
    if status["withholds_levels"] or levels[FIRST_TEST:].max() > limit:
        state = CONTRADICTED
    if was_contradicted and (status["epoch_ticks"] - status["start_ticks"]) * TICK_S < settings["contradicted_start_s"]:
        state = CONTRADICTED
    if status["open_range_errors"] and share > settings["max_open_level_std"]:
        state = CONTRADICTED
    is_new = count <= s.settings[0]["dim"] or not is_warm(s)
    if is_new or share > settings["curved_std"] or is_side_open(s):
        state = UNAVAILABLE
    return state
