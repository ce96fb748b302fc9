"""Least squares of a survey, where a pair's range is ``d + h_a + h_b`` (``docs/survey.md``).

Normal equations are summed pair by pair, for many starts and weights at once: a robust fit and the search for other
results need hundreds of small solutions.

Unless facts give coordinates, positions are determined only up to a rigid motion: steps have minimum norm, so that a
solution stays near its start (a free network).
"""

from itertools import product
from typing import Final, Protocol

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.arrays import Array, Integers, Mask

_MIN_STD_M: Final = 1e-5  # of priors, so that facts without error do not make the equations singular
_MAX_STEPS: Final = 60
_SMALLEST_STEP_M: Final = 1e-7
_MIN_DAMPING: Final = 1e-9


class MoreRows(Protocol):
    """Further constraints on positions and delays, such as a tag's receptions."""

    def rows(self, position_m: Array, delay_m: Array) -> tuple[Array, Array]:
        """Weighted Jacobian, shape (r, 4n): coordinates anchor by anchor, then delays; weighted residuals, (r,)."""
        ...


class Problem(Struct, frozen=True, eq=False):
    """A least squares problem of ``n`` anchors, ``m`` ranges and ``t`` tapes."""

    is_free: Mask
    """Shape (n, 3): coordinates to estimate; the others stay as in the start, by default ``coordinate_m``."""
    first: Integers
    second: Integers
    """Shape (m,): indices of the anchors of each range."""
    range_m: Array
    """Shape (m,)."""
    variance_m2: Array
    """Shape (m,): noise and constant error of each pair together."""
    delay_variance_m2: Array
    """Shape (n,): variance of each anchor's own part of the delay h."""
    coordinate_m: Array
    coordinate_variance_m2: Array
    """Shape (n, 3): known coordinates; infinite variance where unknown."""
    tape_first: Integers
    tape_second: Integers
    tape_m: Array
    tape_variance_m2: Array
    """Shape (t,)."""
    common_delay_m: float = 0.0
    """Standard deviation of the part of the delay that all anchors share."""
    more: tuple[MoreRows, ...] = ()
    """Costly: for a final fit, not for searches."""


class Solution(Struct, frozen=True, eq=False):
    """Fitted positions and delays, with the information matrix of the unknowns."""

    position_m: Array
    """Shape (n, 3)."""
    delay_m: Array
    """Shape (n,)."""
    residual_m: Array
    """Shape (m,): range less distance and delays."""
    cost: float
    """Sum of all weighted squares."""
    information: Array
    """Shape (u, u): free coordinates in their order (anchor by anchor), then delays."""


class Solutions(Struct, frozen=True, eq=False):
    """``b`` solutions of one problem, from different starts or with different weights."""

    position_m: Array
    """Shape (b, n, 3)."""
    delay_m: Array
    """Shape (b, n)."""
    residual_m: Array
    """Shape (b, m)."""
    cost: Array
    """Shape (b,): sum of all weighted squares."""


def solve_least_squares(problem: Problem, position_m: Array, weight: Array | None = None) -> Solution:
    """Levenberg–Marquardt from one start, shape (n, 3); delays start at 0.

    ``weight``: factor on 1/variance of each range, shape (m,), by default 1.
    """
    given = np.ones(len(problem.range_m)) if weight is None else weight
    many = solve_many(problem, position_m[None], given[None])
    information = _Equations(problem).normal(many.position_m, many.delay_m, given[None])[0][0]
    return Solution(many.position_m[0], many.delay_m[0], many.residual_m[0], float(many.cost[0]), information)


