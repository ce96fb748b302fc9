"""Position from one set of TDoAs: choice among the search's minima, and ``locate``, the Python function."""

from functools import cache
from typing import Annotated, Final

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from skyless.core.arrays import Array, Integers
from skyless.core.fix import NoFixReason
from skyless.core.native.arithmetic import chi2_tail, factorise, mean_if_positive, sqrt
from skyless.core.native.library import compiled
from skyless.core.native.records import MAX_ANCHORS, Matrix, Reals, Record, record
from skyless.core.native.views import view
from skyless.core.tag.search import (
    EXHAUSTED,
    LARGEST,
    PLANE,
    LocateProblem,
    Minimum,
    choose_axes,
    find_minima,
    keep_rivals,
    linearise,
    sigma_m,
)

FOUND, NO_COVARIANCE, COLLINEAR_ANCHORS, IMPOSSIBLE, UNSETTLED, SINGULAR, RESIDUALS, MIRROR, UNCERTAIN = range(9)
"""Reasons for no position: Σ is not positive definite; the anchors are collinear; a TDoA exceeds its anchors' distance;
the iteration did not converge; the anchors do not determine a position there; no position fits; two fit equally well;
the position's error exceeds its distance from the anchors."""

BOUND_SIGMAS: Final = 3.0  # a height may exceed the bounds by these sigmas if its mirror image exceeds them more
IMPOSSIBLE_SIGMAS: Final = 6.0  # a TDoA that exceeds its anchors' distance by these sigmas matches no position
# Mirror images have merged if their squared distance from the plane is within these sigmas of zero.
MERGED_SIGMAS: Final = 2.0


@record
class Found(Record):
    """A position and its uncertainty. Metres, site frame."""

    has_mirror: bool
    dof: int
    iterations: int
    chi2: float
    position_m: Annotated[Reals, 3]
    mirror_m: Annotated[Reals, 3]
    """The other position that fits equally well."""
    covariance_m2: Annotated[Matrix, 3, 3]
    residuals_m: Annotated[Reals, MAX_ANCHORS]
    """Measured minus predicted TDoAs."""


def find_position(p: LocateProblem, found: Found) -> int:
    """Locate a tag by finite TDoAs. Returns ``FOUND`` or the reason for no position.

    Needs 4 anchors, or 3 with a given height. Overwrites the problem.
    """
    p.start_count = 0
    p.minimum_count = 0
    if not factorise(p.covariance, p.anchors - 1):
        return NO_COVARIANCE
    if not choose_axes(p):
        return COLLINEAR_ANCHORS
    status = find_minima(p)
    if p.minimum_count == 0:
        return _why_none(p, status)
    best = p.minima[0]
    found.dof = p.anchors - 1 - p.dims
    below = _below_plane(best) if p.kind == PLANE else 0.0
    found.chi2 = best.chi2 + below
    dof = max(
        found.dof + (1 if below > 0.0 else 0), 1
    )  # with no redundancy, residuals are zero unless nothing fits at all
    if chi2_tail(dof, found.chi2) < p.residual_tail:
        return RESIDUALS
    if p.kind == PLANE:
        _fill_residuals(p, found, best)
        _unfold(p)
    else:
        keep_rivals(p)
    return _decide(p, found)


def _why_none(p: LocateProblem, status: int) -> int:
    """The reason if no iteration ended in a minimum."""
    for i in range(p.anchors - 1):
        anchor = p.anchors_m[i + 1]
        baseline_m = sqrt(anchor[0] * anchor[0] + anchor[1] * anchor[1] + anchor[2] * anchor[2])
        if abs(p.tdoa_m[i]) > baseline_m + IMPOSSIBLE_SIGMAS * sigma_m(p, i):
            return IMPOSSIBLE
    return UNSETTLED if status == EXHAUSTED else SINGULAR


# Anchors in a plane


def _below_plane(minimum: Minimum) -> float:
    """Contribution of the constraint s ≥ 0 to chi2: s²/σ_s² if s is negative."""
    s = minimum.state[2]
    return s * s / minimum.covariance[5] if s < 0.0 else 0.0


def _unfold(p: LocateProblem) -> None:
    """Convert s = w² to w: two mirror images, or one point in the plane if s is not distinguishable from 0."""
    best, image = p.minima[0], p.minima[1]
    s, sigma = best.state[2], sqrt(best.covariance[5])
    p.minimum_count = 1
    if s < MERGED_SIGMAS * sigma:
        best.state[2] = 0.0
        best.covariance[3] = 0.0
        best.covariance[4] = 0.0
        best.covariance[5] = mean_if_positive(s, sigma)
        return
    w = sqrt(s)
    best.state[2] = w
    best.covariance[3] *= 0.5 / w
    best.covariance[4] *= 0.5 / w
    best.covariance[5] *= 0.25 / s
    p.minima[1] = p.minima[0]
    image.state[2] = -w
    image.covariance[3] = -image.covariance[3]
    image.covariance[4] = -image.covariance[4]
    p.minimum_count = 2


