"""State of ``joint``: the tag's motion and the clock of every anchor in view, all against the tag's own counter.

States stand in three blocks, each packed, so that rows are worked on whole and only anchors in view cost:

    values  position (dim), then the offset b of each anchor's clock:  tag's reading − anchor's reading, in metres
    rates   velocity (dim), then the rate of each offset, m/s
    noises  the noise of an anchor's last TX stamp, in metres, of those anchors whose packets others relay

Values are kept as of the time ``BASE``, up to 50 ms back: at time t a value is ``value + (t − BASE)·rate``. So
time passes without touching the covariance but for its noise, and the base is moved on now and then. The tag's clock is
the reference of all offsets; no anchor is special, none is ever changed for another.

The whole ticks of an offset stand in an integer. The caller owns all arrays; their capacity is theirs to extend.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyless.compiled import borrowing_kernel
from skyless.eights import EIGHT, zeros

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Integers = NDArray[np.int64]

EPOCH, BASE, ACCEPTED, REJECTED, REJECTED_IN_ROW, SLOTS, NOISES, TERMS, PLACES = range(9)
(
    RELAYS_USED,
    RELAYS_REJECTED,
    RESTARTS,
    EXCLUSIONS,
    READMISSIONS,
    OUT,
    JUMPS,
    STALE,
    STALE_IN_ROW,
    IMPOSSIBLE,
    PARDONED,
    PARDONS,
    SYNCS_USED,
    SYNCS_REFUSED,
) = range(9, 23)
"""Places in ``counts``. The epoch is the tag's reading at the newest message, the base that of the values."""

SITE, WHOLE, TX, RX, NOISE, WANTED, IN_ROW, EXCLUDED, RELAYS_IN_ROW, REJOINED = range(10)
"""Places in a row of ``slots``: index in the site's table, whole ticks of the offset, newest packet's stamps (own
clock, tag's), place among the noises or −1, whether its packets are relayed, rejections in a row, whether it is
left out, refused relays in a row, and when it joined again after a jump (tag's clock; 0: never)."""

PLACE_X, PLACE_Y, PLACE_Z, RANGE, WEIGHT, INNOVATION, SCORE, JOIN_DOUBT = range(8)
"""Places in a row of ``anchors``: position, range at its newest packet, factor on the variance of its receptions (of
the packet at hand, as ``first_path`` says), newest innovation and running mean of the normalised ones, and what is left
of the additional variance that its receptions have after it joined where messages are late."""

LATE_SHARE, LAG_SQUARED, CAUTION = range(4, 7)
LAG: Final = 7
"""Places in ``statistics`` behind the tracker's: share of late messages, lag; running means, then directions."""

DIM, QA, WHITE, WALK, TX_VARIANCE, RX_VARIANCE, GATE, HEIGHT, RATE_VARIANCE, DROP_S = range(10)
"""Places in ``settings``."""

REMEMBERED: Final = 16
"""Packets of each anchor that are kept for relays to come; divides the range of sequence numbers."""

MOST_TERMS: Final = 12
MOST_PLACES: Final = 12
"""A position and a velocity of three axes, two offsets and rates, a noise, and up to a multiple of four."""

EVIDENCE: Final = 3
"""Rows of ``evidence`` for each memory, sums: Σwsν, Σws², Σw²s² (``protection_updates``); ..."""

REJECTIONS: Final = 2 * EVIDENCE
"""... behind both memories the packets of the slot that lay beyond the gate."""

MOTION_VALUE, MOTION_CROSS, MOTION_RATE, CLOCK_VALUE, CLOCK_CROSS, CLOCK_RATE = range(6)
"""Places in ``noise``: variance of a value, its covariance with the rate, the rate's variance; of each axis, and of
each oscillator."""

PACKETS, RELAYS_TAKEN, RELAYS_REFUSED = range(3)
"""Places in ``recent``: how many there were lately, older ones counting less."""

SEQUENCE, PACKET_TX, PACKET_RX = range(3)
"""Places in a remembered packet."""


