"""Other results close to one: with an anchor elsewhere, with a few more ranges left out, with a part mirrored.

They serve twice: a robust fit improves until none of them is better, and those that are nearly as good make it
ambiguous.
"""

from itertools import combinations
from typing import Final

import numpy as np

from skyless.kernels.arrays import Array, Integers, Mask
from skyless.survey.fit.links import adjacency
from skyless.survey.fit.problem import Problem, Solution, unit_vectors

_MOST_NEIGHBOURS: Final = 12
"""Whose ranges give an anchor's other positions."""

_MOST_RELOCATIONS: Final = 3
"""Of one anchor."""

_LOOSE_STD_M: Final = 0.05
"""That is added to a range's while all other anchors stay."""

_LOOSE_COST: Final = 40.0
"""By which a relocation may be worse while all other anchors stay."""

_APART_M: Final = 0.25
"""Positions of an anchor that differ by less are the same: leaving ranges out leads from one to the other."""

_LEAST_LATE: Final = 1.5
"""Standard deviations by which a range is late if it is left out, by a linear prediction that errs."""

_LEAST_MOTION_M: Final = 0.03
"""That leaving ranges out must cause, by the same prediction."""

_UNCONTROLLED: Final = 0.02
"""A share of redundancy below which ranges are not checked by others."""

_LEAST_REFITS: Final = 10
_MOST_REFITS: Final = 600
_REFIT_WORK: Final = 6e5
"""Refits times squared unknowns."""


def relocated(problem: Problem, position_m: Array, delay_m: Array) -> Array:
    """Starts with one anchor where circles (spheres) of two (three) of its ranges meet, shape (b, n, 3)."""
    axes = np.flatnonzero(problem.is_free.all(axis=0))
    found: list[tuple[float, int, Array]] = []
    for anchor in range(len(position_m)):
        for worse, other_m in _other_positions(problem, position_m, delay_m, anchor, axes):
            found.append((worse, anchor, other_m))
    found.sort(key=lambda item: item[:2])
    unknowns = int(np.count_nonzero(problem.is_free)) + len(position_m)
    starts = []
    for _, anchor, other_m in found[: _most_refits(unknowns)]:
        start_m = position_m.copy()
        start_m[anchor] = other_m
        starts.append(start_m)
    return np.array(starts).reshape(-1, *position_m.shape)


def _most_refits(unknowns: int) -> int:
    """As many as large sites allow in little time."""
    return int(np.clip(_REFIT_WORK / unknowns**2, _LEAST_REFITS, _MOST_REFITS))


def _other_positions(
    problem: Problem, position_m: Array, delay_m: Array, anchor: int, axes: Integers
) -> list[tuple[float, Array]]:
    """Where one anchor may be as well, the best first, while all others stay; and by how much worse that fits."""
    own = np.flatnonzero((problem.first == anchor) | (problem.second == anchor))
    neighbour = problem.first[own] + problem.second[own] - anchor
    if len(own) < len(axes) or len(axes) < 2:
        return []
    length_m = problem.range_m[own] - delay_m[neighbour] - delay_m[anchor]
    others = np.setdiff1d(np.arange(3), axes)
    across = np.sum((position_m[neighbour][:, others] - position_m[anchor, others]) ** 2, axis=1)
    along_m = np.sqrt(np.maximum(length_m**2 - across, 0.0))
    chosen = np.unique(np.linspace(0, len(own) - 1, min(len(own), _MOST_NEIGHBOURS)).astype(np.int64))
    sets = np.array(list(combinations(chosen, len(axes))))
    meeting_m = _meeting_points(position_m[neighbour][:, axes][sets], along_m[sets])
    candidate_m = np.tile(position_m[anchor], (len(meeting_m) + 1, 1))
    candidate_m[1:, axes] = meeting_m
    distance = np.linalg.norm(candidate_m[:, None] - position_m[neighbour], axis=2)
    variance = problem.variance_m2[own] + _LOOSE_STD_M**2 + np.minimum(problem.delay_variance_m2[anchor], 0.1**2)
    residual_m = length_m - distance
    cutoff = np.where(residual_m > 0.0, 9.0, 36.0)
    known = np.where(problem.is_free[anchor], candidate_m - np.nan_to_num(problem.coordinate_m[anchor]), 0.0)
    cost = np.minimum(residual_m**2 / variance, cutoff).sum(axis=1)
    cost = cost + np.sum(known**2 / np.maximum(problem.coordinate_variance_m2[anchor], 1e-10), axis=1)
    kept, worse = [position_m[anchor]], [0.0]
    for index in np.argsort(cost, kind="stable"):
        if cost[index] > cost[0] + _LOOSE_COST or len(kept) > _MOST_RELOCATIONS:
            break
        if np.linalg.norm(np.array(kept) - candidate_m[index], axis=1).min() > _APART_M:
            kept.append(candidate_m[index])
            worse.append(float(cost[index] - cost[0]))
    return list(zip(worse, kept, strict=True))[1:]


def _meeting_points(centre_m: Array, radius_m: Array) -> Array:
    """Both points where circles, or spheres, meet: centres (c, d, d), radii (c, d); shape (2 c, d)."""
    origin_m, side_m = centre_m[:, 0], centre_m[:, 1:] - centre_m[:, :1]
    right = 0.5 * (radius_m[:, :1] ** 2 - radius_m[:, 1:] ** 2 + np.sum(side_m**2, axis=2))
    foot_m = np.einsum("cij,cj->ci", np.linalg.pinv(side_m, rcond=1e-6), right)
    if side_m.shape[2] == 2:
        normal = np.stack([-side_m[:, 0, 1], side_m[:, 0, 0]], axis=1)
    else:
        normal = np.cross(side_m[:, 0], side_m[:, 1])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-9)[:, None]
    height_m = np.sqrt(np.maximum(radius_m[:, 0] ** 2 - np.sum(foot_m**2, axis=1), 0.0))[:, None]
    return np.concatenate([origin_m + foot_m + height_m * normal, origin_m + foot_m - height_m * normal])


