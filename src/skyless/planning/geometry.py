"""What the anchors in view make of a point: shares, delays, directions and DOPs, for the kernels of the methods."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyless.compiled import kernel
from skyless.planning.columns import ANCHORS, GDOP, HDOP, PDOP, TDOP, VDOP
from skyless.planning.links import IN_VIEW, hears
from skyless.uncertainty.cholesky import factorise, invert
from skyless.uncertainty.dop import geometry_matrix

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Scene(NamedTuple):
    """Anchors, and what stands between them and points."""

    anchors: Matrix
    """Positions, shape (anchors, 3)."""
    speaks: NDArray[np.bool_]
    """Those that send at all, shape (anchors,)."""
    budget: Vector
    """``link_budget``."""
    walls: Matrix
    """``pack_walls``."""


@kernel
def observe(scene: Scene, point: Vector, share: Vector, sight: Matrix) -> None:
    """Fill ``share`` with the part of each anchor's frames that arrives and ``sight`` with unit vectors and delays.

    ``sight`` has shape (anchors, 4): the direction from the anchor to the point, and the walls' delay in metres.
    """
    anchors = scene.anchors
    for i in range(len(anchors)):
        share[i] = 0.0
        if not scene.speaks[i]:
            continue
        share[i], sight[i, 3] = hears(scene.budget, scene.walls, anchors[i], point)
        x, y, z = point[0] - anchors[i, 0], point[1] - anchors[i, 1], point[2] - anchors[i, 2]
        distance = max(math.sqrt(x * x + y * y + z * z), 1e-6)
        sight[i, 0], sight[i, 1], sight[i, 2] = x / distance, y / distance, z / distance


@kernel
def fill_dops(
    anchors: Matrix,
    share: Vector,
    point: Vector,
    dim: int,
    seen: Matrix,
    normal: Matrix,
    inverse: Matrix,
    row: Vector,
) -> int:
    """Fill the columns of DOPs from the anchors in view; return how many there are."""
    count = 0
    for i in range(len(anchors)):
        if share[i] >= IN_VIEW:
            seen[count] = anchors[i]
            count += 1
    row[ANCHORS] = count
    size = dim + 1
    row[GDOP : TDOP + 1] = math.inf
    if count < size or not (geometry_matrix(seen[:count], point, normal) and factorise(normal, size)):
        return count
    invert(normal, size, inverse)
    horizontal = inverse[1, 1] + inverse[2, 2]
    vertical = inverse[3, 3] if dim == 3 else 0.0
    row[GDOP] = math.sqrt(horizontal + vertical + inverse[0, 0])
    row[PDOP] = math.sqrt(horizontal + vertical)
    row[HDOP] = math.sqrt(horizontal)
    row[VDOP] = math.sqrt(vertical)
    row[TDOP] = math.sqrt(inverse[0, 0])
    return count


@kernel
def weighted_pdop(share: Vector, sight: Matrix, dim: int, normal: Matrix, inverse: Matrix) -> float:
    """PDOP with every anchor weighted by its share of frames, so that none comes or goes at once; may be infinite."""
    normal[:] = 0.0
    for i in range(len(share)):
        normal[0, 0] += share[i]
        for a in range(dim):
            normal[a + 1, 0] += share[i] * sight[i, a]
            for b in range(a + 1):
                normal[a + 1, b + 1] += share[i] * sight[i, a] * sight[i, b]
    if not factorise(normal, dim + 1):
        return math.inf
    invert(normal, dim + 1, inverse)
    trace = 0.0
    for a in range(1, dim + 1):
        trace += inverse[a, a]
    return math.sqrt(trace)
