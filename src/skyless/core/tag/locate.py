"""Positions from one set of TDoAs, without an initial guess and without hiding an ambiguity.

Closed forms give starts (``starts``), from which damped Gauss–Newton steps (``descent``) lead to the minima; these are
distinguished (``minima``), unfolded from a plane, and decided between by the height's bounds (``position``).
"""

from functools import cache
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from skyless.core.arrays import Array, Integers
from skyless.core.fix import NoFixReason
from skyless.core.native.library import compiled
from skyless.core.native.sizes import MAX_ANCHORS
from skyless.core.native.views import view
from skyless.core.tag.position import (
    COLLINEAR_ANCHORS,
    FOUND,
    IMPOSSIBLE,
    MIRROR,
    NO_COVARIANCE,
    RESIDUALS,
    SINGULAR,
    UNCERTAIN,
    UNSETTLED,
    Found,
    find_position,
)
from skyless.core.tag.problem import LARGEST, LocateProblem

_find_position = compiled(find_position)

RESIDUAL_TAIL: Final = 1e-9  # residuals that noise exceeds this rarely are not noise

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
    """A position and how well it is known. Arrays in metres, site frame."""

    position_m: Array
    """Shape (3,)."""
    covariance_m2: Array
    """Shape (3, 3); a given height has zeros."""
    residuals_m: Array
    """Measured minus predicted TDoAs, shape (n,)."""
    chi2: float
    """rᵀΣ⁻¹r, also where the estimate is not weighted by Σ⁻¹."""
    dof: int
    mirror_m: Array | None
    """The position that fits as well and that the height's bounds ruled out, shape (3,)."""
    iterations: int


class PseudorangeSolution(Solution, frozen=True, gc=False):
    """A position together with the pseudoranges' common bias, for example a receiver's clock."""

    bias_m: float
    covariance_joint_m2: Array
    """Covariance of (x, y, z, bias), shape (4, 4); with a given height of (x, y, bias), shape (3, 3)."""


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

    ``anchors_m``: shape (n + 1, 3), the reference first. ``covariance_m2``: Σ of the TDoAs, shape (n, n),
    symmetric. ``height_m``: the tag's known height (2-D positioning; anchors may have any
    heights). ``weighted=False`` minimises the plain sum of squares; its covariance still follows from Σ.

    Where two positions explain the data about equally well, as the two sides of the anchors' plane do
    in 3-D, ``z_bounds_m`` may decide; else the answer is MIRROR. A tag so near that plane that the two have merged is
    put into it, with a variance that covers both. Residuals less likely than ``residual_tail`` give RESIDUALS (0 lets
    everything pass). No value raises; arrays that do not fit each other, and more than ``MAX_ANCHORS`` anchors, raise
    ValueError.
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
    """Rows and columns of a lower triangle's elements, row by row."""
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


def locate_pseudoranges(
    anchors_m: ArrayLike,
    pseudoranges_m: ArrayLike,
    variances_m2: ArrayLike,
    *,
    height_m: float | None = None,
    z_bounds_m: tuple[float, float] | None = None,
    residual_tail: float = RESIDUAL_TAIL,
) -> PseudorangeSolution | NoSolution:
    """Locate a tag by pseudoranges |p − anchors_m[i]| + bias with independent errors.

    ``anchors_m``: shape (n, 3); ``pseudoranges_m`` and ``variances_m2``: shape (n,). The rest as in ``locate``,
    which sees their differences against the first, with its variance in common; nothing is lost by that.
    """
    anchors = np.array(anchors_m, np.float64, ndmin=2)
    pseudoranges, variances = np.array(pseudoranges_m, np.float64), np.array(variances_m2, np.float64)
    if not (anchors.shape == (len(pseudoranges), 3) and variances.shape == pseudoranges.shape):
        raise ValueError(
            f"anchors {anchors.shape}, pseudoranges {pseudoranges.shape}, variances {variances.shape}: "
            "expected (n, 3), (n,), (n,)"
        )
    if not (np.isfinite(pseudoranges).all() and np.isfinite(variances).all() and (variances > 0.0).all()):
        return NoSolution(NoFixReason.BAD_GEOMETRY, "a pseudorange is not finite or its variance not positive")
    solution = locate(
        anchors,
        pseudoranges[1:] - pseudoranges[:1],
        np.diag(variances[1:]) + variances[:1],
        height_m=height_m,
        z_bounds_m=z_bounds_m,
        residual_tail=residual_tail,
    )
    if isinstance(solution, NoSolution):
        return solution
    return _with_bias(solution, anchors, pseudoranges, 1.0 / variances, 2 if height_m is not None else 3)


def _with_bias(
    solution: Solution, anchors: Array, pseudoranges: Array, weights: Array, dims: int
) -> PseudorangeSolution:
    """Add the weighted mean of what the ranges leave over.

    That mean's own error is uncorrelated with all differences of pseudoranges, hence with the position p; so
    bias = mean − hᵀp with h the mean direction, and its covariances follow from p's.
    """
    away = solution.position_m - anchors
    ranges = np.sqrt((away * away).sum(axis=1))
    mean = weights / weights.sum()
    direction = (mean / np.maximum(ranges, 1e-9)) @ away[:, :dims]
    position = solution.covariance_m2[:dims, :dims]
    joint = np.empty((dims + 1, dims + 1))
    joint[:dims, :dims] = position
    joint[dims, :dims] = joint[:dims, dims] = -(position @ direction)
    joint[dims, dims] = 1.0 / weights.sum() + direction @ position @ direction
    fields = {name: getattr(solution, name) for name in Solution.__struct_fields__}
    return PseudorangeSolution(**fields, bias_m=float(mean @ (pseudoranges - ranges)), covariance_joint_m2=joint)
