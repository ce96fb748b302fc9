"""A fit that is robust to late ranges, other results that fit the ranges as well, and which anchors are determined.

Radio may take a longer path, never a shorter one: a range counts as wrong if it is 3 σ longer than the positions say,
or 6 σ shorter. The cost, weighted squares cut off there, has many minima; graduated non-convexity (Yang and others,
2020) leads from plain least squares to a good one, from several starts. The best is improved until no result close to
it, with an anchor elsewhere or with one or two ranges fewer, is better. Results nearly as good make it ambiguous.

A survey knows positions only up to a rigid motion, so a covariance needs a set of anchors, the core, over which results
are aligned. An anchor whose standard deviation remains above ``max_std_m`` leaves the core: it is not determined.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import Final

import numpy as np
from msgspec import Struct, structs
from msgspec.structs import astuple, replace
from scipy.sparse.csgraph import connected_components

from skyless.core.arrays import Array, Integers, Mask
from skyless.site.survey.facts import TapeAdvice
from skyless.site.survey.problem import (
    Problem,
    Solution,
    Solutions,
    adjacency,
    jacobian,
    residuals_m,
    solve_least_squares,
    solve_many,
    superimposed,
    total_cost,
    unit_vectors,
    unknown_columns,
)

LATE_CUTOFF: Final = 3.0
EARLY_CUTOFF: Final = 6.0
"""In standard deviations of a range."""

_LATE_BEND: Final = 0.5
_EARLY_BEND: Final = 3.0
"""Where Huber's cost becomes linear, in standard deviations; nearly absolute values on the late side."""

_HUBER_ROUNDS: Final = 12
_STEPS_A_ROUND: Final = 2
_GROWTH: Final = 1.4
_FAST_GROWTH: Final = 2.0
_MANY_UNKNOWNS: Final = 100
_AGREEING_STARTS: Final = 3
"""Large sites have many spare ranges: larger steps lead to the same minimum, and if the first starts agree the others
are not tried."""

_LAST_CONTROL: Final = 30.0  # at which the graduated cost is practically cut off
_MAX_CHANGES: Final = 10  # of the set of used ranges until it is stable
_MIN_CHECKS: Final = 4.0
_SIGNIFICANT: Final = 2.6
"""Standard deviations by which the squared residuals must exceed their expectation if no range was left out."""

_MIN_LEFT: Final = 1.0
"""Spare ranges that must remain after some were left out: with fewer, any range can be left out and the others fit
exactly, even if folded."""

_LARGEST_SQUARES: Final = 6.6
_WIDEST: Final = 2.0
"""99 % quantile of the weighted square of one spare range, and the factor by which standard deviations may be too small
before a range must be late after all."""

_EXCESS_WEIGHT: Final = 15.0
_MIN_EVIDENCE: Final = 20.0
"""Evidence needed for a larger error: twice the log likelihood ratio plus the weighted excess. Left out ranges say
nothing about the error of the others, so likelihoods alone would mistake many late ranges for a larger error."""

_FIRST_WIDTH: Final = 4.0  # in expected errors
_MAX_WIDENINGS: Final = 20
_SAME_WIDTH: Final = 0.03
_MIN_STD_M: Final = 0.005
_LARGEST_STD_M: Final = 0.3

_MAX_IMPROVEMENTS: Final = 8
_MIN_GAIN: Final = 0.01  # least decrease of the cost for a better result nearby
_SAME_M: Final = 0.005  # results whose residuals differ by less are one minimum


class RobustFit(Struct, frozen=True, eq=False):
    """The best fit found."""

    problem: Problem
    """With the variances that were used."""
    solution: Solution
    """With the weights below."""
    weight: Array
    """Shape (m,), of ranges: 1 or 0, or below 1 for late ones if errors are larger than expected."""
    used: Mask
    """Shape (m,): ranges in use; the others are late."""
    cost: float
    """Sum of weighted squares, cut off for each range."""
    range_std_m: float
    """Constant error of a pair that the fit assumes."""
    others: "Minima"
    """Minima found near this one, to search for ambiguities."""


class Minima(Struct, frozen=True, eq=False):
    """Minima of the cut-off cost, the best first."""

    position_m: Array
    delay_m: Array
    """Shapes (b, n, 3) and (b, n)."""
    used: Mask
    """Shape (b, m)."""
    cost: Array
    """Shape (b,)."""


