"""What anchors relay of each other, as ``joint`` meets it: who tells whose packet, how old it is then, how often."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyless.air.codec import heard_capacity
from skyless.compiled import kernel
from skyless.planning.anchor_clocks import AnchorClocks
from skyless.planning.links import hears

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Integers = NDArray[np.int64]

LEAST_TOLD: Final = 0.01
"""A reception that is relayed more rarely does not count."""

AGE_S, TOLD, LATE_M = range(3)
"""Places in a row of ``values``."""


class Relays(NamedTuple):
    """Receptions that the messages of a superframe relay, one after the other."""

    ends: Integers
    """Where those of each message end; shape (messages,)."""
    heard: Integers
    """Row of the anchor whose packet was heard; shape (relays,)."""
    values: Matrix
    """How long ago it was sent, of the sender's messages those that tell of it, its delay by walls; (relays, 3)."""


def relays_of(anchors_m: Matrix, master: int, clocks: AnchorClocks, budget: Vector, walls: Matrix) -> Relays:
    """The relays of a site's superframe, whose frames tell of the last receptions while there is room.

    ``anchors_m``: shape (anchors, 3); ``master``: row of the master, whose packets have a place of their own.
    """
    count, between = len(clocks.sender), (len(anchors_m), len(anchors_m))
    share, delay_m = np.zeros(between), np.zeros(between)
    _fill_links(anchors_m, clocks.speaks, budget, walls, share, delay_m)
    ends, most = np.zeros(count, np.int64), count * len(anchors_m)
    heard, values = np.zeros(most, np.int64), np.zeros((most, 3))
    room = heard_capacity(master_heard=True, master_time=True, page=True)
    masters_room = heard_capacity(master_heard=False, master_time=True, page=True)
    told = _tell(clocks.sender, clocks.gap_s, master, share, delay_m, room, masters_room, ends, heard, values)
    return Relays(ends, heard[:told].copy(), values[:told].copy())


@kernel
def _fill_links(
    anchors_m: Matrix, speaks: NDArray[np.bool_], budget: Vector, walls: Matrix, share: Matrix, delay_m: Matrix
) -> None:
    """Share of the frames of the anchor in the column that the one in the row hears, and their delay."""
    for i in range(len(anchors_m)):
        for j in range(i):
            if speaks[i] and speaks[j]:
                share[i, j], delay_m[i, j] = hears(budget, walls, anchors_m[j], anchors_m[i])
                share[j, i], delay_m[j, i] = share[i, j], delay_m[i, j]


@kernel
def _tell(
    sender: Integers,
    gap_s: Vector,
    master: int,
    share: Matrix,
    delay_m: Matrix,
    room: int,
    masters_room: int,
    ends: Integers,
    heard: Integers,
    values: Matrix,
) -> int:
    """Fill in the relays of every message, [age, share, delay] in ``values``; return how many there are.

    From an anchor's message back to its one before: a packet is told of if it was heard and there is room, as fewer
    that came later were heard than fit. Of an anchor that sent several only the last counts.
    """
    count, told = len(sender), 0
    more = np.zeros(room + masters_room)
    seen = np.zeros(len(share), np.bool_)
    for k in range(count):
        i = sender[k]
        places = masters_room if i == master else room
        more[:] = 0.0
        more[0] = 1.0
        seen[:] = False
        age_s = 0.0
        for back in range(1, count):
            age_s += gap_s[(k - back + 1) % count]
            j = sender[(k - back) % count]
            if j == i:
                break
            if seen[j] or share[i, j] == 0.0:
                continue
            seen[j] = True
            part = share[i, j]
            if j != master:
                part *= more[:places].sum()
                for c in range(places - 1, 0, -1):
                    more[c] += share[i, j] * (more[c - 1] - more[c])
                more[0] *= 1.0 - share[i, j]
            if part >= LEAST_TOLD:
                heard[told] = j
                values[told, AGE_S], values[told, TOLD], values[told, LATE_M] = age_s, part, delay_m[i, j]
                told += 1
        ends[k] = told
    return told
