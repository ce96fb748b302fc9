"""What a persistent fault of one anchor does to ``joint``, followed beside the filter (``docs/maths.md`` section 8).

Row j of ``sensitivities`` is the error of all states for each metre by which the tag's receptions of slot j are late.
It obeys the filter's own recursion, with the gains that the filter has used, whatever was rejected or weighted down.
Row j of ``evidence`` holds, for a short and a long memory, the sums from which the size of that fault is estimated,
after Friedland (1969) and Willsky and Jones (1976).
"""

from typing import Final

import numpy as np

from skyless.compiled import borrowing_kernel
from skyless.positioning.joint_state import (
    EVIDENCE,
    PACKETS,
    PLACES,
    REJECTIONS,
    RELAYS_REFUSED,
    RELAYS_TAKEN,
    SLOTS,
    JointArrays,
    width,
)

SHORT: Final = 6.0
LONG: Final = 24.0
"""Memories of the evidence, in packets of each anchor in view."""


@borrowing_kernel
def fade_evidence(s: JointArrays) -> None:
    """Let older evidence count less, once for each packet."""
    slots = s.counts[SLOTS]
    if slots == 0:
        return
    short, long = 1.0 - 1.0 / (SHORT * slots), 1.0 - 1.0 / (LONG * slots)
    for slot in range(slots):
        s.evidence[slot, 0] *= short
        s.evidence[slot, 1] *= short
        s.evidence[slot, 2] *= short * short
        s.evidence[slot, EVIDENCE] *= long
        s.evidence[slot, EVIDENCE + 1] *= long
        s.evidence[slot, EVIDENCE + 2] *= long * long
        s.evidence[slot, REJECTIONS] *= long
    s.recent[PACKETS] = s.recent[PACKETS] * long + 1.0
    s.recent[RELAYS_TAKEN] *= long
    s.recent[RELAYS_REFUSED] *= long


@borrowing_kernel
def follow_faults(s: JointArrays, term: int, own: int, innovation: float, spread: float) -> None:
    """Take what an update did: the term is the gain times √spread; ``own`` is the slot that the tag heard, or −1."""
    V, u, columns, scale = s.sensitivities, s.terms, width(s), 1.0 / np.sqrt(spread)
    whitened = innovation * scale
    for slot in range(s.counts[SLOTS]):
        response = 1.0 if slot == own else 0.0
        for k in range(s.counts[PLACES]):
            response -= s.h[k] * V[slot, s.h_places[k]]
        response *= scale
        for column in range(columns):
            V[slot, column] += response * u[term, column]
        along, squared = response * whitened, response * response
        s.evidence[slot, 0] += along
        s.evidence[slot, 1] += squared
        s.evidence[slot, 2] += squared
        s.evidence[slot, EVIDENCE] += along
        s.evidence[slot, EVIDENCE + 1] += squared
        s.evidence[slot, EVIDENCE + 2] += squared
    if own < 0:
        s.recent[RELAYS_TAKEN] += 1.0


@borrowing_kernel
def join_faults(s: JointArrays, slot: int, place: int) -> None:
    """An offset begins at what a first packet says: at minus the errors of the range, and at its own fault."""
    V = s.sensitivities
    for other in range(s.counts[SLOTS]):
        error = 0.0
        for k in range(s.counts[PLACES]):
            error += s.h[k] * V[other, s.h_places[k]]
        V[other, place] = error
    V[slot, place] = 1.0