def fit_robustly(problem: Problem, starts: list[Array], pair_std_m: float = 0.0) -> RobustFit:
    """Fit positions and delays to the ranges that agree, from several starts of shape (n, 3).

    ``pair_std_m``: the part of the ranges' standard deviations that is a pair's constant error. If the residuals show a
    larger one, that is used.
    """
    start_m = np.stack(starts)
    narrow = _best_near(problem, _from_starts(problem, start_m), pair_std_m)
    whole = None if narrow.used.all() else _with_all_ranges(narrow, start_m)
    if whole is not None:
        return whole
    checks = redundancy(problem, narrow.solution, narrow.used)
    excess = _excess(_squares(problem, narrow.solution, narrow.used), checks)
    if checks < _MIN_CHECKS or (narrow.used.all() and excess < _SIGNIFICANT):
        return narrow
    std_m = _shown_std_m(narrow)
    if std_m <= pair_std_m:
        return narrow
    wider = replace(problem, variance_m2=problem.variance_m2 - pair_std_m**2 + std_m**2)
    wide = _best_near(wider, _from_starts(wider, start_m), std_m)
    # Twice the log likelihood ratio: a larger error makes each range in use less likely.
    in_use = wide.used
    width = np.mean(np.log(wider.variance_m2 / problem.variance_m2)[in_use])
    likelier = narrow.cost - wide.cost - redundancy(wider, wide.solution, in_use) * width
    return _softened(wide) if likelier + _EXCESS_WEIGHT * excess > _MIN_EVIDENCE else narrow


def _with_all_ranges(fit: RobustFit, start_m: Array) -> RobustFit | None:
    """The fit with all ranges, if nothing confirms that some are late and all agree within larger errors."""
    if redundancy(fit.problem, fit.solution, fit.used) >= _MIN_LEFT:
        return None
    everything = np.ones(len(fit.used), dtype=np.bool_)
    plain = _plain(fit.problem, start_m)
    position_m, delay_m = plain.position_m[0], plain.delay_m[0]
    solution = solve_least_squares(fit.problem, position_m)
    checks = redundancy(fit.problem, solution, everything)
    ratio = float(np.sqrt(_squares(fit.problem, solution, everything) / (_LARGEST_SQUARES * max(checks, 1.0))))
    if ratio > _WIDEST:
        return None
    std_m = max(ratio, 1.0) * fit.range_std_m
    wider = replace(fit.problem, variance_m2=fit.problem.variance_m2 - fit.range_std_m**2 + std_m**2)
    minima = cut_off(wider, position_m[None], delay_m[None], everything[None])
    solution = solve_least_squares(wider, position_m)
    return RobustFit(
        wider, solution, everything.astype(np.float64), everything, solution.cost, std_m, _joined(minima, fit.others)
    )


def _softened(fit: RobustFit) -> RobustFit:
    """The fit with a one-sided Huber cost for late ranges instead of a cut-off.

    If ranges scatter more than expected, no gap separates late ranges from the others, and which ones are cut off
    depends on chance: one-sided absolute values are a quarter more accurate on drawn plants.
    """
    problem = fit.problem
    start = Solutions(
        fit.solution.position_m[None], fit.solution.delay_m[None], fit.solution.residual_m[None], np.array([fit.cost])
    )
    bent = _huber(problem, start)
    weight = _bent_weight(problem, bent.residual_m)[0]
    solution = solve_least_squares(problem, bent.position_m[0], weight)
    return replace(fit, solution=solution, weight=weight, used=_in_cutoffs(problem, solution.residual_m) < 1.0)


def _best_near(problem: Problem, minima: Minima, pair_std_m: float) -> RobustFit:
    """The best of these minima, or a better one found nearby."""
    presence = Presence(problem, minima.position_m[0])
    best_whole = np.inf
    fit: RobustFit | None = None
    for _ in range(_MAX_IMPROVEMENTS):
        whole = minima.cost + presence.cost(minima.position_m)
        if fit is not None and (not len(whole) or whole.min() > best_whole - _MIN_GAIN):
            break
        best = int(np.argmin(whole))
        best_whole, used = float(whole[best]), minima.used[best]
        solution = solve_least_squares(problem, minima.position_m[best], used.astype(np.float64))
        cost = float(minima.cost[best])
        minima = _joined(_near(problem, solution, used), minima)
        fit = RobustFit(problem, solution, used.astype(np.float64), used, cost, pair_std_m, minima)
    assert fit is not None
    return fit


