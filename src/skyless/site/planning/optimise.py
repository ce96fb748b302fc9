"""Optimise anchor positions: the best of several starts, first on a lattice, then by the filter's prediction.

A quick search exchanges anchors on a lattice of mounts. Its error measure is (HᵀWH)⁻¹ with each anchor weighted by the
share of its frames that arrives. The results are then improved and judged by the filter's prediction. The evenly spaced
layout is one of the starts, so the result is never worse. Mean and worst error over the region count equally, relative
to those of that layout. The same seed gives the same result, unless time runs out.
"""

import time
from collections.abc import Callable
from math import sqrt
from typing import Annotated, Final, NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.arrays import Integers, Matrix, Vector
from skyless.core.native.arithmetic import factorise, solve
from skyless.core.native.library import KERNELS, compiled
from skyless.core.native.records import Array, Reals, Record, Ticks, record
from skyless.core.site import AnchorSite, Site
from skyless.site.channel import Barriers, ChannelModel, barriers_of
from skyless.site.planning.links import (
    FIX_SHARE,
    SIGMA,
    Floor,
    Mounts,
    link_budget,
    links,
    masters_by_links,
    sample_points,
)
from skyless.site.planning.maps import Predictor
from skyless.site.planning.superframe import stamp_variances

_SEARCH_POINTS: Final = 140
_JUDGE_POINTS: Final = 1500
_MAX_CANDIDATES: Final = 220
_STARTS: Final = 16
_REFINED: Final = 4  # starts improved further by the filter's prediction, including the even layout
_FINEST_M: Final = 0.05

_MAX_PASSES: Final = 12  # of an exchange on the lattice
_CLOSEST_M: Final = 0.3  # least distance between anchors
_MIN_HEARD: Final = 0.5  # share of the master's frames below which an anchor loses weight
_PENALTY: Final = 10.0
"""Penalty factor for a mean or worst error that is not clearly smaller than the reference's."""

_CLEARLY_SMALLER: Final = 0.95

_NOTICEABLE: Final = 0.05  # relative reduction of an error that makes one more anchor worth mounting


# Layouts


class Layout(Struct, frozen=True):
    """Anchors on mounts."""

    along_m: Vector
    """Distance of each anchor along the walls."""
    levels: Integers
    """Index of each anchor's height."""


def even_layout(mounts: Mounts, anchors: int) -> Layout:
    """Anchors evenly spaced along the walls, with heights in turn."""
    return Layout(np.arange(anchors) * mounts.length_m / anchors, np.arange(anchors) % len(mounts.heights_m))


def site_with(site: Site, anchors_m: Matrix, master: int) -> Site:
    """The site with other anchors, shape (n, 3), numbered from 1; ``master``: row of the master."""
    anchors = tuple(AnchorSite(k + 1, *position) for k, position in enumerate(anchors_m.tolist()))
    schedule = replace(site.schedule, slots=None)
    return replace(site, anchors=anchors, master=master + 1, schedule=schedule)


def site_with_one_more(site: Site, position_m: Vector) -> Site:
    """The site with one more anchor; if needed, the superframe grows by a slot for each of its frames."""
    number = max(anchor.id for anchor in site.anchors) + 1
    slots, schedule = site.schedule.slots, site.schedule
    if slots is not None and slots < (len(site.anchors) + 1) * schedule.frames_per_node:
        schedule = replace(schedule, slots=None)
    return replace(site, anchors=(*site.anchors, AnchorSite(number, *position_m.tolist())), schedule=schedule)


# The quick search on a lattice


class Lattice(NamedTuple):
    """Precomputed contributions of candidate anchor positions to the points."""

    apart_m: Matrix
    """Distances between candidates; shape (candidates, candidates)."""
    rows: Matrix
    """Weighted rows [1, unit vector] of H; shape (candidates, points, 1 + dim)."""
    heard: Matrix
    """Share of each candidate's frames that reaches each other one; shape (candidates, candidates)."""
    weights: Vector
    """Weights of the points in a mean, with sum 1."""
    cap_m: float
    """Error used for "no position"."""


