"""What the measurements determine: information, covariance after the best rigid alignment, and what has none.

A survey knows positions up to a rigid motion, so a covariance needs a set of anchors, the core, over which results are
aligned. An anchor whose standard deviation remains above ``most_std_m`` leaves the core; it is not determined.
"""

from typing import Final

import numpy as np
from msgspec import Struct, structs

from skyless.kernels.arrays import Array, Integers, Mask
from skyless.survey.fit.problem import Problem, delay_weights, residuals_m, solve_least_squares, unit_vectors

_MOST_STD_M: Final = 0.25
_MOST_RANGE_STDS: Final = 4.0
"""Standard deviation per axis above which an anchor is not determined, in metres and in those of a range."""

TOUCHED: Final = 0.3
"""Part of a direction's largest component from which on it touches an anchor."""

_LEAST_STD_M: Final = 1e-5
_UNKNOWN_STD_M: Final = 30.0
"""What an unknown that nothing determines is given, so that matrices stay regular."""

_SAME: Final = 1e-9
_BARRIER: Final = 4.0
"""Increase of the cost that separates two shapes."""

_NEARLY_FLAT: Final = 0.3
"""Extent across, as a part of the extent along, below which a shape may be flat."""

_FLAT_BARRIER: Final = 11.0
"""Increase of the cost (3.3 σ) by which a flat shape must fit worse for the extent across to be real."""


def most_std_m(problem: Problem) -> float:
    """Standard deviation per axis above which an anchor is not determined.

    Where ranges are poor, so are positions, and poor ones with an honest error are of use: what counts there is that
    the ranges hold an anchor from all sides, and that not a few ranges' errors add up along one direction.
    """
    if not len(problem.variance_m2):
        return _MOST_STD_M
    return max(_MOST_STD_M, _MOST_RANGE_STDS * float(np.sqrt(np.median(problem.variance_m2))))


class Direction(Struct, frozen=True, eq=False):
    """A joint change of positions and delays that is poorly determined."""

    std_m: float
    """Of the anchor that moves most."""
    shift_m: Array
    """Shape (n, 3), of positions; the anchor that moves most moves by 1 m."""
    delay_m: Array
    """Shape (n,): what delays change at the same time."""

    @property
    def anchors(self) -> Mask:
        """Shape (n,): those that it touches."""
        length = np.linalg.norm(self.shift_m, axis=1)
        return np.asarray(length > TOUCHED * length.max(initial=0.0))


def jacobian(problem: Problem, position_m: Array, weight: Array | None = None) -> Array:
    """Weighted derivatives of ranges, tapes, delay priors and coordinate priors, shape (rows, 4 n).

    Columns: coordinates anchor by anchor, then delays; those of coordinates that are not estimated are 0.
    ``weight``: of each range, shape (m,), multiplies 1/variance.
    """
    n, m, t = len(position_m), len(problem.range_m), len(problem.tape_m)
    of_range = np.sqrt((1.0 if weight is None else weight) / problem.variance_m2)
    of_tape = 1.0 / np.sqrt(np.maximum(problem.tape_variance_m2, _LEAST_STD_M**2))
    of_coordinate = 1.0 / np.sqrt(np.maximum(problem.coordinate_variance_m2, _LEAST_STD_M**2)).ravel()
    known = np.flatnonzero((of_coordinate > 0.0) & problem.is_free.ravel())
    rows = np.zeros((m + t + n + len(known), 4 * n))
    number = np.arange(m + t)
    first = np.concatenate([problem.first, problem.tape_first])
    second = np.concatenate([problem.second, problem.tape_second])
    unit = unit_vectors(position_m, first, second)
    factor = np.concatenate([of_range, of_tape])
    for axis in range(3):
        rows[number, 3 * first + axis] = factor * unit[:, axis]
        rows[number, 3 * second + axis] = -factor * unit[:, axis]
    rows[number[:m], 3 * n + problem.first] = of_range
    rows[number[:m], 3 * n + problem.second] = of_range
    rows[m + t : m + t + n, 3 * n :] = delay_weights(problem)
    rows[m + t + n + np.arange(len(known)), known] = of_coordinate[known]
    rows = np.vstack([rows, *(more.rows(position_m, problem.delay_m)[0] for more in problem.more)])
    rows[:, : 3 * n] *= problem.is_free.ravel()
    return rows


