"""``joint``: the tag's motion and all anchors' clocks in one filter, fed from raw stamps (``docs/maths.md`` section 6).

The same kernels serve message by message (``JointFilter.hear``) and over arrays (``JointFilter.track``).
"""

from collections.abc import Iterable
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.compiled import borrowing_kernel
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_S
from skyless.positioning.joint_algebra import settle
from skyless.positioning.joint_state import (
    BASE,
    DIM,
    DROP_S,
    EPOCH,
    IN_ROW,
    INNOVATION,
    NOISE,
    PACKET_RX,
    PACKET_TX,
    QA,
    REJECTED_IN_ROW,
    REMEMBERED,
    RESTARTS,
    RX,
    RX_VARIANCE,
    SEQUENCE,
    SLOTS,
    TX,
    TX_VARIANCE,
    WANTED,
    WHOLE,
    Integers,
    JointArrays,
    Matrix,
    Vector,
    add_noise_state,
    add_slot,
    drop_slot,
    extended,
    has_room,
    new_arrays,
    values,
)
from skyless.positioning.joint_updates import elapse, hear_anchor, hear_relay, join, new_packet
from skyless.positioning.kalman import horizontal_variance
from skyless.positioning.tracker import AGILITY, LOST_IN_ROW, LOST_SHARE, REJECTED_SHARE

FULL, REJECTED, ACCEPTED, JOINED = range(-1, 3)
"""What became of a packet: no room for its anchor, beyond the gate, taken, or the first of its anchor."""

RELAY_AGE_S: Final = 1.0
"""Older packets are not relayed, as sequence numbers come around."""

RESTART_M: Final = 300.0
"""No path is longer than expected by so much: the anchor's counter has jumped, ..."""

RESTART_IN_ROW: Final = 3
"""... if so many packets in a row say so."""

MAX_RATE: Final = 50e-6
"""Two crystals of ±20 ppm, and room."""


class JointSettings(Struct, frozen=True):
    """What the filter assumes."""

    qa: float = 0.5
    """Spectral density of the acceleration, m²/s³ per axis."""
    white: float = 3.6e-5
    """Of each oscillator, m²/s."""
    walk: float = 0.09
    """Of each oscillator's rate, m²/s³."""
    tx_variance_m2: float = 9e-4
    rx_variance_m2: float = 9e-4
    """Of one stamp each."""
    gate: float = 4.0
    """Innovations beyond so many standard deviations are not used."""
    height_m: float | None = None
    """Height of the tag where it is given; None to estimate it."""
    drop_s: float = 2.0
    """Anchors that are silent for longer are out of view."""

    @property
    def dim(self) -> int:
        """Dimensions of the position that are estimated."""
        return 3 if self.height_m is None else 2

    def array(self) -> Vector:
        """The settings as the kernels take them."""
        height_m = 0.0 if self.height_m is None else self.height_m
        rate_variance = (MAX_RATE * SPEED_OF_LIGHT_MPS) ** 2
        stamps = (self.tx_variance_m2, self.rx_variance_m2)
        return np.array(
            [self.dim, self.qa, self.white, self.walk, *stamps, self.gate, height_m, rate_variance, self.drop_s]
        )


@borrowing_kernel
def joint_hear(
    s: JointArrays, site: int, sequence: int, rx_ticks: int, tx_ticks: int, relays: Integers, first: int, last: int
) -> int:
    """Take one packet of the anchor ``site`` (place in the table) and what it relays, in the tag's order of time.

    Rows ``first`` to ``last`` of ``relays`` are [the anchor that heard, the anchor that was heard, sequence, RX stamp
    of the former], anchors by their places in the table; all stamps are unwrapped, each on its own clock.
    """
    elapse(s, rx_ticks)
    if s.counts[BASE] == rx_ticks:
        _drop_silent(s, rx_ticks)
    slot = s.slot_of[site]
    if slot >= 0 and s.slots[slot, IN_ROW] >= RESTART_IN_ROW and abs(s.anchors[slot, INNOVATION]) > RESTART_M:
        settle(s)
        drop_slot(s, slot)
        s.counts[RESTARTS] += 1
        slot = -1
    status = FULL
    if slot >= 0:
        if s.slots[slot, NOISE] < 0 and s.slots[slot, WANTED] > 0:
            settle(s)
            add_noise_state(s, slot)
        new_packet(s, slot)
        status = ACCEPTED if hear_anchor(s, slot, rx_ticks, tx_ticks) else REJECTED
        _remember(s, slot, sequence, rx_ticks, tx_ticks)
        for relay in range(first, last):
            _hear_relayed(
                s, s.slot_of[relays[relay, 0]], s.slot_of[relays[relay, 1]], relays[relay, 2], relays[relay, 3]
            )
    elif has_room(s):
        settle(s)
        slot = add_slot(s, site)
        join(s, slot, rx_ticks, tx_ticks)
        _remember(s, slot, sequence, rx_ticks, tx_ticks)
        status = JOINED
    settle(s)
    return status


