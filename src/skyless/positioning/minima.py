"""The minima that a set of TDoAs has: found from several starts, told apart, and unfolded from a plane."""

import math
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.positioning.closed_form import FREE, HEIGHT, MOST_STARTS, PLANE, starting_points
from skyless.positioning.least_squares import CONVERGED, assess, minimise
from skyless.positioning.problem import Problem
from skyless.uncertainty.cholesky import factorise, solve

Array = NDArray[np.float64]

DISTINCT_CHI2: Final = 9.0
"""Two minima are distinct where one lies outside the 3-sigma ellipsoid of the other."""
MERGED_SIGMAS: Final = 2.0
"""Mirror images have merged while the square of their distance from the plane is within these sigmas of zero."""


class Minimum(Struct, frozen=True, gc=False):
    """A minimum in the local frame."""

    state: Array
    covariance: Array
    residuals: Array
    chi2: float
    cost: float
    iterations: int


def find_minima(problem: Problem) -> tuple[list[Minimum], int]:
    """All minima that are found, the best first, and how the last iteration that failed ended.

    The closed form's starts depend on the reference and miss about one rival in a hundred; the anchors' centroid
    finds most of these.
    """
    starts, work = np.empty((MOST_STARTS, 3)), np.empty((4, 4, 4))
    system = np.empty((len(problem.tdoa), 4))
    count = starting_points(problem.anchors, problem.tdoa, problem.kind, problem.height, work[0], work[1], starts)
    found: list[Minimum] = []
    status = CONVERGED
    for state in (*starts[:count], *_central(problem)):
        status = _descend(problem, state, system, work, found) or status
    found.sort(key=lambda minimum: minimum.cost)
    return found, status


def _central(problem: Problem) -> Array:
    """Starts at the anchors' centroid; where the height is unknown, half their extent off their plane."""
    starts = np.empty((2, 3))
    starts[:] = problem.anchors.mean(axis=0)
    off = 0.5 * problem.extent
    if problem.kind == FREE:
        starts[:, 2] += (off, -off)
        return starts
    starts[:, 2] = problem.height if problem.kind == HEIGHT else off * off
    return starts[:1]


def _descend(problem: Problem, state: Array, system: Array, work: Array, found: list[Minimum]) -> int:
    """Minimise from ``state`` and append what is new to ``found``; returns how the iteration ended."""
    end, iterations = minimise(
        problem.anchors, problem.tdoa, problem.kind, problem.weighted, problem.factor, problem.extent,
        state, system, work,
    )  # fmt: skip
    if end != CONVERGED or any(_same(problem, minimum.state, state) for minimum in found):
        return end
    residuals, covariance = np.empty(len(problem.tdoa)), np.empty((3, 3))
    chi2 = assess(
        problem.anchors, problem.tdoa, problem.kind, problem.weighted, problem.factor, problem.covariance,
        state, system, work, residuals, covariance,
    )  # fmt: skip
    if chi2 >= 0.0:
        cost = chi2 if problem.weighted else float(residuals @ residuals)
        found.append(Minimum(state, covariance, residuals, chi2, cost, iterations))
    return end


def _same(problem: Problem, one: Array, other: Array) -> bool:
    """Whether two iterations ended in one place; a millionth of the extent is far above their tolerance."""
    x, y, z = (one - other).tolist()
    if problem.kind == PLANE:
        z /= problem.extent
    return bool(abs(x) + abs(y) + abs(z) < 1e-6 * problem.extent)


def distinct(one: Minimum, other: Minimum) -> bool:
    """Whether either lies outside the other's error ellipsoid."""
    apart = one.state - other.state
    dims = 3 if one.covariance[2, 2] > 0.0 else 2
    for minimum in (one, other):
        factor, solved = minimum.covariance.copy(), apart.copy()
        if not factorise(factor, dims):
            return True
        solve(factor, dims, solved)
        if float(apart[:dims] @ solved[:dims]) > DISTINCT_CHI2:
            return True
    return False


def below_plane(minimum: Minimum) -> float:
    """What the constraint s ≥ 0 adds to chi2: s²/σ_s² where the square of a distance came out negative."""
    square = float(minimum.state[2])
    return square * square / float(minimum.covariance[2, 2]) if square < 0.0 else 0.0


def unfold(minimum: Minimum) -> list[Minimum]:
    """From s = w² to w: the two images, or one in the plane where s cannot be told from 0."""
    s, variance = float(minimum.state[2]), float(minimum.covariance[2, 2])
    sigma = math.sqrt(variance)
    if s < MERGED_SIGMAS * sigma:
        state, covariance = minimum.state.copy(), minimum.covariance.copy()
        state[2] = covariance[2, :2] = covariance[:2, 2] = 0.0
        covariance[2, 2] = mean_if_positive(s, sigma)
        return [_image(minimum, state, covariance)]
    images = []
    for w in (math.sqrt(s), -math.sqrt(s)):
        state, scale = minimum.state.copy(), np.array([1.0, 1.0, 0.5 / w])
        state[2] = w
        images.append(_image(minimum, state, minimum.covariance * scale * scale[:, None]))
    return images


def _image(minimum: Minimum, state: Array, covariance: Array) -> Minimum:
    return Minimum(state, covariance, minimum.residuals, minimum.chi2, minimum.cost, minimum.iterations)


def mean_if_positive(mean: float, sigma: float) -> float:
    """Mean of a normal variable given that it is positive: E[w²], where w² was measured and may be near 0."""
    z = mean / sigma
    if z < -30.0:  # the first terms of Mills' ratio, before density and tail underflow
        return sigma / -z * (1.0 - 2.0 / (z * z))
    density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return mean + sigma * density / (0.5 * math.erfc(-z / math.sqrt(2.0)))