def rank(rows: Array) -> int:
    """Of a Jacobian; columns may have different scales."""
    squares = rows.T @ rows
    scale = np.sqrt(np.diag(squares))
    kept = scale > 0.0
    scaled = squares[np.ix_(kept, kept)] / np.outer(scale[kept], scale[kept])
    return int(np.count_nonzero(np.linalg.eigvalsh(scaled) > _SAME)) if kept.any() else 0


def aligned_covariance(problem: Problem, rows: Array, position_m: Array, core: Mask) -> Array:
    """Covariance of coordinates and delays after the best rigid alignment over the core, shape (4 n, 4 n).

    Rows of coordinates that are not estimated are 0; what nothing determines has a standard deviation of some 30 m.
    """
    used = np.flatnonzero(np.concatenate([problem.is_free.ravel(), np.ones(len(position_m), bool)]))
    information = rows[:, used].T @ rows[:, used]
    inside = np.concatenate([np.repeat(core, 3) & problem.is_free.ravel(), np.zeros(len(position_m), bool)])[used]
    motion = _rigid_motions(problem, position_m, inside, used)
    count, size = motion.shape[1], int(inside.sum())
    basis = np.zeros((len(used), len(used) - count))
    if count:
        complete = np.linalg.qr(motion[inside], mode="complete")[0]
        basis[inside, : size - count] = complete[:, count:]
    else:
        basis[inside, :size] = np.eye(size)
    basis[~inside, size - count :] = np.eye(len(used) - size)
    slight = 1.0 / _UNKNOWN_STD_M**2
    reduced = basis.T @ information @ basis
    if count:
        along = motion.T @ information @ motion + slight * np.eye(count)
        across = basis.T @ information @ motion
        reduced -= across @ np.linalg.solve(along, across.T)
    reduced[np.diag_indices_from(reduced)] += slight
    scale = 1.0 / np.sqrt(np.diag(reduced))
    inverse = np.linalg.inv(reduced * np.outer(scale, scale)) * np.outer(scale, scale)
    covariance = np.zeros((4 * len(position_m), 4 * len(position_m)))
    covariance[np.ix_(used, used)] = basis @ (0.5 * (inverse + inverse.T)) @ basis.T
    return covariance


def position_stds_m(problem: Problem, covariance_m2: Array) -> Array:
    """Standard deviation of each anchor per axis, rms over the axes that were estimated, shape (n,)."""
    n = len(problem.is_free)
    variance = np.diag(covariance_m2)[: 3 * n].reshape(n, 3)
    free = problem.is_free.sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance.sum(axis=1), 0.0) / np.maximum(free, 1)))


def determined_core(problem: Problem, rows: Array, position_m: Array, least: int) -> Mask:
    """Anchors that have a standard deviation of at most ``most_std_m`` when aligned over themselves, shape (n,).

    None, where fewer than ``least`` remain.
    """
    core, most_m = np.ones(len(position_m), bool), most_std_m(problem)
    while core.sum() >= least:
        std = position_stds_m(problem, aligned_covariance(problem, rows, position_m, core))
        worst = float(std[core].max())
        if worst <= most_m:
            joins = ~core & (std <= most_m)
            if joins.any():
                core = core | joins
                std = position_stds_m(problem, aligned_covariance(problem, rows, position_m, core))
                core = core & (std <= most_m)
            return core
        # All that are equally uncertain leave at once, so that no order of anchors decides.
        core &= std < worst * (1.0 - 1e-6)
    return np.zeros(len(position_m), bool)


def weak_directions(
    problem: Problem, covariance_m2: Array, core: Mask, least_std_m: float, most: int
) -> list[Direction]:
    """The least determined directions of the core's positions that move an anchor by ``least_std_m`` or more (1 σ)."""
    n = len(problem.is_free)
    chosen = np.flatnonzero(np.repeat(core, 3) & problem.is_free.ravel())
    if not chosen.size:
        return []
    values, vectors = np.linalg.eigh(covariance_m2[np.ix_(chosen, chosen)])
    found = []
    for value, vector in list(zip(values, vectors.T, strict=True))[: -most - 1 : -1]:
        if value <= 0.0:
            break
        change = covariance_m2[:, chosen] @ vector / value
        shift = np.where(core[:, None], change[: 3 * n].reshape(n, 3), 0.0)
        largest = float(np.linalg.norm(shift, axis=1).max())
        if largest * float(np.sqrt(value)) < least_std_m:
            continue
        found.append(Direction(largest * float(np.sqrt(value)), shift / largest, change[3 * n :] / largest))
    return found


