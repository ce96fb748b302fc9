"""Find the causes that explain a window's range changes, and the alternatives that would explain them as well.

A cause is an anchor's displacement (each of its ranges changes by the projection on its direction), a change of an
anchor's delay (all its ranges change equally), or one late link. Its evidence is the drop of chi-squared when it is
allowed for. Causes are numbered: displacements of the ``n`` anchors, their delays, then the ``m`` links.

A beam search adds one cause at a time. Each cause must gain more than chance gives among all causes, so that one
displacement is preferred to two late links, but not to one link that explains as much. Causes that all sets within a
margin of the best share are certain; where the sets differ, the anchors are in question.
"""

import math
from collections import Counter, deque
from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace
from scipy.special import chdtri

from skyless.core.arrays import Array, Integers, Mask
from skyless.core.ticks import CARRIER_CYCLES, TICK_M, TICK_RATE_HZ, difference
from skyless.site.survey.legs import MAX_BRACKET_RATE, STD_OVER_MAD, AnchorLeg
from skyless.site.survey.problem import distance_derivatives, incidence

# Findings


Kind = Literal["moved", "delay", "link", "check"]


class Finding(Struct, frozen=True):
    """A detected change at the anchors."""

    kind: Kind
    """An anchor has moved; its delay has changed; one link is blocked; something unclear has changed."""
    anchors: tuple[int, ...]
    """The anchor, or both ends of the link; for ``check`` those in question, in ascending order."""
    size_m: float
    """Displacement, or growth of the delay h or of the link's range; 0 for a silent link."""
    std_m: float | None
    since_s: float
    """Start of the first window that showed the change, on the clock of the blocks."""
    sentence: str


def sentence_of(kind: Kind, anchors: tuple[int, ...], size_m: float, *, or_else: Kind | None = None) -> str:
    """One sentence without a full stop. ``or_else``: another change of the same anchor that would explain it too."""
    if kind == "moved":
        sentence = f"anchor {anchors[0]} has moved by about {_length(size_m)}"
        return f"{sentence}, or its delay has changed" if or_else else sentence
    if kind == "delay":
        more = "more" if size_m > 0.0 else "less"
        sentence = f"the delay of anchor {anchors[0]} has changed: {_length(abs(size_m))} {more}"
        return f"{sentence}, or it has moved" if or_else else sentence
    if kind == "link":
        a, b = anchors
        if size_m < 0.0:
            return f"the link between {a} and {b} is {_length(-size_m)} shorter: it was blocked before"
        return f"the link between {a} and {b} is blocked: {_length(size_m)} late"
    if len(anchors) == 1:
        return f"something has changed at anchor {anchors[0]}: check"
    *others, last = map(str, anchors)
    return f"something has changed at anchors {', '.join(others)} or {last}: check"


def _length(size_m: float) -> str:
    return f"{size_m:.1f} m" if size_m >= 0.995 else f"{max(round(100.0 * size_m), 1)} cm"


# Evidence for single causes


_MIN_INFORMATION_PER_M2: Final = 4.0
"""A displacement is not observable in directions where its standard deviation exceeds half a metre."""

_SHARED: Final = 0.25  # correlation of two pairs that share an anchor: TX noise is half of a range's variance
_STEPS: Final = 8
_SMALLEST_STEP_M: Final = 1e-4


class Pairs(Struct, frozen=True, eq=False):
    """The ``m`` pairs of ``n`` anchors that a window compares."""

    position_m: Array
    """Shape (n, 3): the anchors' positions without any change."""
    first: Integers
    second: Integers
    """Shape (m,): indices of each pair's anchors."""
    dimensions: int
    weight: Array
    """Shape (m, m): inverse covariance of the pairs' changes."""

    @property
    def anchors(self) -> int:
        """Number of anchors."""
        return len(self.position_m)


class Fit(Struct, frozen=True, eq=False):
    """Least squares fit of a set of causes to the changes."""

    chi2: float
    """Remaining chi-squared."""
    residual_m: Array
    """Shape (m,)."""
    parameter_m: tuple[Array, ...]
    """The displacement, delay or lateness of each cause."""
    covariance_m2: tuple[Array, ...]
    columns: Array
    """Shape (m, k): derivatives of the changes with respect to all parameters, at the solution."""


