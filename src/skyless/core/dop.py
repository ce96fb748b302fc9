"""Dilutions of precision: how the anchors' geometry turns range noise into position noise."""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from skyless.core.arrays import Array, Mask
from skyless.core.native.small_matrices import SINGULAR_PIVOT

MAX_VDOP: Final = 4.0
"""With a larger vertical dilution in the middle of the anchors, the height is not worth estimating."""

GUESSED_STD_M: Final = 0.5
"""Standard deviation of a tag's height from the anchors', where that is used instead."""

_POINTS_AT_ONCE: Final = 4096


class Dops(Struct, frozen=True, gc=False):
    """Standard deviations for pseudoranges of unit noise; infinite where the geometry is singular."""

    gdop: float
    """Dilution of position and clock together."""
    pdop: float
    hdop: float
    vdop: float
    """0 for a known height."""
    tdop: float
    """Dilution of the receiver's clock, in metres."""


def dilution_of_precision(anchors_m: ArrayLike, position_m: ArrayLike, *, height_known: bool) -> Dops:
    """DOPs of ``anchors_m``, shape (n, 3), seen from ``position_m``, shape (3,).

    As in GPS: (HᵀH)⁻¹ with one row [unit vector, 1] per anchor. A known height leaves the height's column out.
    Too few anchors, singular geometry, a position on an anchor (no direction) or values that are not finite
    give infinite DOPs.
    """
    return Dops(*dops_at(anchors_m, np.asarray(position_m, np.float64)[None], height_known=height_known)[0].tolist())


def plane_height_m(anchors_m: Mapping[int, tuple[float, float, float]]) -> float | None:
    """Mean height of anchors that lie too flat to resolve the height; None where they resolve it, or are too few."""
    positions_m = np.array(list(anchors_m.values()), dtype=np.float64).reshape(-1, 3)
    if len(positions_m) < 3:
        return None
    middle = positions_m.mean(axis=0)
    dops = dilution_of_precision(positions_m, middle, height_known=False)
    return float(middle[2]) if dops.vdop > MAX_VDOP else None


def dops_at(anchors_m: ArrayLike, positions_m: ArrayLike, *, height_known: bool, weights: ArrayLike = 1.0) -> Array:
    """DOPs at many positions, shape (m, 3): an array (m, 5) with columns in the order of ``Dops``.

    ``weights``: how much each anchor counts at each position, shape (m, n); zero leaves it out.
    """
    anchors = np.array(anchors_m, np.float64).reshape(-1, 3)
    positions = np.array(positions_m, np.float64).reshape(-1, 3)
    counts = np.broadcast_to(np.asarray(weights, np.float64), (len(positions), len(anchors)))
    dops = np.full((len(positions), 5), math.inf)
    for first in range(0, len(positions), _POINTS_AT_ONCE):
        part = slice(first, first + _POINTS_AT_ONCE)
        normal = _normal_matrices(anchors, positions[part], counts[part], 3 if height_known else 4)
        inverse, is_sound = inverses(normal)
        variances = np.zeros((len(normal), 4))
        variances[:, : normal.shape[1]] = np.diagonal(inverse, axis1=1, axis2=2)
        clock, horizontal, vertical = variances[:, 0], variances[:, 1] + variances[:, 2], variances[:, 3]
        position = horizontal + vertical
        found = np.sqrt(np.column_stack([position + clock, position, horizontal, vertical, clock]))
        dops[part][is_sound] = found[is_sound]
    return dops


def _normal_matrices(anchors: Array, positions: Array, weights: Array, size: int) -> Array:
    """HᵀWH of rows [1, unit vector], shape (m, size, size); NaN where an anchor that counts has no direction.

    The clock comes first, so that a factorisation removes the mean direction before anything else.
    """
    away = positions[:, None] - anchors
    with np.errstate(all="ignore"):
        rows = np.concatenate([np.ones((*away.shape[:2], 1)), away / np.linalg.norm(away, axis=2)[..., None]], axis=2)
    rows[weights <= 0.0] = 0.0
    rows = rows[..., :size]
    normal: Array = np.einsum("mi,mip,miq->mpq", weights, rows, rows)
    return normal


def inverses(normal: Array) -> tuple[Array, Mask]:
    """Inverses of matrices, shape (m, k, k), by Cholesky's method, and which of them are positive definite."""
    size = normal.shape[1]
    L, is_sound = np.zeros_like(normal), np.ones(len(normal), np.bool_)
    with np.errstate(all="ignore"):
        for j in range(size):
            pivot = normal[:, j, j] - np.square(L[:, j, :j]).sum(axis=1)
            is_sound &= (pivot > SINGULAR_PIVOT * normal[:, j, j]) & (normal[:, j, j] > 0.0)
            L[:, j, j] = np.sqrt(np.where(is_sound, pivot, 1.0))
            for i in range(j + 1, size):
                L[:, i, j] = (normal[:, i, j] - (L[:, i, :j] * L[:, j, :j]).sum(axis=1)) / L[:, j, j]
    inverse = np.linalg.inv(np.where(is_sound[:, None, None], L, np.eye(size)))
    return inverse.transpose(0, 2, 1) @ inverse, is_sound