class JointArrays(NamedTuple):
    """Everything that the kernels work on, for one tag."""

    x: Vector
    """Shape (states,)."""
    P: Matrix
    """Shape (states, states); zero beyond the states in use."""
    terms: Matrix
    """Shape (MOST_TERMS, states); what P is still to change by, −Σ term·termᵀ (``joint_algebra``)."""
    along: Vector
    """Shape (MOST_TERMS,): the product of each term with the measurement at hand."""
    noise: Vector
    """Shape (6,): what passing time has added to variances but P does not hold yet."""
    h_places: Integers
    """Where the measurement at hand is not zero, shape (MOST_PLACES,); as many as ``counts[PLACES]``."""
    h: Vector
    """What it is there."""
    counts: Integers
    statistics: Vector
    """As the tracker's."""
    slots: Integers
    """Shape (capacity, 10)."""
    anchors: Matrix
    """Shape (capacity, 8)."""
    packets: Integers
    """Shape (capacity, REMEMBERED, 3)."""
    relayed: Integers
    """Row i, column j: TX stamp of the newest packet of slot j whose reception by slot i was taken."""
    slot_of: Integers
    """Slot of each anchor of the site's table, −1 if it is not in view."""
    settings: Vector
    site_m: Matrix
    """Positions of all anchors, shape (anchors of the site, 3)."""
    sensitivities: Matrix
    """Shape (states, lanes): the states' errors for each metre by which the tag's receptions of a slot are late."""
    responses: Matrix
    """Shape (MOST_TERMS, lanes); what sensitivities are still to change by, −Σ term·responsesᵀ."""
    evidence: Matrix
    """Shape (2·EVIDENCE + 1, lanes): what innovations say of such a fault, with a short and a long memory."""
    recent: Vector
    """Shape (3,)."""


NEVER: Final = -(1 << 62)
"""A time before all others."""


