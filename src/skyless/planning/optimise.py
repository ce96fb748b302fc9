"""Where anchors should hang: the best of several starts, first on a lattice, then by the method's own prediction.

The evenly spaced layout is one of the starts, so the result is never worse than it. Mean and worst error over the
region count alike, relative to that layout's. Same seed, same result, unless the time runs out before the search ends.
"""

import time
from collections.abc import Callable
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Integers, Matrix, Vector
from skyless.planning.anchor_clocks import stamp_variances
from skyless.planning.columns import FIX_SHARE, SIGMA
from skyless.planning.floor import Floor
from skyless.planning.lattice import CLOSEST_M, exchange, lattice_of, mean_and_worst, relative_score
from skyless.planning.links import link_budget
from skyless.planning.mounts import (
    Layout,
    Mounts,
    even_layout,
    masters_by_links,
    sample_points,
    site_with,
    site_with_one_more,
)
from skyless.planning.predict import PlanSettings, Predictor, with_noise
from skyless.simulation.channel import pack_walls
from skyless.site.model import Site

SEARCH_POINTS: Final = 140
JUDGE_POINTS: Final = 1500
MOST_CANDIDATES: Final = 220
STARTS: Final = 16
REFINED: Final = 4
"""Starts that the method's own prediction improves further, the even layout among them."""

FINEST_M: Final = 0.05

PASSES: Final = 12
"""Of an exchange on the lattice, at most."""


class Scored(Struct, frozen=True):
    """A layout as a site, and its predicted standard deviation over the region, metres."""

    site: Site
    mean_sigma_m: float
    worst_sigma_m: float
    covered_share: float


class Optimised(Struct, frozen=True):
    """The result beside the even layout of as many anchors."""

    best: Scored
    even: Scored
    evaluations: int
    finished: bool
    """Whether the search came to its end before the time did."""
    target_met: bool | None


class Search:
    """One optimisation: what is sought, and how far it has come."""

    def __init__(
        self,
        site: Site,
        settings: PlanSettings,
        floor: Floor,
        mounts: Mounts,
        heights_m: tuple[float, ...],
        anchors: int,
        seed: int,
        seconds: float,
    ) -> None:
        self._site, self._settings, self._mounts, self._anchors = site, settings, mounts, anchors
        self._budget, self._walls = link_budget(settings.channel), pack_walls(site.walls)
        self._points = sample_points(floor, heights_m, SEARCH_POINTS)
        self._judge_points = sample_points(floor, heights_m, JUDGE_POINTS)
        self._random = np.random.default_rng([seed, anchors])
        self._begin_s, self._seconds = time.monotonic(), seconds
        self._cap_m = float(np.linalg.norm(np.ptp(mounts.segments_m.reshape(-1, 2), axis=0)))
        self.evaluations = 0

    def run(self, target_m: float | None = None, progress: Callable[[float], None] | None = None) -> Optimised:
        """Search until nothing improves or the time is up; ``progress`` gets the share of the time."""
        self._progress = progress
        even = even_layout(self._mounts, self._anchors)
        starts = [even, *self._lattice_starts(even)]
        reference = self._score(even)
        improved = [self._refine(start, reference) for start in starts[:REFINED]]
        judged = [self._judge(layout) for layout in [even, *improved]]
        first = judged[0]
        best = min(judged, key=lambda s: _against(s, first))
        met = None if target_m is None else best.covered_share == 1.0 and best.worst_sigma_m <= target_m
        return Optimised(best, first, self.evaluations, not self._late(), met)

    def _late(self) -> bool:
        passed = (time.monotonic() - self._begin_s) / self._seconds
        if self._progress is not None:
            self._progress(min(passed, 1.0))
        return passed >= 1.0

    # On the lattice

    def _lattice_starts(self, even: Layout) -> list[Layout]:
        all_ways, all_levels = _candidates(self._mounts, MOST_CANDIDATES, 2 * self._anchors)
        dim = 3 if self._site.tags.height_m is None else 2
        noise_m = sum(stamp_variances(with_noise(self._site, self._settings.noise_ps))) ** 0.5
        places = self._mounts.at(all_ways, all_levels)
        lattice = lattice_of(places, *self._points, self._budget, self._walls, dim, noise_m)
        snapped = np.array([_nearest(places, place) for place in self._mounts.at(even.ways_m, even.levels)])
        reference = mean_and_worst(snapped, lattice)
        found = []
        for number in range(STARTS):
            chosen = snapped.copy() if number == 0 else self._random.choice(len(places), self._anchors, replace=False)
            score = exchange(chosen, 0, lattice, reference, PASSES)
            found.append((score, Layout(all_ways[chosen], all_levels[chosen])))
            if self._late():
                break
        found.sort(key=lambda pair: pair[0])
        return [layout for _, layout in found]

    # By the method's own prediction

    def _site_of(self, layout: Layout, rank: int = 0) -> Site:
        places = self._mounts.at(layout.ways_m, layout.levels)
        master = int(masters_by_links(places, self._budget, self._walls)[rank])
        return site_with(self._site, places, master)

    def _sigma(self, site: Site, sample: tuple[Matrix, Vector]) -> tuple[float, float, float]:
        """Mean and worst over the points, those without a fix counting as lost; and the share with one."""
        self.evaluations += 1
        rows = Predictor(site, self._settings).at(sample[0])
        covered = rows[:, FIX_SHARE] >= 0.5
        sigma = np.where(covered, np.minimum(rows[:, SIGMA], self._cap_m), self._cap_m)
        return float(sample[1] @ sigma), float(sigma.max()), float(covered.mean())

    def _score(self, layout: Layout) -> tuple[float, float]:
        mean, worst, _ = self._sigma(self._site_of(layout), self._points)
        return mean, worst

    def _refine(self, start: Layout, reference: tuple[float, float]) -> Layout:
        """Shift one anchor after the other along the walls, by less and less, and between the heights."""
        layout, step = start, self._mounts.length_m / (2.0 * self._anchors)
        score = relative_score(*self._score(layout), *reference)
        while step >= FINEST_M and not self._late():
            better = False
            for k in self._random.permutation(self._anchors):
                for trial in self._moves(layout, int(k), step):
                    if self._late():
                        break
                    value = relative_score(*self._score(trial), *reference)
                    if value < score * (1.0 - 1e-4):
                        layout, score, better = trial, value, True
                        break
            if not better:
                step /= 2.0
        return layout

    def _moves(self, layout: Layout, k: int, step: float) -> list[Layout]:
        """Layouts with one anchor elsewhere, a step away or anywhere, far enough from all others."""
        moves = []
        for shift in (step, -step, self._random.uniform(step, self._mounts.length_m - step)):
            ways = layout.ways_m.copy()
            ways[k] = (ways[k] + shift) % self._mounts.length_m
            moves.append(Layout(ways, layout.levels))
        for level in range(len(self._mounts.heights_m)):
            if level != layout.levels[k]:
                levels = layout.levels.copy()
                levels[k] = level
                moves.append(Layout(layout.ways_m, levels))
        return [move for move in moves if self._apart(move, k)]

    def _apart(self, layout: Layout, k: int) -> bool:
        places = self._mounts.at(layout.ways_m, layout.levels)
        distances = np.linalg.norm(np.delete(places, k, axis=0) - places[k], axis=1)
        return bool(distances.min(initial=np.inf) >= CLOSEST_M)

    def _judge(self, layout: Layout) -> Scored:
        """Score on many more points, with the best of the masters that are heard about equally well."""
        scored = []
        for rank in range(min(3, self._anchors)):
            site = self._site_of(layout, rank)
            scored.append(Scored(site, *self._sigma(site, self._judge_points)))
        return min(scored, key=lambda s: s.mean_sigma_m * s.worst_sigma_m)


