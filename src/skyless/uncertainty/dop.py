"""Dilutions of precision: how the anchors' geometry turns range noise into position noise."""

import math

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike, NDArray

from skyless.compiled import kernel
from skyless.uncertainty.cholesky import factorise, invert


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


def dops_at(anchors_m: ArrayLike, positions_m: ArrayLike, *, height_known: bool) -> NDArray[np.float64]:
    """DOPs at many positions, shape (m, 3): an array (m, 5) with columns in the order of ``Dops``."""
    anchors = np.array(anchors_m, np.float64).reshape(-1, 3)
    positions = np.array(positions_m, np.float64).reshape(-1, 3)
    dops = np.full((len(positions), 5), math.inf)
    if np.isfinite(anchors).all():
        _fill_dops(anchors, positions, height_known, np.empty((4, 4)), np.empty((4, 4)), dops)
    return dops


@kernel
def _fill_dops(
    anchors: NDArray[np.float64],
    positions: NDArray[np.float64],
    height_known: bool,
    normal: NDArray[np.float64],
    inverse: NDArray[np.float64],
    dops: NDArray[np.float64],
) -> None:
    size = 3 if height_known else 4
    for k in range(len(positions)):
        if not (geometry_matrix(anchors, positions[k], normal) and factorise(normal, size)):
            continue
        invert(normal, size, inverse)
        clock = inverse[0, 0]
        horizontal = inverse[1, 1] + inverse[2, 2]
        vertical = 0.0 if height_known else inverse[3, 3]
        dops[k, 0] = math.sqrt(horizontal + vertical + clock)
        dops[k, 1] = math.sqrt(horizontal + vertical)
        dops[k, 2] = math.sqrt(horizontal)
        dops[k, 3] = math.sqrt(vertical)
        dops[k, 4] = math.sqrt(clock)


@kernel
def geometry_matrix(anchors: NDArray[np.float64], position: NDArray[np.float64], normal: NDArray[np.float64]) -> bool:
    """Write HᵀH into ``normal``, shape (4, 4), lower triangle, rows of H being [1, unit vector].

    The clock comes first, so that a factorisation removes the mean direction before anything else, and the
    leading 3 × 3 block is the matrix of a known height. False where some anchor has no direction.
    """
    normal[:] = 0.0
    directed = True
    for i in range(len(anchors)):
        directed = directed and add_anchor(anchors, i, position, 1.0, normal)
    return directed


@kernel
def add_anchor(
    anchors: NDArray[np.float64], i: int, position: NDArray[np.float64], weight: float, normal: NDArray[np.float64]
) -> bool:
    """Add an anchor's row to the normal matrix of ``geometry_matrix``; False where it has no direction."""
    x, y, z = direction(anchors, i, position)
    if math.isnan(x):
        return False
    normal[0, 0] += weight
    normal[1, 0] += weight * x
    normal[2, 0] += weight * y
    normal[3, 0] += weight * z
    normal[1, 1] += weight * x * x
    normal[2, 1] += weight * y * x
    normal[3, 1] += weight * z * x
    normal[2, 2] += weight * y * y
    normal[3, 2] += weight * z * y
    normal[3, 3] += weight * z * z
    return True


@kernel
def direction(anchors: NDArray[np.float64], i: int, position: NDArray[np.float64]) -> tuple[float, float, float]:
    """Unit vector from anchor ``i`` to the position; NaNs where there is none."""
    x = position[0] - anchors[i, 0]
    y = position[1] - anchors[i, 1]
    z = position[2] - anchors[i, 2]
    distance = math.sqrt(x * x + y * y + z * z)
    if distance == 0.0 or not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        return math.nan, math.nan, math.nan
    return x / distance, y / distance, z / distance
