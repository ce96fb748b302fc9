"""Dilutions of precision: how the anchors' geometry turns range noise into position noise."""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from skyless.core.kernels.arrays import Array
from skyless.core.kernels.compiled import kernel, threaded_kernel
from skyless.core.kernels.linear_algebra import factorise, invert

MAX_VDOP: Final = 4.0
"""With a larger vertical dilution in the middle of the anchors, the height is not worth estimating."""

GUESSED_STD_M: Final = 0.5
"""Standard deviation of a tag's height from the anchors', where that is used instead."""


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
    _fill_dops(anchors, positions, np.ascontiguousarray(counts), 3 if height_known else 4, dops)
    return dops


@threaded_kernel
def _fill_dops(
    anchors: Array,
    positions: Array,
    weights: Array,
    size: int,
    dops: Array,
) -> None:
    """From HᵀWH of rows [1, unit vector], where it is not singular and all anchors that count have a direction.

    The clock comes first, so that a factorisation removes the mean direction before anything else.
    """
    normal, inverse, row = np.empty((4, 4)), np.zeros((4, 4)), np.ones(4)
    for k in range(len(positions)):
        normal[:] = 0.0
        for i in range(len(anchors)):
            if weights[k, i] > 0.0:
                row[1], row[2], row[3] = direction(anchors, i, positions[k])
                for p in range(size):
                    for q in range(p + 1):
                        normal[p, q] += weights[k, i] * row[p] * row[q]
        if not factorise(normal, size):
            continue
        invert(normal, size, inverse)
        clock, horizontal, vertical = inverse[0, 0], inverse[1, 1] + inverse[2, 2], inverse[3, 3]
        dops[k, 0] = math.sqrt(horizontal + vertical + clock)
        dops[k, 1] = math.sqrt(horizontal + vertical)
        dops[k, 2] = math.sqrt(horizontal)
        dops[k, 3] = math.sqrt(vertical)
        dops[k, 4] = math.sqrt(clock)


@kernel
def direction(anchors: Array, i: int, position: Array) -> tuple[float, float, float]:
    """Unit vector from anchor ``i`` to the position; NaNs where there is none."""
    x = position[0] - anchors[i, 0]
    y = position[1] - anchors[i, 1]
    z = position[2] - anchors[i, 2]
    distance = math.sqrt(x * x + y * y + z * z)
    if distance == 0.0 or not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        return math.nan, math.nan, math.nan
    return x / distance, y / distance, z / distance
