"""Positions of a site: pairs of anchors that are near each other, and the outline of the room."""

from collections.abc import Iterator
from typing import Final

import numpy as np
from msgspec import UNSET

from skyless.core.arrays import Integers, Mask, Matrix, Vector
from skyless.core.site import Site

_DIRECTION: Final = np.array([0.8164, 0.5211, 0.2489])
"""Length just below one, along no street of a grid, so that few points share a projection."""


RADIO_REACH_M: Final = 31.0
"""Range in the open that the planner's and the simulation's link budget give; half of the frames arrive there."""


def anchor_positions(site: Site) -> Matrix:
    """Return the positions of a site's placed anchors in the order of the file, shape (n, 3)."""
    return np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors]).reshape(-1, 3)


def pairs_within(points_m: Matrix, distance_m: float) -> Iterator[tuple[Integers, Integers, Vector]]:
    """Pairs of points, shape (n, 3), that are closer than a distance: rows of both and their distances, in batches.

    The rows of a pair ascend; every pair comes once, in no order. The points are sorted along a direction; a point is
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


def anchors_in_reach(site: Site) -> Integers:
    """Number of placed anchors within the range in the open of each placed anchor, itself included; shape (n,)."""
    ones, others = links_in_reach(site)
    return np.bincount(np.concatenate([ones, others]), minlength=len(site.anchors)) + 1


def links_in_reach(site: Site) -> tuple[Integers, Integers]:
    """Return the links between anchors within radio reach of each other: the indices of their two ends."""
    pairs = [(one, other) for one, other, _ in pairs_within(anchor_positions(site), RADIO_REACH_M)]
    nothing = np.empty(0, np.int64)
    ones, others = zip(*pairs, strict=True) if pairs else ((nothing,), (nothing,))
    return np.concatenate(ones), np.concatenate(others)


Box = tuple[float, float, float, float]
"""x1, y1, x2, y2."""

OUTSIDE_M: Final = 0.5
"""Anchors hang on walls, whose thickness an outline may leave out: this far outside they count as inside."""


def outline_of(site: Site) -> Matrix | None:
    """The corners of the site's room, shape (k, 2); None where the site has no outline."""
    return None if site.outline_m is UNSET else np.array(site.outline_m, dtype=np.float64)


def rectangle_of(site: Site) -> Box | None:
    """The site's room where it is a rectangle along the axes, otherwise None."""
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
    """Two sides of a polygon, by their first corners, that meet though they are not neighbours; None without such."""
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
    """The sign says on which side of a line a point lies; over the last axis."""
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
    """How far a point, shape (2,), lies outside a polygon; 0 inside."""
    if inside(point_m[None], outline_m)[0]:
        return 0.0
    starts, ends = outline_m, np.roll(outline_m, -1, axis=0)
    along = ends - starts
    lengths2 = np.maximum((along * along).sum(axis=1), 1e-12)
    share = np.clip(((point_m - starts) * along).sum(axis=1) / lengths2, 0.0, 1.0)
    return float(np.linalg.norm(starts + share[:, None] * along - point_m, axis=1).min())
