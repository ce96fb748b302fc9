"""``joint``'s way of taking packets: who joins and leaves, what is remembered, one packet or many in a loop."""

from typing import Final

from skyless.compiled import borrowing_kernel
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.positioning.joint_algebra import add_terms, settle
from skyless.positioning.joint_monitor import LATE_ENOUGH
from skyless.positioning.joint_slots import add_noise_state, add_slot, drop_slot, has_room
from skyless.positioning.joint_state import (
    BASE,
    DIM,
    DROP_S,
    EPOCH,
    IMPOSSIBLE,
    IN_ROW,
    JUMPS,
    LATE_SHARE,
    MOTION_CROSS,
    MOTION_RATE,
    MOTION_VALUE,
    NOISE,
    PACKET_RX,
    PACKET_TX,
    REJECTED_IN_ROW,
    REJOINED,
    RELAYS_IN_ROW,
    REMEMBERED,
    RESTARTS,
    RX,
    SEQUENCE,
    SLOTS,
    STALE,
    STALE_IN_ROW,
    TX,
    WANTED,
    Integers,
    JointArrays,
    Matrix,
    Vector,
    values,
)
from skyless.positioning.joint_sync import SYNC_VARIANCE, hear_sync
from skyless.positioning.joint_time import elapse
from skyless.positioning.joint_updates import hear_anchor, hear_relay, join, new_packet
from skyless.positioning.protection_levels import RELAYS_OFF
from skyless.positioning.protection_updates import unsettle

FULL, REJECTED, ACCEPTED, JOINED, STALE_PACKET = range(-1, 4)
"""What became of a packet: no room for its anchor, not used, taken, the first of its anchor, older than the newest."""

SYNC_WANTED: Final = 8
"""Added to what became of a packet."""

RELAY_AGE_S: Final = 1.0
"""Older packets are not relayed, as sequence numbers come around."""

RESTART_M: Final = 300.0
"""No path is longer than expected by so much: the anchor's counter has jumped, ..."""

RESTART_IN_ROW: Final = 3
"""... if so many packets in a row say so."""

RELAYS_APART: Final = 40
"""A clock that jumps by less shows in receptions among anchors as well (``RELAYS_OFF`` in a row); a blocked path does
not. After so many in a row an anchor's clock stands apart from the others', as it began late: it joins anew,
and what the others heard of it decides."""

REJOIN_S: Final = 5.0
"""Where joining anew has not helped, as the anchor's stamps contradict one another, it is left alone for so long."""

MAX_RATE_MPS: Final = 100e-6 * SPEED_OF_LIGHT_MPS
"""Between two clocks that are still crystals."""


@borrowing_kernel
def joint_hear(
    s: JointArrays,
    site: int,
    sequence: int,
    rx_ticks: int,
    tx_ticks: int,
    relays: Integers,
    first: int,
    last: int,
    syncs: Matrix,
    row: int,
) -> int:
    """Take one packet of the anchor ``site`` (place in the table) and what it relays, in the tag's order of time.

    Rows ``first`` to ``last`` of ``relays`` are [the anchor that heard, the anchor that was heard, sequence, RX stamp
    of the former], anchors by their places in the table; all stamps are unwrapped, each on its own clock. Row ``row``
    of ``syncs``, if there is one, is what the anchor says of its clock (``joint_sync``). Where that is to be asked for,
    ``SYNC_WANTED`` is added to what is returned, and ``end_packet`` must follow.
    """
    slot = s.slot_of[site]
    if s.counts[SLOTS] > 0 and rx_ticks < s.counts[EPOCH]:
        s.counts[STALE] += 1
        s.counts[STALE_IN_ROW] += 1
        return STALE_PACKET
    s.counts[STALE_IN_ROW] = 0
    if slot >= 0 and (tx_ticks == s.slots[slot, TX] or _has_jumped(s, slot, rx_ticks, tx_ticks)):
        if tx_ticks == s.slots[slot, TX] or s.slots[slot, IN_ROW] < RESTART_IN_ROW:
            s.counts[IMPOSSIBLE] += 1
            return REJECTED
        s.counts[RESTARTS] += 1
        unsettle(s)
        drop_slot(s, slot)
        slot = -1
    elapse(s, rx_ticks)
    if s.counts[BASE] == rx_ticks:
        _drop_silent(s, rx_ticks)
        slot = s.slot_of[site]
    rejoins = slot >= 0 and _rejoins(s, slot, rx_ticks)
    if rejoins:
        _forget_jumped(s, slot)
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
        told = row < len(syncs) and syncs[row, SYNC_VARIANCE] > 0.0
        if told and hear_sync(s, slot, syncs, row):
            return SYNC_WANTED + status
    elif has_room(s):
        settle(s)
        slot = add_slot(s, site)
        join(s, slot, rx_ticks, tx_ticks)
        if rejoins:
            s.slots[slot, REJOINED] = rx_ticks
        _remember(s, slot, sequence, rx_ticks, tx_ticks)
        status = JOINED
    add_terms(s)
    return status


