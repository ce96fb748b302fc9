"""A fit that late ranges do not spoil: those that the others contradict are left out.

Radio may take a longer way, never a shorter one: a range counts as wrong if it comes 3 σ later than the positions say,
or 6 σ earlier. The weighted squares, each cut off there, have many minima; graduated non-convexity (Yang and others,
2020) leads from plain least squares to a good one, from several starts, and the best is improved anchor by anchor.
"""

from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import astuple, replace

from skyless.kernels.arrays import Array, Mask
from skyless.survey.fit.neighbours import derivatives, regular, relocated, without_ranges
from skyless.survey.fit.presence import Presence
from skyless.survey.fit.problem import Problem, Solution, Solutions, residuals_m, solve_least_squares, solve_many

LATE_CUTOFF: Final = 3.0
EARLY_CUTOFF: Final = 6.0
"""In standard deviations of a range."""

_LATE_BEND: Final = 0.5
_EARLY_BEND: Final = 3.0
"""Where Huber's cost becomes linear, in standard deviations: absolute values on the late side, nearly."""

_HUBER_ROUNDS: Final = 12
_STEPS_A_ROUND: Final = 2
_GROWTH: Final = 1.4
_FAST_GROWTH: Final = 2.0
_MANY_UNKNOWNS: Final = 100
_AGREEING_STARTS: Final = 3
"""Large sites have ranges to spare: larger steps lead to the same minimum, and where the first starts agree the others
are left out."""

_LAST_CONTROL: Final = 30.0
"""Where the graduated cost is as good as cut off."""

_MOST_CHANGES: Final = 10
"""Of the set of used ranges, while it is brought to rest."""

_LEAST_CHECKS: Final = 4.0
_SIGNIFICANT: Final = 2.6
"""Standard deviations by which squares of residuals must exceed what is expected if no range was left out."""

_LEAST_LEFT: Final = 1.0
"""Ranges more than unknowns that must remain after some were left out: with less, any range can be left out, and what
remains fits exactly, be it folded."""

_LARGEST_SQUARES: Final = 6.6
_WIDEST: Final = 2.0
"""Weighted squares of one range too many in 99 % of sites, and the part by which standard deviations may be too small
before a range must be late even so."""

_EXCESS_WEIGHT: Final = 15.0
_LEAST_EVIDENCE: Final = 20.0
"""For a larger error: twice the logarithm of likelihoods, and these standard deviations times a weight. Late ranges
that were left out say nothing of the error of the others; so likelihoods alone mistake many late ranges for it."""

_FIRST_WIDTH: Final = 4.0
"""Of the expected error."""

_MOST_WIDENINGS: Final = 20
_SAME_WIDTH: Final = 0.03
_LEAST_STD_M: Final = 0.005
_LARGEST_STD_M: Final = 0.3

_MOST_IMPROVEMENTS: Final = 8
_LEAST_GAIN: Final = 0.01
"""Of the cost, by a better result nearby."""

_SAME_M: Final = 0.005
"""Residuals that differ by less belong to one minimum."""


