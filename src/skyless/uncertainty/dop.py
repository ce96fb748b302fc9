"""Dilutions of precision: how the anchors' geometry turns range noise into position noise."""

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike, NDArray

from skyless.uncertainty.normal import inverse_of


class Dops(Struct, frozen=True, gc=False):
    """Standard deviations for pseudoranges of unit noise; infinite where the geometry is singular."""

    gdop: float
    """Of position and clock together."""
    pdop: float
    hdop: float
    vdop: float
    """0 for a known height."""
    tdop: float
    """Of the receiver's clock, in metres."""


def dilution_of_precision(anchors_m: ArrayLike, position_m: ArrayLike, *, height_known: bool) -> Dops:
    """DOPs of ``anchors_m``, shape (n, 3), seen from ``position_m``, shape (3,).

    As in GPS: (HᵀH)⁻¹ with one row [unit vector, 1] per anchor. A known height leaves the height's column out.
    Too few anchors, singular geometry, a position on an anchor (no direction) or values that are not finite
    give infinite DOPs.
    """
    return Dops(*dops_at(anchors_m, np.asarray(position_m, np.float64)[None], height_known=height_known)[0].tolist())


def dops_at(
    anchors_m: ArrayLike, positions_m: ArrayLike, *, height_known: bool, weights: ArrayLike = 1.0
) -> NDArray[np.float64]:
    """DOPs at many positions, shape (m, 3): an array (m, 5) with columns in the order of ``Dops``.

    ``weights``: how much each anchor counts at each position, shape (m, n); zero leaves it out.
    """
    anchors = np.array(anchors_m, np.float64).reshape(-1, 3)
    away = np.array(positions_m, np.float64).reshape(-1, 1, 3) - np.where(np.isfinite(anchors), anchors, np.nan)
    away = np.where(np.isfinite(away), away, np.nan)
    distance = np.sqrt((away * away).sum(axis=2))
    distance[distance == 0.0] = np.nan
    counts = np.broadcast_to(np.asarray(weights, np.float64), distance.shape)[..., None]
    rows = np.ones((*distance.shape, 3 if height_known else 4))
    rows[..., 1:] = (away / distance[..., None])[..., : rows.shape[2] - 1]
    weighted = np.where(counts > 0.0, rows * counts, 0.0)
    inverse = inverse_of(weighted.transpose(0, 2, 1) @ np.where(counts > 0.0, rows, 0.0))
    variances = np.zeros((len(rows), 4))
    variances[:, : rows.shape[2]] = np.diagonal(inverse, axis1=1, axis2=2)
    clock, x, y, z = variances.T
    horizontal = x + y
    dops: NDArray[np.float64] = np.sqrt([horizontal + z + clock, horizontal + z, horizontal, z, clock]).T
    dops[np.isinf(clock)] = np.inf
    return dops