def lattice_of(
    candidates_m: Matrix,
    points_m: Matrix,
    weights: Vector,
    budget: Vector,
    barriers: Barriers,
    dim: int,
    sigma_m: float,
    *,
    has_master: bool = True,
) -> Lattice:
    """The lattice of candidates, shape (c, 3), and points, shape (m, 3); ``sigma_m``: noise of a pseudorange."""
    share, _ = links(points_m, candidates_m, budget, barriers)
    heard, _ = links(candidates_m, candidates_m, budget, barriers) if has_master else (np.ones((len(share),) * 2), None)
    np.fill_diagonal(heard, 1.0)
    away = points_m - candidates_m[:, None]
    unit = away / np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-3)
    rows = np.concatenate([np.ones((*share.shape, 1)), unit[..., :dim]], axis=2) * (np.sqrt(share) / sigma_m)[..., None]
    apart_m = np.linalg.norm(candidates_m[:, None] - candidates_m, axis=2)
    cap_m = float(np.linalg.norm(np.ptp(np.concatenate([candidates_m, points_m]), axis=0)))
    return Lattice(apart_m, rows, heard, weights, cap_m)


@record
class Verdict(Record):
    """Errors over the points of a lattice, and memory to compute them."""

    mean: float
    worst: float
    normal: Annotated[Reals, 10]
    column: Annotated[Reals, 4]