def without_ranges(problem: Problem, solution: Solution, used: Mask) -> Mask:
    """Sets of used ranges with one or two fewer that would then be late and let anchors move, shape (b, m).

    What leaving out would do is predicted with the equations of the solution, so that only few sets need a refit.
    """
    in_use = np.flatnonzero(used)
    if not in_use.size:
        return np.zeros((0, len(used)), dtype=np.bool_)
    std_m = np.sqrt(problem.variance_m2[in_use])
    derivative = derivatives(problem, solution, in_use) / std_m[:, None]
    influence = np.linalg.solve(regular(solution.information), derivative.T)
    redundancy = np.eye(len(in_use)) - derivative @ influence
    residual = solution.residual_m[in_use] / std_m
    own = np.maximum(np.diag(redundancy), 1e-6)
    # Residuals of two ranges predicted without these, from the inverse of their part of the redundancy.
    determinant = own[:, None] * own - redundancy**2
    np.fill_diagonal(determinant, 1.0)
    safe = np.maximum(determinant, 1e-6)
    first = (own[None, :] * residual[:, None] - redundancy * residual[None, :]) / safe
    np.fill_diagonal(first, residual / own)
    second = first.T
    free = determinant < _UNCONTROLLED
    np.fill_diagonal(free, own < _UNCONTROLLED)
    late = np.minimum(first, second) > _LEAST_LATE
    rows, columns = np.nonzero(np.triu(late | free))
    gain = first[rows, columns] * residual[rows]
    gain += np.where(rows == columns, 0.0, second[rows, columns] * residual[columns])
    order = np.argsort(9.0 * (1.0 + (rows != columns)) - gain, kind="stable")[:20_000]
    rows, columns = rows[order], columns[order]
    change = influence[:, rows] * first[rows, columns] + np.where(
        rows == columns, 0.0, influence[:, columns] * second[rows, columns]
    )
    coordinates = np.count_nonzero(problem.is_free)
    motion = np.abs(change[:coordinates]).max(axis=0, initial=0.0)
    moves = (motion > _LEAST_MOTION_M) | free[rows, columns]
    most = _most_refits(len(solution.information))
    rows, columns = rows[moves][:most], columns[moves][:most]
    sets = np.tile(used, (len(rows), 1))
    sets[np.arange(len(rows)), in_use[rows]] = False
    sets[np.arange(len(rows)), in_use[columns]] = False
    return sets


def derivatives(problem: Problem, solution: Solution, ranges: Integers) -> Array:
    """Of modelled ranges by the unknowns, shape (ranges, u)."""
    n = len(problem.delay_m)
    first, second, row = problem.first[ranges], problem.second[ranges], np.arange(len(ranges))
    unit = unit_vectors(solution.position_m, first, second)
    whole = np.zeros((len(ranges), n, 4))
    whole[row, first, :3] = unit
    whole[row, second, :3] = -unit
    whole[row, first, 3] = 1.0
    whole[row, second, 3] = 1.0
    coordinates = whole[:, :, :3].reshape(len(ranges), 3 * n)[:, problem.is_free.ravel()]
    return np.concatenate([coordinates, whole[:, :, 3]], axis=1)


def regular(information: Array) -> Array:
    """With a little of information on everything, a hundredth of a metre's, so that it can be inverted."""
    return np.asarray(information + 1e-4 * np.eye(len(information)))


def mirrored(problem: Problem, position_m: Array) -> Array:
    """Starts with parts reflected in the line (plane) through the two (three) anchors they hang on, shape (b, n, 3).

    Single anchors are among those of ``relocated``.
    """
    axes = np.flatnonzero(problem.is_free.all(axis=0))
    n = len(position_m)
    joined = adjacency(n, problem.first, problem.second) | adjacency(n, problem.tape_first, problem.tape_second)
    starts = []
    for part in _hanging_parts(joined, len(axes)):
        hinge = joined[part].any(axis=0) & ~part
        start_m = position_m.copy()
        start_m[np.ix_(part, axes)] = _reflection(position_m[part][:, axes], position_m[hinge][:, axes])
        starts.append(start_m)
    return np.array(starts).reshape(-1, n, 3)


def _hanging_parts(joined: Mask, dimensions: int) -> list[Mask]:
    """Pairs of anchors that hang on no more others than there are dimensions; each shape (n,)."""
    n = len(joined)
    parts = []
    for pair in combinations(range(n), 2):
        part = np.isin(np.arange(n), pair)
        if np.count_nonzero(joined[part].any(axis=0) & ~part) <= dimensions < n - 2:
            parts.append(part)
    return parts


def _reflection(position_m: Array, hinge_m: Array) -> Array:
    """Positions, shape (k, d), reflected in the line or plane that fits the hinge best, shape (h, d)."""
    if not len(hinge_m):
        return position_m
    centre = hinge_m.mean(axis=0)
    normal = np.linalg.svd(np.concatenate([hinge_m - centre, np.zeros(position_m.shape[1:])[None]]))[2][-1]
    return np.asarray(position_m - 2.0 * np.outer((position_m - centre) @ normal, normal))