def pairs_of(
    position_m: Array, first: Integers, second: Integers, dimensions: int, white_m: Array, drift_m: Array
) -> Pairs:
    """Pairs whose changes have white noise of stamps and drift, each shape (m,)."""
    anchors = len(position_m)
    # Effect of each anchor's TX noise on its pairs.
    shared = math.sqrt(_SHARED) * white_m[:, None] * incidence(anchors, first, second)
    own = 1.0 / ((1.0 - 2.0 * _SHARED) * white_m**2 + drift_m**2)
    weighted = own[:, None] * shared
    inner = np.linalg.inv(np.eye(anchors) + shared.T @ weighted)  # matrix inversion lemma: n × n, not m × m
    weight: Array = -(weighted @ inner) @ weighted.T
    weight[np.diag_indices_from(weight)] += own
    return Pairs(position_m, first, second, dimensions, weight)


def evidence(pairs: Pairs, weight: Array, weighted_m: Array) -> tuple[Array, Integers]:
    """Drop of chi-squared by each cause alone, shape (..., causes), and its degrees of freedom, shape (causes,).

    ``weight``: shape (m, m), after other causes are projected out. ``weighted_m``: ``weight`` times the changes, shape
    (..., m).
    """
    n, dim, m = pairs.anchors, pairs.dimensions, len(pairs.first)
    moved = distance_derivatives(pairs.position_m, pairs.first, pairs.second)[:, :, :dim].reshape(m, n * dim)
    delayed = incidence(n, pairs.first, pairs.second)
    products = (weight @ moved).reshape(m, n, dim)
    information, directions = np.linalg.eigh(np.einsum("pid,pie->ide", moved.reshape(m, n, dim), products))
    along = np.einsum("ide,...id->...ie", directions, (weighted_m @ moved).reshape(*weighted_m.shape[:-1], n, dim))
    of_moved, moved_seen = _gained(along, information)
    of_delay, delay_seen = _gained(weighted_m @ delayed, np.einsum("pi,pi->i", delayed, weight @ delayed))
    of_link, link_seen = _gained(weighted_m, np.diagonal(weight))
    return (
        np.concatenate([of_moved.sum(axis=-1), of_delay, of_link], axis=-1),
        np.concatenate([moved_seen.sum(axis=-1), delay_seen, link_seen]).astype(np.int64),
    )


def _gained(along: Array, information: Array) -> tuple[Array, Mask]:
    is_seen = information > _MIN_INFORMATION_PER_M2
    return np.asarray(np.where(is_seen, along**2 / np.where(is_seen, information, 1.0), 0.0)), is_seen


def thresholds(dof: Integers, probability: float) -> Array:
    """Chi-squared that chance exceeds in any cause with this probability; infinite without a degree of freedom."""
    found = np.full(len(dof), np.inf)
    seen = dof > 0
    found[seen] = chdtri(dof[seen], probability / max(int(seen.sum()), 1))
    return found


def fit(pairs: Pairs, change_m: Array, causes: Sequence[int], scratch: Fit | None = None) -> Fit:
    """Joint least squares fit of these causes, iterated so that displacements may be large.

    ``change_m``: shape (m,). ``scratch``: fit of all but the last cause, as a start.
    """
    sizes = [pairs.dimensions if cause < pairs.anchors else 1 for cause in causes]
    ends = np.cumsum(sizes, dtype=np.int64)
    parameter = np.zeros(int(ends[-1]) if sizes else 0)
    if scratch is not None and scratch.parameter_m:
        start = np.concatenate(scratch.parameter_m)
        parameter[: len(start)] = start
    columns, predicted = _model(pairs, causes, ends, parameter)
    moves = any(cause < pairs.anchors for cause in causes)
    for _ in range(_STEPS if moves else 1):
        residual = change_m - predicted
        step = _inverse(columns.T @ pairs.weight @ columns) @ (columns.T @ (pairs.weight @ residual))
        parameter = parameter + step
        columns, predicted = _model(pairs, causes, ends, parameter)
        if not len(step) or np.abs(step).max() < _SMALLEST_STEP_M:
            break
    residual = change_m - predicted
    covariance = _inverse(columns.T @ pairs.weight @ columns)
    spans = [slice(end - size, end) for size, end in zip(sizes, ends.tolist(), strict=True)]
    return Fit(
        float(residual @ pairs.weight @ residual),
        residual,
        tuple(parameter[span] for span in spans),
        tuple(covariance[span, span] for span in spans),
        columns,
    )