def judge(
    chosen: Array[Ticks],
    count: int,
    heard: Reals,
    candidates: int,
    rows: Reals,
    weights: Reals,
    points: int,
    size: int,
    cap_m: float,
    v: Verdict,
) -> None:
    """Fill the verdict on the chosen candidates, with the best received one as the master."""
    best, master = -1.0, 0
    for one in range(count):
        total = 0.0
        for other in range(count):
            total += min(heard[chosen[one] * candidates + chosen[other]], 0.9)
        if total > best:
            best, master = total, one
    v.mean, v.worst = 0.0, 0.0
    for m in range(points):
        for k in range(size * (size + 1) // 2):
            v.normal[k] = 0.0
        for one in range(count):
            factor = min(heard[chosen[one] * candidates + chosen[master]] / _MIN_HEARD, 1.0)
            begin = (chosen[one] * points + m) * size
            for a in range(size):
                for b in range(a + 1):
                    v.normal[a * (a + 1) // 2 + b] += factor * rows[begin + a] * rows[begin + b]
        error = cap_m
        if factorise(v.normal, size):
            trace = 0.0
            for a in range(1, size):
                for b in range(size):
                    v.column[b] = 1.0 if a == b else 0.0
                solve(v.normal, size, v.column)
                trace += v.column[a]
            error = min(sqrt(trace), error)
        v.mean += weights[m] * error
        v.worst = max(v.worst, error)


_judge = compiled(judge, KERNELS)


def mean_and_worst(chosen: Integers, lattice: Lattice) -> tuple[float, float]:
    """Mean and largest error over the points for these candidates, with the best received one as the master."""
    verdict = Verdict()
    candidates, points, size = lattice.rows.shape
    heard, rows = lattice.heard.reshape(-1), lattice.rows.reshape(-1)
    _judge(chosen, len(chosen), heard, candidates, rows, lattice.weights, points, size, lattice.cap_m, verdict)
    return verdict.mean, verdict.worst


def relative_score(mean: float, worst: float, mean_reference: float, worst_reference: float) -> float:
    """Mean of both errors relative to a reference, with a penalty for one that is not clearly smaller."""
    a, b = mean / mean_reference, worst / worst_reference
    return 0.5 * (a + b) + _PENALTY * (max(a - _CLEARLY_SMALLER, 0.0) + max(b - _CLEARLY_SMALLER, 0.0))


def exchange(
    chosen: Integers,
    fixed: int,
    lattice: Lattice,
    reference: tuple[float, float],
    passes: int,
    late: Callable[[], bool] = lambda: False,
) -> float:
    """Move each anchor in turn to its best candidate until none moves, except the first ``fixed``. Returns the score.

    Stops early once ``late()``.
    """
    score = relative_score(*mean_and_worst(chosen, lattice), *reference)
    for _ in range(passes):
        before = chosen.copy()
        for k in range(fixed, len(chosen)):
            if late():
                return score
            best = chosen[k]
            free = (lattice.apart_m[:, np.delete(chosen, k)] >= _CLOSEST_M).all(axis=1)
            for candidate in np.flatnonzero(free):
                chosen[k] = candidate
                trial = relative_score(*mean_and_worst(chosen, lattice), *reference)
                if trial < score * (1.0 - 1e-9):
                    score, best = trial, candidate
            chosen[k] = best
        if (chosen == before).all():
            break
    return score


# The search by the filter's prediction


class Scored(Struct, frozen=True):
    """A layout as a site, and its predicted standard deviation over the region, metres."""

    site: Site
    mean_sigma_m: float
    worst_sigma_m: float
    covered_share: float


class Optimised(Struct, frozen=True):
    """Result of an optimisation, with the even layout of the same number of anchors."""

    best: Scored
    even: Scored
    evaluations: int
    finished: bool
    """Whether the search was completed before time ran out or Ctrl-C was pressed."""
    target_met: bool | None


class Search:
    """One optimisation: its parameters and state."""

    def __init__(
        self,
        site: Site,
        channel: ChannelModel,
        floor: Floor,
        mounts: Mounts,
        heights_m: tuple[float, ...],
        anchors: int,
        seed: int,
        seconds: float,
    ) -> None:
        self._site, self._channel, self._mounts, self._anchors = site, channel, mounts, anchors
        self._budget, self._barriers = link_budget(channel), barriers_of(site.walls, site.storeys)
        self._points = sample_points(floor, heights_m, _SEARCH_POINTS)
        self._floor, self._heights_m = floor, heights_m
        self._random = np.random.default_rng([seed, anchors])
        self._begin_s, self._seconds = time.monotonic(), seconds
        self._cap_m = float(np.linalg.norm(np.ptp(mounts.segments_m.reshape(-1, 2), axis=0)))
        self._found: list[tuple[float, Layout]] = []
        """The best layout of each refined start, with its score."""
        self.evaluations = 0

    def run(self, target_m: float | None = None, progress: Callable[[float], None] | None = None) -> Optimised:
        """Search until nothing improves, time is up, or Ctrl-C. Returns the best result so far.

        ``progress`` is called with the share of the time.
        """
        self._progress = progress
        even = even_layout(self._mounts, self._anchors)
        reference = self._score(even)  # not timed, as the first call also loads kernels
        thorough = self._plan_judging(even)
        first = self._judge(even)
        judged, finished = [first], False
        try:
            for start in [even, *self._lattice_starts(even)][:_REFINED]:
                self._refine(start, reference)
            finished = thorough and not self._late()
            judged += [self._judge(layout) for _, layout in self._found]
        except KeyboardInterrupt:
            if self._found:
                judged.append(self._judge(min(self._found, key=lambda found: found[0])[1]))
        usual = first.mean_sigma_m, first.worst_sigma_m
        best = min(judged, key=lambda s: relative_score(s.mean_sigma_m, s.worst_sigma_m, *usual))
        met = None if target_m is None else best.covered_share == 1.0 and best.worst_sigma_m <= target_m
        return Optimised(best, first, self.evaluations, finished, met)

    def _plan_judging(self, layout: Layout) -> bool:
        """Choose the numbers of points and masters for judging layouts, so that this takes at most half of the time.

        Returns whether the largest numbers are possible.
        """
        begin_s = time.monotonic()
        self._score(layout)
        score_s = time.monotonic() - begin_s
        for masters, points in ((3, _JUDGE_POINTS), (3, 4 * _SEARCH_POINTS), (1, 2 * _SEARCH_POINTS), (1, 0)):
            sample = sample_points(self._floor, self._heights_m, points) if points else self._points
            judging_s = score_s * masters * len(sample[1]) / len(self._points[1])
            if (_REFINED + 1) * judging_s < 0.5 * self._seconds:
                break
        self._masters, self._judge_points = masters, sample
        self._search_s = max(self._seconds - _REFINED * (judging_s + score_s), 0.1 * self._seconds)
        return masters > 1 and points == _JUDGE_POINTS

    def _late(self) -> bool:
        """Whether the search must end, to leave time to judge its results."""
        passed = (time.monotonic() - self._begin_s) / self._search_s
        if self._progress is not None:
            self._progress(min(passed, 1.0))
        return passed >= 1.0

    # On the lattice

    def _lattice_starts(self, even: Layout) -> list[Layout]:
        all_along_m, all_levels = _candidates(self._mounts, _MAX_CANDIDATES, 2 * self._anchors)
        dim = 3 if self._site.tags.height_m is None else 2
        noise_m = sum(stamp_variances(self._site)) ** 0.5
        candidates_m = self._mounts.at(all_along_m, all_levels)
        has_master = self._site.schedule.needs_master
        lattice = lattice_of(
            candidates_m, *self._points, self._budget, self._barriers, dim, noise_m, has_master=has_master
        )
        even_m = self._mounts.at(even.along_m, even.levels)
        snapped = np.array([np.argmin(np.linalg.norm(candidates_m - anchor_m, axis=1)) for anchor_m in even_m])
        reference = mean_and_worst(snapped, lattice)
        found = []
        for number in range(_STARTS):
            chosen = (
                snapped.copy() if number == 0 else self._random.choice(len(candidates_m), self._anchors, replace=False)
            )
            score = exchange(chosen, 0, lattice, reference, _MAX_PASSES, self._late)
            found.append((score, Layout(all_along_m[chosen], all_levels[chosen])))
            if self._late():
                break
        found.sort(key=lambda pair: pair[0])
        return [layout for _, layout in found]

    # By the filter's prediction

    def _site_of(self, layout: Layout, rank: int = 0) -> Site:
        anchors_m = self._mounts.at(layout.along_m, layout.levels)
        return site_with(self._site, anchors_m, int(masters_by_links(anchors_m, self._budget, self._barriers)[rank]))

    def _sigma(self, site: Site, sample: tuple[Matrix, Vector]) -> tuple[float, float, float]:
        """Mean and worst standard deviation over the points, capped, as without a fix; and the share with a fix."""
        self.evaluations += 1
        rows = Predictor(site, self._channel).at(sample[0])
        covered = rows[:, FIX_SHARE] >= 0.5
        sigma = np.where(covered, np.minimum(rows[:, SIGMA], self._cap_m), self._cap_m)
        return float(sample[1] @ sigma), float(sigma.max()), float(covered.mean())

    def _score(self, layout: Layout) -> tuple[float, float]:
        return self._sigma(self._site_of(layout), self._points)[:2]

    def _refine(self, start: Layout, reference: tuple[float, float]) -> None:
        """Shift anchors along the walls, by decreasing steps, and between heights while that improves the score."""
        layout, step = start, self._mounts.length_m / (2.0 * self._anchors)
        score = relative_score(*self._score(layout), *reference)
        self._found.append((score, layout))
        while step >= _FINEST_M and not self._late():
            better = False
            for k in self._random.permutation(self._anchors):
                for trial in self._moves(layout, int(k), step):
                    if self._late():
                        break
                    value = relative_score(*self._score(trial), *reference)
                    if value < score * (1.0 - 1e-4):
                        layout, score, better = trial, value, True
                        self._found[-1] = score, layout
                        break
            if not better:
                step /= 2.0

    def _moves(self, layout: Layout, k: int, step: float) -> list[Layout]:
        """Layouts with anchor ``k`` moved, by a step or anywhere, but not too close to another."""
        moves = []
        for shift in (step, -step, self._random.uniform(step, self._mounts.length_m - step)):
            along_m = layout.along_m.copy()
            along_m[k] = (along_m[k] + shift) % self._mounts.length_m
            moves.append(Layout(along_m, layout.levels))
        for level in range(len(self._mounts.heights_m)):
            if level != layout.levels[k]:
                levels = layout.levels.copy()
                levels[k] = level
                moves.append(Layout(layout.along_m, levels))
        return [move for move in moves if self._apart(move, k)]

    def _apart(self, layout: Layout, k: int) -> bool:
        anchors_m = self._mounts.at(layout.along_m, layout.levels)
        distances = np.linalg.norm(np.delete(anchors_m, k, axis=0) - anchors_m[k], axis=1)
        return bool(distances.min(initial=np.inf) >= _CLOSEST_M)

    def _judge(self, layout: Layout) -> Scored:
        """Score at many more points, with the best of the best received masters."""
        sites = [self._site_of(layout, rank) for rank in range(min(self._masters, self._anchors))]
        scored = [Scored(site, *self._sigma(site, self._judge_points)) for site in sites]
        return min(scored, key=lambda s: s.mean_sigma_m * s.worst_sigma_m)


def _candidates(mounts: Mounts, most: int, least: int = 1) -> tuple[Vector, Integers]:
    """Distances along the walls and levels of candidates, evenly spaced at every height."""
    levels = len(mounts.heights_m)
    count = max(most // levels, least)
    return np.repeat(np.arange(count) * mounts.length_m / count, levels), np.tile(np.arange(levels), count)


class OneMore(Struct, frozen=True):
    """Best position of one more anchor, and its effect on mean and worst error over the region, metres."""

    position_m: tuple[float, float, float]
    mean_before_m: float
    mean_after_m: float
    worst_before_m: float
    worst_after_m: float
    helps: bool
    """Whether the anchor noticeably lowers the mean or the worst error, and does not raise the other as much."""


def one_more(
    site: Site, channel: ChannelModel, floor: Floor, mounts: Mounts, heights_m: tuple[float, ...]
) -> OneMore | None:
    """Try one more anchor at a hundred positions; None if none is free.

    The quick search on the lattice gives the position, the filter's prediction its benefit.
    """
    before = Predictor(site, channel)
    points, weights = sample_points(floor, heights_m, _SEARCH_POINTS)
    free = mounts.at(*_candidates(mounts, _MAX_CANDIDATES // 2))
    candidates_m = np.concatenate([before.anchors_m, free])
    noise_m = sum(stamp_variances(site)) ** 0.5
    lattice = lattice_of(
        candidates_m, points, weights, before.budget, before.barriers, before.dim, noise_m,
        has_master=before.master is not None,
    )  # fmt: skip
    n = len(before.anchors_m)
    gaps = np.linalg.norm(free[:, None] - before.anchors_m[None], axis=2).min(axis=1)
    if not (gaps >= _CLOSEST_M).any():
        return None
    chosen = np.append(np.arange(n), n + int(np.argmax(gaps)))
    exchange(chosen, n, lattice, mean_and_worst(np.arange(n), lattice), _MAX_PASSES)
    position_m = candidates_m[chosen[n]]
    after = Predictor(site_with_one_more(site, position_m), channel)
    (mean_before, worst_before), (mean_after, worst_after) = (
        _mean_and_worst(predictor.at(points)[:, SIGMA], weights, lattice.cap_m) for predictor in (before, after)
    )
    x, y, z = position_m.tolist()
    changes = mean_after / mean_before - 1.0, worst_after / worst_before - 1.0
    helps = min(changes) <= -_NOTICEABLE and max(changes) < _NOTICEABLE
    return OneMore((x, y, z), mean_before, mean_after, worst_before, worst_after, helps)


def _mean_and_worst(sigma: Vector, weights: Vector, cap_m: float) -> tuple[float, float]:
    capped = np.minimum(sigma, cap_m)
    return float(weights @ capped), float(capped.max())