def _shown_std_m(fit: RobustFit) -> float:
    """Constant error of a pair according to the residuals of ranges in use; at least what the fit assumes.

    With few spare ranges, leaving out even slightly deviating ones makes the rest agree. So the search starts with a
    larger error and iterates until it agrees with the residuals.
    """
    least_m, problem = fit.range_std_m, fit.problem
    position_m, delay_m = fit.solution.position_m[None], fit.solution.delay_m[None]
    std_m = _FIRST_WIDTH * max(least_m, _MIN_STD_M)
    for _ in range(_MAX_WIDENINGS):
        wider = replace(problem, variance_m2=problem.variance_m2 - least_m**2 + std_m**2)
        near = graduated(wider, position_m, delay_m, np.full(1, 0.1))
        position_m, delay_m, used = near.position_m, near.delay_m, near.used[0]
        solution = solve_least_squares(wider, position_m[0], used.astype(np.float64))
        checks = redundancy(wider, solution, used)
        if checks < _MIN_CHECKS:
            return least_m
        before_m = std_m
        ratio = np.sqrt(_squares(wider, solution, used) / checks)
        std_m = float(np.clip(std_m * np.clip(ratio, 0.5, 1.5), least_m, _LARGEST_STD_M))
        if abs(std_m - before_m) <= _SAME_WIDTH * before_m:
            break
    return std_m


def _squares(problem: Problem, solution: Solution, used: Mask) -> float:
    return float(np.sum(used * solution.residual_m**2 / problem.variance_m2))


def _excess(squares: float, checks: float) -> float:
    """Standard deviations by which weighted squares exceed their expectation (their cube root is nearly normal)."""
    variance = 2.0 / (9.0 * max(checks, 1e-6))
    return float((np.cbrt(squares / max(checks, 1e-6)) - 1.0 + variance) / np.sqrt(variance))


def _near(problem: Problem, solution: Solution, used: Mask) -> Minima:
    """Minima with an anchor elsewhere, or with one or two ranges fewer."""
    start_m = relocated(problem, solution.position_m, solution.delay_m)
    delay_m = np.tile(solution.delay_m, (len(start_m), 1))
    elsewhere = graduated(problem, start_m, delay_m, np.full(len(start_m), 0.3))
    sets = without_ranges(problem, solution, used)
    position_m, delay_m = np.tile(solution.position_m, (len(sets), 1, 1)), np.tile(solution.delay_m, (len(sets), 1))
    return _joined(elsewhere, cut_off(problem, position_m, delay_m, sets))


def _joined(some: Minima, more: Minima) -> Minima:
    both = [np.concatenate(parts) for parts in zip(astuple(some), astuple(more), strict=True)]
    order = np.argsort(both[3], kind="stable")
    return Minima(*(part[order] for part in both))


def redundancy(problem: Problem, solution: Solution, used: Mask) -> float:
    """Ranges in use less the unknowns that they determine, where priors determine a part of the unknowns."""
    in_use = np.flatnonzero(used)
    derivative = jacobian(problem, solution.position_m)[np.ix_(in_use, unknown_columns(problem))]
    influence = np.linalg.solve(regular(solution.information), derivative.T)
    return float(len(in_use) - np.einsum("ij,ji->", derivative, influence))


def _from_starts(problem: Problem, start_m: Array) -> Minima:
    """Minima reached by graduated non-convexity from plain and from one-sided least squares."""
    plain = _plain(problem, start_m[:_AGREEING_STARTS] if _is_large(problem) else start_m)
    if _is_large(problem) and len(plain.cost) > 1:
        plain = _plain(problem, start_m)
    bent = _distinct(_huber(problem, plain))
    position_m = np.concatenate([plain.position_m, bent.position_m, bent.position_m])
    delay_m = np.concatenate([plain.delay_m, bent.delay_m, bent.delay_m])
    # A bent start is used twice: with the convex cost, and with one near the cut-off.
    nearly_cut = np.arange(len(position_m)) >= len(plain.position_m) + len(bent.position_m)
    return graduated(problem, position_m, delay_m, np.where(nearly_cut, 0.3, 0.0))


