"""Slots for the anchors of a site: two that are near each other, or that were received at once, get different ones.

A greedy sweep: anchors in the order of x, each with the lowest slot that no near anchor before it has.
"""

from collections.abc import Iterable
from typing import Final

import numpy as np
from msgspec.structs import replace

from skyless.kernels.arrays import Integers, Matrix, Vector
from skyless.site.model import Site
from skyless.site.near import DISTANCE_ROUNDING_M, anchor_positions

MAX_SLOTS: Final = 255
"""Slots that a superframe can have; a beacon carries its slot in eight bits."""


class SlotShortageError(ValueError):
    """A site needs more slots than a superframe can have."""


def slot_colours(points_m: Matrix, reuse_m: float, conflicts: Iterable[tuple[int, int]] = ()) -> Integers:
    """Return a slot for every point, shape (n, 3): points closer than ``reuse_m`` metres get different ones.

    ``conflicts``: further pairs of rows that must differ. The slots are 0, 1, …, without a gap; shape (n,).
    """
    more: dict[int, list[int]] = {}
    for one, other in conflicts:
        if one != other:
            more.setdefault(one, []).append(other)
            more.setdefault(other, []).append(one)
    squared_m2 = max(reuse_m - DISTANCE_ROUNDING_M, 0.0) ** 2
    x_m: Vector = np.round(points_m[:, 0] / DISTANCE_ROUNDING_M) * DISTANCE_ROUNDING_M
    order = np.lexsort((points_m[:, 2], points_m[:, 1], x_m))
    swept_m = points_m[order]
    starts = np.searchsorted(x_m[order], x_m[order] - reuse_m)
    slots, swept = np.full((2, len(order)), -1)
    taken = np.zeros(len(order) + 1, np.bool_)
    for position, (row, start) in enumerate(zip(order.tolist(), starts.tolist(), strict=True)):
        away_m = swept_m[start:position] - swept_m[position]
        near = np.einsum("ij,ij->i", away_m, away_m) < squared_m2
        others = [int(slots[other]) for other in more.get(row, ()) if slots[other] >= 0]
        of_others = np.concatenate([swept[start:position][near], np.array(others, np.int64)])
        taken[of_others] = True
        slots[row] = swept[position] = int(np.argmin(taken))
        taken[of_others] = False
    return slots


def with_slots(site: Site, conflicts: Iterable[tuple[int, int]] = ()) -> Site:
    """Return a site of mode slots with a slot for every anchor, by ``schedule.reuse_m``, and ``schedule.slots``.

    ``conflicts``: pairs of identifiers of anchors that some anchor received at once. An anchor without a position gets
    a slot that no other anchor has.

    Raises:
        SlotShortageError: more slots are needed than a superframe can have.
    """
    row_of = {anchor.id: row for row, anchor in enumerate(site.anchors)}
    pairs = [(row_of[one], row_of[other]) for one, other in conflicts if one in row_of and other in row_of]
    slots = slot_colours(anchor_positions(site), site.schedule.reuse_m, pairs)
    colours = int(slots.max(initial=-1)) + 1
    needed = colours + len(site.unplaced)
    if needed > MAX_SLOTS:
        what = f"{colours} for anchors closer than schedule.reuse_m, {site.schedule.reuse_m:g} m"
        if site.unplaced:
            what += f", and one for each of {len(site.unplaced)} anchors without a position"
        raise SlotShortageError(
            f"{needed} slots are needed ({what}), and a superframe has at most {MAX_SLOTS}; a smaller reuse_m, anchors "
            "farther apart, or mode free need fewer"
        )
    return replace(
        site,
        schedule=replace(site.schedule, slots=needed),
        anchors=tuple(replace(a, slot=slot) for a, slot in zip(site.anchors, slots.tolist(), strict=True)),
        unplaced=tuple(replace(anchor, slot=slot) for slot, anchor in enumerate(site.unplaced, start=colours)),
    )
