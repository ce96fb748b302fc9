"""What a tag at a point hears in a superframe, as ``joint`` takes it: packets, and the receptions that they relay."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyless.compiled import kernel
from skyless.planning.anchor_clocks import AnchorClocks
from skyless.planning.relays import AGE_S, LATE_M, TOLD, Relays

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Integers = NDArray[np.int64]

RARELY: Final = 0.1
"""An anchor of whose frames fewer arrive does not help the tag."""


class Script(NamedTuple):
    """A superframe at one point; filled as far as ``counts`` says, by ``write_script``."""

    counts: Integers
    """Anchors, packets, relays."""
    place: Integers
    """Where each anchor of the site stands among those in view, −1 if it does not; shape (anchors,)."""
    sight: Matrix
    """Of those in view: direction from the anchor, delay by walls; shape (anchors, 4)."""
    sender: Integers
    """Shape (messages,), as all of packets: place of the sender, ..."""
    since_s: Vector
    """... time since the packet before, ..."""
    share: Vector
    """... how often it arrives, ..."""
    end: Integers
    """... where its relays end."""
    heard: Integers
    """Shape (relays,), as all of relays: place of the anchor whose packet was heard, ..."""
    age_s: Vector
    part: Vector
    """... how often the tag can use it, ..."""
    late_m: Vector
    """... and its delay by walls."""


@kernel
def new_script(anchors: int, messages: int, relays: int) -> Script:
    """Room for a site."""
    return Script(
        np.zeros(3, np.int64),
        np.zeros(anchors, np.int64),
        np.zeros((anchors, 4)),
        np.zeros(messages, np.int64),
        np.zeros(messages),
        np.zeros(messages),
        np.zeros(messages, np.int64),
        np.zeros(relays, np.int64),
        np.zeros(relays),
        np.zeros(relays),
        np.zeros(relays),
    )


@kernel
def write_script(
    script: Script,
    share: Vector,
    sight: Matrix,
    clocks: AnchorClocks,
    relays: Relays,
) -> None:
    """Fill in what a point hears: ``share`` and ``sight`` as ``observe`` leaves them, the rest of the site."""
    sender, ends = clocks.sender, relays.ends
    anchors, packets, told, waited_s = 0, 0, 0, 0.0
    for i in range(len(share)):
        script.place[i] = -1
        if share[i] >= RARELY:
            script.place[i] = anchors
            script.sight[anchors] = sight[i]
            anchors += 1
    for k in range(len(sender)):
        i = sender[k]
        waited_s += clocks.gap_s[k]
        if script.place[i] < 0:
            continue
        for r in range(ends[k - 1] if k > 0 else 0, ends[k]):
            j = relays.heard[r]
            if script.place[j] >= 0:
                script.heard[told] = script.place[j]
                script.age_s[told] = relays.values[r, AGE_S]
                script.part[told] = share[i] * share[j] * relays.values[r, TOLD]
                script.late_m[told] = relays.values[r, LATE_M]
                told += 1
        script.sender[packets], script.end[packets] = script.place[i], told
        script.since_s[packets], script.share[packets] = waited_s, share[i]
        waited_s = 0.0
        packets += 1
    if packets > 0:
        script.since_s[0] += waited_s
    script.counts[0], script.counts[1], script.counts[2] = anchors, packets, told
