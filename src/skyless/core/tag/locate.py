"""Positions from one set of TDoAs, without an initial guess and without hiding an ambiguity.

With the reference anchor at the origin, x the tag, ρ = |x| its distance from there, and the measured
d_i = |x − a_i| − ρ, squaring ρ + d_i = |x − a_i| leaves equations that are linear in x and ρ:

    a_iᵀx + d_i·ρ = (|a_i|² − d_i²)/2

*Spherical intersection* solves them for x as a function of ρ, and |x|² = ρ² is then a quadratic with two roots;
*spherical interpolation* takes ρ as one more unknown (H. C. Schau and A. Z. Robinson 1987; J. O. Smith and
J. S. Abel 1987). Anchors in one plane determine nothing of the coordinate w across it except w² = ρ² − x² − y².

From there Gauss–Newton steps, damped after Levenberg and Marquardt where they fail, lead to the minima, which are then
distinguished, unfolded from a plane, and decided between by the height's bounds.
"""

import math
from functools import lru_cache
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import ArrayLike

from skyless.core.arrays import Array
from skyless.core.fix import NoFixReason
from skyless.core.native.library import compiled
from skyless.core.native.records import view
from skyless.core.tag.descent import (
    CONVERGED,
    EXHAUSTED,
    FREE,
    HEIGHT,
    MAX_ANCHORS,
    PLANE,
    SINGULAR_PIVOT,
    Descent,
    descend,
    linearise,
)

_descend, _linearise = compiled(descend), compiled(linearise)

RESIDUAL_TAIL: Final = 1e-9  # residuals that noise exceeds this rarely are not noise
# A second minimum is a rival while its chi2 is less than this above the best one (a likelihood ratio of 90).
RIVAL_MINIMUM_CHI2: Final = 9.0
BOUND_SIGMAS: Final = 3.0  # a height may exceed the bounds by these sigmas if its mirror image exceeds them more
IMPOSSIBLE_SIGMAS: Final = 6.0  # a TDoA that exceeds its anchors' distance by these sigmas belongs to no position
LARGEST: Final = 1e9  # metres (or m²); anything beyond is no site, and no number here overflows before it


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


# Anchors are in one line, or one point, if their figure's width is below this part of its length.
COLLINEAR: Final = 1e-6
# Anchors are in one plane if they leave it by less than this part of the smallest TDoA sigma.
THIN_SIGMAS: Final = 0.1
# Equations of a start are not independent if their smallest singular value is below this part of the largest.
DEPENDENT: Final = 1e-6
# Two minima are distinct where one lies outside the 3-sigma ellipsoid of the other.
DISTINCT_MINIMA_CHI2: Final = 9.0
# Mirror images have merged while the square of their distance from the plane is within these sigmas of zero.
MERGED_SIGMAS: Final = 2.0


class Problem(Struct, frozen=True, gc=False):
    """TDoAs in the axes in which their solution is simplest: p = origin + axesᵀ·local, the reference at the origin."""

    kind: int
    anchors: Array
    """Shape (n + 1, 3)."""
    tdoa: Array
    covariance: Array
    whitener: Array
    """W with W·Σ·Wᵀ = 1, shape (n, n)."""
    weighted: bool
    extent: float
    """Size of the anchors' figure; 0 if they are in one line."""
    height: float
    origin: Array
    axes: Array

    @property
    def dims(self) -> int:
        """Number of unknowns."""
        return 2 if self.kind == HEIGHT else 3

    @property
    def dof(self) -> int:
        """Measurements beyond the unknowns."""
        return len(self.tdoa) - self.dims

    @property
    def scale(self) -> Array:
        """What the extent is for each unknown."""
        sizes = np.full(self.dims, self.extent)
        if self.kind == PLANE:
            sizes[2] *= self.extent
        return sizes