def _plain(problem: Problem, start_m: Array) -> Solutions:
    return _distinct(solve_many(problem, start_m, np.ones((len(start_m), len(problem.range_m))), most_steps=15))


def _is_large(problem: Problem) -> bool:
    return int(np.count_nonzero(problem.is_free)) + len(problem.is_free) > _MANY_UNKNOWNS


def _huber(problem: Problem, start: Solutions) -> Solutions:
    """Least squares with nearly absolute values for late residuals (iteratively reweighted)."""
    fit = start
    for _ in range(_HUBER_ROUNDS):
        fit = solve_many(problem, fit.position_m, _bent_weight(problem, fit.residual_m), fit.delay_m, _STEPS_A_ROUND)
    return fit


def _bent_weight(problem: Problem, residual_m: Array) -> Array:
    """Huber weights, which bend far out on the early side and near on the late side; shape as given."""
    scaled = residual_m / np.sqrt(problem.variance_m2)
    bend = np.where(scaled > 0.0, _LATE_BEND, _EARLY_BEND)
    return np.asarray(bend / np.maximum(np.abs(scaled), bend))


def graduated(problem: Problem, position_m: Array, delay_m: Array, least_control: Array) -> Minima:
    """Graduated non-convexity from ``b`` starts. ``least_control``: 0 begins with a convex cost, 1 near the cut-off."""
    scaled = _in_cutoffs(problem, residuals_m(problem, position_m, delay_m))
    convex = 1.0 / np.maximum(2.0 * np.max(scaled, axis=1, initial=0.0) - 1.0, 1.0 / _LAST_CONTROL)
    control = np.maximum(convex, least_control)
    growth = _FAST_GROWTH if _is_large(problem) else _GROWTH
    while np.any(control < _LAST_CONTROL):
        mu = control[:, None]
        weight = np.sqrt(mu * (mu + 1.0) / np.maximum(scaled, 1e-12)) - mu
        weight = np.clip(weight, 0.0, 1.0)
        fit = solve_many(problem, position_m, weight, delay_m, _STEPS_A_ROUND)
        position_m, delay_m = fit.position_m, fit.delay_m
        scaled = _in_cutoffs(problem, fit.residual_m)
        control = control * growth
    return cut_off(problem, position_m, delay_m)


def cut_off(problem: Problem, position_m: Array, delay_m: Array, used: Mask | None = None) -> Minima:
    """Minima of the cut-off cost near ``b`` positions, where least squares and the set of used ranges agree.

    ``used``: the initial sets, shape (b, m); by default from the positions' residuals.
    """
    nearby = _in_cutoffs(problem, residuals_m(problem, position_m, delay_m)) < 1.0
    used = nearby if used is None else used.copy()
    position_m, delay_m = position_m.copy(), delay_m.copy()
    cost = np.full(len(position_m), np.inf)
    found = used.copy()
    busy = np.arange(len(position_m))
    for _ in range(_MAX_CHANGES):
        weight = used[busy].astype(np.float64)
        fit = solve_many(problem, position_m[busy], weight, delay_m[busy])
        new = _in_cutoffs(problem, fit.residual_m) < 1.0
        # Squares of all ranges; those left out cost the cut-off.
        squares = fit.residual_m**2 / problem.variance_m2
        limit = np.where(fit.residual_m > 0.0, LATE_CUTOFF**2, EARLY_CUTOFF**2)
        whole = fit.cost + np.sum(np.where(new, squares, limit) - weight * squares, axis=1)
        better = whole < cost[busy]
        chosen = busy[better]
        cost[chosen], position_m[chosen], delay_m[chosen] = whole[better], fit.position_m[better], fit.delay_m[better]
        found[chosen] = new[better]
        changed = better & np.any(new != used[busy], axis=1)
        used[busy] = new
        busy = busy[changed]
        if not busy.size:
            break
    order = np.argsort(cost, kind="stable")
    return Minima(position_m[order], delay_m[order], found[order], cost[order])