def weight_without(pairs: Pairs, found: Fit) -> Array:
    """Weight with the causes of a fit projected out."""
    if not found.columns.shape[1]:
        return pairs.weight
    weighted = pairs.weight @ found.columns
    return np.asarray(pairs.weight - weighted @ _inverse(found.columns.T @ weighted) @ weighted.T)


def _inverse(information: Array) -> Array:
    """Pseudo-inverse that leaves out unobservable directions."""
    values, vectors = np.linalg.eigh(information)
    is_seen = values > _MIN_INFORMATION_PER_M2
    return np.asarray((vectors * np.where(is_seen, 1.0 / np.where(is_seen, values, 1.0), 0.0)) @ vectors.T)


def _model(pairs: Pairs, causes: Sequence[int], ends: Integers, parameter: Array) -> tuple[Array, Array]:
    """Derivatives, shape (m, k), and changes predicted from these parameters, shape (m,)."""
    n, m, dim = pairs.anchors, len(pairs.first), pairs.dimensions
    position_m = pairs.position_m.copy()
    for cause, end in zip(causes, ends.tolist(), strict=True):
        if cause < n:
            position_m[cause, :dim] += parameter[end - dim : end]
    apart_m = np.linalg.norm(position_m[pairs.first] - position_m[pairs.second], axis=1)
    predicted = apart_m - np.linalg.norm(pairs.position_m[pairs.first] - pairs.position_m[pairs.second], axis=1)
    columns = np.zeros((m, len(parameter)))
    moved = distance_derivatives(position_m, pairs.first, pairs.second)[:, :, :dim]
    delayed = incidence(n, pairs.first, pairs.second)
    for cause, end in zip(causes, ends.tolist(), strict=True):
        if cause < n:
            columns[:, end - dim : end] = moved[:, cause]
            continue
        if cause < 2 * n:
            columns[:, end - 1] = delayed[:, cause - n]
        else:
            columns[cause - 2 * n, end - 1] = 1.0
        predicted = predicted + columns[:, end - 1] * parameter[end - 1]
    return columns, predicted


# Sets of causes


_ADDED: Final = 1e-4  # probability that chance adds a cause to a set
_MARGIN: Final = 9.0  # difference of scores (twice the log odds) up to which both sets are possible: odds of 90 to 1
_BEAM: Final = 5
_BRANCHES: Final = 8
_MAX_CAUSES: Final = 5

_FURTHER_LINK: Final = 9.0
"""Reduction of the evidence that every late link after the first needs, as one body can block several."""
_LATE: Final = 3.0  # standard deviations above which a link counts as late


class Part(Struct, frozen=True):
    """One change in a window."""

    kind: Kind
    anchors: tuple[int, ...]
    """Indices, in ascending order."""
    size_m: float
    std_m: float | None
    or_else: Kind | None = None
    """Another change of the same anchor that would explain it too."""


class Explanation(Struct, frozen=True, eq=False):
    """The changes in a window, and the remainder after allowing for them."""

    parts: tuple[Part, ...]
    weight: Array
    """Shape (m, m)."""
    weighted_m: Array
    """Shape (m,): weight times the remaining changes."""


class _Set(Struct, frozen=True, eq=False):
    causes: tuple[int, ...]
    fit: Fit
    score: float
    is_complete: bool = False
    """Whether no further cause is worth adding."""


def is_significant(pairs: Pairs, change_m: Array, false_alarm: float) -> Array:
    """Whether the evidence for any cause exceeds what chance gives with probability ``false_alarm``.

    ``change_m``: shape (..., m). Returns shape (...).
    """
    found, dof = evidence(pairs, pairs.weight, change_m @ pairs.weight)
    return np.asarray((found > thresholds(dof, false_alarm)).any(axis=-1))