class Minimum(Struct, frozen=True, gc=False):
    """A minimum in the local frame."""

    state: Array
    covariance: Array
    residuals: Array
    chi2: float
    cost: float
    iterations: int


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
    minima, status = find_minima(problem)
    if not minima:
        return _why_none(problem, status)
    best = minima[0]
    excess = below_plane(best) if problem.kind == PLANE else 0.0
    if best.chi2 + excess > chi2_limit(problem.dof + (1 if excess else 0), residual_tail):
        return NoSolution(NoFixReason.RESIDUALS, f"no position fits these TDoAs: chi2 is {best.chi2 + excess:.3g}")
    if problem.kind == PLANE:
        minima = unfold(best)
    else:
        minima = [best, *(m for m in minima[1:] if m.chi2 <= best.chi2 + RIVAL_MINIMUM_CHI2 and distinct(best, m))]
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
    """Return the value that chi2 with ``dof`` degrees of freedom exceeds with probability ``tail``.

    Without degrees of freedom residuals are zero unless nothing fits at all, and the limit of one serves.
    """
    if tail <= 0.0:
        return math.inf
    low, high = 0.0, 1.0
    while _chi2_tail(dof, high) > tail:
        low, high = high, 2.0 * high
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if _chi2_tail(dof, middle) > tail else (low, middle)
    return high


