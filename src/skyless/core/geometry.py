"""Positions of a site: pairs of anchors that are near each other, and the outline of the room."""

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec import UNSET, Struct
from numpy.typing import ArrayLike

from skyless.core.arrays import Array, Integers, Mask, Matrix, Vector
from skyless.core.native.arithmetic import SINGULAR_PIVOT

if TYPE_CHECKING:
    from skyless.core.site import Site

_DIRECTION: Final = np.array([0.8164, 0.5211, 0.2489])
"""Slightly shorter than one, and along no street of a grid, so that few points share a projection."""


RADIO_REACH_M: Final = 31.0
"""Open-air range of the planner's and the simulation's link budget, at which half of the frames arrive."""


def anchor_positions(site: "Site") -> Matrix:
    """Positions of a site's placed anchors in the order of the file, shape (n, 3)."""
    return np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors]).reshape(-1, 3)


def pairs_within(points_m: Matrix, distance_m: float) -> Iterator[tuple[Integers, Integers, Vector]]:
    """Pairs of points, shape (n, 3), closer than a distance: rows of both and their distances, in batches.

    The rows of a pair ascend; each pair appears once, in no order. The points are sorted along a direction; a point is
    compared with its first follower, its second and so on, until none is near along that direction.
    """
    along_m = points_m @ _DIRECTION
    order = np.argsort(along_m, kind="stable")
    along_m, sorted_m = along_m[order], points_m[order]
    candidates = np.arange(len(order))
    for shift in range(1, len(order)):
        candidates = candidates[: np.searchsorted(candidates, len(order) - shift)]
        candidates = candidates[along_m[candidates + shift] - along_m[candidates] < distance_m]
        if len(candidates) == 0:
            return
        apart_m = np.linalg.norm(sorted_m[candidates + shift] - sorted_m[candidates], axis=1)
        near = apart_m < distance_m
        one, other = order[candidates[near]], order[candidates[near] + shift]
        yield np.minimum(one, other), np.maximum(one, other), apart_m[near]


def anchors_in_reach(site: "Site") -> Integers:
    """Number of placed anchors within open-air range of each placed anchor, itself included; shape (n,)."""
    ones, others = links_in_reach(site)
    return np.bincount(np.concatenate([ones, others]), minlength=len(site.anchors)) + 1


def links_in_reach(site: "Site") -> tuple[Integers, Integers]:
    """Links between anchors within radio reach of each other: the indices of both ends."""
    pairs = [(one, other) for one, other, _ in pairs_within(anchor_positions(site), RADIO_REACH_M)]
    nothing = np.empty(0, np.int64)
    ones, others = zip(*pairs, strict=True) if pairs else ((nothing,), (nothing,))
    return np.concatenate(ones), np.concatenate(others)


Box = tuple[float, float, float, float]
"""x1, y1, x2, y2."""

OUTSIDE_M: Final = 0.5
"""Anchors this far outside an outline count as inside: it may leave out the walls that they hang on."""


def outline_of(site: "Site") -> Matrix | None:
    """Corners of the site's room, shape (k, 2); None without an outline."""
    return None if site.outline_m is UNSET else np.array(site.outline_m, dtype=np.float64)


def rectangle_of(site: "Site") -> Box | None:
    """The site's room if it is a rectangle along the axes, otherwise None."""
    outline_m = outline_of(site)
    if outline_m is None:
        return None
    (x1, y1), (x2, y2) = outline_m.min(axis=0).tolist(), outline_m.max(axis=0).tolist()
    corners = {(x1, y1), (x2, y1), (x2, y2), (x1, y2)}
    return (x1, y1, x2, y2) if len(outline_m) == 4 and {(x, y) for x, y in outline_m.tolist()} == corners else None


def area(outline_m: Matrix) -> float:
    """Signed area of a polygon."""
    x, y = outline_m.T
    return float(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def sides_that_meet(outline_m: Matrix) -> tuple[int, int] | None:
    """Two sides of a polygon, by their first corners, that meet without being neighbours; None if there are none."""
    starts, ends = outline_m, np.roll(outline_m, -1, axis=0)
    lows, highs = np.minimum(starts, ends), np.maximum(starts, ends)
    count = len(outline_m)
    for side in range(count - 2):
        others = np.arange(side + 2, count - (side == 0))
        a, b, c, d = starts[side], ends[side], starts[others], ends[others]
        apart = _left(a, b, c) * _left(a, b, d) > 0.0
        apart |= _left(c, d, a) * _left(c, d, b) > 0.0
        apart |= ((lows[others] > highs[side]) | (highs[others] < lows[side])).any(axis=1)
        if not apart.all():
            return side, int(others[~apart][0])
    return None


def _left(start_m: Vector, end_m: Vector, point_m: Vector) -> Vector:
    """Sign of the side of a line on which a point lies; over the last axis."""
    along, to = end_m - start_m, point_m - start_m
    return np.sign(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])


def inside(points_m: Matrix, outline_m: Matrix) -> Mask:
    """Which points, shape (m, 2), lie inside a polygon (even-odd rule)."""
    x, y = points_m[:, 0], points_m[:, 1]
    within = np.zeros(len(points_m), dtype=np.bool_)
    for (x1, y1), (x2, y2) in zip(outline_m, np.roll(outline_m, -1, axis=0), strict=True):
        if y1 != y2:
            within ^= ((y1 > y) != (y2 > y)) & (x < (x2 - x1) * (y - y1) / (y2 - y1) + x1)
    return within


def distance_outside(point_m: Vector, outline_m: Matrix) -> float:
    """Distance of a point, shape (2,), from a polygon; 0 inside."""
    if inside(point_m[None], outline_m)[0]:
        return 0.0
    starts, ends = outline_m, np.roll(outline_m, -1, axis=0)
    along = ends - starts
    lengths2 = np.maximum((along * along).sum(axis=1), 1e-12)
    share = np.clip(((point_m - starts) * along).sum(axis=1) / lengths2, 0.0, 1.0)
    return float(np.linalg.norm(starts + share[:, None] * along - point_m, axis=1).min())


# Dilutions of precision: how the anchors' geometry turns range noise into position noise.

MAX_VDOP: Final = 4.0
"""With a larger vertical dilution in the middle of the anchors, estimating the height is not worthwhile."""

GUESSED_STD_M: Final = 0.5
"""Standard deviation of a tag's height about the anchors', if that is used instead."""

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
    """Mean height of anchors too flat to resolve the height; None if they resolve it or are too few."""
    positions_m = np.array(list(anchors_m.values()), dtype=np.float64).reshape(-1, 3)
    if len(positions_m) < 3:
        return None
    middle = positions_m.mean(axis=0)
    dops = dilution_of_precision(positions_m, middle, height_known=False)
    return float(middle[2]) if dops.vdop > MAX_VDOP else None


def dops_at(anchors_m: ArrayLike, positions_m: ArrayLike, *, height_known: bool, weights: ArrayLike = 1.0) -> Array:
    """DOPs at many positions, shape (m, 3): an array (m, 5) with columns in the order of ``Dops``.

    ``weights`` of each anchor at each position, shape (m, n); zero leaves it out.
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
    """HᵀWH of rows [1, unit vector], shape (m, size, size); NaN if an anchor with a weight has no direction.

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
