"""Which causes explain the changes of a window, and which others would as well.

Sets of causes grow one by one, a few best sets side by side. Each cause must be worth more than chance among all causes
gives, so that one displacement is preferred to two late links, but not to one that explains as much. What every set
within a margin of the best has in common is certain; where they differ, the anchors are in question.
"""

from typing import Final

import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Array, Integers
from skyless.survey.watch.causes import Fit, Pairs, evidence, fit, thresholds, weight_without
from skyless.survey.watch.finding import Kind

_ADDED: Final = 1e-4
"""Probability that chance adds a cause to a set."""

_MARGIN: Final = 9.0
"""Twice the logarithm of the odds up to which two sets are both possible: 1 to 90."""

_BEAM: Final = 5
_BRANCHES: Final = 8
_MOST_CAUSES: Final = 5

_FURTHER_LINK: Final = 9.0
"""By how much less evidence every late link after the first needs in comparisons of sets: one body blocks several."""
_LATE: Final = 3.0
"""Standard deviations from which on a link counts as late there."""


class Part(Struct, frozen=True):
    """Something that has changed in a window."""

    kind: Kind
    anchors: tuple[int, ...]
    """Indices, in ascending order."""
    size_m: float
    std_m: float | None
    or_else: Kind | None = None
    """What the same anchor may have done as well."""


class Explanation(Struct, frozen=True, eq=False):
    """What has changed in a window, and what is left when that is allowed for."""

    parts: tuple[Part, ...]
    weight: Array
    """Shape (m, m)."""
    weighted_m: Array
    """Shape (m,): the weight times the changes that are left."""


class _Set(Struct, frozen=True, eq=False):
    causes: tuple[int, ...]
    fit: Fit
    score: float
    is_complete: bool = False
    """Whether no further cause is worth adding."""


def is_significant(pairs: Pairs, change_m: Array, false_alarm: float) -> Array:
    """Whether any cause has more evidence than chance gives with probability ``false_alarm``.

    ``change_m``: shape (..., m); result of shape (...).
    """
    found, dof = evidence(pairs, pairs.weight, change_m @ pairs.weight)
    return np.asarray((found > thresholds(dof, false_alarm)).any(axis=-1))


def nothing(pairs: Pairs, change_m: Array) -> Explanation:
    """Of a window that noise and drift explain."""
    return Explanation((), pairs.weight, change_m @ pairs.weight)


def explain(pairs: Pairs, change_m: Array) -> Explanation:
    """Of a window with a significant change. ``change_m``: shape (m,)."""
    sets = _grown(pairs, change_m)
    sets += _blocked(pairs, change_m, max(sets, key=lambda one: one.score))
    best = max(sets, key=lambda one: one.score)
    if not best.causes:
        return nothing(pairs, change_m)
    if best.is_complete:
        rivals = [one for one in sets if one is not best and one.score > best.score - _MARGIN]
        parts = _parts(pairs, best, rivals)
    else:
        parts = [_check(pairs, [best.causes], best)]
    return Explanation(tuple(parts), weight_without(pairs, best.fit), pairs.weight @ best.fit.residual_m)


def _grown(pairs: Pairs, change_m: Array) -> list[_Set]:
    """All sets that were looked at."""
    empty = fit(pairs, change_m, ())
    beam = [_Set((), empty, 0.0)]
    known: dict[frozenset[int], _Set] = {}
    worth: Array | None = None
    for size in range(_MOST_CAUSES + 1):
        candidates: list[tuple[float, _Set, int]] = []
        for one in beam:
            weight = weight_without(pairs, one.fit) if one.causes else pairs.weight
            gained, dof = evidence(_displaced(pairs, one), weight, one.fit.residual_m @ pairs.weight)
            if worth is None:
                worth = thresholds(dof, _ADDED)
            gained[list(one.causes)] = 0.0
            value = gained - worth
            if not (value > 0.0).any():
                known[frozenset(one.causes)] = _Set(one.causes, one.fit, one.score, is_complete=True)
                continue
            known[frozenset(one.causes)] = one
            best = np.argsort(-value)[:_BRANCHES]
            candidates += [(one.score + float(value[of]), one, of) for of in best[value[best] > -_MARGIN].tolist()]
        if size == _MOST_CAUSES or not candidates or worth is None:
            break
        beam = _best_sets(pairs, change_m, candidates, known, worth, empty.chi2)
    return list(known.values())


def _best_sets(
    pairs: Pairs,
    change_m: Array,
    candidates: list[tuple[float, _Set, int]],
    known: dict[frozenset[int], _Set],
    worth: Array,
    whole: float,
) -> list[_Set]:
    """The sets with one more cause that explain most. ``whole``: chi-squared without any cause."""
    grown: dict[frozenset[int], _Set] = {}
    for _, one, cause in sorted(candidates, key=lambda candidate: -candidate[0])[: _BEAM * _BRANCHES]:
        key = frozenset((*one.causes, cause))
        if key in grown or key in known:
            continue
        causes = (*one.causes, cause)
        found = fit(pairs, change_m, causes, one.fit)
        grown[key] = _Set(causes, found, whole - found.chi2 - _cost(pairs, causes, worth))
    ordered = sorted(grown.values(), key=lambda one: -one.score)
    for one in ordered[_BEAM:]:
        known[frozenset(one.causes)] = one
    return ordered[:_BEAM]


