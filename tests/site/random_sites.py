"""Drawn sites and ranges for the tests of robust fitting: layouts of studies, late pairs, and a sparse plant."""

from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from skyless.sim.lab import lab_site
from skyless.site.survey.fit import redundancy
from skyless.site.survey.problem import Problem
from support.alignment import aligned_errors_m

GRID = [[x, y, 6.0] for x in (0.0, 12.0, 24.0, 36.0) for y in (0.0, 12.0, 24.0)]
CORNERS = [[0, 0, 0.4], [8, 0, 2.6], [8, 6, 0.4], [0, 6, 2.6], [4, 0, 2.6], [8, 3, 0.4], [4, 6, 2.6], [0, 3, 0.4]]


def jittered(positions, seed, size):
    """x, y (and z where the size is of three axes) moved by U(±size)."""
    positions = np.array(positions, float)
    moved = np.random.default_rng(seed).uniform(-1, 1, (len(positions), len(size))) * size
    positions[:, : len(size)] += moved
    return positions


LAB = np.array([[anchor.x_m, anchor.y_m, 0.0] for anchor in lab_site().anchors])
ROOM_J = jittered(CORNERS, 7, [0.3, 0.3, 0.3])
HALL_J = jittered(GRID, 8, [1.0, 1.0])


class Drawn(NamedTuple):
    problem: Problem
    position_m: np.ndarray
    is_late: np.ndarray
    sketch_m: np.ndarray | None


def problem_of(position_m, first, second, range_m, *, dimensions, delay_std_m, std_m, heights=None):
    n = len(position_m)
    fixed_m = np.zeros((n, 3))
    fixed_m[:, 2] = position_m[:, 2] if heights is None else heights
    is_free = np.ones((n, 3), bool)
    is_free[:, dimensions:] = False
    none = np.zeros(0)
    return Problem(
        is_free=is_free,
        first=np.asarray(first, np.int64),
        second=np.asarray(second, np.int64),
        range_m=np.asarray(range_m, float),
        variance_m2=np.full(len(range_m), std_m**2),
        delay_variance_m2=np.full(n, delay_std_m**2),
        coordinate_m=fixed_m,
        coordinate_variance_m2=np.full((n, 3), np.inf),
        tape_first=none.astype(np.int64),
        tape_second=none.astype(np.int64),
        tape_m=none,
        tape_variance_m2=none,
    )


def draw(layout, seed, *, dimensions=2, late=0.0, missing=0.0, delay_std_m=0.0, std_m=0.03, sketch_std_m=None):
    """A site's ranges: each pair off by N(std), a share ``late`` of them by U(0.2, 1) m more."""
    rng = np.random.default_rng(seed)
    n = len(layout)
    first, second = np.triu_indices(n, 1)
    kept = np.sort(rng.permutation(len(first))[: round(len(first) * (1 - missing))])
    first, second = first[kept], second[kept]
    delay_m = rng.normal(0, delay_std_m, n)
    is_late = rng.random(len(first)) < late
    range_m = np.linalg.norm(layout[first] - layout[second], axis=1) + delay_m[first] + delay_m[second]
    range_m += rng.normal(0, std_m, len(first)) + is_late * rng.uniform(0.2, 1.0, len(first))
    problem = problem_of(layout, first, second, range_m, dimensions=dimensions, delay_std_m=delay_std_m, std_m=std_m)
    sketch_m = None
    if sketch_std_m is not None:
        sketch_m = layout + rng.normal(0, sketch_std_m, layout.shape)
        sketch_m[:, dimensions:] = layout[:, dimensions:]
        variance = problem.coordinate_variance_m2.copy()
        variance[:, :dimensions] = sketch_std_m**2
        coordinate_m = np.where(problem.is_free, sketch_m, problem.coordinate_m)
        problem = replace(problem, coordinate_m=coordinate_m, coordinate_variance_m2=variance)
    return Drawn(problem, layout, is_late, sketch_m)


def draw_plant(seed, *, delay_std_m=0.07, std_m=0.03):
    """28 anchors on 29 m × 69 m, about 105 pairs of those not far apart, errors of a real plant's kind.

    A pair's error: N(−4 cm, 12 cm), 13 % late by 0.3 to 1.9 m (more often little). 1 to 27 ranges of 10 cm each.
    """
    rng = np.random.default_rng(seed)
    columns, rows = np.meshgrid(np.linspace(2, 27, 4), np.linspace(3, 66, 7))
    position_m = np.stack([columns.ravel(), rows.ravel(), rng.uniform(2.5, 6.0, 28)], axis=1)
    position_m[:, :2] += rng.uniform(-2.5, 2.5, (28, 2))
    position_m[:, :2] = np.clip(position_m[:, :2], 0, [29, 69])
    first, second = np.triu_indices(28, 1)
    distance = np.linalg.norm(position_m[first] - position_m[second], axis=1)
    # Which pairs are in range: near ones rather, by chance.
    kept = np.sort(np.argsort(distance * rng.lognormal(0, 0.25, len(distance)))[:105])
    first, second, distance = first[kept], second[kept], distance[kept]
    is_late = rng.random(105) < 0.13
    error_m = np.where(is_late, 0.3 + rng.beta(1, 2.5, 105) * 1.6, rng.normal(-0.04, 0.12, 105))
    count = rng.integers(1, 28, 105)
    range_m = distance + error_m + rng.normal(0, 0.1, 105) / np.sqrt(count)
    problem = problem_of(position_m, first, second, range_m, dimensions=2, delay_std_m=delay_std_m, std_m=std_m)
    variance = problem.variance_m2 + 0.1**2 / count
    return Drawn(replace(problem, variance_m2=variance), position_m, is_late, None)


def aligned_error_m(position_m, truth_m, dimensions=2):
    """Distance of each anchor from its true position after the best rigid motion or reflection, shape (n,)."""
    return np.linalg.norm(aligned_errors_m(position_m[:, :dimensions], truth_m[:, :dimensions]), axis=1)


def is_unchecked(fit):
    """Whether too few ranges check a robust fit: fewer than three, or fewer than it has left out as late."""
    checks = redundancy(fit.problem, fit.solution, fit.used)
    out = np.count_nonzero(~fit.used)
    return checks < 3.0 or out > 0.5 * (checks + out)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))