class RobustFit(Struct, frozen=True, eq=False):
    """The best fit found."""

    problem: Problem
    """With the variances that were used."""
    solution: Solution
    """With the weights below."""
    weight: Array
    """Shape (m,), of ranges: 1 and 0, or less than 1 for those that come late where errors are larger than expected."""
    used: Mask
    """Shape (m,): ranges in use; the others are late."""
    cost: float
    """All weighted squares, each range's cut off."""
    range_std_m: float
    """Constant error of a pair that the fit assumes."""
    others: "Minima"
    """Minima found near this one, for the search of ambiguities."""


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

    ``pair_std_m``: the part of the ranges' standard deviations that is a pair's constant error. Where the residuals
    show that it is larger, the larger one is used.
    """
    start_m = np.stack(starts)
    narrow = _best_near(problem, _from_starts(problem, start_m), pair_std_m)
    whole = None if narrow.used.all() else _with_all_ranges(narrow, start_m)
    if whole is not None:
        return whole
    checks = redundancy(problem, narrow.solution, narrow.used)
    excess = _excess(_squares(problem, narrow.solution, narrow.used), checks)
    if checks < _LEAST_CHECKS or (narrow.used.all() and excess < _SIGNIFICANT):
        return narrow
    std_m = _shown_std_m(narrow)
    if std_m <= pair_std_m:
        return narrow
    wider = replace(problem, variance_m2=problem.variance_m2 - pair_std_m**2 + std_m**2)
    wide = _best_near(wider, _from_starts(wider, start_m), std_m)
    # Twice the logarithm of how much likelier the ranges are: a larger error makes each range in use less likely.
    in_use = wide.used
    width = np.mean(np.log(wider.variance_m2 / problem.variance_m2)[in_use])
    likelier = narrow.cost - wide.cost - redundancy(wider, wide.solution, in_use) * width
    return _softened(wide) if likelier + _EXCESS_WEIGHT * excess > _LEAST_EVIDENCE else narrow


def _with_all_ranges(fit: RobustFit, start_m: Array) -> RobustFit | None:
    """The fit with all ranges, if nothing checks that some of them are late and all agree within larger errors."""
    if redundancy(fit.problem, fit.solution, fit.used) >= _LEAST_LEFT:
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
    """The fit with late ranges bent instead of cut off.

    Where ranges scatter more than is expected, no gap parts late ranges from the others, and cutting some of them off
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
    """The best of some minima, or a better one that is found from there."""
    presence = Presence(problem, minima.position_m[0])
    best_whole = np.inf
    fit: RobustFit | None = None
    for _ in range(_MOST_IMPROVEMENTS):
        whole = minima.cost + presence.cost(minima.position_m)
        if fit is not None and (not len(whole) or whole.min() > best_whole - _LEAST_GAIN):
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
    """The constant error of a pair that residuals of ranges in use show, if it is more than the fit assumes.

    Few ranges too many can be made to agree by leaving out those that do not, whatever their error: so the search
    begins with a larger error, and goes on to what the residuals show until both agree.
    """
    least_m, problem = fit.range_std_m, fit.problem
    position_m, delay_m = fit.solution.position_m[None], fit.solution.delay_m[None]
    std_m = _FIRST_WIDTH * max(least_m, _LEAST_STD_M)
    for _ in range(_MOST_WIDENINGS):
        wider = replace(problem, variance_m2=problem.variance_m2 - least_m**2 + std_m**2)
        near = graduated(wider, position_m, delay_m, np.full(1, 0.1))
        position_m, delay_m, used = near.position_m, near.delay_m, near.used[0]
        solution = solve_least_squares(wider, position_m[0], used.astype(np.float64))
        checks = redundancy(wider, solution, used)
        if checks < _LEAST_CHECKS:
            return least_m
        before_m = std_m
        ratio = np.sqrt(_squares(wider, solution, used) / checks)
        std_m = float(np.clip(std_m * np.clip(ratio, 0.5, 1.5), least_m, _LARGEST_STD_M))
        if abs(std_m - before_m) <= _SAME_WIDTH * before_m:
            break
    return std_m


def _squares(problem: Problem, solution: Solution, used: Mask) -> float:
    """Weighted squares of the ranges in use."""
    return float(np.sum(used * solution.residual_m**2 / problem.variance_m2))


def _excess(squares: float, checks: float) -> float:
    """Standard deviations by which weighted squares exceed what is expected: their cube root is nearly normal."""
    variance = 2.0 / (9.0 * max(checks, 1e-6))
    return float((np.cbrt(squares / max(checks, 1e-6)) - 1.0 + variance) / np.sqrt(variance))


def _near(problem: Problem, solution: Solution, used: Mask) -> Minima:
    """Minima with an anchor elsewhere, or with one or two ranges fewer."""
    start_m = relocated(problem, solution.position_m, solution.delay_m)
    delay_m = np.tile(solution.delay_m, (len(start_m), 1))
    elsewhere = graduated(problem, start_m, delay_m, np.full(len(start_m), 0.3))
    sets = without_ranges(problem, solution, used)
    position_m, delay_m = np.tile(solution.position_m, (len(sets), 1, 1)), np.tile(solution.delay_m, (len(sets), 1))
    fewer = cut_off(problem, position_m, delay_m, sets)
    return _joined(elsewhere, fewer)


def _joined(some: Minima, more: Minima) -> Minima:
    """All of them, the best first."""
    both = [np.concatenate(parts) for parts in zip(astuple(some), astuple(more), strict=True)]
    order = np.argsort(both[3], kind="stable")
    return Minima(*(part[order] for part in both))