def _in_cutoffs(problem: Problem, residual_m: Array) -> Array:
    """Squared residuals, scaled to 1 at the cut-off; shape as given."""
    cutoff = np.where(residual_m > 0.0, LATE_CUTOFF, EARLY_CUTOFF)
    return np.asarray(residual_m**2 / (problem.variance_m2 * cutoff**2))


def _distinct(fits: Solutions) -> Solutions:
    """The distinct minima, the cheapest first, compared by residuals, which are independent of rotations."""
    kept: list[int] = []
    for index in np.argsort(fits.cost, kind="stable"):
        apart = np.abs(fits.residual_m[kept] - fits.residual_m[index])
        if not kept or np.all(np.max(apart, axis=1, initial=0.0) > _SAME_M):
            kept.append(int(index))
    return Solutions(fits.position_m[kept], fits.delay_m[kept], fits.residual_m[kept], fits.cost[kept])


# Other results close to one


_MAX_NEIGHBOURS: Final = 12  # anchors whose ranges give an anchor's other positions
_MAX_RELOCATIONS: Final = 3  # per anchor
_LOOSE_STD_M: Final = 0.05  # added to a range's standard deviation while all other anchors stay
_LOOSE_COST: Final = 40.0  # a relocation may be worse by this while all other anchors stay
_APART_M: Final = 0.25
"""Positions of an anchor that differ by less count as one: leaving ranges out leads from one to the other."""

_MIN_LATE: Final = 1.5
"""Standard deviations by which a range must be late after leaving it out, by an approximate linear prediction."""

_MIN_MOTION_M: Final = 0.03  # motion that leaving ranges out must cause, by the same prediction
_UNCONTROLLED: Final = 0.02  # share of redundancy below which no other ranges check a range
_MIN_REFITS: Final = 10
_MAX_REFITS: Final = 600
_REFIT_WORK: Final = 6e5  # refits times squared unknowns


def relocated(problem: Problem, position_m: Array, delay_m: Array) -> Array:
    """Starts with one anchor moved to where circles (spheres) of two (three) of its ranges meet, shape (b, n, 3)."""
    axes = np.flatnonzero(problem.is_free.all(axis=0))
    found = [
        (worse, anchor, other_m)
        for anchor in range(len(position_m))
        for worse, other_m in _other_positions(problem, position_m, delay_m, anchor, axes)
    ]
    found.sort(key=lambda item: item[:2])
    unknowns = int(np.count_nonzero(problem.is_free)) + len(position_m)
    starts = []
    for _, anchor, other_m in found[: _most_refits(unknowns)]:
        start_m = position_m.copy()
        start_m[anchor] = other_m
        starts.append(start_m)
    return np.array(starts).reshape(-1, *position_m.shape)


def _most_refits(unknowns: int) -> int:
    """Number of refits that takes little time even at large sites."""
    return int(np.clip(_REFIT_WORK / unknowns**2, _MIN_REFITS, _MAX_REFITS))


def _other_positions(
    problem: Problem, position_m: Array, delay_m: Array, anchor: int, axes: Integers
) -> list[tuple[float, Array]]:
    """Alternative positions of one anchor while all others stay, best first, each after its increase of the cost."""
    own = np.flatnonzero((problem.first == anchor) | (problem.second == anchor))
    neighbour = problem.first[own] + problem.second[own] - anchor
    if len(own) < len(axes) or len(axes) < 2:
        return []
    length_m = problem.range_m[own] - delay_m[neighbour] - delay_m[anchor]
    others = np.setdiff1d(np.arange(3), axes)
    across = np.sum((position_m[neighbour][:, others] - position_m[anchor, others]) ** 2, axis=1)
    along_m = np.sqrt(np.maximum(length_m**2 - across, 0.0))
    chosen = np.unique(np.linspace(0, len(own) - 1, min(len(own), _MAX_NEIGHBOURS)).astype(np.int64))
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
        if cost[index] > cost[0] + _LOOSE_COST or len(kept) > _MAX_RELOCATIONS:
            break
        if np.linalg.norm(np.array(kept) - candidate_m[index], axis=1).min() > _APART_M:
            kept.append(candidate_m[index])
            worse.append(float(cost[index] - cost[0]))
    return list(zip(worse, kept, strict=True))[1:]


