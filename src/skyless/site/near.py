"""Which points are near each other: pairs within a distance, without a table of all pairs."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from skyless.kernels.arrays import Integers, Matrix, Vector
from skyless.site.model import Site

_DIRECTION: Final = np.array([0.8164, 0.5211, 0.2489])
"""Of a length just below one, and along no street of a grid, so that few points share a projection."""

DISTANCE_ROUNDING_M: Final = 1e-6
"""Two points at exactly a limit must not count as nearer by the rounding of their coordinates."""


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


def pairs_within_groups(
    points_m: Matrix, group: Integers, distance_m: float
) -> Iterator[tuple[Integers, Integers, Vector]]:
    """Pairs of points of one group that are closer than a distance; ``group``: shape (n,), numbers below 0 are none."""
    order = np.argsort(group, kind="stable")
    order = order[np.searchsorted(group[order], 0) :]
    ends = np.flatnonzero(np.diff(group[order])) + 1
    for rows in np.split(order, ends):
        for one, other, apart_m in pairs_within(points_m[rows], distance_m):
            yield rows[one], rows[other], apart_m
