"""The robust regression behind a calibration: constants of anchors, and a slope, from differences at known places."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from skyless.kernels.arrays import Array, Integers, Mask, Vector

HUBER: Final = 1.345
"""Standard deviations up to which a residual weighs in full: 95 % of the efficiency on Gaussian noise."""

REJECT: Final = 4.0

BLOCK_S: Final = 5.0
"""Reflections change while a walker or a drone goes a metre or two: errors within such a time count as one."""

FEWEST_BLOCKS: Final = 10

LEAST_MOTION: Final = 0.05
"""How much the logarithms of the ratios must change beyond what constants explain for a slope to be looked for."""


@dataclass(frozen=True)
class Differences:
    """Time differences at known places, n of them."""

    t_s: Vector
    """Shape (n,), not decreasing."""
    anchor_a: Integers
    anchor_b: Integers
    excess_m: Vector
    """Measured less what the geometry says."""
    log_ratio: Vector
    """ln(range to b / range to a)."""


@dataclass(frozen=True)
class Fit:
    """A regression: m anchors, n differences."""

    anchors: Integers
    bias_m: Vector
    """Shape (m,), sum 0."""
    covariance_m2: Array
    """Shape (m, m), or (m + 1, m + 1) with the slope."""
    slope_m: float | None
    residual_m: Vector
    used: Mask
    scale_m: float
    a: Integers
    b: Integers
    counts: Integers


def fit(data: Differences, anchors: Integers, *, slope: bool) -> Fit:
    """Fit one constant for each of the anchors, all of them tied together by the differences, perhaps with a slope."""
    a, b = np.searchsorted(anchors, data.anchor_a), np.searchsorted(anchors, data.anchor_b)
    x = data.log_ratio if slope else np.zeros(len(a))
    y = _pair_medians(a, b, data.excess_m, len(anchors))
    weights = np.ones(len(a))
    for step in range(50):
        before = weights
        solution = _solve(_normal(a, b, x, weights, len(anchors)), _right(a, b, x, weights * y, len(anchors)))
        residual_m = data.excess_m - _model(solution, a, b, x)
        scale_m = max(1.4826 * float(np.median(np.abs(residual_m))), 1e-6)
        share = np.abs(residual_m) / scale_m
        weights = np.where(share <= REJECT, np.minimum(1.0, HUBER / np.maximum(share, HUBER)), 0.0)
        y = data.excess_m
        if step and np.abs(weights - before).max() < 1e-6:
            break
    used = share <= REJECT
    counts = np.bincount(a[used], minlength=len(anchors)) + np.bincount(b[used], minlength=len(anchors))
    covariance = _covariance(data.t_s, a, b, x, residual_m, scale_m, len(anchors))
    if not slope:
        covariance = covariance[:-1, :-1]
    bias = solution[:-1]
    return Fit(
        anchors, bias, covariance, float(solution[-1]) if slope else None, residual_m, used, scale_m, a, b, counts
    )


def moves(data: Differences, found: Fit) -> bool:
    """Whether the ranges change enough; at one place a slope looks like constants."""
    a, b, count, still = found.a, found.b, len(found.anchors), np.zeros(len(found.a))
    alike = _solve(_normal(a, b, still, still + 1.0, count), _right(a, b, still, data.log_ratio, count))
    change = data.log_ratio - _model(alike, a, b, still)
    return float(np.sqrt(np.mean(change**2))) > LEAST_MOTION


def _pair_medians(a: Integers, b: Integers, excess_m: Vector, count: int) -> Vector:
    """Each difference replaced by the median of its pair: a start that outliers do not touch."""
    start = np.empty_like(excess_m)
    pair = a * count + b
    for one in np.unique(pair):
        of_pair = pair == one
        start[of_pair] = np.median(excess_m[of_pair])
    return start


def _solve(normal: Array, right: Vector) -> Vector:
    solution: Vector = np.linalg.solve(normal, right).astype(np.float64)
    return solution


def _model(solution: Vector, a: Integers, b: Integers, x: Vector) -> Vector:
    values: Vector = solution[b] - solution[a] + solution[-1] * x
    return values


def _right(a: Integers, b: Integers, x: Vector, values: Vector, count: int) -> Vector:
    """Hᵀ times values; the slope is the last column."""
    right: Vector = (np.bincount(b, values, count + 1) - np.bincount(a, values, count + 1)).astype(np.float64)
    right[-1] = x @ values
    return right


def _normal(a: Integers, b: Integers, x: Vector, weights: Vector, count: int) -> Array:
    """Hᵀ W H; the sum of the constants is held at zero, and the slope where nothing tells it."""
    normal = np.zeros((count + 1, count + 1))
    flat = normal.reshape(-1)
    for row, column, sign in ((a, a, 1.0), (b, b, 1.0), (a, b, -1.0), (b, a, -1.0)):
        flat += sign * np.bincount(row * (count + 1) + column, weights, flat.size)
    cross = np.bincount(b, weights * x, count + 1) - np.bincount(a, weights * x, count + 1)
    normal[-1, :] += cross
    normal[:, -1] += cross
    normal[-1, -1] = weights @ (x * x)
    typical = max(float(np.trace(normal[:-1, :-1])) / count, 1e-9)
    normal[:-1, :-1] += typical / count
    normal[-1, -1] += 1e-9 * typical
    return normal


def _covariance(
    t_s: Vector, a: Integers, b: Integers, x: Vector, residual_m: Vector, scale_m: float, count: int
) -> Array:
    """Errors within a block of time taken as one (sandwich); never less than independent ones would make it."""
    share = np.abs(residual_m) / scale_m
    influence = np.where(share <= REJECT, np.clip(residual_m, -HUBER * scale_m, HUBER * scale_m), 0.0)
    bread = np.linalg.inv(_normal(a, b, x, (share < HUBER).astype(np.float64), count))
    block_s = min(BLOCK_S, (t_s[-1] - t_s[0]) / FEWEST_BLOCKS)
    block = ((t_s - t_s[0]) / max(block_s, 1e-9)).astype(np.int64)
    blocks = [_right(a[here], b[here], x[here], influence[here], count) for here in map(block.__eq__, np.unique(block))]
    meat = np.array(blocks).T @ np.array(blocks) * len(blocks) / max(len(blocks) - 1, 1)
    white = _normal(a, b, x, influence**2, count)
    together, apart = bread @ meat @ bread, bread @ white @ bread
    grow = np.sqrt(np.maximum(np.diag(apart) / np.maximum(np.diag(together), 1e-30), 1.0))
    result: Array = together * np.outer(grow, grow)
    return result
