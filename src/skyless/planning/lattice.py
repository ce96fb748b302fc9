"""A quick search for places of anchors: exchange on a lattice of mounts, judged by pseudoranges of one superframe.

The error that counts here is that of (HᵀWH)⁻¹ with each anchor weighted by the share of its frames that arrives. It
knows no method; what it finds is judged, and improved, by the method's own prediction.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from skyless.kernels.arrays import Integers, Matrix, Vector
from skyless.kernels.compiled import kernel, threaded_kernel
from skyless.kernels.linear_algebra import factorise, invert
from skyless.planning.links import links

CLOSEST_M: Final = 0.3
"""Anchors nearer to each other than this are not considered."""

LEAST_HEARD: Final = 0.5
"""Share of the master's frames below which an anchor loses weight."""

BOTH: Final = 10.0
"""What a mean or a worst error costs that is not clearly better than the reference's, against a gain elsewhere."""

CLEARLY: Final = 0.95


class Lattice(NamedTuple):
    """Candidates for anchors' places, and what each is to the points."""

    places_m: Matrix
    """Shape (candidates, 3)."""
    apart_m: Matrix
    """Distances between them; shape (candidates, candidates)."""
    rows: Matrix
    """Weighted rows [1, unit vector] of H; shape (candidates, points, 1 + dim)."""
    heard: Matrix
    """Share of each candidate's frames that reach each other one; shape (candidates, candidates)."""
    weights: Vector
    """Of the points in a mean; of sum 1."""
    cap_m: float
    """Error that stands for "no position"."""


def lattice_of(
    places_m: Matrix, points_m: Matrix, weights: Vector, budget: Vector, walls: Matrix, dim: int, sigma_m: float
) -> Lattice:
    """Candidates at places, shape (c, 3), for points, shape (m, 3); ``sigma_m`` is a pseudorange's noise."""
    share, _ = links(points_m, places_m, budget, walls)
    heard, _ = links(places_m, places_m, budget, walls)
    np.fill_diagonal(heard, 1.0)
    away = points_m - places_m[:, None]
    unit = away / np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-3)
    rows = np.concatenate([np.ones((*share.shape, 1)), unit[..., :dim]], axis=2) * (np.sqrt(share) / sigma_m)[..., None]
    apart_m = np.linalg.norm(places_m[:, None] - places_m, axis=2)
    cap_m = float(np.linalg.norm(np.ptp(np.concatenate([places_m, points_m]), axis=0)))
    return Lattice(places_m, apart_m, rows, heard, weights, cap_m)


@threaded_kernel
def mean_and_worst(chosen: Integers, lattice: Lattice) -> tuple[float, float]:
    """Mean and largest error over the points for these candidates, the best heard of them being the master."""
    rows, heard = lattice.rows, lattice.heard
    size = rows.shape[2]
    normal, inverse = np.zeros((size, size)), np.zeros((size, size))
    best, master = -1.0, 0
    for i in chosen:
        total = 0.0
        for j in chosen:
            total += min(heard[i, j], 0.9)
        if total > best:
            best, master = total, i
    mean, worst = 0.0, 0.0
    for m in range(rows.shape[1]):
        normal[:] = 0.0
        for i in chosen:
            factor = min(heard[i, master] / LEAST_HEARD, 1.0)
            for a in range(size):
                for b in range(a + 1):
                    normal[a, b] += factor * rows[i, m, a] * rows[i, m, b]
        error = lattice.cap_m
        if factorise(normal, size):
            invert(normal, size, inverse)
            trace = 0.0
            for a in range(1, size):
                trace += inverse[a, a]
            error = min(math.sqrt(trace), error)
        mean += lattice.weights[m] * error
        worst = max(worst, error)
    return mean, worst


@kernel
def relative_score(mean: float, worst: float, mean_reference: float, worst_reference: float) -> float:
    """Mean and worst error against a reference's; dear where either is not clearly smaller."""
    a, b = mean / mean_reference, worst / worst_reference
    return 0.5 * (a + b) + BOTH * (max(a - CLEARLY, 0.0) + max(b - CLEARLY, 0.0))


def exchange(chosen: Integers, fixed: int, lattice: Lattice, reference: tuple[float, float], passes: int) -> float:
    """Move one anchor after the other to its best candidate until none moves; the first ``fixed`` stay. The score."""
    score = relative_score(*mean_and_worst(chosen, lattice), *reference)
    for _ in range(passes):
        before = chosen.copy()
        for k in range(fixed, len(chosen)):
            best = chosen[k]
            others = np.delete(chosen, k)
            free = (lattice.apart_m[:, others] >= CLOSEST_M).all(axis=1)
            for candidate in np.flatnonzero(free):
                chosen[k] = candidate
                trial = relative_score(*mean_and_worst(chosen, lattice), *reference)
                if trial < score * (1.0 - 1e-9):
                    score, best = trial, candidate
            chosen[k] = best
        if (chosen == before).all():
            break
    return score