def solve_many(
    problem: Problem, position_m: Array, weight: Array, delay_m: Array | None = None, most_steps: int = _MAX_STEPS
) -> Solutions:
    """Levenberg–Marquardt from ``b`` starts, shape (b, n, 3), with weights of shape (b, m), all at once.

    ``delay_m``: starts of the delays, shape (b, n); by default 0.
    """
    equations = _Equations(problem)
    position_m = position_m.astype(np.float64).copy()
    delay_m = np.zeros(position_m.shape[:2]) if delay_m is None else delay_m.astype(np.float64).copy()
    damping = np.full(len(position_m), 1e-3)
    cost = equations.cost(position_m, delay_m, weight)
    busy = np.arange(len(position_m))
    information, gradient = equations.normal(position_m, delay_m, weight)
    for _ in range(most_steps):
        diagonal = np.einsum("bii->bi", information)
        damped = information.copy()
        floor = 1e-6 * diagonal.max(axis=1, initial=0.0)[:, None]
        np.einsum("bii->bi", damped)[:] += damping[busy, None] * np.maximum(diagonal, floor)
        step = np.asarray(np.linalg.solve(damped, gradient[:, :, None])[:, :, 0], dtype=np.float64)
        trial_m, trial_delay_m = equations.moved(position_m[busy], delay_m[busy], step)
        trial_cost = equations.cost(trial_m, trial_delay_m, weight[busy])
        better = trial_cost <= cost[busy]
        chosen = busy[better]
        position_m[chosen], delay_m[chosen], cost[chosen] = trial_m[better], trial_delay_m[better], trial_cost[better]
        ended = np.where(better, np.abs(step).max(axis=1, initial=0.0) < _SMALLEST_STEP_M, damping[busy] > 1e9)
        damping[busy] = np.where(better, np.maximum(damping[busy] * 0.1, _MIN_DAMPING), damping[busy] * 10.0)
        busy = busy[~ended]
        if not busy.size:
            break
        if better.all():
            information, gradient = equations.normal(position_m[busy], delay_m[busy], weight[busy])
        else:
            information, gradient = information[~ended], gradient[~ended]
            moved = better[~ended]
            some = busy[moved]
            if some.size:
                information[moved], gradient[moved] = equations.normal(position_m[some], delay_m[some], weight[some])
    return Solutions(position_m, delay_m, residuals_m(problem, position_m, delay_m), cost)


def delay_weights(problem: Problem) -> Array:
    """Square root of the delays' prior information, shape (n, n): weights of the delays."""
    own = 1.0 / np.sqrt(np.maximum(problem.delay_variance_m2, _MIN_STD_M**2))
    # The covariance is own² + common·commonᵀ; the root of its inverse has a closed form.
    common = own * problem.common_delay_m
    square = float(common @ common)
    share = (1.0 - 1.0 / np.sqrt(1.0 + square)) / max(square, 1e-30)
    return np.asarray((np.eye(len(own)) - share * np.outer(common, common)) * own)


def residuals_m(problem: Problem, position_m: Array, delay_m: Array) -> Array:
    """Ranges less distances and delays, shape (..., m), of positions (..., n, 3) and delays (..., n)."""
    apart = position_m[..., problem.first, :] - position_m[..., problem.second, :]
    distance = np.sqrt(np.einsum("...ij,...ij->...i", apart, apart))
    return np.asarray(problem.range_m - distance - delay_m[..., problem.first] - delay_m[..., problem.second])


def unit_vectors(position_m: Array, first: Integers, second: Integers) -> Array:
    """Unit vectors from the second to the first anchor of each pair, shape (pairs, 3); 0 where they coincide."""
    apart = position_m[first] - position_m[second]
    return np.asarray(apart / np.maximum(np.linalg.norm(apart, axis=1), 1e-9)[:, None])


def distance_derivatives(position_m: Array, first: Integers, second: Integers) -> Array:
    """Derivatives of the pairs' distances with respect to the positions, shape (pairs, n, 3)."""
    rows, number = np.zeros((len(first), *position_m.shape)), np.arange(len(first))
    unit = unit_vectors(position_m, first, second)
    rows[number, first], rows[number, second] = unit, -unit
    return rows


def incidence(n: int, first: Integers, second: Integers) -> Array:
    """Incidence matrix of pairs and n anchors, shape (pairs, n): 1 where a pair contains an anchor."""
    rows = np.zeros((len(first), n))
    number = np.arange(len(rows))
    rows[number, first] = rows[number, second] = 1.0
    return rows


