"""One packet from Python: its numbers in one array, and all that is made of it in one call."""

import struct
from typing import Final

from skyless.compiled import borrowing_kernel
from skyless.positioning.joint_hearing import joint_hear, joint_motion
from skyless.positioning.joint_state import (
    DIM,
    HEIGHT,
    SITE,
    SLOTS,
    Integers,
    JointArrays,
    Matrix,
    Vector,
)
from skyless.positioning.motion_rows import fill_motion
from skyless.positioning.protection_levels import protect
from skyless.positioning.tracker import CHI2
from skyless.ticks import HALF_WRAP_TICKS, TICK_MASK

PLACE, NUMBER, RX_TICKS, TX_TICKS, LISTED, PACKED, WORDS = range(7)
"""Places in a packet: the anchor's in the table, sequence number, the tag's and the anchor's stamps, how many relays
stand listed in rows, how many packed, and the first of those: 64-bit words of anchor, sequence and RX stamp."""

MOST_PACKED: Final = 16
"""Relays in a frame; 13 fit."""

PACKET: Final = struct.Struct(f"{WORDS}q{8 * MOST_PACKED}s")


@borrowing_kernel
def _unpack(s: JointArrays, packet: Integers, names: Integers, relays: Integers) -> int:
    """Add the packed relays of anchors in view to those listed, unwrapped; returns how many rows there are.

    ``names`` has the identifier of each anchor of the table.
    """
    rows: int = packet[LISTED]
    least = packet[TX_TICKS] - HALF_WRAP_TICKS
    for k in range(WORDS, WORDS + min(packet[PACKED], MOST_PACKED)):
        word = packet[k]
        heard = _in_view(s, names, word & 0xFFFF)
        if heard >= 0:
            relays[rows, 0] = packet[PLACE]
            relays[rows, 1] = heard
            relays[rows, 2] = (word >> 16) & 0xFF
            relays[rows, 3] = least + (((word >> 24) - least) & TICK_MASK)
            rows += 1
    return rows


@borrowing_kernel
def _in_view(s: JointArrays, names: Integers, name: int) -> int:
    """Place in the table of an anchor in view, −1 for another."""
    for slot in range(s.counts[SLOTS]):
        place: int = s.slots[slot, SITE]
        if names[place] == name:
            return place
    return -1


@borrowing_kernel
def joint_step(
    x: Vector,
    P: Matrix,
    terms: Matrix,
    along: Vector,
    noise: Vector,
    h_places: Integers,
    h: Vector,
    counts: Integers,
    statistics: Vector,
    slots: Integers,
    anchors: Matrix,
    packets: Integers,
    relayed: Integers,
    slot_of: Integers,
    settings: Vector,
    site_m: Matrix,
    sensitivities: Matrix,
    responses: Matrix,
    evidence: Matrix,
    recent: Vector,
    packet: Integers,
    relays: Integers,
    names: Integers,
    syncs: Matrix,
    motion: Vector,
    covariance: Matrix,
    rows: Matrix,
    limits: Vector,
    levels: Vector,
) -> int:
    """``joint_hear``, ``joint_motion``, ``fill_motion`` and ``protect`` in one call from Python.

    The fields of ``JointArrays`` come one by one: a tuple of them would take Numba twice as long to look at. There is
    room for ``MOST_PACKED`` relays behind those listed, if any are packed.
    """
    s = JointArrays(
        x,
        P,
        terms,
        along,
        noise,
        h_places,
        h,
        counts,
        statistics,
        slots,
        anchors,
        packets,
        relayed,
        slot_of,
        settings,
        site_m,
        sensitivities,
        responses,
        evidence,
        recent,
    )
    count = _unpack(s, packet, names, relays)
    stamps = (packet[PLACE], packet[NUMBER], packet[RX_TICKS], packet[TX_TICKS])
    status = joint_hear(s, *stamps, relays, 0, count, syncs, 0)
    joint_motion(s, motion, covariance)
    fill_motion(rows, motion, covariance, int(s.settings[DIM]), s.statistics[CHI2], s.settings[HEIGHT])
    protect(s, covariance, limits, levels)
    return status
