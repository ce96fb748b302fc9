"""Unknowns, rows and least squares of a survey: a range of a pair is ``d + h_a + h_b`` (``docs/survey.md``).

Positions are only known up to a rigid motion here, unless facts name coordinates: steps have minimum norm, so that a
solution stays where its start was (a free network).
"""

from typing import Final, Protocol

import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Array, Integers, Mask

_LEAST_STD_M: Final = 1e-5
"""Of any prior, so that facts without error do not make the equations singular."""

_MOST_STEPS: Final = 60
_SMALLEST_STEP_M: Final = 1e-7
_LEAST_DAMPING: Final = 1e-9


class MoreRows(Protocol):
    """What else constrains positions and delays, such as a tag's receptions."""

    def rows(self, position_m: Array, delay_m: Array) -> tuple[Array, Array]:
        """Weighted Jacobian, shape (r, 4n): coordinates anchor by anchor, then delays; weighted residuals, (r,)."""
        ...


class Problem(Struct, frozen=True, eq=False):
    """What is fitted. ``n`` anchors, ``m`` ranges, ``t`` tapes."""

    is_free: Mask
    """Shape (n, 3): coordinates that are estimated; the others stay as in the start."""
    first: Integers
    second: Integers
    """Shape (m,): indices of the anchors of each range."""
    range_m: Array
    """Shape (m,)."""
    variance_m2: Array
    """Shape (m,): of each range, noise and constant error of the pair together."""
    delay_m: Array
    delay_variance_m2: Array
    """Shape (n,): expected delays h."""
    coordinate_m: Array
    coordinate_variance_m2: Array
    """Shape (n, 3): known coordinates; infinite variance for none."""
    tape_first: Integers
    tape_second: Integers
    tape_m: Array
    tape_variance_m2: Array
    """Shape (t,)."""
    more: tuple[MoreRows, ...] = ()


class Solution(Struct, frozen=True, eq=False):
    """Positions and delays, with the information matrix of their unknowns."""

    position_m: Array
    """Shape (n, 3)."""
    delay_m: Array
    """Shape (n,)."""
    residual_m: Array
    """Shape (m,): range less distance and delays."""
    cost: float
    """Sum of all weighted squares."""
    information: Array
    """Shape (u, u), of ``unknowns(problem)`` in their order: free coordinates (anchor by anchor), then delays."""


def solve_least_squares(problem: Problem, position_m: Array, weight: Array | None = None) -> Solution:
    """Levenberg–Marquardt from a start, shape (n, 3), with delays from their expectation.

    ``weight``: of each range, shape (m,), multiplies 1/variance; by default 1.
    """
    free = np.flatnonzero(problem.is_free.ravel())
    position_m, delay_m = position_m.astype(np.float64).copy(), problem.delay_m.copy()
    root = _roots(problem, weight)
    jacobian, residual = _rows(problem, position_m, delay_m, free, root)
    cost, damping = float(residual @ residual), 1e-3
    information = jacobian.T @ jacobian
    for _ in range(_MOST_STEPS):
        gradient = jacobian.T @ residual
        scale = np.diag_indices_from(information)
        damped = information.copy()
        damped[scale] += damping * np.maximum(information[scale], 1e-6 * information[scale].max())
        step = np.linalg.solve(damped, gradient)
        trial_m = position_m.copy()
        trial_m.ravel()[free] += step[: len(free)]
        trial_delay_m = delay_m + step[len(free) :]
        trial_jacobian, trial_residual = _rows(problem, trial_m, trial_delay_m, free, root)
        trial_cost = float(trial_residual @ trial_residual)
        if trial_cost <= cost:
            position_m, delay_m, jacobian, residual = trial_m, trial_delay_m, trial_jacobian, trial_residual
            information, cost = jacobian.T @ jacobian, trial_cost
            damping = max(damping * 0.1, _LEAST_DAMPING)
            if np.abs(step).max() < _SMALLEST_STEP_M:
                break
        elif damping > 1e9:
            break
        else:
            damping *= 10.0
    return Solution(position_m, delay_m, residuals_m(problem, position_m, delay_m), cost, information)


def residuals_m(problem: Problem, position_m: Array, delay_m: Array) -> Array:
    """Ranges less distances and delays, shape (m,)."""
    apart = position_m[problem.first] - position_m[problem.second]
    distance = np.sqrt(np.einsum("ij,ij->i", apart, apart))
    return np.asarray(problem.range_m - distance - delay_m[problem.first] - delay_m[problem.second])


def _roots(problem: Problem, weight: Array | None) -> tuple[Array, Array, Array, Array]:
    """Square roots of the weights of ranges, delays, coordinates and tapes."""
    ranges = 1.0 / np.sqrt(problem.variance_m2) if weight is None else np.sqrt(weight / problem.variance_m2)
    delays = 1.0 / np.sqrt(np.maximum(problem.delay_variance_m2, _LEAST_STD_M**2))
    coordinates = 1.0 / np.sqrt(np.maximum(problem.coordinate_variance_m2, _LEAST_STD_M**2))
    return ranges, delays, coordinates, 1.0 / np.sqrt(np.maximum(problem.tape_variance_m2, _LEAST_STD_M**2))


def _rows(
    problem: Problem, position_m: Array, delay_m: Array, free: Integers, root: tuple[Array, Array, Array, Array]
) -> tuple[Array, Array]:
    """Weighted Jacobian of the modelled values and weighted residuals, measured less modelled."""
    n, m, t = len(position_m), len(problem.range_m), len(problem.tape_m)
    of_range, of_delay, of_coordinate, of_tape = root
    known = np.flatnonzero((of_coordinate.ravel() > 0.0) & problem.is_free.ravel())
    whole = np.zeros((m + t + n + len(known), 4 * n))
    residual = np.zeros(len(whole))
    row = np.arange(m + t)
    first = np.concatenate([problem.first, problem.tape_first])
    second = np.concatenate([problem.second, problem.tape_second])
    apart = position_m[first] - position_m[second]
    distance = np.sqrt(np.einsum("ij,ij->i", apart, apart))
    unit = apart / np.maximum(distance, 1e-9)[:, None]
    weight = np.concatenate([of_range, of_tape])
    for axis in range(3):
        whole[row, 3 * first + axis] = weight * unit[:, axis]
        whole[row, 3 * second + axis] = -weight * unit[:, axis]
    residual[:m] = of_range * (problem.range_m - distance[:m] - delay_m[problem.first] - delay_m[problem.second])
    residual[m : m + t] = of_tape * (problem.tape_m - distance[m:])
    row = np.arange(m)
    whole[row, 3 * n + problem.first] = of_range
    whole[row, 3 * n + problem.second] = of_range
    row = m + t + np.arange(n)
    whole[row, 3 * n + np.arange(n)] = of_delay
    residual[row] = of_delay * (problem.delay_m - delay_m)
    row = m + t + n + np.arange(len(known))
    whole[row, known] = of_coordinate.ravel()[known]
    residual[row] = of_coordinate.ravel()[known] * (problem.coordinate_m - position_m).ravel()[known]
    for more in problem.more:
        more_whole, more_residual = more.rows(position_m, delay_m)
        whole, residual = np.vstack([whole, more_whole]), np.concatenate([residual, more_residual])
    return whole[:, np.concatenate([free, 3 * n + np.arange(n)])], residual