@borrowing_kernel
def _remember(s: JointArrays, slot: int, sequence: int, rx_ticks: int, tx_ticks: int) -> None:
    s.slots[slot, TX] = tx_ticks
    s.slots[slot, RX] = rx_ticks
    place = sequence % REMEMBERED
    s.packets[slot, place, SEQUENCE] = sequence
    s.packets[slot, place, PACKET_TX] = tx_ticks
    s.packets[slot, place, PACKET_RX] = rx_ticks


@borrowing_kernel
def _hear_relayed(s: JointArrays, listener: int, slot: int, sequence: int, relayed_rx: int) -> None:
    """Take a relayed reception once, if the tag has heard that very packet."""
    place = sequence % REMEMBERED
    if slot >= 0 and listener >= 0 and slot != listener and s.packets[slot, place, SEQUENCE] == sequence:
        tx_ticks = s.packets[slot, place, PACKET_TX]
        rx_ticks = s.packets[slot, place, PACKET_RX]
        if tx_ticks > s.relayed[listener, slot] and (s.counts[EPOCH] - rx_ticks) * TICK_S < RELAY_AGE_S:
            s.relayed[listener, slot] = tx_ticks
            s.slots[slot, WANTED] = 1
            hear_relay(s, listener, slot, tx_ticks, rx_ticks, relayed_rx)


@borrowing_kernel
def _drop_silent(s: JointArrays, rx_ticks: int) -> None:
    for slot in range(s.counts[SLOTS] - 1, -1, -1):
        if (rx_ticks - s.slots[slot, RX]) * TICK_S > s.settings[DROP_S]:
            settle(s)
            drop_slot(s, slot)


@borrowing_kernel
def joint_motion(s: JointArrays, x: Vector, P: Matrix) -> None:
    """Write position and velocity at the newest message, shape (2·dim,), and their covariance."""
    dim, half = int(s.settings[DIM]), values(s)
    tau_s = (s.counts[EPOCH] - s.counts[BASE]) * TICK_S
    for one in range(dim):
        x[one] = s.x[one] + tau_s * s.x[half + one]
        x[dim + one] = s.x[half + one]
        for other in range(dim):
            rate = s.P[half + one, half + other]
            cross = s.P[one, half + other] + tau_s * rate
            P[one, other] = s.P[one, other] + tau_s * (s.P[half + one, other] + cross)
            P[one, dim + other] = cross
            P[dim + other, one] = cross
            P[dim + one, dim + other] = rate


@borrowing_kernel
def joint_track(
    s: JointArrays,
    begin: int,
    sites: Integers,
    sequences: Integers,
    rx_ticks: Integers,
    tx_ticks: Integers,
    relays: Integers,
    ends: Integers,
    motion: Vector,
    covariance: Matrix,
    motions: Matrix,
    variances: Matrix,
) -> int:
    """Take packets from ``begin`` on; ``ends[k]`` is where the relays of packet k end. Returns the first not taken.

    Rows k of ``motions`` and ``variances`` become position and velocity after packet k, and the position's
    covariance; where they have no rows nothing is written.
    """
    dim = int(s.settings[DIM])
    for k in range(begin, len(sites)):
        first = ends[k - 1] if k > 0 else 0
        if joint_hear(s, sites[k], sequences[k], rx_ticks[k], tx_ticks[k], relays, first, ends[k]) == FULL:
            return k
        if len(motions) > 0:
            joint_motion(s, motion, covariance)
            for one in range(2 * dim):
                motions[k, one] = motion[one]
            for one in range(dim):
                for other in range(dim):
                    variances[k, dim * one + other] = covariance[one, other]
    return len(sites)


class Messages(Struct, frozen=True):
    """Packets in the order in which the tag heard them, all stamps unwrapped."""

    sites: Integers
    """Place of each packet's anchor in the table of positions, shape (n,)."""
    sequences: Integers
    rx_ticks: Integers
    """The tag's stamps."""
    tx_ticks: Integers
    """The anchors' own."""
    relays: Integers
    """As ``joint_hear`` takes them, shape (relays, 4)."""
    ends: Integers
    """Where the relays of each packet end."""


NO_RELAYS: Final = np.empty((0, 4), np.int64)