def in_eights(count: int) -> int:
    """The next multiple of eight, for ``eights``."""
    return -(-count // EIGHT) * EIGHT


def new_arrays(settings: Vector, capacity: int, site_capacity: int) -> JointArrays:
    """Empty arrays with room for so many anchors in view, and in the table."""
    states = in_eights(2 * int(settings[DIM]) + 3 * capacity)
    columns = in_eights(capacity)
    return JointArrays(
        x=zeros(states),
        P=zeros(states, states),
        terms=zeros(MOST_TERMS, states),
        along=np.zeros(MOST_TERMS),
        noise=np.zeros(6),
        h_places=np.zeros(MOST_PLACES, np.int64),
        h=np.zeros(MOST_PLACES),
        counts=np.zeros(23, np.int64),
        statistics=np.zeros(13),
        slots=np.zeros((capacity, 10), np.int64),
        anchors=np.zeros((capacity, 8)),
        packets=np.full((capacity, REMEMBERED, 3), NEVER),
        relayed=np.full((capacity, capacity), NEVER),
        slot_of=np.full(site_capacity, -1, np.int64),
        settings=settings,
        site_m=np.zeros((site_capacity, 3)),
        sensitivities=zeros(states, columns),
        responses=zeros(MOST_TERMS, columns),
        evidence=zeros(2 * EVIDENCE + 1, columns),
        recent=np.zeros(3),
    )


def extended(old: JointArrays, capacity: int, site_capacity: int) -> JointArrays:
    """The same state with more room."""
    new = new_arrays(old.settings, capacity, site_capacity)
    for source, target in zip(old, new, strict=True):
        if source is not target:
            target[tuple(slice(length) for length in source.shape)] = source
    return new


@borrowing_kernel
def values(s: JointArrays) -> int:
    """How many values there are; as many rates follow them, then the noises."""
    return int(s.settings[DIM] + s.counts[SLOTS])


@borrowing_kernel
def states(s: JointArrays) -> int:
    """How many states are in use."""
    return int(2 * (s.settings[DIM] + s.counts[SLOTS]) + s.counts[NOISES])


@borrowing_kernel
def width(s: JointArrays) -> int:
    """Columns that loops run over: the states in use, and zeros up to a whole number of eights."""
    return (states(s) + 7) // 8 * 8


@borrowing_kernel
def lanes(s: JointArrays) -> int:
    """As many for the slots."""
    return int((s.counts[SLOTS] + 7) // 8 * 8)


@borrowing_kernel
def _insert(s: JointArrays, n: int, place: int) -> None:
    """Make room for a state at ``place``, zero and without variance."""
    x, P = s.x, s.P
    for row in range(n, place, -1):
        x[row] = x[row - 1]
        for column in range(n):
            P[row, column] = P[row - 1, column]
    x[place] = 0.0
    for column in range(n + 1):
        P[place, column] = 0.0
    for row in range(n + 1):
        for column in range(n, place, -1):
            P[row, column] = P[row, column - 1]
        P[row, place] = 0.0
    V = s.sensitivities
    for slot in range(s.counts[SLOTS]):
        for row in range(n, place, -1):
            V[row, slot] = V[row - 1, slot]
        V[place, slot] = 0.0


@borrowing_kernel
def _remove(s: JointArrays, n: int, place: int) -> None:
    """Take a state out; what stood behind it moves up, zeros follow."""
    x, P = s.x, s.P
    for row in range(place, n - 1):
        x[row] = x[row + 1]
        for column in range(n):
            P[row, column] = P[row + 1, column]
    x[n - 1] = 0.0
    for column in range(n):
        P[n - 1, column] = 0.0
    for row in range(n):
        for column in range(place, n - 1):
            P[row, column] = P[row, column + 1]
        P[row, n - 1] = 0.0
    V = s.sensitivities
    for slot in range(s.counts[SLOTS]):
        for row in range(place, n - 1):
            V[row, slot] = V[row + 1, slot]
        V[n - 1, slot] = 0.0


@borrowing_kernel
def has_room(s: JointArrays) -> bool:
    """Whether one more anchor fits."""
    return bool(s.counts[SLOTS] < s.slots.shape[0])


@borrowing_kernel
def add_slot(s: JointArrays, site: int) -> int:
    """Give an anchor a slot, the last one, with two states of zero; the caller has seen that there is room."""
    slot: int = s.counts[SLOTS]
    n, one_more = states(s), values(s)
    _insert(s, n, 2 * one_more)
    _insert(s, n + 1, one_more)
    s.counts[SLOTS] = slot + 1
    s.slot_of[site] = slot
    s.slots[slot, :] = 0
    s.slots[slot, SITE] = site
    s.slots[slot, NOISE] = -1
    for axis in range(3):
        s.anchors[slot, axis] = s.site_m[site, axis]
    s.anchors[slot, RANGE:] = 0.0
    s.anchors[slot, WEIGHT] = 1.0
    s.sensitivities[:, slot] = 0.0
    s.evidence[:, slot] = 0.0
    s.packets[slot, :, :] = NEVER
    s.relayed[slot, :] = NEVER
    s.relayed[:, slot] = NEVER
    return slot


@borrowing_kernel
def add_noise_state(s: JointArrays, slot: int) -> None:
    """Give an anchor a state for the noise of its TX stamps (there is room for one of each slot)."""
    _insert(s, states(s), states(s))
    s.slots[slot, NOISE] = s.counts[NOISES]
    s.counts[NOISES] += 1


@borrowing_kernel
def drop_slot(s: JointArrays, slot: int) -> None:
    """Forget an anchor and its states."""
    noise = s.slots[slot, NOISE]
    if noise >= 0:
        _remove(s, states(s), 2 * values(s) + noise)
        s.counts[NOISES] -= 1
    dim, n, half = int(s.settings[DIM]), states(s), values(s)
    _remove(s, n, half + dim + slot)
    _remove(s, n - 1, dim + slot)
    last = s.counts[SLOTS] - 1
    s.slot_of[s.slots[slot, SITE]] = -1
    for k in range(slot, last):
        for column in range(s.slots.shape[1]):
            s.slots[k, column] = s.slots[k + 1, column]
        for column in range(s.anchors.shape[1]):
            s.anchors[k, column] = s.anchors[k + 1, column]
        for row in range(s.sensitivities.shape[0]):
            s.sensitivities[row, k] = s.sensitivities[row, k + 1]
        for row in range(2 * EVIDENCE + 1):
            s.evidence[row, k] = s.evidence[row, k + 1]
        for packet in range(REMEMBERED):
            for column in range(3):
                s.packets[k, packet, column] = s.packets[k + 1, packet, column]
        for column in range(last + 1):
            s.relayed[k, column] = s.relayed[k + 1, column]
        s.slot_of[s.slots[k, SITE]] = k
    for k in range(last):
        for column in range(slot, last):
            s.relayed[k, column] = s.relayed[k, column + 1]
        if s.slots[k, NOISE] > noise >= 0:
            s.slots[k, NOISE] -= 1
    s.sensitivities[:, last] = 0.0
    s.evidence[:, last] = 0.0
    s.counts[SLOTS] = last
