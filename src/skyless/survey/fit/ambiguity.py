"""Other results that fit the ranges as well as the best one."""

from typing import Final

import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Array, Mask
from skyless.survey.fit.gauge import superimposed
from skyless.survey.fit.neighbours import mirrored
from skyless.survey.fit.problem import Problem, solve_least_squares
from skyless.survey.fit.robust import RobustFit, cut_off

_MIRROR_AS_GOOD: Final = 16.0
"""Weighted squares by which a result that uses the same ranges may fit worse."""

_OTHERS_AS_GOOD: Final = 12.0
"""And one that takes other ranges for late."""

_LATE_GAIN: Final = 16.0
"""Weighted squares that leaving ranges out must save; below, no range is late and no other result takes any for it."""

_MOVED_STDS: Final = 3.0
_MOVED_M: Final = 0.1
"""Motion of an anchor that makes two results different."""

_NO_MOTION: Final = 1e-9
"""Of a site, such as a line's around itself."""

_MOST_OTHERS: Final = 4
"""That are reported."""


class OtherFit(Struct, frozen=True, eq=False):
    """Another result that fits as well."""

    position_m: Array
    """Shape (n, 3), moved rigidly onto the best fit's."""
    used: Mask
    """Shape (m,)."""
    anchors: tuple[int, ...]
    """Indices of those that are elsewhere."""
    reason: str


def find_ambiguities(fit: RobustFit) -> tuple[OtherFit, ...]:
    """Results that fit nearly as well and have anchors elsewhere, the best first."""
    problem = fit.problem
    starts = mirrored(problem, fit.solution.position_m)
    delay_m = np.tile(fit.solution.delay_m, (len(starts), 1))
    by_mirror = cut_off(problem, starts, delay_m)
    std_m = aligned_std_m(fit)
    is_late = solve_least_squares(problem, fit.solution.position_m).cost > fit.cost + _LATE_GAIN
    others: list[tuple[float, OtherFit]] = []
    for minima in (by_mirror, fit.others):
        for index in np.flatnonzero(minima.cost < fit.cost + _MIRROR_AS_GOOD):
            same = not np.any(fit.used & ~minima.used[index])
            if not same and not (is_late and minima.cost[index] < fit.cost + _OTHERS_AS_GOOD):
                continue
            position_m = aligned_to(problem, minima.position_m[index], fit.solution.position_m)
            motion_m = np.linalg.norm(position_m - fit.solution.position_m, axis=1)
            elsewhere = np.flatnonzero((motion_m > _MOVED_M) & (motion_m > _MOVED_STDS * std_m))
            if elsewhere.size:
                used = minima.used[index]
                reason = _reason(problem, fit.used, used)
                other = OtherFit(position_m, used, tuple(elsewhere.tolist()), reason)
                others.append((float(minima.cost[index]), other))
    others.sort(key=lambda item: item[0])
    kept: list[OtherFit] = []
    for _, other in others:
        apart = [np.linalg.norm(other.position_m - known.position_m, axis=1).max() for known in kept]
        if len(kept) < _MOST_OTHERS and min(apart, default=np.inf) > _MOVED_M:
            kept.append(other)
    return tuple(kept)


def _reason(problem: Problem, used: Mask, other: Mask) -> str:
    out = np.flatnonzero(used & ~other)
    if not out.size:
        return "mirrored"
    return "other ranges late: " + ", ".join(f"{problem.first[k]}–{problem.second[k]}" for k in out)


def aligned_to(problem: Problem, position_m: Array, target_m: Array) -> Array:
    """Moved rigidly, or reflected, along the free axes so that it fits the target best; both shape (n, 3).

    Anchors that are elsewhere must not pull the others along: the alignment follows those that fit.
    """
    axes = np.flatnonzero(problem.is_free.any(axis=0))
    weight = np.ones(len(position_m))
    moved_m = position_m.copy()
    for _ in range(5):
        moved_m[:, axes] = superimposed(position_m[:, axes], target_m[:, axes], weight)
        weight = 1.0 / np.maximum(np.linalg.norm(moved_m - target_m, axis=1), 0.01)
    return moved_m


def aligned_std_m(fit: RobustFit) -> Array:
    """Of each anchor's distance from the truth, after the best rigid alignment, shape (n,)."""
    problem = fit.problem
    free = np.flatnonzero(problem.is_free.ravel())
    motions = _rigid_motions(problem, fit.solution.position_m)[free]
    direction, length, _ = np.linalg.svd(motions, full_matrices=False)
    direction = direction[:, length > _NO_MOTION * length.max(initial=0.0)]
    basis = np.zeros((len(fit.solution.information), direction.shape[1]))
    basis[: len(free)] = direction
    covariance = np.linalg.inv(fit.solution.information + basis @ basis.T + 1e-6 * np.eye(len(basis)))
    keep = np.eye(len(basis)) - basis @ basis.T
    variance = np.zeros(problem.is_free.size)
    variance[free] = np.einsum("ij,jk,ik->i", keep, covariance, keep)[: len(free)]
    return np.asarray(np.sqrt(np.maximum(variance.reshape(-1, 3).sum(axis=1), 0.0)))


def _rigid_motions(problem: Problem, position_m: Array) -> Array:
    """Small shifts and rotations along the free axes, shape (3 n, motions)."""
    axes = np.flatnonzero(problem.is_free.any(axis=0))
    centred = position_m - position_m.mean(axis=0)
    motions = []
    for axis in axes:
        shift = np.zeros_like(position_m)
        shift[:, axis] = 1.0
        motions.append(shift.ravel())
    for index, axis in enumerate(axes):
        for other in axes[index + 1 :]:
            turn = np.zeros_like(position_m)
            turn[:, axis], turn[:, other] = -centred[:, other], centred[:, axis]
            motions.append(turn.ravel())
    return np.column_stack(motions) if motions else np.zeros((position_m.size, 0))