class JointFilter:
    """State of one tag."""

    def __init__(self, settings: JointSettings, site_m: NDArray[np.float64], capacity: int = 8) -> None:
        """``site_m``: positions of the anchors, shape (n, 3); ``capacity``: how many may be in view, to begin with."""
        self.arrays = new_arrays(settings.array(), capacity, max(len(site_m), capacity))
        self.arrays.site_m[: len(site_m)] = site_m
        self.dim = settings.dim
        self._anchors = len(site_m)
        self._motion = np.zeros(2 * self.dim)
        self._covariance = np.zeros((2 * self.dim, 2 * self.dim))

    def add_anchor(self, anchor_m: Vector) -> int:
        """Add an anchor to the table; returns its place there."""
        place, s = self._anchors, self.arrays
        if place == len(s.site_m):
            self.arrays = s = extended(s, len(s.slots), 2 * place)
        s.site_m[place] = anchor_m
        self._anchors += 1
        return place

    def has_anchors(self, places: Iterable[int]) -> bool:
        """Whether these places in the table are taken."""
        return all(type(place) is int and 0 <= place < self._anchors for place in places)

    def move_anchor(self, place: int, anchor_m: Vector) -> None:
        """Correct an anchor's position."""
        s = self.arrays
        s.site_m[place] = anchor_m
        if s.slot_of[place] >= 0:
            s.anchors[s.slot_of[place], :3] = anchor_m

    def start(self, rx_ticks: int, position_m: Vector, covariance_m2: Matrix, speed_variance: float) -> None:
        """Begin at a position, shapes (dim,) and (dim, dim), without any anchor in view."""
        old, dim = self.arrays, self.dim
        self.arrays = s = new_arrays(old.settings, len(old.slots), len(old.site_m))
        s.site_m[:] = old.site_m
        s.x[:dim] = position_m
        s.P[:dim, :dim] = covariance_m2
        s.P[range(dim, 2 * dim), range(dim, 2 * dim)] = speed_variance
        s.counts[EPOCH] = s.counts[BASE] = rx_ticks
        s.statistics[:] = (1.0, s.settings[TX_VARIANCE] + s.settings[RX_VARIANCE], 0.0, 1.0)

    def hear(self, site: int, sequence: int, rx_ticks: int, tx_ticks: int, relays: Integers = NO_RELAYS) -> int:
        """Take one packet (``joint_hear``)."""
        status = joint_hear(self.arrays, site, sequence, rx_ticks, tx_ticks, relays, 0, len(relays))
        if status == FULL:
            self._extend()
            status = joint_hear(self.arrays, site, sequence, rx_ticks, tx_ticks, relays, 0, len(relays))
        return status

    def track(self, messages: Messages, motions: Matrix | None = None, variances: Matrix | None = None) -> None:
        """Take many packets in one loop; the arithmetic is that of ``hear``, so the states are its, bit for bit.

        Rows of ``motions``, shape (n, 2·dim), and ``variances``, shape (n, dim·dim), are filled in after each packet.
        """
        nothing = np.empty((0, 0))
        done = 0
        while True:
            done = joint_track(
                self.arrays,
                done,
                messages.sites,
                messages.sequences,
                messages.rx_ticks,
                messages.tx_ticks,
                messages.relays,
                messages.ends,
                self._motion,
                self._covariance,
                nothing if motions is None else motions,
                nothing if variances is None else variances,
            )
            if done == len(messages.sites):
                return
            self._extend()

    def _extend(self) -> None:
        self.arrays = extended(self.arrays, 2 * len(self.arrays.slots), len(self.arrays.site_m))

    def motion(self) -> tuple[Vector, Matrix]:
        """Position and velocity at the newest message, and their covariance; overwritten by the next call."""
        joint_motion(self.arrays, self._motion, self._covariance)
        return self._motion, self._covariance

    @property
    def lost(self) -> bool:
        """Whether so many messages do not fit that the state must be wrong."""
        in_row = self.arrays.counts[REJECTED_IN_ROW]
        return bool(self.arrays.statistics[REJECTED_SHARE] > LOST_SHARE or in_row >= LOST_IN_ROW)

    def horizontal_variance_m2(self, ahead_s: float) -> float:
        """Sum of the variances of x and y so much later, if nothing is heard until then."""
        s = self.arrays
        _, covariance = self.motion()
        return horizontal_variance(covariance, self.dim, ahead_s, s.settings[QA] * s.statistics[AGILITY])

    def clock(self, site: int) -> tuple[int, float, float] | None:
        """The tag's clock against that of an anchor in view: whole ticks, the rest in metres, rate in m/s."""
        s = self.arrays
        slot = int(s.slot_of[site])
        if slot < 0:
            return None
        half, place = values(s), self.dim + slot
        tau_s = (int(s.counts[EPOCH]) - int(s.counts[BASE])) * TICK_S
        rate = float(s.x[half + place])
        return int(s.slots[slot, WHOLE]), float(s.x[place]) + tau_s * rate, rate