def jacobian(problem: Problem, position_m: Array, weight: Array | None = None) -> Array:
    """Weighted derivatives of ranges, tapes, delay priors and coordinate priors, shape (rows, 4 n).

    Columns: coordinates anchor by anchor, then delays; 0 for coordinates that are not estimated. ``weight``: factor on
    1/variance of each range, shape (m,).
    """
    n, m, t = len(position_m), len(problem.range_m), len(problem.tape_m)
    of_range = np.sqrt((1.0 if weight is None else weight) / problem.variance_m2)
    of_tape = 1.0 / np.sqrt(np.maximum(problem.tape_variance_m2, _MIN_STD_M**2))
    of_coordinate = 1.0 / np.sqrt(np.maximum(problem.coordinate_variance_m2, _MIN_STD_M**2)).ravel()
    known = np.flatnonzero((of_coordinate > 0.0) & problem.is_free.ravel())
    rows = np.zeros((m + t + n + len(known), 4 * n))
    first = np.concatenate([problem.first, problem.tape_first])
    second = np.concatenate([problem.second, problem.tape_second])
    of_position = distance_derivatives(position_m, first, second).reshape(m + t, 3 * n)
    rows[: m + t, : 3 * n] = np.concatenate([of_range, of_tape])[:, None] * of_position
    rows[:m, 3 * n :] = of_range[:, None] * incidence(n, problem.first, problem.second)
    rows[m + t : m + t + n, 3 * n :] = delay_weights(problem)
    rows[m + t + n + np.arange(len(known)), known] = of_coordinate[known]
    rows = np.vstack([rows, *(more.rows(position_m, np.zeros(n))[0] for more in problem.more)])
    rows[:, : 3 * n] *= problem.is_free.ravel()
    return rows


def unknown_columns(problem: Problem) -> Integers:
    """Columns of a ``jacobian`` that are estimated: free coordinates, then delays."""
    n = len(problem.is_free)
    return np.concatenate([np.flatnonzero(problem.is_free.ravel()), 3 * n + np.arange(n)])


def total_cost(problem: Problem, position_m: Array, delay_m: Array, weight: Array) -> Array:
    """Weighted sum of squares of ranges, tapes and priors, shape (b,), for positions (b, n, 3) and delays (b, n).

    ``weight``: factor on 1/variance of each range, shape (m,).
    """
    equations = _Equations(replace(problem, more=()))
    return equations.cost(position_m, delay_m, np.broadcast_to(weight, (len(position_m), len(weight))))


def adjacency(n: int, first: Integers, second: Integers) -> Mask:
    """Symmetric adjacency matrix of n anchors joined by these pairs, shape (n, n)."""
    adjacent = np.zeros((n, n), bool)
    adjacent[first, second] = adjacent[second, first] = True
    return adjacent


def distances_m(position_m: Array) -> Array:
    """Distances between all positions, shape (n, n)."""
    apart = position_m[:, None] - position_m[None]
    return np.asarray(np.sqrt(np.einsum("ijk,ijk->ij", apart, apart)))


def superimposed(position_m: Array, target_m: Array, weight: Array, axes: Integers | slice) -> Array:
    """Positions rotated, shifted and possibly reflected in some axes to best fit a target (weighted Procrustes).

    ``position_m``, ``target_m``: shape (n, 3). ``weight``: of each anchor's squared distance, shape (n,), not all 0.
    """
    own, other = position_m[:, axes], target_m[:, axes]
    centre, goal = np.average(own, axis=0, weights=weight), np.average(other, axis=0, weights=weight)
    left, _, right = np.linalg.svd((weight[:, None] * (own - centre)).T @ (other - goal))
    moved_m = position_m.copy()
    moved_m[:, axes] = (own - centre) @ (left @ right) + goal
    return moved_m