@borrowing_kernel
def end_packet(s: JointArrays, site: int, syncs: Matrix) -> None:
    """What ``joint_hear`` has left to do once it is told what an anchor says of its clock; variance 0 says nothing."""
    if syncs[0, SYNC_VARIANCE] > 0.0:
        hear_sync(s, s.slot_of[site], syncs, 0)
    add_terms(s)


@borrowing_kernel
def _forget_jumped(s: JointArrays, slot: int) -> None:
    """Make room for an anchor's clock to join anew; where its relays alone did not fit, as if messages were late."""
    if s.slots[slot, RELAYS_IN_ROW] >= RELAYS_APART:
        s.statistics[LATE_SHARE] = max(s.statistics[LATE_SHARE], 2.0 * LATE_ENOUGH)
    if s.slots[slot, IN_ROW] >= RESTART_IN_ROW:
        unsettle(s)
    settle(s)
    drop_slot(s, slot)
    s.counts[JUMPS] += 1


@borrowing_kernel
def _rejoins(s: JointArrays, slot: int, rx_ticks: int) -> bool:
    """Whether an anchor's clock is so far from what the filter says that the anchor had better join anew."""
    in_row = 0 if s.slots[slot, RELAYS_IN_ROW] >= RELAYS_APART else RESTART_IN_ROW
    if s.slots[slot, IN_ROW] < in_row or s.slots[slot, RELAYS_IN_ROW] < RELAYS_OFF:
        return False
    rejoined = s.slots[slot, REJOINED]
    return bool(rejoined == 0 or (rx_ticks - rejoined) * TICK_S > REJOIN_S)


@borrowing_kernel
def _has_jumped(s: JointArrays, slot: int, rx_ticks: int, tx_ticks: int) -> bool:
    """Whether no clock can have gone from an anchor's newest packet to this one; such stamps move no time."""
    elapsed = rx_ticks - s.slots[slot, RX]
    change_m = abs(elapsed - (tx_ticks - s.slots[slot, TX])) * TICK_M
    jumped = bool(change_m > RESTART_M + MAX_RATE_MPS * elapsed * TICK_S)
    if jumped:
        s.slots[slot, IN_ROW] += 1
        s.counts[REJECTED_IN_ROW] += 1
    return jumped


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
            rate = s.P[half + one, half + other] + (s.noise[MOTION_RATE] if one == other else 0.0)
            at_base = s.noise[MOTION_CROSS] if one == other else 0.0
            cross = s.P[one, half + other] + at_base + tau_s * rate
            value = s.P[one, other] + (s.noise[MOTION_VALUE] if one == other else 0.0)
            P[one, other] = value + tau_s * (s.P[half + one, other] + at_base + cross)
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
    syncs: Matrix,
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
        packet = (sites[k], sequences[k], rx_ticks[k], tx_ticks[k])
        if joint_hear(s, *packet, relays, first, ends[k], syncs, k) == FULL:
            return k
        if len(motions) > 0:
            joint_motion(s, motion, covariance)
            for one in range(2 * dim):
                motions[k, one] = motion[one]
            for one in range(dim):
                for other in range(dim):
                    variances[k, dim * one + other] = covariance[one, other]
    return len(sites)
