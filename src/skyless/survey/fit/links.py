"""Which anchors have enough ranges: counting, before anything is computed.

An anchor with ``k`` unknown coordinates needs ``k + 1`` distances to anchors that have enough themselves: with ``k``,
two positions fit. Groups of anchors between which there are too few distances cannot be laid out as one site.
"""

import numpy as np
from msgspec import Struct
from scipy.sparse.csgraph import connected_components

from skyless.kernels.arrays import Array, Integers, Mask


class Links(Struct, frozen=True, eq=False):
    """What counting shows. ``n`` anchors."""

    has_enough: Mask
    """Shape (n,): anchors of the group that can be laid out."""
    adjacent: Mask
    """Shape (n, n): a range or a tape."""
    groups: tuple[tuple[int, ...], ...]
    """Groups that can be laid out, each in itself, the largest first; indices."""
    needed: Integers
    """Shape (n,): distances that an anchor needs."""


def count_links(adjacent: Mask, unknown: Integers, is_known: Mask, least: int) -> Links:
    """Leave out anchors with too few distances until all that remain have enough, then choose the largest group.

    ``unknown``: coordinates of each anchor that are not given, shape (n,). ``is_known``: anchors whose positions are
    given; the distances between them are known as well. ``least``: anchors of the smallest group that has a shape.
    No group is chosen where the second one has more than half of the largest one's anchors.
    """
    needed = np.where(is_known, 0, unknown + 1)
    joined = (adjacent | np.outer(is_known, is_known)) & ~np.eye(len(adjacent), dtype=bool)
    active = np.ones(len(adjacent), bool)
    while active.any():
        degree = (joined & active).sum(axis=1)
        size = np.ones(len(adjacent), np.int64)
        for group in _groups(joined, active):
            size[group] = len(group)
        few = active & (degree < np.minimum(needed, size - 1))
        small = active & (size < least) & ~is_known
        if small.any():
            active &= ~small
        elif few.any():
            active &= ~(few & (degree == degree[few].min()))
        else:
            break
    groups = sorted(_groups(joined, active), key=lambda group: (-len(group), int(group[0])))
    has_enough = np.zeros(len(adjacent), bool)
    if groups and (len(groups) == 1 or 2 * len(groups[1]) <= len(groups[0])):
        has_enough[groups[0]] = True
    return Links(has_enough, adjacent, tuple(tuple(group.tolist()) for group in groups), needed)


def _groups(joined: Mask, active: Mask) -> list[Integers]:
    """Connected parts of the anchors that are active."""
    members = np.flatnonzero(active)
    if not members.size:
        return []
    count, part = connected_components(joined[np.ix_(members, members)], directed=False)
    return [members[part == number] for number in range(count)]


def adjacency(n: int, first: Integers, second: Integers) -> Mask:
    """Which of n anchors these pairs join, shape (n, n), symmetric."""
    adjacent = np.zeros((n, n), bool)
    adjacent[first, second] = adjacent[second, first] = True
    return adjacent


def distances_m(position_m: Array) -> Array:
    """Between all positions, shape (n, n)."""
    apart = position_m[:, None] - position_m[None]
    return np.asarray(np.sqrt(np.einsum("ijk,ijk->ij", apart, apart)))