def _meeting_points(centre_m: Array, radius_m: Array) -> Array:
    """Both intersections of d circles or spheres, shape (2 c, d), from centres (c, d, d) and radii (c, d)."""
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
    """Sets of used ranges without one or two that would then be late and let anchors move, shape (b, m).

    The effect is predicted with the linearised equations of the solution, so that only few sets need a refit.
    """
    in_use = np.flatnonzero(used)
    if not in_use.size:
        return np.zeros((0, len(used)), dtype=np.bool_)
    std_m = np.sqrt(problem.variance_m2[in_use])
    derivative = jacobian(problem, solution.position_m)[np.ix_(in_use, unknown_columns(problem))]
    influence = np.linalg.solve(regular(solution.information), derivative.T)
    redundancy = np.eye(len(in_use)) - derivative @ influence
    residual = solution.residual_m[in_use] / std_m
    own = np.maximum(np.diag(redundancy), 1e-6)
    # Residuals of two ranges when predicted without both, from the inverse of their block of the redundancy matrix.
    determinant = own[:, None] * own - redundancy**2
    np.fill_diagonal(determinant, 1.0)
    safe = np.maximum(determinant, 1e-6)
    first = (own[None, :] * residual[:, None] - redundancy * residual[None, :]) / safe
    np.fill_diagonal(first, residual / own)
    second = first.T
    free = determinant < _UNCONTROLLED
    np.fill_diagonal(free, own < _UNCONTROLLED)
    late = np.minimum(first, second) > _MIN_LATE
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
    moves = (motion > _MIN_MOTION_M) | free[rows, columns]
    most = _most_refits(len(solution.information))
    rows, columns = rows[moves][:most], columns[moves][:most]
    sets = np.tile(used, (len(rows), 1))
    sets[np.arange(len(rows)), in_use[rows]] = False
    sets[np.arange(len(rows)), in_use[columns]] = False
    return sets


def regular(information: Array) -> Array:
    """Invertible information matrix: a little information (1e-4 per m², 100 m standard deviation) on every unknown."""
    return np.asarray(information + 1e-4 * np.eye(len(information)))


def mirrored(problem: Problem, position_m: Array) -> Array:
    """Starts with two anchors reflected in the line (plane) of the others that hold them, shape (b, n, 3).

    These are no more than there are dimensions. ``relocated`` covers single anchors.
    """
    axes = np.flatnonzero(problem.is_free.all(axis=0))
    n = len(position_m)
    joined = adjacency(n, problem.first, problem.second) | adjacency(n, problem.tape_first, problem.tape_second)
    starts = []
    for pair in combinations(range(n), 2):
        part = np.isin(np.arange(n), pair)
        hinge = joined[part].any(axis=0) & ~part
        if np.count_nonzero(hinge) <= len(axes) < n - 2:
            start_m = position_m.copy()
            start_m[np.ix_(part, axes)] = _reflection(position_m[part][:, axes], position_m[hinge][:, axes])
            starts.append(start_m)
    return np.array(starts).reshape(-1, n, 3)


def _reflection(position_m: Array, hinge_m: Array) -> Array:
    """Positions, shape (k, d), reflected in the line or plane that best fits the hinge, shape (h, d)."""
    if not len(hinge_m):
        return position_m
    centre = hinge_m.mean(axis=0)
    normal = np.linalg.svd(np.concatenate([hinge_m - centre, np.zeros(position_m.shape[1:])[None]]))[2][-1]
    return np.asarray(position_m - 2.0 * np.outer((position_m - centre) @ normal, normal))


# Which pairs have a range


_PRESENCE_STEPS: Final = 12
_MIN_PRESENCE_EVIDENCE: Final = 30.0
"""Twice the log likelihood ratio by which distance must explain which pairs have a range; else it is not used."""

_PRESENCE_WEIGHT: Final = 0.5  # below 1, as pairs behind one wall are missing together
_SURE: Final = 1e-3  # probability that a pair has, or lacks, a range for a reason other than distance