def _against(scored: Scored, even: Scored) -> float:
    return relative_score(scored.mean_sigma_m, scored.worst_sigma_m, even.mean_sigma_m, even.worst_sigma_m)


def _candidates(mounts: Mounts, most: int, least: int = 1) -> tuple[Vector, Integers]:
    """Ways along the walls and levels of some candidates, evenly spaced at every height."""
    levels = len(mounts.heights_m)
    count = max(most // levels, least)
    return np.repeat(np.arange(count) * mounts.length_m / count, levels), np.tile(np.arange(levels), count)


def _nearest(places: Matrix, place: Vector) -> int:
    return int(np.argmin(np.linalg.norm(places - place, axis=1)))


class OneMore(Struct, frozen=True):
    """Where one more anchor helps most, and how much: means and worst over the region, metres."""

    place_m: tuple[float, float, float]
    mean_before_m: float
    mean_after_m: float
    worst_before_m: float
    worst_after_m: float


def one_more(
    site: Site, settings: PlanSettings, floor: Floor, mounts: Mounts, heights_m: tuple[float, ...]
) -> OneMore | None:
    """Try one more anchor at a hundred places; None where no place is free.

    The place follows from the quick measure of ``lattice``, what it brings from the method's own prediction.
    """
    before = Predictor(site, settings)
    points, weights = sample_points(floor, heights_m, SEARCH_POINTS)
    free = mounts.at(*_candidates(mounts, MOST_CANDIDATES // 2))
    places = np.concatenate([before.anchors_m, free])
    noise_m = sum(stamp_variances(before.site)) ** 0.5
    lattice = lattice_of(places, points, weights, before.budget, before.walls, before.dim, noise_m)
    n = len(before.anchors_m)
    gaps = np.linalg.norm(free[:, None] - before.anchors_m[None], axis=2).min(axis=1)
    if not (gaps >= CLOSEST_M).any():
        return None
    chosen = np.append(np.arange(n), n + int(np.argmax(gaps)))
    exchange(chosen, n, lattice, mean_and_worst(np.arange(n), lattice), PASSES)
    place = places[chosen[n]]
    after = Predictor(site_with_one_more(site, place), settings)
    (mean_before, worst_before), (mean_after, worst_after) = (
        _mean_and_worst(predictor.at(points)[:, SIGMA], weights, lattice.cap_m) for predictor in (before, after)
    )
    x, y, z = place.tolist()
    return OneMore((x, y, z), mean_before, mean_after, worst_before, worst_after)


def _mean_and_worst(sigma: Vector, weights: Vector, cap_m: float) -> tuple[float, float]:
    capped = np.minimum(sigma, cap_m)
    return float(weights @ capped), float(capped.max())
