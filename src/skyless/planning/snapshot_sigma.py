"""Predicted errors of the snapshot methods at points: the TDoAs' covariance through the geometry, G·Σ·Gᵀ.

Where frames arrive only at times, fixes come from changing sets of anchors: the sets that the most doubtful anchors
make are gone through one by one, each with its probability; other anchors count by whether they mostly take part.
"""

from collections.abc import Iterator
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyless.planning.columns import BIAS, CLAIMED, FIX_SHARE, RMSE, SIGMA, SIGMA_X, SIGMA_Z
from skyless.planning.geometry import Scene, fill_dops
from skyless.planning.links import AnchorLinks
from skyless.planning.rounds import Rounds
from skyless.uncertainty.normal import inverse_of

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MOST_DOUBTFUL: Final = 4
"""Anchors whose coming and going is followed exactly."""

DOUBT: Final = 0.01
"""An anchor is sure to take part, or not to, beyond this."""


def gains(towards: Array, weights: Matrix, common: float) -> Array:
    """G of the least squares over TDoAs, shape (m, n, dim); infinite where singular.

    ``towards``: rows of H, shape (m, n, dim). The weight matrix is that of variances 1/weights, shape (m, n), and
    ``common`` in all (Sherman-Morrison).
    """
    weighted = weights[..., None] * towards
    mean = weighted.sum(axis=1)
    share = common / (1.0 + common * weights.sum(axis=1))[:, None, None]
    normal = towards.transpose(0, 2, 1) @ weighted - share * (mean[:, :, None] * mean[:, None])
    inverse = inverse_of(normal)
    singular = np.isinf(inverse)
    gain: Array = (weighted - share * (weights[..., None] * mean[:, None])) @ np.where(singular, 0.0, inverse)
    gain[singular[:, 0, 0]] = np.inf
    return gain


def variances(gain: Array, own: Matrix, common: Array) -> Matrix:
    """The diagonal of G·(diag(own) + common·commonᵀ)·Gᵀ, shape (m, dim); shapes (m, n) and (m, n, k)."""
    together = gain.transpose(0, 2, 1) @ common
    found: Matrix = np.einsum("mna,mna,mn->ma", gain, gain, own) + (together * together).sum(axis=2)
    return found


def anchor_sets(part: Matrix) -> Iterator[tuple[Vector, Mask]]:
    """Sets of anchors from which points' fixes come: their probabilities, shape (m,), and masks, shape (m, n).

    ``part``: each anchor's part in the rounds, shape (m, n).
    """
    doubt = (part > DOUBT) & (part < 1.0 - DOUBT)
    order = np.argsort(np.where(doubt, np.abs(part - 0.5), np.inf), axis=1, kind="stable")[:, :MOST_DOUBTFUL]
    order = order[:, np.take_along_axis(doubt, order, axis=1).any(axis=0)]
    doubtful, there = np.take_along_axis(doubt, order, axis=1), np.take_along_axis(part, order, axis=1)
    usual = part >= 0.5
    usual_here = np.take_along_axis(usual, order, axis=1)
    for present in product((False, True), repeat=order.shape[1]):
        chances = np.where(doubtful, np.where(present, there, 1.0 - there), np.logical_not(present))
        np.put_along_axis(usual, order, np.where(doubtful, present, usual_here), axis=1)
        yield chances.prod(axis=1), usual


def fill_snapshot_sigma(
    points: Matrix,
    dim: int,
    scene: Scene,
    master: int,
    links: AnchorLinks,
    rounds: Rounds,
    weighted: bool,
    farthest_m: float,
    table: Matrix,
) -> None:
    """Fill ``table`` (points, columns) for the points, shape (m, 3).

    Sets of anchors whose error would exceed ``farthest_m`` give no fix.
    """
    share, delay_m = scene.heard_at(points)
    fill_dops(scene, points, share, dim, table)
    part = share * share * np.where(rounds.usable & scene.speaks, links.share**2, 0.0)
    part[:, master] = 0.0
    # of each point only the anchors that take part, in the order of how much
    some = np.argsort(-part, axis=1, kind="stable")[:, : int((part > DOUBT).sum(axis=1).max())]
    part = np.take_along_axis(part, some, axis=1)
    towards = (_directions(scene.anchors[some], points) - _directions(scene.anchors[master], points))[..., :dim]
    late_m = np.take_along_axis(delay_m, some, axis=1) - delay_m[:, master, None] + links.delay_m[some]
    assumed, true, common = rounds.assumed_own[some], rounds.true_own[some], rounds.common[some]
    assumed_common = np.full((*some.shape, 1), rounds.assumed_common**0.5)
    weights = 1.0 / assumed if weighted else np.ones(some.shape)
    fixes, claimed = np.zeros((2, len(points)))
    total, bias = np.zeros((2, len(points), 3))
    for probability, chosen in anchor_sets(part):
        rows = np.flatnonzero((probability > 0.0) & (chosen.sum(axis=1) >= dim))
        gain = gains(towards[rows], chosen[rows] * weights[rows], rounds.assumed_common if weighted else 0.0)
        with np.errstate(invalid="ignore"):
            said = variances(gain, assumed[rows], assumed_common[rows]).sum(axis=1)
        good = said < farthest_m**2
        rows, gain = rows[good], gain[good]
        chance = probability[rows]
        shift = np.einsum("mna,mn->ma", gain, late_m[rows])
        fixes[rows] += chance
        claimed[rows] += chance * said[good]
        bias[rows, :dim] += chance[:, None] * shift
        total[rows, :dim] += chance[:, None] * (variances(gain, true[rows], common[rows]) + shift * shift)
    table[:, SIGMA:] = np.inf
    table[:, FIX_SHARE] = fixes * share[:, master] ** 2
    _finish(table, total, bias, fixes, claimed)


def _directions(anchors: Array, points: Matrix) -> Array:
    """Unit vectors from anchors, shape (m, n, 3) or (3,), to points, shape (m, 3)."""
    away = points[:, None] - anchors
    unit: Array = away / np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-6)
    return unit


def _finish(table: Matrix, total: Matrix, bias: Matrix, fixes: Vector, claimed: Vector) -> None:
    """Turn sums over the sets of anchors into the columns."""
    known = np.flatnonzero(table[:, FIX_SHARE] >= DOUBT)
    shift = bias[known] / fixes[known, None]
    variance = np.maximum(total[known] / fixes[known, None] - shift * shift, 0.0)
    table[known, SIGMA_X : SIGMA_Z + 1] = np.sqrt(variance)
    table[known, SIGMA] = np.sqrt(variance.sum(axis=1))
    table[known, BIAS] = np.linalg.norm(shift, axis=1)
    table[known, RMSE] = np.hypot(table[known, SIGMA], table[known, BIAS])
    table[known, CLAIMED] = np.sqrt(claimed[known] / fixes[known])