class Presence:
    """Logistic curve of the probability of a range over distance, fitted to one result of a problem."""

    def __init__(self, problem: Problem, position_m: Array) -> None:
        """``position_m``: shape (n, 3)."""
        n = len(position_m)
        self._first, self._second = np.triu_indices(n, 1)
        self._is_present = adjacency(n, problem.first, problem.second)[self._first, self._second]
        share = float(np.mean(self._is_present)) if self._is_present.size else 1.0
        self._curve: Array | None = None
        if not 0.0 < share < 1.0:
            return
        distance = self._distances(position_m[None])[0]
        rows = np.stack([np.ones_like(distance), distance], axis=1)
        curve = np.array([np.log(share / (1.0 - share)), 0.0])
        for _ in range(_PRESENCE_STEPS):
            expected = 1.0 / (1.0 + np.exp(-np.clip(rows @ curve, -30.0, 30.0)))
            information = (rows * (expected * (1.0 - expected))[:, None]).T @ rows + 1e-3 * np.eye(2)
            curve = curve + np.linalg.solve(information, rows.T @ (self._is_present - expected) - 1e-3 * curve)
        level = -2.0 * np.sum(np.where(self._is_present, np.log(share), np.log1p(-share)))
        if curve[1] < 0.0 and level - self._surprise(distance, curve) > _MIN_PRESENCE_EVIDENCE:
            self._curve = curve

    def cost(self, position_m: Array) -> Array:
        """Term to add to the cost of results of shape (b, n, 3); shape (b,)."""
        if self._curve is None:
            return np.zeros(len(position_m))
        return np.asarray(_PRESENCE_WEIGHT * self._surprise(self._distances(position_m), self._curve))

    def _distances(self, position_m: Array) -> Array:
        return np.asarray(np.linalg.norm(position_m[:, self._first] - position_m[:, self._second], axis=2))

    def _surprise(self, distance_m: Array, curve: Array) -> Array:
        """Minus twice the log likelihood of which pairs have a range, summed over the last axis."""
        share = 1.0 / (1.0 + np.exp(-np.clip(curve[0] + curve[1] * distance_m, -30.0, 30.0)))
        share = _SURE + (1.0 - 2.0 * _SURE) * share
        return np.asarray(-2.0 * np.sum(np.log(np.where(self._is_present, share, 1.0 - share)), axis=-1))


# Ambiguities


_MIRROR_AS_GOOD: Final = 16.0  # cost by which a result that uses the same ranges may be worse
_OTHERS_AS_GOOD: Final = 12.0  # the same for a result that takes other ranges as late
_LATE_GAIN: Final = 16.0
"""Cost that leaving ranges out must save; otherwise results that take other ranges as late are ignored."""

_MOVED_STDS: Final = 3.0
_MOVED_M: Final = 0.1  # motion of an anchor that makes two results different
_MAX_OTHERS: Final = 4  # reported results


class OtherFit(Struct, frozen=True, eq=False):
    """Another result that fits as well."""

    position_m: Array
    """Shape (n, 3), aligned with the best fit."""
    used: Mask
    """Shape (m,)."""
    anchors: tuple[int, ...]
    """Indices of the anchors that are elsewhere."""


def find_ambiguities(fit: RobustFit) -> tuple[OtherFit, ...]:
    """Results that fit nearly as well and have anchors elsewhere, the best first."""
    problem = fit.problem
    starts = mirrored(problem, fit.solution.position_m)
    by_mirror = cut_off(problem, starts, np.tile(fit.solution.delay_m, (len(starts), 1)))
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
                other = OtherFit(position_m, minima.used[index], tuple(elsewhere.tolist()))
                others.append((float(minima.cost[index]), other))
    others.sort(key=lambda item: item[0])
    kept: list[OtherFit] = []
    for _, other in others:
        apart = [np.linalg.norm(other.position_m - known.position_m, axis=1).max() for known in kept]
        if len(kept) < _MAX_OTHERS and min(apart, default=np.inf) > _MOVED_M:
            kept.append(other)
    return tuple(kept)


def aligned_to(problem: Problem, position_m: Array, target_m: Array) -> Array:
    """Positions moved rigidly, or reflected, in the free axes to best fit the target; both shape (n, 3).

    The alignment is robust, so that anchors that are elsewhere do not shift the others.
    """
    axes = np.flatnonzero(problem.is_free.any(axis=0))
    weight = np.ones(len(position_m))
    moved_m = position_m
    for _ in range(5):
        moved_m = superimposed(position_m, target_m, weight, axes)
        weight = 1.0 / np.maximum(np.linalg.norm(moved_m - target_m, axis=1), 0.01)
    return moved_m


