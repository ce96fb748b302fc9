"""Positions from one set of TDoAs, without an initial guess and without hiding an ambiguity."""

import math
from functools import lru_cache
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from skyless.kernels.arrays import Array
from skyless.positioning.fix import NoFixReason
from skyless.positioning.solver.minima import (
    EXHAUSTED,
    PLANE,
    Minimum,
    Problem,
    below_plane,
    distinct,
    find_minima,
    frame,
    unfold,
)

RESIDUAL_TAIL: Final = 1e-9
"""Residuals that noise exceeds this rarely are not noise."""
RIVAL_CHI2: Final = 9.0
"""A second minimum is a rival while its chi2 is less than this above the best one (a likelihood ratio of 90)."""
BOUND_SIGMAS: Final = 3.0
"""A height may exceed the bounds by these sigmas if its mirror image exceeds them more."""
IMPOSSIBLE_SIGMAS: Final = 6.0
"""A TDoA that exceeds its anchors' distance by these sigmas belongs to no position."""
LARGEST: Final = 1e9
"""Metres (or m²); anything beyond is no site, and no number here overflows before it."""
SINGULAR: Final = 1e-12
"""A pivot of Cholesky's below this part of its diagonal element is rounding noise."""


class Solution(Struct, frozen=True, gc=False):
    """A position and how well it is known. Arrays in metres, site frame."""

    position_m: Array
    """Shape (3,)."""
    covariance_m2: Array
    """Shape (3, 3); a given height has zeros."""
    residuals_m: Array
    """Measured minus predicted TDoAs, shape (n,)."""
    chi2: float
    """rᵀΣ⁻¹r, whatever the estimate's weights."""
    dof: int
    mirror_m: Array | None
    """The position that fits as well and that the height's bounds ruled out, shape (3,)."""
    iterations: int