def redundancy(problem: Problem, solution: Solution, used: Mask) -> float:
    """Ranges in use less the unknowns that they determine; what is expected of delays and coordinates counts, too."""
    in_use = np.flatnonzero(used)
    derivative = derivatives(problem, solution, in_use) / np.sqrt(problem.variance_m2[in_use])[:, None]
    influence = np.linalg.solve(regular(solution.information), derivative.T)
    return float(len(in_use) - np.einsum("ij,ji->", derivative, influence))


def _from_starts(problem: Problem, start_m: Array) -> Minima:
    """Minima that plain and one-sided least squares and graduated non-convexity reach."""
    plain = _plain(problem, start_m[:_AGREEING_STARTS] if _is_large(problem) else start_m)
    if _is_large(problem) and len(plain.cost) > 1:
        plain = _plain(problem, start_m)
    bent = _distinct(_huber(problem, plain))
    position_m = np.concatenate([plain.position_m, bent.position_m, bent.position_m])
    delay_m = np.concatenate([plain.delay_m, bent.delay_m, bent.delay_m])
    # A bent start comes twice: from the convex cost, and from one that trusts it.
    nearly_cut = np.arange(len(position_m)) >= len(plain.position_m) + len(bent.position_m)
    return graduated(problem, position_m, delay_m, np.where(nearly_cut, 0.3, 0.0))


def _plain(problem: Problem, start_m: Array) -> Solutions:
    """Minima of plain least squares."""
    everything = np.ones((len(start_m), len(problem.range_m)))
    return _distinct(solve_many(problem, start_m, everything, most_steps=15))


def _is_large(problem: Problem) -> bool:
    return int(np.count_nonzero(problem.is_free)) + len(problem.delay_m) > _MANY_UNKNOWNS


def _huber(problem: Problem, start: Solutions) -> Solutions:
    """Least squares with late residuals by their absolute value."""
    fit = start
    for _ in range(_HUBER_ROUNDS):
        weight = _bent_weight(problem, fit.residual_m)
        fit = solve_many(problem, fit.position_m, weight, fit.delay_m, _STEPS_A_ROUND)
    return fit


def _bent_weight(problem: Problem, residual_m: Array) -> Array:
    """Weights that make squares absolute values, far on the early and soon on the late side; shape as given."""
    scaled = residual_m / np.sqrt(problem.variance_m2)
    bend = np.where(scaled > 0.0, _LATE_BEND, _EARLY_BEND)
    return np.asarray(bend / np.maximum(np.abs(scaled), bend))


def graduated(problem: Problem, position_m: Array, delay_m: Array, least_control: Array) -> Minima:
    """Graduated non-convexity from ``b`` starts: controls of 0 begin with a convex cost, of 1 near the cut-off one."""
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

    ``used``: shape (b, m), the first set; by default what the positions' residuals say.
    """
    nearby = _in_cutoffs(problem, residuals_m(problem, position_m, delay_m)) < 1.0
    used = nearby if used is None else used.copy()
    position_m, delay_m = position_m.copy(), delay_m.copy()
    cost = np.full(len(position_m), np.inf)
    found = used.copy()
    busy = np.arange(len(position_m))
    for _ in range(_MOST_CHANGES):
        weight = used[busy].astype(np.float64)
        fit = solve_many(problem, position_m[busy], weight, delay_m[busy])
        scaled = _in_cutoffs(problem, fit.residual_m)
        new = scaled < 1.0
        # Squares of all ranges, those that are out by what leaving them out costs.
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
    """Squares of residuals, 1 where they are cut off; shape as given."""
    cutoff = np.where(residual_m > 0.0, LATE_CUTOFF, EARLY_CUTOFF)
    return np.asarray(residual_m**2 / (problem.variance_m2 * cutoff**2))


def _distinct(fits: Solutions) -> Solutions:
    """One of each minimum, by residuals, the cheapest first: these do not see how a site is turned."""
    kept: list[int] = []
    for index in np.argsort(fits.cost, kind="stable"):
        apart = np.abs(fits.residual_m[kept] - fits.residual_m[index])
        if not kept or np.all(np.max(apart, axis=1, initial=0.0) > _SAME_M):
            kept.append(int(index))
    return Solutions(fits.position_m[kept], fits.delay_m[kept], fits.residual_m[kept], fits.cost[kept])
