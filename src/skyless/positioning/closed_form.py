"""Positions from TDoAs without an initial guess: the algebra that starts the iterations of the solver.

With the reference anchor at the origin, x the tag, ρ = |x| its distance from there, and the measured
d_i = |x − a_i| − ρ, squaring ρ + d_i = |x − a_i| leaves equations that are linear in x and ρ:

    a_iᵀx + d_i·ρ = (|a_i|² − d_i²)/2

*Spherical intersection* solves them for x as a function of ρ, and |x|² = ρ² is then a quadratic with two roots;
*spherical interpolation* takes ρ as one more unknown (H. C. Schau and A. Z. Robinson 1987; J. O. Smith and
J. S. Abel 1987). Anchors in one plane say nothing of the coordinate w across it except w² = ρ² − x² − y².
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyless.compiled import kernel, part
from skyless.uncertainty.cholesky import factorise, solve

FREE: Final = 0
"""Kind of problem: the state is (x, y, z)."""
HEIGHT: Final = 1
"""The state is (x, y); its third element is the given height."""
PLANE: Final = 2
"""All anchors have z = 0; the state is (x, y, s) with s = z², negative where noise makes it so."""

MOST_STARTS: Final = 6


@kernel
def spread(points: NDArray[np.float64], axes: NDArray[np.float64]) -> tuple[float, float, float]:
    """Extent, width and thickness of ``points``, shape (n, 3), about the first one, which is the origin.

    Writes an orthonormal frame into the rows of ``axes``, shape (3, 3): along the farthest point, towards the
    point farthest from that line, and across both. Where the points are in one line, only the first row is
    set and width is 0.
    """
    extent, width = 0.0, 0.0
    for row in range(2):
        extent, width = width, _farthest(points, axes, row)
    if not width > 1e-9 * extent:
        return extent, 0.0, 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        axes[2, i] = axes[0, j] * axes[1, k] - axes[0, k] * axes[1, j]
    thickness = 0.0
    for i in range(len(points)):
        across = points[i, 0] * axes[2, 0] + points[i, 1] * axes[2, 1] + points[i, 2] * axes[2, 2]
        thickness = max(thickness, abs(across))
    return extent, width, thickness


@kernel
def _farthest(points: NDArray[np.float64], axes: NDArray[np.float64], row: int) -> float:
    """Set ``axes[row]`` towards the point farthest from the span of the ``row`` axes before it (0 or 1)."""
    longest = 0.0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if row == 1:
            along = x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2]
            x, y, z = x - along * axes[0, 0], y - along * axes[0, 1], z - along * axes[0, 2]
        length = math.sqrt(x * x + y * y + z * z)
        if length > longest:
            longest = length
            axes[row, 0], axes[row, 1], axes[row, 2] = x / length, y / length, z / length
    return longest


@kernel
def starting_points(
    anchors: NDArray[np.float64],
    tdoa: NDArray[np.float64],
    kind: int,
    height: float,
    normal: NDArray[np.float64],
    solution: NDArray[np.float64],
    starts: NDArray[np.float64],
) -> int:
    """Write states to start from into ``starts``, shape (MOST_STARTS, 3); returns their number.

    ``anchors``, shape (n + 1, 3), has the reference at the origin (and, unless the height is given, the axes of
    ``spread``); ``normal`` (4, 4) and ``solution`` (2, 4) are scratch. The equations are not weighted.
    """
    dims = 3 if kind == FREE else 2
    count = 0
    if kind != PLANE:
        count = _intersections(anchors, tdoa, dims, height, normal, solution, starts)
    if len(tdoa) > dims and _interpolation(anchors, tdoa, dims, height, normal, solution[0]):
        for axis in range(3):
            starts[count, axis] = solution[0, axis]
        if kind == HEIGHT:
            starts[count, 2] = height
        elif kind == PLANE:
            starts[count, 2] = _square_across(solution[0])
        count += 1
    if kind == FREE and _interpolation(anchors, tdoa, dims - 1, 0.0, normal, solution[0]):
        across = math.sqrt(max(_square_across(solution[0]), 0.0))
        for sign in (1.0, -1.0):
            starts[count, 0], starts[count, 1] = solution[0, 0], solution[0, 1]
            starts[count, 2] = sign * across
            count += 1
    return count


@part
def _square_across(solution: NDArray[np.float64]) -> float:
    """The square of the coordinate across the plane, from (x, y, ρ)."""
    return float(solution[2] * solution[2] - solution[0] * solution[0] - solution[1] * solution[1])


@part
def _right_hand_side(anchor: NDArray[np.float64], tdoa: float, dims: int, height: float) -> float:
    square = anchor[0] * anchor[0] + anchor[1] * anchor[1] + anchor[2] * anchor[2]
    known = anchor[2] * height if dims == 2 else 0.0
    return float(0.5 * (square - tdoa * tdoa) - known)


@kernel
def _interpolation(
    anchors: NDArray[np.float64],
    tdoa: NDArray[np.float64],
    dims: int,
    height: float,
    normal: NDArray[np.float64],
    solution: NDArray[np.float64],
) -> bool:
    """Least squares for the first ``dims`` coordinates and ρ; False where they are not determined."""
    normal[:] = 0.0
    solution[:] = 0.0
    for i in range(1, len(anchors)):
        known = _right_hand_side(anchors[i], tdoa[i - 1], dims, height)
        for j in range(dims + 1):
            left = anchors[i, j] if j < dims else tdoa[i - 1]
            solution[j] += left * known
            for k in range(j + 1):
                normal[j, k] += left * (anchors[i, k] if k < dims else tdoa[i - 1])
    if not factorise(normal, dims + 1):
        return False
    solve(normal, dims + 1, solution)
    return True


@kernel
def _intersections(
    anchors: NDArray[np.float64],
    tdoa: NDArray[np.float64],
    dims: int,
    height: float,
    normal: NDArray[np.float64],
    solution: NDArray[np.float64],
    starts: NDArray[np.float64],
) -> int:
    """Write the points x = u − v·ρ for each non-negative root ρ of |x|² = ρ²; returns their number.

    Where noise leaves no real root, the vertex of the parabola is taken.
    """
    normal[:] = 0.0
    solution[:] = 0.0
    for i in range(1, len(anchors)):
        known = _right_hand_side(anchors[i], tdoa[i - 1], dims, height)
        for j in range(dims):
            solution[0, j] += anchors[i, j] * known
            solution[1, j] += anchors[i, j] * tdoa[i - 1]
            for k in range(j + 1):
                normal[j, k] += anchors[i, j] * anchors[i, k]
    if not factorise(normal, dims):
        return 0
    u, v = solution[0], solution[1]
    solve(normal, dims, u)
    solve(normal, dims, v)
    a, half_b = -1.0, 0.0
    c = height * height if dims == 2 else 0.0
    for j in range(dims):
        a += v[j] * v[j]
        half_b -= u[j] * v[j]
        c += u[j] * u[j]
    count = 0
    for first in (True, False):
        root = _root(a, half_b, c, first)
        if root >= 0.0:
            starts[count, 2] = height
            for j in range(dims):
                starts[count, j] = u[j] - v[j] * root
            count += 1
    return count


@part
def _root(a: float, half_b: float, c: float, first: bool) -> float:
    """One of the roots of a·ρ² + 2·half_b·ρ + c, in the form that does not cancel; −1 where there is none."""
    discriminant = half_b * half_b - a * c
    if discriminant < 0.0:
        return -half_b / a if first else -1.0
    larger = -(half_b + math.copysign(math.sqrt(discriminant), half_b))
    if first:
        return larger / a if a != 0.0 else -1.0
    return c / larger if larger != 0.0 else -1.0