def folds(problem: Problem, position_m: Array, delay_m: Array, weight: Array, direction: Direction) -> bool:
    """Whether the shape can be moved by twice ``most_std_m`` along a direction without ranges that contradict."""
    start = cost(problem, position_m, delay_m, weight)
    for sign in (1.0, -1.0):
        for step in np.arange(0.05, 2.0 * most_std_m(problem) + 0.01, 0.05):
            moved = position_m + sign * step * direction.shift_m
            if cost(problem, moved, delay_m + sign * step * direction.delay_m, weight) > start + _BARRIER:
                break
        else:
            return True
    return False


def may_be_flat(problem: Problem, position_m: Array, delay_m: Array, weight: Array, axes: int) -> bool:
    """Whether all anchors may stand on one line (``axes`` 2, seen from above) or in one plane (3).

    Anchors on a line have no first-order hold across it; their ranges' errors put them next to the line, where they
    seem to have one. So the anchors are fitted on the line, which must fit worse.
    """
    if np.isfinite(problem.coordinate_variance_m2[:, :axes]).any() or len(position_m) < 2:
        return False
    centred = position_m[:, :axes] - position_m[:, :axes].mean(axis=0)
    _, extent, directions = np.linalg.svd(centred, full_matrices=False)
    if len(extent) == axes and extent[-1] > _NEARLY_FLAT * extent[0]:
        return False
    flat_m = position_m.copy()
    flat_m[:, :axes] = 0.0
    flat_m[:, : axes - 1] = centred @ directions[: axes - 1].T
    is_free = problem.is_free.copy()
    is_free[:, axes - 1] = False
    flat = structs.replace(problem, is_free=is_free, coordinate_m=np.where(is_free, problem.coordinate_m, flat_m))
    found = solve_least_squares(flat, flat_m, weight)
    return cost(flat, found.position_m, found.delay_m, weight) < (
        cost(problem, position_m, delay_m, weight) + _FLAT_BARRIER
    )


def cost(problem: Problem, position_m: Array, delay_m: Array, weight: Array) -> float:
    """Sum of the weighted squares of ranges, tapes and priors."""
    ranges = residuals_m(problem, position_m, delay_m) ** 2 * weight / problem.variance_m2
    apart = np.linalg.norm(position_m[problem.tape_first] - position_m[problem.tape_second], axis=1)
    tapes = (problem.tape_m - apart) ** 2 / np.maximum(problem.tape_variance_m2, _LEAST_STD_M**2)
    delays = (delay_weights(problem) @ (problem.delay_m - delay_m)) ** 2
    known = np.isfinite(problem.coordinate_variance_m2) & problem.is_free
    coordinates = (problem.coordinate_m - position_m)[known] ** 2
    coordinates = coordinates / np.maximum(problem.coordinate_variance_m2[known], _LEAST_STD_M**2)
    return float(ranges.sum() + tapes.sum() + delays.sum() + coordinates.sum())


def _rigid_motions(problem: Problem, position_m: Array, inside: Mask, used: Integers) -> Array:
    """Velocities of all unknowns in motions of the whole site, orthonormal over the core, shape (u, motions)."""
    n = len(position_m)
    columns = np.flatnonzero(inside)
    centre = position_m[np.unique(used[columns] // 3)].mean(axis=0) if columns.size else np.zeros(3)
    arm = position_m - centre
    motions = [np.tile(axis, (n, 1)) for axis in np.eye(3)] + [np.cross(axis, arm) for axis in np.eye(3)]
    allowed = [motion.ravel() for motion in motions if not np.abs(motion[~problem.is_free]).max(initial=0.0) > _SAME]
    whole = np.zeros((len(used), len(allowed)))
    for column, motion in enumerate(allowed):
        whole[:, column] = np.concatenate([motion, np.zeros(n)])[used]
    if not allowed or not columns.size:
        return np.zeros((len(used), 0))
    _, size, right = np.linalg.svd(whole[inside], full_matrices=False)
    kept = size > 1e-6 * size.max()
    return np.asarray(whole @ (right[kept].T / size[kept]))
