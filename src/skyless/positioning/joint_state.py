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
    SYNCS_USED,
    SYNCS_REFUSED,
) = range(9, 21)
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

CLOCK_SHARE, CLOCK_AGILITY = 13, 14
"""Share of receptions beyond one standard deviation, and the factor on the oscillators' random walk."""

DIM, QA, WHITE, WALK, TX_VARIANCE, RX_VARIANCE, GATE, HEIGHT, RATE_VARIANCE, DROP_S, MOST_CLOCK_AGILITY = range(11)
"""Places in ``settings``."""

REMEMBERED: Final = 16
"""Packets of each anchor that are kept for relays to come; divides the range of sequence numbers."""

MOST_TERMS: Final = 12
MOST_PLACES: Final = 12
"""A position and a velocity of three axes, two offsets and rates, a noise, and up to a multiple of four."""

EVIDENCE: Final = 3
"""Rows of ``evidence`` for each memory, sums: Σwsν, Σws², Σw²s² (``protection_updates``); ..."""

REJECTIONS: Final = 2 * EVIDENCE
"""... behind both memories the packets of the slot that lay beyond the gate, ..."""

REFUSED: Final = REJECTIONS + 1
"""... and what Σwsν, of the long memory, lacks of innovations that were not used."""

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
    """Shape (REFUSED + 1, lanes): what innovations say of such a fault, with a short and a long memory."""
    shared: Matrix
    """Shape (lanes, lanes): −Σwss' of any two slots, with the long memory and of refused innovations as well."""
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
        counts=np.zeros(21, np.int64),
        statistics=np.zeros(15),
        slots=np.zeros((capacity, 10), np.int64),
        anchors=np.zeros((capacity, 8)),
        packets=np.full((capacity, REMEMBERED, 3), NEVER),
        relayed=np.full((capacity, capacity), NEVER),
        slot_of=np.full(site_capacity, -1, np.int64),
        settings=settings,
        site_m=np.zeros((site_capacity, 3)),
        sensitivities=zeros(states, columns),
        responses=zeros(MOST_TERMS, columns),
        evidence=zeros(REFUSED + 1, columns),
        shared=zeros(columns, columns),
        recent=np.zeros(3),
    )


def extended(old: JointArrays, capacity: int, site_capacity: int) -> JointArrays:
    """The same state with more room."""
    new = new_arrays(old.settings, capacity, site_capacity)
    for source, target in zip(old, new, strict=True):
        if source is not target:
            target[tuple(slice(length) for length in source.shape)] = source
    return new


def started(
    old: JointArrays, rx_ticks: int, position_m: Vector, covariance_m2: Matrix, speed_variance: float, caution_m2: float
) -> JointArrays:
    """Another state with the same settings and anchors, none of them in view, that begins at a position."""
    s, dim = new_arrays(old.settings, len(old.slots), len(old.site_m)), len(position_m)
    s.site_m[:] = old.site_m
    s.x[:dim] = position_m
    s.P[:dim, :dim] = covariance_m2
    s.P[range(dim, 2 * dim), range(dim, 2 * dim)] = speed_variance
    s.counts[EPOCH] = s.counts[BASE] = rx_ticks
    s.statistics[:] = 0.0
    s.statistics[CAUTION] = caution_m2
    s.statistics[CLOCK_AGILITY] = 1.0
    s.statistics[:4] = (1.0, s.settings[TX_VARIANCE] + s.settings[RX_VARIANCE], 0.0, 1.0)
    return s


def weigh(s: JointArrays, site: int, variance_factor: float) -> None:
    """Set the factor on the variance of the tag's receptions of an anchor, if it is in view."""
    if s.slot_of[site] >= 0:
        s.anchors[s.slot_of[site], WEIGHT] = variance_factor


def doubt(s: JointArrays, site: int, variance_factor: float) -> None:
    """Let the offset of an anchor that has just joined be as uncertain as the reception that it rests on."""
    place = int(s.settings[DIM]) + int(s.slot_of[site])
    s.P[place, place] += (variance_factor - 1.0) * (s.settings[TX_VARIANCE] + s.settings[RX_VARIANCE])


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