class PseudorangeSolution(Solution, frozen=True, gc=False):
    """A position together with the pseudoranges' common bias, for example a receiver's clock."""

    bias_m: float
    covariance_joint_m2: Array
    """Of (x, y, z, bias), shape (4, 4), or of (x, y, bias), shape (3, 3), where the height is given."""


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

    Where two positions explain the data about equally well, as the two sides of the anchors' plane do in 3-D,
    ``z_bounds_m`` may decide; else the answer is MIRROR. A tag so near that plane that the two have merged is put
    into it, with a variance that covers both. Residuals less likely than ``residual_tail`` give RESIDUALS (0 lets
    everything pass). No value raises; arrays that do not fit each other raise ValueError.
    """
    problem = _prepare(
        np.array(anchors_m, np.float64, ndmin=2),
        np.array(tdoa_m, np.float64, ndmin=1),
        np.array(covariance_m2, np.float64),
        height_m,
        weighted,
    )
    if isinstance(problem, NoSolution):
        return problem
    limit = chi2_limit(problem.dof, residual_tail)
    minima, status = find_minima(problem)
    if not minima:
        return _why_none(problem, status)
    best = minima[0]
    if problem.kind == PLANE:
        excess = below_plane(best)
        if best.chi2 + excess > (chi2_limit(problem.dof + 1, residual_tail) if excess else limit):
            return _residuals_too_large(best.chi2 + excess)
        minima = unfold(best)
    elif best.chi2 > limit:
        return _residuals_too_large(best.chi2)
    else:
        minima = [best, *(m for m in minima[1:] if m.chi2 <= best.chi2 + RIVAL_CHI2 and distinct(best, m))]
    return _decide(problem, minima, z_bounds_m)


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


@lru_cache(maxsize=256)
def chi2_limit(dof: int, tail: float) -> float:
    """The value that chi2 with ``dof`` degrees of freedom exceeds with probability ``tail``.

    Without any, residuals are zero unless nothing fits at all, and the limit of one serves.
    """
    from scipy.special import chdtri  # noqa: PLC0415 (SciPy is loaded late)

    return float(chdtri(max(dof, 1), tail))


def _prepare(
    anchors: Array, tdoa: Array, covariance: Array, height_m: float | None, weighted: bool
) -> Problem | NoSolution:
    """Check the input and choose the kind of problem and its frame."""
    count = len(tdoa)
    needed = 3 if height_m is not None else 4
    if count + 1 < needed:
        detail = f"{needed} anchors are needed, {anchors.size // 3} are there"
        return NoSolution(NoFixReason.TOO_FEW_ANCHORS, detail)
    if anchors.shape != (count + 1, 3) or tdoa.ndim != 1 or covariance.shape != (count, count):
        raise ValueError(
            f"anchors {anchors.shape}, TDoAs {tdoa.shape}, covariance {covariance.shape}: "
            "expected (n + 1, 3), (n,), (n, n)"
        )
    sensible = all(np.abs(values).max() < LARGEST for values in (anchors, tdoa, covariance))
    if not (sensible and abs(height_m or 0.0) < LARGEST):
        return NoSolution(NoFixReason.BAD_GEOMETRY, "a coordinate or a measurement is not a sensible number")
    whitener = _whitener(covariance)
    if whitener is None:
        return NoSolution(NoFixReason.BAD_GEOMETRY, "the TDoAs' covariance is not positive definite")
    origin = anchors[0].copy()
    height = None if height_m is None else height_m - float(origin[2])
    kind, local, extent, axes = frame(anchors - origin, height, math.sqrt(covariance.diagonal().min()))
    if not extent > 0.0:
        return NoSolution(NoFixReason.BAD_GEOMETRY, "the anchors are in one line or in one point")
    return Problem(kind, local, tdoa, covariance, whitener, weighted, extent, height or 0.0, origin, axes)


def _whitener(covariance: Array) -> Array | None:
    """W with W·Σ·Wᵀ = 1; None where Σ is not positive definite, to rounding."""
    try:
        factor = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return None
    sound = (factor.diagonal() ** 2 > SINGULAR * covariance.diagonal()).all()
    return np.linalg.inv(factor) if sound else None


def _why_none(problem: Problem, status: int) -> NoSolution:
    """The reason when no iteration ended in a minimum."""
    baselines = np.sqrt((problem.anchors[1:] ** 2).sum(axis=1))
    if (np.abs(problem.tdoa) > baselines + IMPOSSIBLE_SIGMAS * np.sqrt(problem.covariance.diagonal())).any():
        return NoSolution(NoFixReason.RESIDUALS, "a TDoA is larger than the distance of its anchors")
    if status == EXHAUSTED:
        return NoSolution(NoFixReason.NOT_CONVERGED, "the iterations did not settle")
    return NoSolution(NoFixReason.BAD_GEOMETRY, "these anchors do not determine a position there")


def _residuals_too_large(chi2: float) -> NoSolution:
    return NoSolution(NoFixReason.RESIDUALS, f"no position fits these TDoAs: chi2 is {chi2:.3g}")


def _decide(problem: Problem, minima: list[Minimum], z_bounds_m: tuple[float, float] | None) -> Solution | NoSolution:
    """Choose among rivals by the height's bounds, and refuse what is not resolved."""
    positions = [problem.origin + problem.axes.T @ minimum.state for minimum in minima]
    covariances = [problem.axes.T @ minimum.covariance @ problem.axes for minimum in minima]
    chosen = 0
    if len(minima) > 1:
        decided = _by_height(positions, covariances, z_bounds_m)
        if decided is None:
            places = " and ".join("({:.2f}, {:.2f}, {:.2f}) m".format(*p) for p in positions[:2])
            return NoSolution(NoFixReason.MIRROR, f"{places} explain the measurements equally well")
        chosen = decided
    minimum, covariance = minima[chosen], covariances[chosen]
    distance = float(np.abs(minimum.state).sum())
    if not covariance.trace() < (problem.extent + distance) ** 2:
        return NoSolution(NoFixReason.BAD_GEOMETRY, "the position's error exceeds its distance from the anchors")
    return Solution(
        position_m=positions[chosen],
        covariance_m2=covariance,
        residuals_m=minimum.residuals,
        chi2=minimum.chi2,
        dof=problem.dof,
        mirror_m=positions[0 if chosen else 1] if len(minima) > 1 else None,
        iterations=minimum.iterations,
    )


def _by_height(positions: list[Array], covariances: list[Array], z_bounds_m: tuple[float, float] | None) -> int | None:
    """The only position within the bounds, or else the one that exceeds them least and by little."""
    if z_bounds_m is None:
        return None
    low, high = z_bounds_m
    excesses = [max(low - float(p[2]), float(p[2]) - high, 0.0) for p in positions]
    least = min(excesses)
    first = excesses.index(least)
    if excesses.count(least) > 1 or least > BOUND_SIGMAS * math.sqrt(covariances[first][2, 2]):
        return None
    return first