def nothing(pairs: Pairs, change_m: Array) -> Explanation:
    """Explanation of a window that shows only noise and drift."""
    return Explanation((), pairs.weight, change_m @ pairs.weight)


def explain(pairs: Pairs, change_m: Array) -> Explanation:
    """Explanation of a window with a significant change. ``change_m``: shape (m,)."""
    sets = _grown(pairs, change_m)
    sets += _blocked(pairs, change_m, max(sets, key=lambda one: one.score))
    best = max(sets, key=lambda one: one.score)
    if not best.causes:
        return nothing(pairs, change_m)
    if best.is_complete:
        parts = _parts(pairs, best, [one for one in sets if one is not best and one.score > best.score - _MARGIN])
    else:
        parts = [_check(pairs, [best.causes], best)]
    return Explanation(tuple(parts), weight_without(pairs, best.fit), pairs.weight @ best.fit.residual_m)


def _grown(pairs: Pairs, change_m: Array) -> list[_Set]:
    empty = fit(pairs, change_m, ())
    beam = [_Set((), empty, 0.0)]
    known: dict[frozenset[int], _Set] = {}
    worth: Array | None = None
    for size in range(_MAX_CAUSES + 1):
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
        if size == _MAX_CAUSES or not candidates or worth is None:
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
    """The best sets with one more cause. ``whole``: chi-squared without any cause."""
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
    """For each displaced or delayed anchor, the alternative set with its late links blocked instead."""
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
    moved = [(cause, of) for cause, of in zip(one.causes, one.fit.parameter_m, strict=True) if cause < pairs.anchors]
    if not moved:
        return pairs
    position_m = pairs.position_m.copy()
    for cause, parameter in moved:
        position_m[cause, : pairs.dimensions] += parameter
    return replace(pairs, position_m=position_m)


def _parts(pairs: Pairs, best: _Set, rivals: list[_Set]) -> list[Part]:
    """The causes of the best set; those that the rivals leave uncertain are merged into one ``check``."""
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
    """Whether a spare range checks this displacement or delay; ``or_else``: and the alternative to it."""
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
    """Part that names all anchors in question, or of many only those in most causes."""
    named = [anchor for one in sets for cause in one for anchor in _anchors(pairs, cause)]
    counts: Integers = np.bincount(named, minlength=pairs.anchors)
    anchors = np.flatnonzero(counts > 0)
    if len(anchors) > 3 and counts.max() > 1:
        shared = np.flatnonzero(counts == counts.max())
        anchors = shared if len(shared) <= 3 else anchors
    sizes = [float(np.linalg.norm(parameter)) for parameter in best.fit.parameter_m]
    return Part("check", tuple(anchors.tolist()), max(sizes), None)


# Watch of the anchors by carrier phase: millimetres, but only modulo half a wavelength.
#
#     −phase(b receives a) − phase(a receives b)  =  2·distance/λ + constant      (mod 1 cycle)
#
# The clocks cancel if both phases are taken at one instant, so the phases of one direction are interpolated at the
# receptions of the other, following the clock difference known from the stamps. The constant stays as long as both
# radios stay powered (``docs/watch.md``).

BLOCK_S: Final = 2.0
_LIMIT_M: Final = 0.002
_SIGMAS: Final = 5.0
_LEARNING_BLOCKS: Final = 5
_USUAL_BLOCKS: Final = 300  # blocks without a change whose mean is the reference
_STRIKES: Final = 2  # consecutive blocks after which a pair counts as changed, or as unchanged again
_FEWEST: Final = 8  # legs in each direction, and sums, in a block
_MOST: Final = 4096  # legs in a block
_LONGEST_GAP_S: Final = 0.1  # between two phases used for interpolation
_LARGEST_SCATTER: Final = 0.12  # cycles, of one sum
_DRIFT_TICKS_PER_S: Final = MAX_BRACKET_RATE * TICK_RATE_HZ
_LONGEST_JUMP_TICKS: Final = TICK_RATE_HZ  # if clocks may have drifted farther, a restart cannot be recognised


