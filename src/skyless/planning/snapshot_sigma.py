"""Predicted errors of the snapshot methods at points: the TDoAs' covariance through the geometry, G·Σ·Gᵀ.

Where frames arrive only at times, fixes come from changing sets of anchors: the sets that the most doubtful anchors
make are gone through one by one, each with its probability; other anchors count by whether they mostly take part.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyless.compiled import kernel, threaded_kernel
from skyless.planning.columns import (
    BIAS,
    CLAIMED,
    FIX_SHARE,
    RMSE,
    SIGMA,
    SIGMA_X,
    SIGMA_Z,
)
from skyless.planning.geometry import Scene, fill_dops, observe
from skyless.uncertainty.cholesky import factorise, invert

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

MOST_DOUBTFUL: Final = 4
"""Anchors whose coming and going is followed exactly."""

DOUBT: Final = 0.01
"""An anchor is sure to take part, or not to, beyond this."""


@kernel
def gains(
    sight: Matrix,
    chosen: NDArray[np.int64],
    count: int,
    dim: int,
    master: int,
    weights: Vector,
    common: float,
    normal: Matrix,
    inverse: Matrix,
    gain: Matrix,
) -> bool:
    """Fill ``gain`` (count, dim) with G of the least squares over the chosen anchors' TDoAs; False where singular.

    The weight matrix is that of variances 1/weights and ``common`` in all (Sherman-Morrison).
    """
    total = 0.0
    mean = gain[count]
    for a in range(dim):
        mean[a] = 0.0
        for b in range(dim):
            normal[a, b] = 0.0
    for k in range(count):
        i = chosen[k]
        total += weights[i]
        for a in range(dim):
            h = sight[i, a] - sight[master, a]
            mean[a] += weights[i] * h
            for b in range(a + 1):
                normal[a, b] += weights[i] * h * (sight[i, b] - sight[master, b])
    share = common / (1.0 + common * total)
    for a in range(dim):
        for b in range(a + 1):
            normal[a, b] -= share * mean[a] * mean[b]
    if not factorise(normal, dim):
        return False
    invert(normal, dim, inverse)
    for k in range(count):
        i = chosen[k]
        for a in range(dim):
            value = 0.0
            for b in range(dim):
                h = weights[i] * (sight[i, b] - sight[master, b] - share * mean[b])
                value += inverse[a, b] * h
            gain[k, a] = value
    return True


@kernel
def propagate(
    gain: Matrix,
    chosen: NDArray[np.int64],
    count: int,
    dim: int,
    own: Vector,
    common: Matrix,
    variances: Vector,
) -> None:
    """Write the diagonal of G·(diag(own) + common·commonᵀ)·Gᵀ into ``variances``."""
    for a in range(dim):
        variances[a] = 0.0
        for k in range(count):
            variances[a] += own[chosen[k]] * gain[k, a] * gain[k, a]
        for column in range(common.shape[1]):
            total = 0.0
            for k in range(count):
                total += gain[k, a] * common[chosen[k], column]
            variances[a] += total * total


@kernel
def sort_doubtful(part: Vector, master: int, doubtful: NDArray[np.int64], chosen: NDArray[np.int64]) -> tuple[int, int]:
    """Split anchors by their part in the rounds: the most doubtful, and those that count as always there."""
    doubts = 0
    for i in range(len(part)):
        if i == master or not DOUBT < part[i] < 1.0 - DOUBT:
            continue
        place = min(doubts, MOST_DOUBTFUL)
        while place > 0 and abs(part[i] - 0.5) < abs(part[doubtful[place - 1]] - 0.5):
            doubtful[place] = doubtful[place - 1]
            place -= 1
        doubtful[place] = i
        doubts = min(doubts + 1, MOST_DOUBTFUL)
    sure = 0
    for i in range(len(part)):
        if i == master or part[i] < 0.5:
            continue
        listed = False
        for k in range(doubts):
            listed = listed or doubtful[k] == i
        if not listed:
            chosen[sure] = i
            sure += 1
    return doubts, sure


@threaded_kernel
def fill_snapshot_sigma(
    points: Matrix,
    dim: int,
    scene: Scene,
    master: int,
    in_step: Vector,
    sync_delay: Vector,
    weights: Vector,
    weighing_common: float,
    assumed_own: Vector,
    assumed_common: Matrix,
    true_own: Vector,
    common: Matrix,
    farthest: float,
    table: Matrix,
) -> None:
    """Fill ``table`` (points, columns) for the points, shape (m, 3).

    ``in_step``: share of the rounds in which an anchor can be used at all; ``sync_delay``: by how much its time lags.
    Sets of anchors whose error would exceed ``farthest`` metres give no fix.
    """
    n = len(scene.anchors)
    share, part, sight = np.zeros(n), np.zeros(n), np.zeros((n, 4))
    seen, gain = np.zeros((n, 3)), np.zeros((n + 1, 3))
    normal, inverse = np.zeros((4, 4)), np.zeros((4, 4))
    variances, total, claimed = np.zeros(3), np.zeros(3), 0.0
    bias = np.zeros(3)
    chosen, doubtful = np.zeros(n, np.int64), np.zeros(MOST_DOUBTFUL + 1, np.int64)
    for m in range(len(points)):
        row = table[m]
        observe(scene, points[m], share, sight)
        fill_dops(scene.anchors, share, points[m], dim, seen, normal, inverse, row)
        for i in range(n):
            part[i] = share[i] * share[i] * in_step[i]
        doubts, sure = sort_doubtful(part, master, doubtful, chosen)
        total[:] = 0.0
        bias[:] = 0.0
        fixes, claimed = 0.0, 0.0
        for number in range(1 << doubts):
            probability, count = 1.0, sure
            for k in range(doubts):
                i = doubtful[k]
                if number >> k & 1:
                    probability *= part[i]
                    chosen[count] = i
                    count += 1
                else:
                    probability *= 1.0 - part[i]
            if count < dim or not gains(
                sight, chosen, count, dim, master, weights, weighing_common, normal, inverse, gain
            ):
                continue
            propagate(gain, chosen, count, dim, assumed_own, assumed_common, variances)
            said = 0.0
            for a in range(dim):
                said += variances[a]
            if not said < farthest * farthest:
                continue
            propagate(gain, chosen, count, dim, true_own, common, variances)
            fixes += probability
            claimed += probability * said
            for a in range(dim):
                shift = 0.0
                for k in range(count):
                    i = chosen[k]
                    shift += gain[k, a] * (sight[i, 3] - sight[master, 3] + sync_delay[i])
                bias[a] += probability * shift
                total[a] += probability * (variances[a] + shift * shift)
        row[SIGMA:] = math.inf
        row[FIX_SHARE] = fixes * part[master]
        if row[FIX_SHARE] >= DOUBT:
            _finish(row, total, bias, dim, fixes, claimed)


@kernel
def _finish(row: Vector, total: Vector, bias: Vector, dim: int, fixes: float, claimed: float) -> None:
    """Turn sums over the sets of anchors into the columns."""
    squares, shifts = 0.0, 0.0
    row[SIGMA_Z] = 0.0
    for a in range(dim):
        shift = bias[a] / fixes
        variance = max(total[a] / fixes - shift * shift, 0.0)
        row[SIGMA_X + a] = math.sqrt(variance)
        squares += variance
        shifts += shift * shift
    row[SIGMA] = math.sqrt(squares)
    row[BIAS] = math.sqrt(shifts)
    row[RMSE] = math.sqrt(squares + shifts)
    row[CLAIMED] = math.sqrt(claimed / fixes)
