"""Protection levels: bounds on the position error even if receptions are late (``docs/maths.md`` section 8).

Hypothesis: the tag's receptions of every anchor are late (or early) by a constant of its own, all at once. With the
faults b̂ and their sensitivities V (``faults``) the estimate under the hypothesis and its covariance are

    x + V·b̂        P + V·(M + I/σ_f²)⁻¹·Vᵀ

so the error exceeds |V·b̂| + k·σ only with the stated risk, whichever anchors are at fault. Three kinds are considered:
constants since an anchor joined, recent changes, and growth over seconds. A fault larger than σ_f is detected as a
jump or by yᵀ·(M + I/σ_f²)⁻¹·y, which is χ² without faults; then no level is stated.
"""

from typing import Final

from skyless.core.estimator.faults import fault_chi2, whiten
from skyless.core.estimator.monitor import is_warm, motion_covariance
from skyless.core.estimator.state import AXES, FAULT_KINDS, LASTING, State, at
from skyless.core.integrity import CONTRADICTED, HPL, OBSTRUCTED, SOUND, UNAVAILABLE, VPL
from skyless.core.native.arithmetic import hypot, sqrt, square
from skyless.core.ticks import TICK_S

FIRST_TEST: Final = 2
"""Index of the tests of faults in ``levels``, after ``HPL`` and ``VPL``."""


_SWEEPS: Final = 8
"""Sweeps of Jacobi rotations; each squares what is left off the diagonal."""


def protect(s: State) -> None:
    """Compute the levels in metres and the tests of faults."""
    levels = s.levels
    levels[HPL] = levels[VPL] = 0.0
    for kind in range(FAULT_KINDS):
        levels[FIRST_TEST + kind] = fault_chi2(s, kind, s.dim)
        faults, x, y, z = s.work[s.count], s.work[s.count + 1], s.work[s.count + 2], s.work[s.count + 3]
        first = s.count + 1 + (AXES if kind == LASTING else 0)
        of_x, of_y, of_z = s.work[first], s.work[first + 1], s.work[first + 2]
        shift_x, shift_y, shift_z = 0.0, 0.0, 0.0
        xx, xy, yy, zz = motion_covariance(s, 0, 0), motion_covariance(s, 0, 1), motion_covariance(s, 1, 1), 0.0
        for one in range(s.count):
            shift_x += x[one] * faults[one]
            shift_y += y[one] * faults[one]
            xx += x[one] * of_x[one]
            xy += x[one] * of_y[one]
            yy += y[one] * of_y[one]
            if s.dim == 3:
                shift_z += z[one] * faults[one]
                zz += z[one] * of_z[one]
        largest = 0.5 * (xx + yy) + sqrt(0.25 * square(xx - yy) + xy * xy)
        levels[HPL] = max(levels[HPL], hypot(shift_x, shift_y) + s.horizontal_k * sqrt(largest))
        if s.dim == 3:
            levels[VPL] = max(levels[VPL], abs(shift_z) + s.vertical_k * sqrt(motion_covariance(s, 2, 2) + zz))


def largest_test(s: State) -> float:
    """The largest test of faults; without faults χ² with one degree of freedom for each anchor."""
    largest = 0.0
    for kind in range(FAULT_KINDS):
        largest = max(largest, s.levels[FIRST_TEST + kind])
    return largest


# Whether the anchors determine on which side of their plane the tag is


def fit_plane(s: State) -> None:
    """Fit the least-squares plane through the anchors; with a given height, the line on the floor plan."""
    status = s.status
    for axis in range(AXES):
        status.plane_normal[axis] = 0.0
        status.plane_m[axis] = 0.0
    if s.count < s.dim:
        return
    for anchor in range(s.count):
        for axis in range(s.dim):
            status.plane_m[axis] += s.anchors[anchor].position_m[axis] / s.count
    for one in range(s.dim):
        for other in range(s.dim):
            s.work[one][other] = 0.0
    for anchor in range(s.count):
        position_m = s.anchors[anchor].position_m
        for one in range(s.dim):
            for other in range(s.dim):
                s.work[one][other] += (position_m[one] - status.plane_m[one]) * (
                    position_m[other] - status.plane_m[other]
                )
    _find_least_axis(s, s.dim)


def _find_least_axis(s: State, dim: int) -> None:
    """Write the eigenvector of the matrix in ``work`` with the smallest eigenvalue into the plane's normal.

    By Jacobi's method (1846).
    """
    M, axes = s.work, AXES
    for one in range(dim):
        for other in range(dim):
            M[axes + one][other] = 1.0 if one == other else 0.0
    for _ in range(_SWEEPS):
        for one in range(dim):
            for other in range(one):
                if M[one][other] != 0.0:
                    _rotate(s, dim, one, other)
    least = 0
    for axis in range(dim):
        if M[axis][axis] < M[least][least]:
            least = axis
    for axis in range(dim):
        s.status.plane_normal[axis] = M[axes + axis][least]


