"""Which anchors the measurements determine, by counting and by covariance, and which tapes would help most.

A survey knows positions only up to a rigid motion, so a covariance needs a set of anchors, the core, over which results
are aligned. An anchor whose standard deviation remains above ``max_std_m`` leaves the core: it is not determined.
"""

from typing import Final

import numpy as np
from msgspec import Struct, structs
from scipy.sparse.csgraph import connected_components

from skyless.core.arrays import Array, Integers, Mask
from skyless.site.survey.problem import (
    Problem,
    adjacency,
    solve_least_squares,
    total_cost,
    unit_vectors,
    unknown_columns,
)

# Counting


class Links(Struct, frozen=True, eq=False):
    """Result of counting distances, for ``n`` anchors."""

    has_enough: Mask
    """Shape (n,): anchors of the chosen group."""
    adjacent: Mask
    """Shape (n, n): pairs with a range or a tape."""
    groups: tuple[tuple[int, ...], ...]
    """Groups that can each be laid out, as indices, the largest first."""
    needed: Integers
    """Shape (n,): distances that each anchor needs."""


def count_links(adjacent: Mask, unknown: Integers, is_known: Mask, least: int) -> Links:
    """Leave out anchors with too few distances until all that remain have enough, then choose the largest group.

    ``unknown``: number of coordinates of each anchor that are not given, shape (n,). ``is_known``: anchors whose
    positions, and so the distances between them, are given. ``least``: anchors of the smallest group that has a shape.
    No group is chosen if the second largest has more than half as many anchors as the largest.
    """
    needed = np.where(is_known, 0, unknown + 1)
    joined = (adjacent | np.outer(is_known, is_known)) & ~np.eye(len(adjacent), dtype=bool)
    active = np.ones(len(adjacent), bool)
    while active.any():
        degree = (joined & active).sum(axis=1)
        size = np.ones(len(adjacent), np.int64)
        for group in _groups(joined, active):
            size[group] = len(group)
        few = active & (degree < np.minimum(needed, size - 1))
        small = active & (size < least) & ~is_known
        if small.any():
            active &= ~small
        elif few.any():
            active &= ~(few & (degree == degree[few].min()))
        else:
            break
    groups = sorted(_groups(joined, active), key=lambda group: (-len(group), int(group[0])))
    has_enough = np.zeros(len(adjacent), bool)
    if groups and (len(groups) == 1 or 2 * len(groups[1]) <= len(groups[0])):
        has_enough[groups[0]] = True
    return Links(has_enough, adjacent, tuple(tuple(group.tolist()) for group in groups), needed)


def _groups(joined: Mask, active: Mask) -> list[Integers]:
    """Connected components of the active anchors."""
    members = np.flatnonzero(active)
    if not members.size:
        return []
    count, part = connected_components(joined[np.ix_(members, members)], directed=False)
    return [members[part == number] for number in range(count)]


# Covariance after the best rigid alignment


_MAX_STD_M: Final = 0.25
_MAX_RANGE_STDS: Final = 4.0
"""Standard deviation per axis above which an anchor is not determined, in metres and as a multiple of a range's."""

TOUCHED: Final = 0.3
"""A direction touches an anchor that moves by at least this share of the largest shift."""

_UNKNOWN_STD_M: Final = 30.0  # prior of every unknown, so that matrices stay regular
_SAME: Final = 1e-9
_BARRIER: Final = 4.0  # increase of the cost that separates two shapes
_NEARLY_FLAT: Final = 0.3  # a shape may be flat if its extent across is a smaller share of that along
_FLAT_BARRIER: Final = 11.0
"""Increase of the cost (3.3 σ) by which a flat shape must fit worse for the extent across to be real."""


def max_std_m(problem: Problem) -> float:
    """Standard deviation per axis above which an anchor is not determined.

    Poor ranges give poor positions, which are useful with an honest error. What counts then is that ranges hold an
    anchor from all sides, so that the errors of several do not add up along one direction.
    """
    if not len(problem.variance_m2):
        return _MAX_STD_M
    return max(_MAX_STD_M, _MAX_RANGE_STDS * float(np.sqrt(np.median(problem.variance_m2))))


class Direction(Struct, frozen=True, eq=False):
    """A joint change of positions and delays that is poorly determined."""

    std_m: float
    """Standard deviation of the anchor that moves most."""
    shift_m: Array
    """Shape (n, 3): change of the positions, scaled so that the largest shift is 1 m."""
    delay_m: Array
    """Shape (n,): simultaneous change of the delays."""

    @property
    def anchors(self) -> Mask:
        """The anchors that this direction touches, shape (n,)."""
        length = np.linalg.norm(self.shift_m, axis=1)
        return np.asarray(length > TOUCHED * length.max(initial=0.0))


def rank(rows: Array) -> int:
    """Rank of a Jacobian whose columns may have different scales."""
    squares = rows.T @ rows
    scale = np.sqrt(np.diag(squares))
    kept = scale > 0.0
    scaled = squares[np.ix_(kept, kept)] / np.outer(scale[kept], scale[kept])
    return int(np.count_nonzero(np.linalg.eigvalsh(scaled) > _SAME)) if kept.any() else 0


def aligned_covariance(problem: Problem, rows: Array, position_m: Array, core: Mask) -> Array:
    """Covariance of coordinates and delays after the best rigid alignment over the core, shape (4 n, 4 n).

    Rows of coordinates that are not estimated are 0; undetermined unknowns have a standard deviation of some 30 m.
    """
    used = unknown_columns(problem)
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
    """Mask of the anchors whose standard deviation is at most ``max_std_m`` when aligned over themselves, shape (n,).

    All False if fewer than ``least`` remain.
    """
    core, most_m = np.ones(len(position_m), bool), max_std_m(problem)
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
        # Equally uncertain anchors leave together, so that their order does not matter.
        core &= std < worst * (1.0 - 1e-6)
    return np.zeros(len(position_m), bool)