# Decision


def _decide(p: LocateProblem, found: Found) -> int:
    """Choose among rivals by the height bounds, and reject what stays ambiguous or too uncertain."""
    chosen = 0
    if p.minimum_count > 1:
        found.has_mirror = True
        _fill_position(p, p.minima[0], found.position_m)
        _fill_position(p, p.minima[1], found.mirror_m)
        chosen = _chosen_by_height(p)
        if chosen < 0:
            return MIRROR
        if chosen > 0:
            _fill_position(p, p.minima[0], found.mirror_m)
    minimum = p.minima[chosen]
    _fill_position(p, minimum, found.position_m)
    trace_m2, distance_m = 0.0, 0.0
    for a in range(3):
        for b in range(3):
            found.covariance_m2[a][b] = _site_covariance(p, minimum, a, b)
        trace_m2 += found.covariance_m2[a][a]
        distance_m += abs(minimum.state[a])
    if not trace_m2 < (p.extent_m + distance_m) * (p.extent_m + distance_m):
        return UNCERTAIN
    if p.kind != PLANE:
        _fill_residuals(p, found, minimum)
    found.chi2 = minimum.chi2
    found.iterations = minimum.iterations
    return FOUND


def _chosen_by_height(p: LocateProblem) -> int:
    """The only position within the height bounds, else the one that exceeds them least and by little; −1 if none."""
    chosen, equals, least_m = -1, 0, 0.0
    if not p.has_bounds:
        return chosen
    for index in range(p.minimum_count):
        z = _site_coordinate(p, p.minima[index], 2)
        excess_m = max(p.low_m - z, z - p.high_m, 0.0)
        if chosen < 0 or excess_m < least_m:
            chosen, equals, least_m = index, 1, excess_m
        elif excess_m == least_m:
            equals += 1
    variance_m2 = max(_site_covariance(p, p.minima[chosen], 2, 2), 0.0)
    return -1 if equals > 1 or least_m > BOUND_SIGMAS * sqrt(variance_m2) else chosen


def _fill_position(p: LocateProblem, minimum: Minimum, position_m: Reals) -> None:
    for k in range(3):
        position_m[k] = _site_coordinate(p, minimum, k)


def _site_coordinate(p: LocateProblem, minimum: Minimum, k: int) -> float:
    """A coordinate of a minimum in the site frame."""
    total = p.origin_m[k]
    for j in range(3):
        total += p.axes[j][k] * minimum.state[j]
    return total