def aligned_std_m(fit: RobustFit) -> Array:
    """Standard deviation of each anchor's position error after the best rigid alignment, all axes together, (n,)."""
    n = len(fit.solution.position_m)
    covariance_m2 = aligned_covariance(fit.problem, fit.solution.position_m, np.ones(n, bool), fit.weight)
    variance = np.diag(covariance_m2)[: 3 * n].reshape(n, 3).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


# Which anchors have enough distances


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


def aligned_covariance(problem: Problem, position_m: Array, core: Mask, weight: Array | None = None) -> Array:
    """Covariance of coordinates and delays after the best rigid alignment over the core, shape (4 n, 4 n).

    Rows of coordinates that are not estimated are 0; undetermined unknowns have a standard deviation of some 30 m.
    ``weight``: see ``jacobian``.
    """
    used = unknown_columns(problem)
    rows = jacobian(problem, position_m, weight)
    information = rows[:, used].T @ rows[:, used]
    inside = np.concatenate([np.repeat(core, 3) & problem.is_free.ravel(), np.zeros(len(position_m), bool)])[used]
    motion = _rigid_motions(problem, position_m, inside, used)
    count, size = motion.shape[1], int(inside.sum())
    basis = np.zeros((len(used), len(used) - count))
    if count:
        basis[inside, : size - count] = np.linalg.qr(motion[inside], mode="complete")[0][:, count:]
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


def determined_core(problem: Problem, position_m: Array, least: int, weight: Array) -> Mask:
    """Mask of the anchors whose standard deviation is at most ``max_std_m`` when aligned over themselves, shape (n,).

    All False if fewer than ``least`` remain.
    """
    core, most_m = np.ones(len(position_m), bool), max_std_m(problem)
    while core.sum() >= least:
        std = position_stds_m(problem, aligned_covariance(problem, position_m, core, weight))
        worst = float(std[core].max())
        if worst <= most_m:
            joins = ~core & (std <= most_m)
            if joins.any():
                core = core | joins
                std = position_stds_m(problem, aligned_covariance(problem, position_m, core, weight))
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

_MIN_TAPE_GAIN: Final = 0.02  # share of the standard deviation that a tape must remove to be advised

_AS_GOOD: Final = 0.98
_AS_LITTLE: Final = 1.2
"""A tape is as good as the best with this share of the best gain and this multiple of the least remaining variance.

The first of several equally good tapes is chosen, so that noise does not change the choice.
"""


def best_tapes(
    problem: Problem,
    anchors: Sequence[int],
    position_m: Array,
    covariance_m2: Array,
    core: Mask,
    most: int = 3,
    until_m: float = 0.0,
) -> tuple[list[TapeAdvice], float]:
    """Choose the best distances one by one, until the worst standard deviation in the core is ``until_m`` or less.

    Returns them with that standard deviation. ``anchors``: identifiers. ``covariance_m2``: after alignment over the
    core, shape (4 n, 4 n).
    """
    n = len(position_m)
    first, second = np.triu_indices(n, 1)
    usable = core[first] & core[second] & ~adjacency(n, problem.tape_first, problem.tape_second)[first, second]
    first, second = first[usable], second[usable]
    unit = unit_vectors(position_m, first, second)
    inside = np.repeat(core, 3)
    covariance, worst_m = covariance_m2.copy(), np.inf
    chosen: list[TapeAdvice] = []
    while first.size and len(chosen) < most and worst_m > until_m:
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
        if after > before * (1.0 - _MIN_TAPE_GAIN):
            break
        a, b = sorted((anchors[first[best]], anchors[second[best]]))
        chosen.append(TapeAdvice(a, b, before, after))
        worst_m = float(stds.max())
        first, second, unit = np.delete(first, best), np.delete(second, best), np.delete(unit, best, axis=0)
    return chosen, worst_m


def _rms(stds_m: Array) -> float:
    return float(np.sqrt(np.mean(stds_m**2))) if stds_m.size else 0.0
