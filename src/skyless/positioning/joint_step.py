"""One packet from Python: its numbers in one array, and all that is made of it in one call."""

import struct
from typing import Final, NamedTuple

import numpy as np

from skyless.addresses import Table, integer_blocks, integer_matrix, integers, matrix, vector
from skyless.compiled import borrowing_kernel
from skyless.positioning.fix_rows import PROTECTION, fill_motion
from skyless.positioning.joint_hearing import SYNC_WANTED, end_packet, joint_hear, joint_motion
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
from skyless.positioning.joint_sync import SYNC_MASTER, SYNC_SUBTICKS, SYNC_VARIANCE
from skyless.positioning.protection_levels import HPL, STATE, VPL, protect
from skyless.positioning.tracker import CHI2, RESIDUAL_SQUARED
from skyless.ticks import HALF_WRAP_TICKS, TICK_MASK

PLACE, NUMBER, RX_TICKS, TX_TICKS, SYNCED, LISTED, PACKED, MASTER, STATUS, VARIANCE, WORDS = range(11)
"""Places in a packet: the anchor's in the table, sequence number, the tag's and the anchor's stamps, 1 if there is a
sync, how many relays stand listed in rows, how many packed, whose time the anchor tells, what became of the packet so
far, the variance of that time (a float; 0 where it tells none), and the first of the packed relays: 64-bit words of
anchor, sequence and RX stamp."""

MOST_PACKED: Final = 16
"""Relays in a frame; 13 fit."""

PACKET: Final = struct.Struct(f"{VARIANCE}qd{8 * MOST_PACKED}s")

FIELDS: Final = len(JointArrays._fields)


class Exchanged(NamedTuple):
    """What passes between Python and ``joint_step``."""

    packet: Integers
    """Shape (PACKET.size // 8,)."""
    names: Integers
    """Identifier of each anchor of the table, -1 for one without."""
    relays: Integers
    """Those that are listed, as ``joint_hear`` takes them, and room for ``MOST_PACKED``; shape (rows, 4)."""
    sync: Matrix
    """As ``joint_hear`` takes it, shape (1, 3)."""
    motion: Vector
    covariance: Matrix
    """As ``joint_motion`` writes them."""
    rows: Matrix
    """What a fix carries, shape (PROTECTED_ROWS, 3)."""
    limits: Vector
    levels: Vector
    """As ``protect`` takes and writes them."""


@borrowing_kernel
def _unpack(s: JointArrays, packet: Integers, names: Integers, relays: Integers) -> int:
    """Add the packed relays of anchors in view to those listed, unwrapped; returns how many rows there are."""
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
def _arrays(table: Table) -> JointArrays:
    """The first rows of a table are the fields in their order."""
    return JointArrays(
        vector(table, 0),
        matrix(table, 1),
        matrix(table, 2),
        vector(table, 3),
        vector(table, 4),
        integers(table, 5),
        vector(table, 6),
        integers(table, 7),
        vector(table, 8),
        integer_matrix(table, 9),
        matrix(table, 10),
        integer_blocks(table, 11),
        integer_matrix(table, 12),
        integers(table, 13),
        vector(table, 14),
        matrix(table, 15),
        matrix(table, 16),
        matrix(table, 17),
        matrix(table, 18),
        matrix(table, 19),
        vector(table, 20),
    )


@borrowing_kernel
def joint_step(table: Table) -> int:
    """``joint_hear``, ``joint_motion``, ``fill_motion`` and ``protect`` in one call from Python.

    ``table`` has the addresses of the fields of ``JointArrays`` and of ``Exchanged``. Where ``SYNC_WANTED`` is in what
    is returned, ``joint_rest`` must follow, with a row of syncs: it is rarely needed, and costs the caller.
    """
    s, packet, relays = _arrays(table), integers(table, FIELDS), integer_matrix(table, FIELDS + 2)
    names, sync = integers(table, FIELDS + 1), matrix(table, FIELDS + 3)
    if not packet[SYNCED]:
        master = _in_view(s, names, packet[MASTER])
        sync[0, SYNC_MASTER], sync[0, SYNC_SUBTICKS] = master, np.nan
        sync[0, SYNC_VARIANCE] = vector(table, FIELDS)[VARIANCE] if master >= 0 else 0.0
    count = _unpack(s, packet, names, relays)
    stamps = (packet[PLACE], packet[NUMBER], packet[RX_TICKS], packet[TX_TICKS])
    status = joint_hear(s, *stamps, relays, 0, count, sync, 0)
    if status >= SYNC_WANTED:
        packet[STATUS] = status - SYNC_WANTED
        return status
    _tell(s, table)
    return status


@borrowing_kernel
def joint_rest(table: Table) -> int:
    """The rest of a ``joint_step`` that wanted to know what the anchor says of its clock."""
    s, packet = _arrays(table), integers(table, FIELDS)
    end_packet(s, packet[PLACE], matrix(table, FIELDS + 3))
    _tell(s, table)
    return int(packet[STATUS])


@borrowing_kernel
def _tell(s: JointArrays, table: Table) -> None:
    """Write what is known after the packet."""
    motion, covariance, rows = vector(table, FIELDS + 4), matrix(table, FIELDS + 5), matrix(table, FIELDS + 6)
    levels, means = vector(table, FIELDS + 8), s.statistics
    joint_motion(s, motion, covariance)
    dim, height_m = int(s.settings[DIM]), s.settings[HEIGHT]
    fill_motion(rows, motion, covariance, dim, means[CHI2], means[RESIDUAL_SQUARED], height_m)
    protect(s, covariance, vector(table, FIELDS + 7), levels)
    rows[PROTECTION, HPL], rows[PROTECTION, VPL], rows[PROTECTION, STATE] = levels[HPL], levels[VPL], levels[STATE]