def circular_mean(cycles: Array) -> tuple[float, float]:
    """Mean in [0, 1) and standard deviation of phases without outliers, in cycles. ``cycles``: shape (n,), n > 0."""
    kept, mean = cycles, 0.0
    for sigmas in (1e9, 5.0, 3.0, 3.0, 3.0, 3.0):  # many wild phases move the first means
        off = (cycles - mean + 0.5) % 1.0 - 0.5
        kept = off[np.abs(off) <= sigmas * STD_OVER_MAD * float(np.median(np.abs(off))) + 1e-9]
        mean += float(np.angle(np.exp(2j * np.pi * kept).sum()) / (2.0 * np.pi))
    return mean % 1.0, float(np.std(kept))


class _Pair(Struct):
    """Legs of a pair in the current block, its reference sums, and its change."""

    legs: list[AnchorLeg] = field(default_factory=list)
    block: int = 0
    """Number of the current block."""
    usual_cycles: deque[float] = field(default_factory=lambda: deque(maxlen=_USUAL_BLOCKS))
    clock_ticks: int = 0
    """Difference of the counters in block ``clock_block``."""
    clock_block: int = 0
    change_cycles: float = 0.0
    strikes: int = 0
    since_s: float | None = None
    """Time of the change; None while unchanged."""

    def add(self, cycles: float, std_cycles: float, limit_cycles: float) -> None:
        """Compare the current block's sum with the reference."""
        is_off = False
        if len(self.usual_cycles) >= _LEARNING_BLOCKS:
            usual, scatter = circular_mean(np.array(self.usual_cycles))
            change = math.remainder(cycles - usual, 1.0)
            is_off = abs(change) > max(limit_cycles, _SIGMAS * math.hypot(scatter, std_cycles))
            self.change_cycles = change if is_off else self.change_cycles
        self.strikes = min(self.strikes + 1, _STRIKES) if is_off else max(self.strikes - 1, 0)
        if self.strikes == _STRIKES and self.since_s is None:
            self.since_s = (self.block - _STRIKES + 1) * BLOCK_S
        elif self.strikes == 0:
            self.since_s = None
            self.usual_cycles.append(cycles)


