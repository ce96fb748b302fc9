"""Ranges of anchors and of a tag in one fit: which of several results the tag confirms, and whether both fit."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from scipy.special import chdtri

from skyless.kernels.arrays import Array, Mask
from skyless.survey.fit.links import distances_m
from skyless.survey.fit.problem import Problem, Solution, solve_least_squares
from skyless.survey.fit.robust import LATE_CUTOFF
from skyless.survey.tags.epochs import EPOCH_S, TagEpochs, tag_ranges
from skyless.survey.tags.walk import WalkRows

_FEWEST_EPOCHS: Final = 10
_LIMIT: Final = 4.0
"""Standard deviations beyond which a range of the tag is not used."""

_MOST_EXCLUDED: Final = 0.2
_FALSE_ALARM: Final = 1e-4
"""Probability that the chi-squared tests reject a walk that fits."""

_RANGES_PER_INDEPENDENT: Final = 4.0
"""The residuals of a walk are tested as if only every fourth range were independent: reflections outlast an epoch."""

_CLEARLY: Final = 16.0
"""A result whose cost is higher by this is not the right one."""

_ROUNDS: Final = 6


class JointFit(Struct, frozen=True, eq=False):
    """What came of a walk."""

    solution: Solution | None
    """With the walk; None if it was not used."""
    chosen: int
    """Which of the starts led to it."""
    possible: tuple[int, ...]
    """Starts whose results the walk does not rule out, ``chosen`` among them; all of them if it was not used."""
    sentence: str
    """What was done with it and why."""
    rows: WalkRows | None
    """For fits that go on from ``solution``: ``replace(problem, more=(*problem.more, rows))``."""


class _Trial(Struct, frozen=True, eq=False):
    solution: Solution
    rows: WalkRows
    cost: float
    """With what ranges that are not used cost at the limit, those of the tag and those of anchors."""


def fit_with_tag(
    problem: Problem,
    anchors: Sequence[int],
    alone: Sequence[Solution],
    epochs: TagEpochs,
    pair_ranges_m: Mapping[tuple[int, int], float],
    used: Sequence[Mask] = (),
) -> JointFit:
    """Fit ranges and tag together, from each of the results of the ranges ``alone``, of which the first is the best.

    The first remains, unless the tag contradicts it clearly. ``anchors``: identifiers in the problem's order.
    ``pair_ranges_m``: see ``tag_ranges``. ``used``: ranges in use, of each result; by default all.
    """
    everything, name = tuple(range(len(alone))), epochs.name
    range_m = _of_anchors(tag_ranges(epochs, pair_ranges_m), epochs.anchors, anchors)
    in_use = used or [np.ones(len(problem.range_m), dtype=bool)] * len(alone)
    trials = [
        _trial(problem, start.position_m, epochs, range_m, mask) for start, mask in zip(alone, in_use, strict=True)
    ]
    least = min(trial.cost for trial in trials)
    possible = tuple(number for number in everything if trials[number].cost <= least + _CLEARLY)
    chosen = 0 if 0 in possible else min(possible, key=lambda number: trials[number].cost)
    best = trials[chosen]
    reason = _unfit(problem, alone[chosen], best)
    if reason is not None:
        return JointFit(None, 0, everything, f"what {name} received was not used: {reason}", None)
    apart = [number for number in possible if number == chosen or not _same(best.solution, trials[number].solution)]
    seconds, excluded = best.rows.epochs * EPOCH_S, best.rows.excluded_share
    sentence = f"{seconds:g} s of {name} were used" + (
        f"; {excluded:.0%} of its ranges were left out" if excluded else ""
    )
    return JointFit(best.solution, chosen, tuple(apart), sentence, best.rows)


def _of_anchors(range_m: Array, have: Sequence[int], wanted: Sequence[int]) -> Array:
    """Columns of the wanted anchors; NaN where there is none."""
    column = {anchor: number for number, anchor in enumerate(have)}
    found = np.full((len(range_m), len(wanted)), np.nan)
    for number, anchor in enumerate(wanted):
        if anchor in column:
            found[:, number] = range_m[:, column[anchor]]
    return found


def _trial(problem: Problem, start_m: Array, epochs: TagEpochs, range_m: Array, used: Mask) -> _Trial:
    rows = WalkRows(epochs, range_m, start_m)
    both = replace(problem, more=(*problem.more, rows))
    weight = used.astype(np.float64)
    solution = solve_least_squares(both, start_m, weight)
    for _ in range(_ROUNDS):
        before = rows.used
        rows.exclude_beyond(solution.position_m, solution.delay_m, _LIMIT)
        if rows.used is before:
            break
        solution = solve_least_squares(both, solution.position_m, weight)
    excluded = int(rows.measured.sum() - rows.used.sum())
    return _Trial(solution, rows, solution.cost + _LIMIT**2 * excluded + LATE_CUTOFF**2 * int((~used).sum()))


def _unfit(problem: Problem, alone: Solution, trial: _Trial) -> str | None:
    """Why ranges and walk are not to be used together."""
    rows, solution = trial.rows, trial.solution
    if rows.epochs < _FEWEST_EPOCHS:
        return f"only {rows.epochs} epochs of half a second have enough anchors; {_FEWEST_EPOCHS} are needed"
    if rows.excluded_share > _MOST_EXCLUDED:
        return f"{rows.excluded_share:.0%} of its ranges do not fit, as where anchors are not in sight"
    jacobian, _ = rows.rows(solution.position_m, solution.delay_m)
    independent = rows.freedom / _RANGES_PER_INDEPENDENT
    excess = rows.cost / max(rows.freedom, 1)
    if excess > chdtri(independent, _FALSE_ALARM) / independent:
        return f"its residuals are {np.sqrt(excess):.1f} times what they should be"
    n = len(solution.delay_m)
    unknown = np.concatenate([np.flatnonzero(problem.is_free.ravel()), 3 * n + np.arange(n)])
    of_walk = jacobian[:, unknown].T @ jacobian[:, unknown]
    of_ranges = solution.information - of_walk
    taken = np.linalg.matrix_rank(of_ranges, hermitian=True) - float(
        np.trace(np.linalg.pinv(solution.information, rcond=1e-12, hermitian=True) @ of_ranges)
    )
    rise = solution.cost - rows.cost - alone.cost
    checks = int(alone.residual_m.size + n - np.linalg.matrix_rank(of_ranges, hermitian=True))
    usual = max(1.0, alone.cost / checks) if checks > 0 else 1.0
    if rise > usual * chdtri(max(taken, 1.0), _FALSE_ALARM):
        return "it contradicts the ranges between the anchors"
    return None


def _same(one: Solution, other: Solution) -> bool:
    """Whether two results have the same distances, within 2 cm."""
    return bool(np.abs(distances_m(one.position_m) - distances_m(other.position_m)).max() < 0.02)