def _chi2_tail(dof: int, value: float) -> float:
    """Probability that chi2 exceeds a value: the finite sum for a whole number of degrees of freedom."""
    half = 0.5 * value
    odd = max(dof, 1) % 2
    term = math.sqrt(half / math.pi) * 2.0 if odd else 1.0
    total = 0.0
    for k in range(max(dof, 1) // 2):
        total += term
        term *= half / (k + 1.5 if odd else k + 1.0)
    return (math.erfc(math.sqrt(half)) if odd else 0.0) + math.exp(-half) * total


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
    if count >= MAX_ANCHORS:
        raise ValueError(f"{count + 1} anchors; a position is located with at most {MAX_ANCHORS} at a time")
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
    sound = (factor.diagonal() ** 2 > SINGULAR_PIVOT * covariance.diagonal()).all()
    return np.linalg.inv(factor) if sound else None


def _why_none(problem: Problem, status: int) -> NoSolution:
    """The reason when no iteration ended in a minimum."""
    baselines = np.sqrt((problem.anchors[1:] ** 2).sum(axis=1))
    if (np.abs(problem.tdoa) > baselines + IMPOSSIBLE_SIGMAS * np.sqrt(problem.covariance.diagonal())).any():
        return NoSolution(NoFixReason.RESIDUALS, "a TDoA is larger than the distance of its anchors")
    if status == EXHAUSTED:
        return NoSolution(NoFixReason.NOT_CONVERGED, "the iterations did not settle")
    return NoSolution(NoFixReason.BAD_GEOMETRY, "these anchors do not determine a position there")


def _decide(problem: Problem, minima: list[Minimum], z_bounds_m: tuple[float, float] | None) -> Solution | NoSolution:
    """Choose among rivals by the height's bounds, and reject what is not resolved."""
    positions = [problem.origin + problem.axes.T @ minimum.state for minimum in minima]
    covariances = [problem.axes.T @ minimum.covariance @ problem.axes for minimum in minima]
    chosen = 0
    if len(minima) > 1:
        decided = _by_height(positions, covariances, z_bounds_m)
        if decided is None:
            rivals = " and ".join("({:.2f}, {:.2f}, {:.2f}) m".format(*p) for p in positions[:2])
            return NoSolution(NoFixReason.MIRROR, f"{rivals} explain the measurements equally well")
        chosen = decided
    minimum, covariance = minima[chosen], covariances[chosen]
    distance = float(np.abs(minimum.state).sum())
    if not covariance.trace() < (problem.extent + distance) ** 2:
        return NoSolution(NoFixReason.BAD_GEOMETRY, "the position's error exceeds its distance from the anchors")
    mirror_m = positions[0 if chosen else 1] if len(minima) > 1 else None
    found = (minimum.residuals, minimum.chi2, problem.dof, mirror_m, minimum.iterations)
    return Solution(positions[chosen], covariance, *found)


def _by_height(positions: list[Array], covariances: list[Array], z_bounds_m: tuple[float, float] | None) -> int | None:
    """The only position within the bounds, else the position that exceeds them least and by little."""
    if z_bounds_m is None:
        return None
    low, high = z_bounds_m
    excesses = [max(low - float(p[2]), float(p[2]) - high, 0.0) for p in positions]
    least = min(excesses)
    first = excesses.index(least)
    if excesses.count(least) > 1 or least > BOUND_SIGMAS * math.sqrt(covariances[first][2, 2]):
        return None
    return first


# The minima of a set of TDoAs


def frame(anchors: Array, height: float | None, sigma: float) -> tuple[int, Array, float, Array]:
    """Kind of problem, anchors in its axes, their extent (0 if they are in one line), and the axes as rows."""
    flat = anchors if height is None else anchors * (1.0, 1.0, 0.0)
    axes: Array = np.linalg.svd(flat, full_matrices=False)[2]
    along = flat @ axes.T
    extent, width = float(np.linalg.norm(flat, axis=1).max()), float(np.linalg.norm(along[:, 1:], axis=1).max())
    if not width > COLLINEAR * extent:
        return FREE, anchors, 0.0, axes
    if height is not None:
        return HEIGHT, anchors, extent, np.eye(3)
    if np.abs(along[:, 2]).max() > max(1e-9 * extent, THIN_SIGMAS * sigma):
        return FREE, along, extent, axes
    along[:, 2] = 0.0
    return PLANE, along, extent, axes


def find_minima(problem: Problem) -> tuple[list[Minimum], int]:
    """All minima that are found, the best first, and how the last iteration that failed ended.

    The closed form's starts depend on the reference and miss about one rival in a hundred; the anchors' centroid
    finds most of these, and the mirror image of what is found the rest where anchors are nearly in one line or plane.
    """
    found: list[Minimum] = []
    status, starts = CONVERGED, [*_algebraic_starts(problem), *_central_starts(problem)]
    d, scale = _new_descent(problem), problem.scale
    for state in starts:
        view(d.state)[:] = state
        end = _descend(d)
        state[:] = view(d.state)
        status = end or status
        if end == CONVERGED and not any(_same(minimum.state, state, scale) for minimum in found):
            if problem.kind != PLANE and not found and len(starts) < 9:  # singular minima do not go on without end
                starts.append(_image(problem, state))
            found += _assess(problem, d, state)
    found.sort(key=lambda minimum: minimum.cost)
    return found, status


# Starts


def _algebraic_starts(problem: Problem) -> list[Array]:
    """States to start from without a guess; the equations are not weighted."""
    kind, tdoa, anchors = problem.kind, problem.tdoa, problem.anchors[1:]
    height = problem.height if kind == HEIGHT else 0.0
    half = 0.5 * ((anchors * anchors).sum(axis=1) - tdoa * tdoa)
    known = half - anchors[:, 2] * height
    dims = 3 if kind == FREE else 2
    starts = []
    if kind != PLANE:
        starts += _intersections(anchors[:, :dims], tdoa, known, height)
    if len(tdoa) > dims:
        for x in _solved(np.column_stack([anchors[:, :dims], tdoa]), known):
            third = _square_across(x) if kind == PLANE else height if kind == HEIGHT else x[2]
            starts.append(np.array([x[0], x[1], third]))
    if kind == FREE:
        for x in _solved(np.column_stack([anchors[:, :2], tdoa]), half):
            across = math.sqrt(max(_square_across(x), 0.0))
            starts += [np.array([x[0], x[1], across]), np.array([x[0], x[1], -across])]
    return starts


def _solved(left: Array, right: Array) -> list[Array]:
    """The least squares solution; none where the equations do not determine it."""
    solution, _, rank, _ = np.linalg.lstsq(left, right, rcond=DEPENDENT)
    return [solution.astype(np.float64, copy=False)] if rank == left.shape[1] else []


def _square_across(solution: Array) -> float:
    """The square of the coordinate across the plane, from (x, y, ρ)."""
    x, y, distance = solution.tolist()
    return float(distance * distance - x * x - y * y)


def _intersections(anchors: Array, tdoa: Array, known: Array, height: float) -> list[Array]:
    """The points x = u − v·ρ for each non-negative root ρ of |x|² = ρ², with the height besides two coordinates.

    Where noise leaves no real root, the vertex of the parabola is used. The roots' form does not cancel.
    """
    points = []
    for solution in _solved(anchors, np.column_stack([known, tdoa])):
        u, v = solution.T
        a, half_b, c = float(v @ v) - 1.0, -float(u @ v), float(u @ u) + height * height
        discriminant = half_b * half_b - a * c
        if discriminant < 0.0:
            roots = [-half_b / a]
        else:
            larger = -(half_b + math.copysign(math.sqrt(discriminant), half_b))
            roots = [larger / a] if a != 0.0 else []
            roots += [c / larger] if larger != 0.0 else []
        points += [np.append(u - v * root, [height] * (3 - len(u))) for root in roots if root >= 0.0]
    return points


def _central_starts(problem: Problem) -> list[Array]:
    """Starts at the anchors' centroid; where the height is unknown, half their extent off their plane."""
    x, y, z = problem.anchors.mean(axis=0).tolist()
    off = 0.5 * problem.extent
    if problem.kind == FREE:
        return [np.array([x, y, z + off]), np.array([x, y, z - off])]
    return [np.array([x, y, problem.height if problem.kind == HEIGHT else off * off])]


def _image(problem: Problem, state: Array) -> Array:
    """The mirror image behind the anchors' line or plane of least squares; a given height stays."""
    anchors, image = problem.anchors[:, : problem.dims], state.copy()
    normal = np.linalg.svd(anchors - anchors.mean(axis=0))[2][-1]
    image[: problem.dims] -= 2.0 * float(normal @ (state[: problem.dims] - anchors.mean(axis=0))) * normal
    return image


# Iterations


def _new_descent(problem: Problem) -> Descent:
    """The problem as the iteration takes it."""
    count = len(problem.tdoa)
    d = Descent(kind=problem.kind, anchors=count + 1, dims=problem.dims)
    view(d.positions_m)[: count + 1], view(d.tdoa_m)[:count] = problem.anchors, problem.tdoa
    view(d.whitener)[:count, :count] = problem.whitener if problem.weighted else np.eye(count)
    view(d.scale)[: problem.dims] = problem.scale
    return d


def _assess(problem: Problem, d: Descent, state: Array) -> list[Minimum]:
    """The minimum at a state, unless it is singular there.

    Its covariance is G·Σ·Gᵀ with the G of the estimate, (HᵀΣ⁻¹H)⁻¹HᵀΣ⁻¹ or, not weighted, (HᵀH)⁻¹Hᵀ. chi2 is rᵀΣ⁻¹r in
    both cases.
    """
    _linearise(d, d.state)
    system = view(d.system)[: len(problem.tdoa), : problem.dims + 1]
    gradients, residuals = system[:, :-1], system[:, -1].copy()
    weights = problem.whitener.T @ problem.whitener if problem.weighted else np.eye(len(residuals))
    inverse = inverse_of(gradients.T @ weights @ gradients)
    if not np.isfinite(inverse).all():
        return []
    G = inverse @ gradients.T @ weights
    covariance = np.zeros((3, 3))
    covariance[: problem.dims, : problem.dims] = G @ problem.covariance @ G.T
    whitened = problem.whitener @ residuals
    chi2 = float(whitened @ whitened)
    cost = chi2 if problem.weighted else float(residuals @ residuals)
    return [Minimum(state, covariance, residuals, chi2, cost, d.iterations)]


def _same(one: Array, other: Array, scale: Array) -> bool:
    """Whether two iterations ended in one point; a millionth of the extent is far above their tolerance."""
    apart = np.abs(one - other)[: len(scale)] / scale
    return bool(apart.sum() < 1e-6)


# Several minima


def distinct(one: Minimum, other: Minimum) -> bool:
    """Whether either lies outside the other's error ellipsoid."""
    dims = 3 if one.covariance[2, 2] > 0.0 else 2
    apart = (one.state - other.state)[:dims]
    for minimum in (one, other):
        inverse = inverse_of(minimum.covariance[:dims, :dims])
        if not (np.isfinite(inverse).all() and float(apart @ inverse @ apart) <= DISTINCT_MINIMA_CHI2):
            return True
    return False


def below_plane(minimum: Minimum) -> float:
    """What the constraint s ≥ 0 adds to chi2: s²/σ_s² where the square of a distance came out negative."""
    square = float(minimum.state[2])
    return square * square / float(minimum.covariance[2, 2]) if square < 0.0 else 0.0


def unfold(minimum: Minimum) -> list[Minimum]:
    """From s = w² to w: the two images, or one in the plane where s cannot be distinguished from 0."""
    s, variance = float(minimum.state[2]), float(minimum.covariance[2, 2])
    sigma = math.sqrt(variance)
    if s < MERGED_SIGMAS * sigma:
        state, covariance = minimum.state.copy(), minimum.covariance.copy()
        state[2] = covariance[2, :2] = covariance[:2, 2] = 0.0
        covariance[2, 2] = mean_if_positive(s, sigma)
        return [replace(minimum, state=state, covariance=covariance)]
    images = []
    for w in (math.sqrt(s), -math.sqrt(s)):
        state, scale = minimum.state.copy(), np.array([1.0, 1.0, 0.5 / w])
        state[2] = w
        images.append(replace(minimum, state=state, covariance=minimum.covariance * scale * scale[:, None]))
    return images


def mean_if_positive(mean: float, sigma: float) -> float:
    """Mean of a normal variable given that it is positive: E[w²], where w² was measured and may be near 0."""
    z = mean / sigma
    if z < -30.0:  # the first terms of Mills' ratio, before density and tail underflow
        return sigma / -z * (1.0 - 2.0 / (z * z))
    density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return mean + sigma * density / (0.5 * math.erfc(-z / math.sqrt(2.0)))


# Inverses of normal matrices


# An unknown whose variance the others inflate by more is not determined: the difference is rounding noise.
MAX_INFLATION: Final = 1e12

_RIDGE: Final = 1e-14
"""Part of the diagonal that is added to it, so that LAPACK meets no matrix that is exactly singular."""


def inverse_of(normal: Array) -> Array:
    """Inverses of symmetric matrices (..., k, k); all elements are infinite where one is singular or not finite.

    Rows and columns are divided by the roots of the diagonal first, so that units do not count.
    """
    diagonal = np.diagonal(normal, axis1=-2, axis2=-1)
    size = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scale = size[..., :, None] * size[..., None, :]
    one = normal / scale
    finite = np.isfinite(one).all(axis=(-2, -1), keepdims=True)
    identity = np.eye(normal.shape[-1])
    inverse = np.linalg.inv(np.where(finite, one + _RIDGE * identity, identity))
    inflation = np.diagonal(inverse, axis1=-2, axis2=-1)
    determined = np.all((inflation > 0.0) & (inflation < MAX_INFLATION), axis=-1, keepdims=True)
    sound = finite & np.expand_dims(determined, -1)
    return np.where(sound, inverse / scale, np.inf)