class _Equations:
    """Normal equations of a problem; rows are ranges, then tapes."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        n, m, t = len(problem.is_free), len(problem.range_m), len(problem.tape_m)
        self._free = np.flatnonzero(problem.is_free.ravel())
        self._unknowns = len(self._free) + n
        self._more_columns = unknown_columns(problem)
        # Fixed coordinates use an extra last column, which is cut off again.
        column = np.full((n, 4), self._unknowns)
        flat = np.full(3 * n, self._unknowns)
        flat[self._free] = np.arange(len(self._free))
        column[:, :3] = flat.reshape(n, 3)
        column[:, 3] = len(self._free) + np.arange(n)
        self._axes = np.flatnonzero(problem.is_free.any(axis=0))
        column = column[:, [*self._axes, 3]]
        self._first = np.concatenate([problem.first, problem.tape_first])
        self._second = np.concatenate([problem.second, problem.tape_second])
        self._measured = np.concatenate([problem.range_m, problem.tape_m])
        self._has_delay = np.repeat([1.0, 0.0], [m, t])
        self._row_columns = np.concatenate([column[self._first], column[self._second]], axis=1)
        size = self._unknowns + 1
        self._cells = (self._row_columns[:, :, None] * size + self._row_columns[:, None, :]).ravel()
        self._of_range = 1.0 / problem.variance_m2
        self._of_tape = 1.0 / np.maximum(problem.tape_variance_m2, _MIN_STD_M**2)
        self._of_delay = delay_weights(problem)
        of_coordinate = 1.0 / np.maximum(problem.coordinate_variance_m2, _MIN_STD_M**2)
        self._of_coordinate = np.where(problem.is_free, of_coordinate, 0.0)
        self._coordinate_m = np.where(self._of_coordinate > 0.0, problem.coordinate_m, 0.0)

    def normal(self, position_m: Array, delay_m: Array, weight: Array) -> tuple[Array, Array]:
        """Information, shape (b, u, u), and gradient towards the minimum, shape (b, u)."""
        b, size = len(position_m), self._unknowns + 1
        apart, distance, residual = self._rows(position_m, delay_m)
        weights = self._weights(weight)
        unit = (apart / np.maximum(distance, 1e-9)[:, :, None])[:, :, self._axes]
        delays = np.broadcast_to(self._has_delay[None, :, None], (*distance.shape, 1))
        # C order, as the products below would otherwise be copied.
        derivative = np.ascontiguousarray(np.concatenate([unit, delays, -unit, delays], axis=2))
        weighted = weights[:, :, None] * derivative
        item = np.arange(b)[:, None]
        cells = (item * size**2 + self._cells).ravel()
        products = (weighted[:, :, :, None] * derivative[:, :, None, :]).ravel()
        information = np.bincount(cells, products, b * size**2).reshape(b, size, size)[:, :-1, :-1].astype(np.float64)
        columns = (item * size + self._row_columns.ravel()).ravel()
        gradient = np.bincount(columns, (weighted * residual[:, :, None]).ravel(), b * size).reshape(b, size)[:, :-1]
        from_coordinates = self._of_coordinate * (self._coordinate_m - position_m)
        of_delay = self._of_delay.T @ self._of_delay
        coordinates = len(self._free)
        np.einsum("bii->bi", information)[:, :coordinates] += self._of_coordinate.ravel()[self._free]
        information[:, coordinates:, coordinates:] += of_delay
        from_delays = -delay_m @ of_delay
        from_coordinates = from_coordinates.reshape(b, self._problem.is_free.size)[:, self._free]
        gradient = gradient + np.concatenate([from_coordinates, from_delays], axis=1)
        for one, more in product(range(b), self._problem.more):
            jacobian, residual_more = more.rows(position_m[one], delay_m[one])
            of_unknowns = jacobian[:, self._more_columns]
            information[one] += of_unknowns.T @ of_unknowns
            gradient[one] += of_unknowns.T @ residual_more
        return information, gradient

    def cost(self, position_m: Array, delay_m: Array, weight: Array) -> Array:
        """Sum of all weighted squares, shape (b,)."""
        _, _, residual = self._rows(position_m, delay_m)
        squares = np.sum(self._weights(weight) * residual**2, axis=1)
        of_delays = np.sum((delay_m @ self._of_delay.T) ** 2, axis=1)
        of_coordinates = np.sum(self._of_coordinate * (self._coordinate_m - position_m) ** 2, axis=(1, 2))
        whole = np.asarray(squares + of_delays + of_coordinates)
        for one, more in product(range(len(whole)), self._problem.more):
            _, residual_more = more.rows(position_m[one], delay_m[one])
            whole[one] += residual_more @ residual_more
        return whole

    def moved(self, position_m: Array, delay_m: Array, step: Array) -> tuple[Array, Array]:
        """Positions and delays after steps of shape (b, u)."""
        flat = position_m.reshape(len(position_m), self._problem.is_free.size).copy()
        flat[:, self._free] += step[:, : len(self._free)]
        return flat.reshape(position_m.shape), delay_m + step[:, len(self._free) :]

    def _rows(self, position_m: Array, delay_m: Array) -> tuple[Array, Array, Array]:
        """Vectors from the second to the first anchor of each row, their lengths, and the residuals."""
        apart = position_m[:, self._first] - position_m[:, self._second]
        distance = np.sqrt(np.einsum("bij,bij->bi", apart, apart))
        delays = self._has_delay * (delay_m[:, self._first] + delay_m[:, self._second])
        return apart, distance, self._measured - distance - delays

    def _weights(self, weight: Array) -> Array:
        """Weights of all rows, shape (b, m + t)."""
        of_tape = np.broadcast_to(self._of_tape, (len(weight), len(self._of_tape)))
        return np.concatenate([weight * self._of_range, of_tape], axis=1)
