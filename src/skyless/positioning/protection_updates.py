"""What a persistent fault of one anchor does to ``joint``, followed beside the filter (``docs/maths.md`` section 8).

Column j of ``sensitivities`` is the error of all states for each metre by which the tag's receptions of slot j are
late. It obeys the filter's own recursion, with the gains that the filter has used, whatever was rejected or weighted
down; ``joint_algebra`` keeps it.
Column j of ``evidence`` holds, for a short and a long memory, the sums from which the size of that fault is estimated,
after Friedland (1969) and Willsky and Jones (1976).
"""

from typing import Final

import numpy as np

from skyless.compiled import borrowing_kernel
from skyless.eights import EIGHT, Eight, add, load, scaled, store
from skyless.positioning.joint_state import (
    EVIDENCE,
    PACKETS,
    PLACES,
    REFUSED,
    REJECTIONS,
    RELAYS_REFUSED,
    RELAYS_TAKEN,
    SLOTS,
    JointArrays,
    Matrix,
)

SHORT: Final = 6.0
LONG: Final = 24.0
"""Memories of the evidence, in packets of each anchor in view."""

REFUSED_CLIP: Final = 5.0
"""So many standard deviations an innovation that was not used counts at most as evidence."""


@borrowing_kernel
def fade_evidence(s: JointArrays) -> None:
    """Let older evidence count less, once for each packet."""
    slots = s.counts[SLOTS]
    if slots == 0:
        return
    short, long = 1.0 - 1.0 / (SHORT * slots), 1.0 - 1.0 / (LONG * slots)
    for lane in range(0, slots, EIGHT):
        _fade(s.evidence, 0, lane, short)
        _fade(s.evidence, 1, lane, short)
        _fade(s.evidence, 2, lane, short * short)
        _fade(s.evidence, EVIDENCE, lane, long)
        _fade(s.evidence, EVIDENCE + 1, lane, long)
        _fade(s.evidence, EVIDENCE + 2, lane, long * long)
        _fade(s.evidence, REJECTIONS, lane, long)
        _fade(s.evidence, REFUSED, lane, long)
        for slot in range(slots):
            _fade(s.shared, slot, lane, long)
    s.recent[PACKETS] = s.recent[PACKETS] * long + 1.0
    s.recent[RELAYS_TAKEN] *= long
    s.recent[RELAYS_REFUSED] *= long


@borrowing_kernel
def _fade(sums: Matrix, row: int, lane: int, factor: float) -> None:
    store(sums, (row, lane), scaled(factor, load(sums, (row, lane))))


@borrowing_kernel
def gather_evidence(s: JointArrays, term: int, own: int, whitened: float, scale: float) -> None:
    """Take what an update did; ``own`` is the slot that the tag heard, or −1.

    ``whitened`` is the innovation times ``scale``, one over the root of its variance; so is w, but for its sign, what
    the faults have done to the innovation. The responses hold V·h and become −w.
    """
    r = s.responses
    if own >= 0:
        r[term, own] -= 1.0
    else:
        s.recent[RELAYS_TAKEN] += 1.0
    for lane in range(0, s.counts[SLOTS], EIGHT):
        response = scaled(scale, load(r, (term, lane)))
        store(r, (term, lane), response)
        for memory in range(0, 2 * EVIDENCE, EVIDENCE):
            _gather(s, memory, lane, -whitened, response)
            _gather(s, memory + 1, lane, response, response)
            _gather(s, memory + 2, lane, response, response)


@borrowing_kernel
def _gather(s: JointArrays, row: int, lane: int, factor: float | Eight, response: Eight) -> None:
    store(s.evidence, (row, lane), add(load(s.evidence, (row, lane)), factor, response))


@borrowing_kernel
def gather_refused(s: JointArrays, term: int, own: int, innovation: float, spread: float) -> None:
    """Take an innovation that was not used as evidence for the monitor alone: it may be anything."""
    r, scale = s.responses, 1.0 / np.sqrt(spread)
    r[term, own] -= 1.0
    clipped = min(max(innovation * scale, -REFUSED_CLIP), REFUSED_CLIP)
    if not np.isfinite(clipped):
        return
    for lane in range(0, s.counts[SLOTS], EIGHT):
        response = scaled(scale, load(r, (term, lane)))
        _gather(s, REFUSED, lane, -clipped, response)
        for slot in range(s.counts[SLOTS]):
            share = add(load(s.shared, (slot, lane)), -scale * r[term, slot], response)
            store(s.shared, (slot, lane), share)


@borrowing_kernel
def unsettle(s: JointArrays) -> None:
    """Begin to count packets anew: until there are enough of them nothing is promised."""
    s.recent[PACKETS] = 0.0


@borrowing_kernel
def join_faults(s: JointArrays, slot: int, place: int) -> None:
    """An offset begins at what a first packet says: at minus the errors of the range, and at its own fault."""
    V = s.sensitivities
    for other in range(s.counts[SLOTS]):
        error = 0.0
        for k in range(s.counts[PLACES]):
            error += s.h[k] * V[s.h_places[k], other]
        V[place, other] = error
    V[place, slot] = 1.0