def _cost(pairs: Pairs, causes: tuple[int, ...], worth: Array) -> float:
    links = sum(cause >= 2 * pairs.anchors for cause in causes)
    return float(worth[list(causes)].sum()) - _FURTHER_LINK * max(links - 1, 0)


def _blocked(pairs: Pairs, change_m: Array, best: _Set) -> list[_Set]:
    """Of each displaced or delayed anchor, the set in which its late links are blocked instead."""
    n = pairs.anchors
    whole = float(change_m @ pairs.weight @ change_m)
    _, dof = evidence(pairs, pairs.weight, change_m @ pairs.weight)
    worth = thresholds(dof, _ADDED)
    found = []
    for cause in best.causes:
        if cause >= 2 * n:
            continue
        others = tuple(one for one in best.causes if one != cause)
        residual_m = fit(pairs, change_m, others).residual_m
        is_late = (pairs.first == cause % n) | (pairs.second == cause % n)
        is_late &= residual_m > _LATE / np.sqrt(np.diagonal(pairs.weight))
        causes = (*others, *(link for link in (2 * n + np.flatnonzero(is_late)).tolist() if link not in others))
        instead = fit(pairs, change_m, causes)
        found.append(_Set(causes, instead, whole - instead.chi2 - _cost(pairs, causes, worth), is_complete=True))
    return found


def _displaced(pairs: Pairs, one: _Set) -> Pairs:
    """With the anchors where a set of causes has them."""
    moved = [(cause, of) for cause, of in zip(one.causes, one.fit.parameter_m, strict=True) if cause < pairs.anchors]
    if not moved:
        return pairs
    position_m = pairs.position_m.copy()
    for cause, parameter in moved:
        position_m[cause, : pairs.dimensions] += parameter
    return Pairs(position_m, pairs.first, pairs.second, pairs.dimensions, pairs.weight)


def _parts(pairs: Pairs, best: _Set, rivals: list[_Set]) -> list[Part]:
    """Each cause of the best set as certain as the rivals leave it."""
    differences = [frozenset(best.causes) ^ frozenset(rival.causes) for rival in rivals]
    uncertain: list[tuple[int, ...]] = []
    parts = []
    for number, cause in enumerate(best.causes):
        against = [one for one in differences if cause in one]
        elsewhere = [one for one in against if len({_anchors(pairs, other) for other in one}) > 1]
        if elsewhere:
            uncertain += [tuple(one) for one in elsewhere]
        elif not _is_checked(pairs, best, cause, or_else=bool(against)):
            uncertain.append((cause,))
        else:
            parts.append(_part(pairs, best, number, or_else=bool(against)))
    if uncertain:
        parts.append(_check(pairs, uncertain, best))
    return parts


def _is_checked(pairs: Pairs, best: _Set, cause: int, *, or_else: bool) -> bool:
    """Whether a range is left over that checks a displacement or a delay, and the other ``or_else``."""
    n = pairs.anchors
    if cause >= 2 * n:
        return True
    anchor = cause % n
    late = [other - 2 * n for other in best.causes if other >= 2 * n]
    ranged = np.flatnonzero((pairs.first == anchor) | (pairs.second == anchor))
    ranged = ranged[~np.isin(ranged, late)]
    return len(ranged) > (pairs.dimensions if cause < n or or_else else 1)


def _anchors(pairs: Pairs, cause: int) -> tuple[int, ...]:
    n = pairs.anchors
    if cause < 2 * n:
        return (cause % n,)
    return (int(pairs.first[cause - 2 * n]), int(pairs.second[cause - 2 * n]))


def _part(pairs: Pairs, best: _Set, number: int, *, or_else: bool) -> Part:
    cause, parameter, covariance = best.causes[number], best.fit.parameter_m[number], best.fit.covariance_m2[number]
    anchors = _anchors(pairs, cause)
    if cause >= pairs.anchors:
        kind: Kind = "delay" if cause < 2 * pairs.anchors else "link"
        return Part(kind, anchors, float(parameter[0]), float(covariance[0, 0] ** 0.5), "moved" if or_else else None)
    size_m = float(np.linalg.norm(parameter))
    along = parameter / max(size_m, 1e-9)
    return Part("moved", anchors, size_m, float((along @ covariance @ along) ** 0.5), "delay" if or_else else None)


def _check(pairs: Pairs, sets: list[tuple[int, ...]], best: _Set) -> Part:
    """All anchors in question; of many, those that most causes share."""
    named = [anchor for one in sets for cause in one for anchor in _anchors(pairs, cause)]
    counts: Integers = np.bincount(named, minlength=pairs.anchors)
    anchors = np.flatnonzero(counts > 0)
    if len(anchors) > 3 and counts.max() > 1:
        shared = np.flatnonzero(counts == counts.max())
        anchors = shared if len(shared) <= 3 else anchors
    sizes = [float(np.linalg.norm(parameter)) for parameter in best.fit.parameter_m]
    return Part("check", tuple(anchors.tolist()), max(sizes), None)
