"""What anchors relay of each other, as ``joint`` meets it: who tells whose packet, how old it is then, how often."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyless.air.codec import heard_capacity
from skyless.planning.anchor_clocks import AnchorClocks
from skyless.planning.links import links

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
    share, delay_m = links(anchors_m, anchors_m, budget, walls)
    share *= clocks.speaks & clocks.speaks[:, None]
    room = heard_capacity(master_heard=True, master_time=True, page=True)
    masters_room = heard_capacity(master_heard=False, master_time=True, page=True)
    ends, heard, values = [], [], []
    for k, listener in enumerate(clocks.sender.tolist()):
        for sender, age_s, part in _told(
            clocks, k, share[listener], master, masters_room if listener == master else room
        ):
            heard.append(sender)
            values.append((age_s, part, delay_m[listener, sender]))
        ends.append(len(heard))
    return Relays(np.array(ends, np.int64), np.array(heard, np.int64), np.array(values).reshape(-1, 3))


def _told(clocks: AnchorClocks, k: int, share: Vector, master: int, room: int) -> Iterator[tuple[int, float, float]]:
    """What message k relays: senders, how long ago they sent, and how often it tells.

    From an anchor's message back to its one before: a packet is told of if it was heard and there is room, as fewer
    that came later were heard than fit. Of an anchor that sent several only the last counts.
    """
    more = np.zeros(room + 1)  # probability that one less than so many later packets were heard
    more[1] = 1.0
    seen, age_s = {int(clocks.sender[k])}, 0.0
    for back in range(1, len(clocks.sender)):
        age_s += float(clocks.gap_s[k - back + 1])
        sender = int(clocks.sender[k - back])
        if sender == clocks.sender[k]:
            break
        if sender in seen or share[sender] == 0.0:
            continue
        seen.add(sender)
        part = float(share[sender])
        if sender != master:
            part *= float(more.sum())
            more[1:] += share[sender] * (more[:-1] - more[1:])
        if part >= LEAST_TOLD:
            yield sender, age_s, part
