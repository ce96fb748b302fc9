"""The position of a set of TDoAs: its minima, unfolded from a plane, and decided between by the height's bounds."""

from typing import Annotated, Final

from skyless.core.native.arithmetic import sqrt
from skyless.core.native.records import Matrix, Reals, Record, record
from skyless.core.native.sizes import MAX_ANCHORS
from skyless.core.native.small_matrices import factorise
from skyless.core.native.tails import chi2_tail, mean_if_positive
from skyless.core.tag.descent import EXHAUSTED, linearise
from skyless.core.tag.minima import find_minima, keep_rivals
from skyless.core.tag.problem import PLANE, LocateProblem, Minimum, choose_axes, sigma_m

FOUND, NO_COVARIANCE, COLLINEAR_ANCHORS, IMPOSSIBLE, UNSETTLED, SINGULAR, RESIDUALS, MIRROR, UNCERTAIN = range(9)
"""Why there is no position: Σ is not positive definite; the anchors are in one line; a TDoA is larger than its anchors'
distance; the iterations did not settle; the anchors determine no position there; no position fits; two fit equally
well; the position's error exceeds its distance from the anchors."""

BOUND_SIGMAS: Final = 3.0  # a height may exceed the bounds by these sigmas if its mirror image exceeds them more
IMPOSSIBLE_SIGMAS: Final = 6.0  # a TDoA that exceeds its anchors' distance by these sigmas belongs to no position
# Mirror images have merged while the square of their distance from the plane is within these sigmas of zero.
MERGED_SIGMAS: Final = 2.0


@record
class Found(Record):
    """A position and how well it is known. Metres, site frame."""

    has_mirror: bool
    dof: int
    iterations: int
    chi2: float
    position_m: Annotated[Reals, 3]
    mirror_m: Annotated[Reals, 3]
    """The other position that fits as well."""
    covariance_m2: Annotated[Matrix, 3, 3]
    residuals_m: Annotated[Reals, MAX_ANCHORS]
    """Measured minus predicted TDoAs."""


def find_position(p: LocateProblem, found: Found) -> int:
    """Locate a tag by TDoAs whose numbers are finite; returns why there is no position.

    Needs 4 anchors, with a given height 3; with fewer, no position is determined. The problem is used up.
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
    dof = max(found.dof + (1 if below > 0.0 else 0), 1)  # without any, residuals are zero unless nothing fits at all
    if chi2_tail(dof, found.chi2) < p.residual_tail:
        return RESIDUALS
    if p.kind == PLANE:
        _fill_residuals(p, found, best)
        _unfold(p)
    else:
        keep_rivals(p)
    return _decide(p, found)


def _why_none(p: LocateProblem, status: int) -> int:
    """The reason when no iteration ended in a minimum."""
    for i in range(p.anchors - 1):
        anchor = p.anchors_m[i + 1]
        baseline_m = sqrt(anchor[0] * anchor[0] + anchor[1] * anchor[1] + anchor[2] * anchor[2])
        if abs(p.tdoa_m[i]) > baseline_m + IMPOSSIBLE_SIGMAS * sigma_m(p, i):
            return IMPOSSIBLE
    return UNSETTLED if status == EXHAUSTED else SINGULAR


# Anchors in a plane


def _below_plane(minimum: Minimum) -> float:
    """What the constraint s ≥ 0 adds to chi2: s²/σ_s² where the square of a distance came out negative."""
    s = minimum.state[2]
    return s * s / minimum.covariance[5] if s < 0.0 else 0.0


def _unfold(p: LocateProblem) -> None:
    """From s = w² to w: the two images, or one in the plane where s cannot be distinguished from 0."""
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
    """Choose among rivals by the height's bounds, and reject what is not resolved."""
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
    """The only position within the bounds, else the one that exceeds them least and by little; −1 if there is none."""
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
