"""A quick search for places of anchors: exchange on a lattice of mounts, judged by pseudoranges of one superframe.

The error that counts here is that of (HᵀWH)⁻¹ with each anchor weighted by the share of its frames that arrives. It
knows no method; what it finds is judged, and improved, by the method's own prediction.
"""

import math
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.compiled import threaded_kernel
from skyless.planning.links import hears
from skyless.uncertainty.cholesky import factorise, invert

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Rows = NDArray[np.float64]
Indices = NDArray[np.int64]

CLOSEST_M: Final = 0.3
"""Anchors nearer to each other than this are not considered."""

LEAST_HEARD: Final = 0.5
"""Share of the master's frames below which an anchor loses weight."""

BOTH: Final = 10.0
"""What a mean or a worst error costs that is not clearly better than the reference's, against a gain elsewhere."""

CLEARLY: Final = 0.95


class Lattice(Struct, frozen=True):
    """Candidates for anchors' places, and what each is to the points."""

    places_m: Matrix
    """Shape (candidates, 3)."""
    rows: Rows
    """Weighted rows [1, unit vector] of H; shape (candidates, points, 4)."""
    heard: Matrix
    """Share of each candidate's frames that reach each other one; shape (candidates, candidates)."""
    weights: Vector
    """Of the points in a mean; of sum 1."""
    dim: int
    cap_m: float
    """Error that stands for "no position"."""


def lattice_of(
    places_m: Matrix, points_m: Matrix, weights: Vector, budget: Vector, walls: Matrix, dim: int, sigma_m: float
) -> Lattice:
    """Candidates at places, shape (c, 3), for points, shape (m, 3); ``sigma_m`` is a pseudorange's noise."""
    rows = np.zeros((len(places_m), len(points_m), 4))
    heard = np.ones((len(places_m), len(places_m)))
    fill_lattice(places_m, points_m, budget, walls, sigma_m, rows, heard)
    cap_m = float(np.linalg.norm(np.ptp(np.concatenate([places_m, points_m]), axis=0)))
    return Lattice(places_m, rows, heard, weights, dim, cap_m)


@threaded_kernel
def fill_lattice(
    places: Matrix, points: Matrix, budget: Vector, walls: Matrix, sigma: float, rows: Rows, heard: Matrix
) -> None:
    """Fill the rows of H and the links between the candidates."""
    for c in range(len(places)):
        for m in range(len(points)):
            share, _ = hears(budget, walls, places[c], points[m])
            distance = 0.0
            for a in range(3):
                distance += (points[m, a] - places[c, a]) ** 2
            weight, distance = math.sqrt(share) / sigma, max(math.sqrt(distance), 1e-3)
            rows[c, m, 0] = weight
            for a in range(3):
                rows[c, m, 1 + a] = weight * (points[m, a] - places[c, a]) / distance
        for other in range(c):
            share, _ = hears(budget, walls, places[c], places[other])
            heard[c, other] = share
            heard[other, c] = share


@threaded_kernel
def mean_and_worst(
    chosen: Indices,
    rows: Rows,
    heard: Matrix,
    weights: Vector,
    dim: int,
    cap: float,
    normal: Matrix,
    inverse: Matrix,
) -> tuple[float, float]:
    """Mean and largest error over the points for these candidates, the best heard of them being the master."""
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
            for a in range(dim + 1):
                for b in range(a + 1):
                    normal[a, b] += factor * rows[i, m, a] * rows[i, m, b]
        error = cap
        if factorise(normal, dim + 1):
            invert(normal, dim + 1, inverse)
            trace = 0.0
            for a in range(1, dim + 1):
                trace += inverse[a, a]
            error = min(math.sqrt(trace), cap)
        mean += weights[m] * error
        worst = max(worst, error)
    return mean, worst


@threaded_kernel
def relative_score(mean: float, worst: float, mean_reference: float, worst_reference: float) -> float:
    """Mean and worst error against a reference's; dear where either is not clearly smaller."""
    a, b = mean / mean_reference, worst / worst_reference
    return 0.5 * (a + b) + BOTH * (max(a - CLEARLY, 0.0) + max(b - CLEARLY, 0.0))


@threaded_kernel
def exchange(
    chosen: Indices,
    fixed: int,
    places: Matrix,
    rows: Rows,
    heard: Matrix,
    weights: Vector,
    dim: int,
    cap: float,
    reference: tuple[float, float],
    passes: int,
) -> float:
    """Move one anchor after the other to its best candidate until none moves; the first ``fixed`` stay. The score."""
    normal, inverse = np.zeros((4, 4)), np.zeros((4, 4))
    mean, worst = mean_and_worst(chosen, rows, heard, weights, dim, cap, normal, inverse)
    score = relative_score(mean, worst, reference[0], reference[1])
    for _ in range(passes):
        moved = False
        for k in range(fixed, len(chosen)):
            home = chosen[k]
            best = home
            for c in range(len(places)):
                if c == home or too_close(places, chosen, k, c):
                    continue
                chosen[k] = c
                mean, worst = mean_and_worst(chosen, rows, heard, weights, dim, cap, normal, inverse)
                trial = relative_score(mean, worst, reference[0], reference[1])
                if trial < score * (1.0 - 1e-9):
                    score, best = trial, c
            chosen[k] = best
            moved = moved or best != home
        if not moved:
            break
    return score


@threaded_kernel
def too_close(places: Matrix, chosen: Indices, moving: int, candidate: int) -> bool:
    """Whether a candidate lies on another anchor of the choice."""
    for k in range(len(chosen)):
        if k == moving:
            continue
        squared = 0.0
        for a in range(3):
            squared += (places[chosen[k], a] - places[candidate, a]) ** 2
        if squared < CLOSEST_M * CLOSEST_M:
            return True
    return False