def weak_directions(
    problem: Problem, covariance_m2: Array, core: Mask, least_std_m: float, most: int
) -> list[Direction]:
    """The ``most`` least determined directions of the core that move an anchor by ``least_std_m`` or more (1 σ)."""
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
    """Whether the shape can move by twice ``max_std_m`` along a direction without contradicting the ranges."""
    most = total_cost(problem, position_m[None], delay_m[None], weight)[0] + _BARRIER
    for sign in (1.0, -1.0):
        step = sign * np.arange(0.05, 2.0 * max_std_m(problem) + 0.01, 0.05)
        moved_m = position_m + step[:, None, None] * direction.shift_m
        if (total_cost(problem, moved_m, delay_m + step[:, None] * direction.delay_m, weight) <= most).all():
            return True
    return False


def may_be_flat(problem: Problem, position_m: Array, delay_m: Array, weight: Array, axes: int) -> bool:
    """Whether all anchors may stand on one line (``axes`` 2, seen from above) or in one plane (3).

    Ranges do not hold anchors on a line across it to first order; range errors put the anchors beside the line, where
    ranges seem to hold them. So the anchors are also fitted exactly flat; they may be flat unless that fits worse.
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
    here, flattened = (
        total_cost(one, at_m[None], h_m[None], weight)[0]
        for one, at_m, h_m in ((problem, position_m, delay_m), (flat, found.position_m, found.delay_m))
    )
    return bool(flattened < here + _FLAT_BARRIER)


def _rigid_motions(problem: Problem, position_m: Array, inside: Mask, used: Integers) -> Array:
    """Velocities of all unknowns under rigid motions of the site, orthonormal over the core, shape (u, motions)."""
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


# Tapes


TAPE_STD_M: Final = 0.005
"""Assumed standard deviation of a distance that is yet to be measured."""

_MIN_GAIN: Final = 0.02  # share of the standard deviation that a tape must remove to be advised


_AS_GOOD: Final = 0.98
_AS_LITTLE: Final = 1.2
"""A tape is as good as the best with this share of the best gain and this multiple of the least remaining variance.

The first of several equally good tapes is chosen, so that noise does not change the choice.
"""


class TapeChoice(Struct, frozen=True, eq=False):
    """A distance to measure, by indices, and its benefit."""

    first: int
    second: int
    std_before_m: float
    std_after_m: float
    """RMS over the anchors of the core."""
    worst_after_m: float
    """Standard deviation of the least determined anchor of the core."""


def best_tapes(
    problem: Problem, position_m: Array, covariance_m2: Array, core: Mask, most: int = 3, until_m: float = 0.0
) -> list[TapeChoice]:
    """Choose the best distances one by one, until the worst standard deviation is ``until_m`` or less.

    ``covariance_m2``: after alignment over the core, shape (4 n, 4 n).
    """
    n = len(position_m)
    first, second = np.triu_indices(n, 1)
    has_tape = adjacency(n, problem.tape_first, problem.tape_second)
    usable = core[first] & core[second] & ~has_tape[first, second]
    first, second = first[usable], second[usable]
    unit = unit_vectors(position_m, first, second)
    inside = np.repeat(core, 3)
    covariance = covariance_m2.copy()
    chosen: list[TapeChoice] = []
    while first.size and len(chosen) < most:
        columns = np.zeros((len(covariance), len(first)))
        for axis in range(3):
            a, b = covariance[:, 3 * first + axis], covariance[:, 3 * second + axis]
            columns += unit[:, axis] * (a - b)
        number = np.arange(len(first))
        variance = sum(
            unit[:, axis] * (columns[3 * first + axis, number] - columns[3 * second + axis, number])
            for axis in range(3)
        )
        variance = np.maximum(variance, 0.0) + TAPE_STD_M**2
        gain = np.sum(columns[: 3 * n][inside] ** 2, axis=0) / variance
        left = max(float(np.diag(covariance)[: 3 * n][inside].sum()), 0.0) - gain
        as_good = (gain >= _AS_GOOD * gain.max()) & (left <= _AS_LITTLE * left.min() + 1e-12)
        best = int(np.flatnonzero(as_good | (gain == gain.max()))[0])
        before = _rms(position_stds_m(problem, covariance)[core])
        covariance = covariance - np.outer(columns[:, best], columns[:, best]) / variance[best]
        stds = position_stds_m(problem, covariance)[core]
        after = _rms(stds)
        if after > before * (1.0 - _MIN_GAIN):
            break
        chosen.append(TapeChoice(int(first[best]), int(second[best]), before, after, float(stds.max())))
        first, second, unit = np.delete(first, best), np.delete(second, best), np.delete(unit, best, axis=0)
        if chosen[-1].worst_after_m <= until_m:
            break
    return chosen


def mending_tapes(problem: Problem, position_m: Array, covariance_m2: Array, core: Mask) -> list[TapeChoice]:
    """The distances that would determine every anchor of the core; empty if six are not enough."""
    most_m = max_std_m(problem)
    chosen = best_tapes(problem, position_m, covariance_m2, core, most=6, until_m=most_m)
    return chosen if chosen and chosen[-1].worst_after_m <= most_m else []


def _rms(stds_m: Array) -> float:
    return float(np.sqrt(np.mean(stds_m**2))) if stds_m.size else 0.0