class PhaseWatch:
    """Finds anchors that have moved by more than 2 mm, or turned. Times are ``t_s`` of the legs."""

    def __init__(self, carrier_cycles: int = CARRIER_CYCLES[5]) -> None:
        """``carrier_cycles``: carrier cycles in 128 ticks."""
        self._cycles_per_tick = carrier_cycles / 128
        self._half_wave_m = TICK_M / self._cycles_per_tick / 2.0
        self._pairs: dict[tuple[int, int], _Pair] = {}

    def add(self, leg: AnchorLeg) -> None:
        """Add a leg, in any order within a second. A leg without a phase is ignored."""
        phase_cycles = leg.carrier_phase_cycles
        if phase_cycles is None or leg.sender == leg.receiver or not math.isfinite(phase_cycles + leg.t_s):
            return
        pair, block = (min(leg.sender, leg.receiver), max(leg.sender, leg.receiver)), math.floor(leg.t_s / BLOCK_S)
        one = self._pairs.setdefault(pair, _Pair(block=block))
        if not one.block - 1 <= block <= one.block:
            self._conclude(pair, one)
            one.block = block
        if len(one.legs) < _MOST:
            one.legs.append(leg)

    def _conclude(self, pair: tuple[int, int], one: _Pair) -> None:
        """Evaluate a finished block. If a counter has restarted, the reference is learned again."""
        found = _sum_of(one.legs, pair[0], self._cycles_per_tick)
        one.legs.clear()
        if found is None:
            return
        cycles, std_cycles, clock_ticks = found
        limit_ticks = _DRIFT_TICKS_PER_S * BLOCK_S * (abs(one.block - one.clock_block) + 1)
        if not abs(difference(clock_ticks, one.clock_ticks)) <= limit_ticks <= _LONGEST_JUMP_TICKS:
            one.usual_cycles.clear()
        one.clock_ticks, one.clock_block = clock_ticks, one.block
        one.add(cycles, std_cycles, _LIMIT_M / self._half_wave_m)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Anchors with most of their pairs changed, at least two, while most pairs of the others have not."""
        rest = {pair: one for pair, one in self._pairs.items() if len(one.usual_cycles) >= _LEARNING_BLOCKS}
        found = []
        while changed := {pair: one for pair, one in rest.items() if one.since_s is not None}:
            ends, all_ends = (Counter(end for pair in pairs for end in pair) for pairs in (changed, rest))
            worst = max(ends, key=lambda anchor: (ends[anchor] / all_ends[anchor], ends[anchor]))
            if ends[worst] < 2 or 2 * ends[worst] <= all_ends[worst]:
                break
            found.append(self._finding(worst, [one for pair, one in changed.items() if worst in pair]))
            rest = {pair: one for pair, one in rest.items() if worst not in pair}
        return tuple(found) if 2 * len(changed) <= len(rest) > 0 else ()

    def _finding(self, anchor: int, changed: list[_Pair]) -> Finding:
        half_m, size_m = self._half_wave_m, max(abs(one.change_cycles) for one in changed) * self._half_wave_m
        alike = ", ".join(f"{1e3 * other_m:.0f}" for other_m in (half_m - size_m, half_m + size_m, 2 * half_m - size_m))
        sentence = f"anchor {anchor} moved or turned by about {1e3 * size_m:.0f} mm (or {alike} …)"
        since_s = min(one.since_s for one in changed if one.since_s is not None)
        return Finding("check", (anchor,), size_m, None, since_s, f"{sentence}, by the phases of its carrier")


def _sum_of(legs: list[AnchorLeg], first: int, cycles_per_tick: float) -> tuple[float, float, int] | None:
    """Phase sum of both directions and its standard deviation in cycles, and the counters' difference in ticks.

    None if there are too few legs or the sums scatter too much.
    """
    if len(legs) < 2 * _FEWEST:
        return None
    is_out = np.array([leg.sender == first for leg in legs])
    stamps = [(leg.tx_ticks, leg.rx_ticks) if leg.sender == first else (leg.rx_ticks, leg.tx_ticks) for leg in legs]
    clock_ticks = stamps[0][1] - stamps[0][0]
    gained = np.array([difference(y_ticks - x_ticks, clock_ticks) for x_ticks, y_ticks in stamps], np.float64)
    gained -= (middle := float(np.median(gained)))
    begin_ticks = stamps[int(np.argmin(np.abs(gained)))][0]
    t_s = np.array([difference(x_ticks, begin_ticks) for x_ticks, _ in stamps]) / TICK_RATE_HZ
    run = np.flatnonzero(np.abs(gained) < 2.0 * BLOCK_S * _DRIFT_TICKS_PER_S)  # one run of both counters
    run = run[np.argsort(t_s[run])]
    t_s, gained, is_out = t_s[run], gained[run], is_out[run]
    if min(is_out.sum(), (~is_out).sum()) < _FEWEST:
        return None
    way = np.where(is_out, 1.0, -1.0)
    terms = np.stack([t_s, t_s * t_s, way, np.ones(len(run))], axis=1)  # flight and delays change sign with direction
    off_ticks, fit = np.zeros(len(run)), np.zeros(4)
    for _ in range(2):
        near = np.abs(off_ticks) <= _SIGMAS * STD_OVER_MAD * float(np.median(np.abs(off_ticks)))
        fit = np.linalg.lstsq(terms[near], gained[near])[0]
        off_ticks = gained - terms @ fit
    off = -np.array([leg.carrier_phase_cycles for leg in legs])[run] % 1.0
    off -= way * cycles_per_tick * (terms[:, :2] @ fit[:2])
    back_s, at_s = t_s[~is_out], t_s[is_out]
    after = np.clip(np.searchsorted(back_s, at_s), 1, len(back_s) - 1)
    between = (back_s[after - 1] <= at_s) & (at_s <= back_s[after])
    between &= back_s[after] - back_s[after - 1] <= _LONGEST_GAP_S
    if between.sum() < _FEWEST:
        return None
    sums = off[is_out] + np.interp(at_s, back_s, np.unwrap(off[~is_out], period=1.0))
    cycles, scatter = circular_mean(sums[between])
    if scatter > _LARGEST_SCATTER:
        return None
    return cycles, scatter / math.sqrt(between.sum()), clock_ticks + round(middle)