def _rotate(s: State, dim: int, one: int, other: int) -> None:
    """Rotate two axes of the matrix in ``work`` so that their off-diagonal element becomes zero."""
    M = s.work
    half = 0.5 * (M[other][other] - M[one][one]) / M[one][other]
    tangent = (1.0 if half >= 0.0 else -1.0) / (abs(half) + sqrt(half * half + 1.0))
    cosine = 1.0 / sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    for row in range(AXES + dim):  # columns, including those of the axes behind the matrix
        if row < dim or row >= AXES:
            kept = M[row][one]
            M[row][one] = cosine * kept - sine * M[row][other]
            M[row][other] = sine * kept + cosine * M[row][other]
    for column in range(dim):
        kept = M[one][column]
        M[one][column] = cosine * kept - sine * M[other][column]
        M[other][column] = sine * kept + cosine * M[other][column]
    M[one][other] = M[other][one] = 0.0


def is_side_open(s: State) -> bool:
    """Whether the tag and its mirror image in the anchors' plane (2-D: line) explain the ranges about equally well.

    The tag's clock and a shift of the image absorb the difference by least squares; range errors must explain the rest.
    Not if the tag cannot be where the image is, nor while a sensor measures the height.
    """
    status, tuning, settings, dim = s.status, s.tuning, s.settings, s.dim
    if (status.epoch_ticks - status.height_ticks) * TICK_S < tuning.sensor_valid_s:
        return False
    normal, off_m = status.plane_normal, 0.0
    for axis in range(dim):
        off_m += normal[axis] * (s.x[axis] - status.plane_m[axis])
    image_z_m = s.x[2] - 2.0 * off_m * normal[2]
    is_near = off_m * off_m * square(normal[2]) <= s.P[at(2, 2)]
    if dim == 3 and not (settings.lowest_m <= image_z_m <= settings.highest_m or is_near):
        return False
    variance = square(settings.range_std_m) + square(settings.survey_std_m) + settings.rx_variance_m2
    return _left_by_image(s, off_m, variance) < tuning.apart_chi2 * variance


def _left_by_image(s: State, off_m: float, variance: float) -> float:
    """Sum of squares [m²] of the ranges' difference that the tag's clock and a shift of the image leave.

    ``off_m``: signed distance of the tag from the plane; ``variance``: of a range.
    """
    settings, dim, normal, left = s.settings, s.dim, s.status.plane_normal, 0.0
    if s.count <= dim:
        return left
    probe_m = max(abs(off_m), s.tuning.probe_m) * (1.0 if off_m > 0.0 else -1.0)
    information, seen = s.work[dim + 1], s.work[dim + 2]
    for one in range(dim + 2):
        for other in range(dim + 1):
            s.work[one][other] = 0.0
    for one in range(dim):
        s.work[one][one] = variance / square(s.tuning.shift_part * probe_m)
    for anchor in range(s.count):
        position_m = s.anchors[anchor].position_m
        tag_m2 = 0.0 if dim == 3 else square(settings.height_m - position_m[2])
        image_m2 = tag_m2
        for axis in range(dim):
            foot_m = s.x[axis] - off_m * normal[axis] - position_m[axis]
            seen[axis] = foot_m - probe_m * normal[axis]
            tag_m2 += square(foot_m + probe_m * normal[axis])
            image_m2 += square(foot_m - probe_m * normal[axis])
        apart_m, image_m = sqrt(image_m2) - sqrt(tag_m2), sqrt(image_m2)
        for axis in range(dim):
            seen[axis] /= image_m
        seen[dim] = 1.0
        left += apart_m * apart_m
        for one in range(dim + 1):
            information[one] += seen[one] * apart_m
            for other in range(one + 1):
                s.work[one][other] += seen[one] * seen[other]
    whiten(s, dim + 1, 1)
    for one in range(dim + 1):
        left -= square(information[one])
    return left


# Whether a position can be relied on


def integrity_state(s: State) -> int:
    """Whether the position's levels are reliable: ``SOUND``, ``OBSTRUCTED``, ``CONTRADICTED`` or ``UNAVAILABLE``."""
    status, tuning = s.status, s.tuning
    state, range_m = SOUND, 0.0
    for anchor in range(s.count):
        range_m += s.anchors[anchor].range_m / s.count
        if s.anchors[anchor].is_obstructed or s.anchors[anchor].has_fault:
            state = OBSTRUCTED
    was_contradicted = status.fault_std_m[LASTING] > tuning.lasting_std_m  # then no anchor is selected
    limit = tuning.sure_chi2 if was_contradicted else tuning.uncovered_chi2
    share = sqrt(s.P[at(0, 0)] + s.P[at(1, 1)]) / max(
        range_m, 1e-6
    )  # levels are a first-order approximation in this share
    if largest_test(s) > limit:
        state = CONTRADICTED
    if was_contradicted and (status.epoch_ticks - status.start_ticks) * TICK_S < tuning.contradicted_start_s:
        state = CONTRADICTED
    if status.has_open_ranges and share > tuning.max_open_level_std:
        state = CONTRADICTED
    is_new = s.count <= s.dim or not is_warm(s)
    if is_new or share > tuning.curved_std or is_side_open(s):
        state = UNAVAILABLE
    return max(state, status.withheld)