def _site_covariance(p: LocateProblem, minimum: Minimum, a: int, b: int) -> float:
    """An element of a minimum's covariance in the site frame."""
    total = 0.0
    for j in range(3):
        for k in range(3):
            one, other = max(j, k), min(j, k)
            total += p.axes[j][a] * minimum.covariance[one * (one + 1) // 2 + other] * p.axes[k][b]
    return total


def _fill_residuals(p: LocateProblem, found: Found, minimum: Minimum) -> None:
    linearise(p, minimum.state)
    for i in range(p.anchors - 1):
        found.residuals_m[i] = p.system[i][p.dims]


# The Python functions: no initial guess, and no hidden ambiguity

_find_position = compiled(find_position)

RESIDUAL_TAIL: Final = 1e-9  # residuals with a smaller tail probability are not noise

_REASONS: Final = {
    NO_COVARIANCE: (NoFixReason.BAD_GEOMETRY, "the TDoAs' covariance is not positive definite"),
    COLLINEAR_ANCHORS: (NoFixReason.BAD_GEOMETRY, "the anchors are in one line or in one point"),
    IMPOSSIBLE: (NoFixReason.RESIDUALS, "a TDoA is larger than the distance of its anchors"),
    UNSETTLED: (NoFixReason.NOT_CONVERGED, "the iterations did not settle"),
    SINGULAR: (NoFixReason.BAD_GEOMETRY, "these anchors do not determine a position there"),
    RESIDUALS: (NoFixReason.RESIDUALS, "no position fits these TDoAs: chi2 is {chi2:.3g}"),
    MIRROR: (
        NoFixReason.MIRROR,
        "({0[0]:.2f}, {0[1]:.2f}, {0[2]:.2f}) m and ({1[0]:.2f}, {1[1]:.2f}, {1[2]:.2f}) m "
        "explain the measurements equally well",
    ),
    UNCERTAIN: (NoFixReason.BAD_GEOMETRY, "the position's error exceeds its distance from the anchors"),
}


class Solution(Struct, frozen=True, gc=False):
    """A position and its uncertainty. Arrays in metres, site frame."""

    position_m: Array
    """Shape (3,)."""
    covariance_m2: Array
    """Shape (3, 3); zeros for a given height."""
    residuals_m: Array
    """Measured minus predicted TDoAs, shape (n,)."""
    chi2: float
    """rᵀΣ⁻¹r, even if the estimate is not weighted by Σ⁻¹."""
    dof: int
    mirror_m: Array | None
    """The position that fits equally well and that the height bounds excluded, shape (3,)."""
    iterations: int


class NoSolution(Struct, frozen=True, gc=False):
    """Why there is no position."""

    reason: NoFixReason
    detail: str


def locate(
    anchors_m: ArrayLike,
    tdoa_m: ArrayLike,
    covariance_m2: ArrayLike,
    *,
    height_m: float | None = None,
    weighted: bool = True,
    z_bounds_m: tuple[float, float] | None = None,
    residual_tail: float = RESIDUAL_TAIL,
) -> Solution | NoSolution:
    """Locate a tag by TDoAs ``tdoa_m[i] = |p − anchors_m[i + 1]| − |p − anchors_m[0]|``.

    ``anchors_m``: shape (n + 1, 3), the reference first. ``covariance_m2``: Σ of the TDoAs, shape (n, n), symmetric.
    ``height_m``: the tag's known height (2-D positioning; anchors may have any height). ``weighted=False`` minimises
    the unweighted sum of squares; the covariance still follows from Σ.

    If two positions explain the data about equally well, like the two sides of the anchors' plane in 3-D,
    ``z_bounds_m`` may decide; otherwise the answer is MIRROR. A tag so near that plane that the two have merged is
    placed in it, with a variance that covers both. Residuals less likely than ``residual_tail`` give RESIDUALS (0
    accepts any). Values never raise; mismatched shapes and more than ``MAX_ANCHORS`` anchors raise ValueError.
    """
    anchors, tdoa = np.array(anchors_m, np.float64, ndmin=2), np.array(tdoa_m, np.float64, ndmin=1)
    covariance, count = np.array(covariance_m2, np.float64), len(tdoa)
    needed = 3 if height_m is not None else 4
    if count + 1 < needed:
        detail = f"{needed} anchors are needed, {anchors.size // 3} are there"
        return NoSolution(NoFixReason.TOO_FEW_ANCHORS, detail)
    if anchors.shape != (count + 1, 3) or tdoa.ndim != 1 or covariance.shape != (count, count):
        raise ValueError(
            f"anchors {anchors.shape}, TDoAs {tdoa.shape}, covariance {covariance.shape}: "
            "expected (n + 1, 3), (n,), (n, n)"
        )
    if count >= MAX_ANCHORS:
        raise ValueError(f"{count + 1} anchors; a position is located with at most {MAX_ANCHORS} at a time")
    sensible = all(np.abs(values).max() < LARGEST for values in (anchors, tdoa, covariance))
    if not (sensible and abs(height_m or 0.0) < LARGEST):
        return NoSolution(NoFixReason.BAD_GEOMETRY, "a coordinate or a measurement is not a sensible number")
    low_m, high_m = z_bounds_m or (0.0, 0.0)
    found = Found()
    problem = LocateProblem(
        anchors=count + 1,
        knows_height=height_m is not None,
        is_weighted=weighted,
        has_bounds=z_bounds_m is not None,
        height_m=height_m or 0.0,
        low_m=low_m,
        high_m=high_m,
        residual_tail=residual_tail,
    )
    view(problem.anchors_m)[: count + 1], view(problem.tdoa_m)[:count] = anchors, tdoa
    view(problem.covariance)[: count * (count + 1) // 2] = covariance[_lower_triangle(count)]
    reason = _find_position(problem, found)
    if reason == FOUND:
        return _solution(found, count)
    no_fix, detail = _REASONS[reason]
    return NoSolution(no_fix, detail.format(found.position_m, found.mirror_m, chi2=found.chi2))


@cache
def _lower_triangle(size: int) -> tuple[Integers, Integers]:
    """Row and column indices of a lower triangle, row by row."""
    return np.tril_indices(size)


def _solution(found: Found, count: int) -> Solution:
    return Solution(
        position_m=view(found.position_m).copy(),
        covariance_m2=view(found.covariance_m2).copy(),
        residuals_m=view(found.residuals_m)[:count].copy(),
        chi2=found.chi2,
        dof=found.dof,
        mirror_m=view(found.mirror_m).copy() if found.has_mirror else None,
        iterations=found.iterations,
    )
