"""What the frames of both protocols have in common: the header, relayed receptions, and why bytes are no beacon.

A beacon is an IEEE 802.15.4 data frame of at most 127 bytes, little endian throughout. 40-bit stamps travel as a low
word of 32 bits and a high byte.
"""

import struct
from collections.abc import Iterator
from enum import StrEnum
from typing import Final

from msgspec import Struct

from skyless.core.ticks import nearest, wrap

MAX_FRAME_BYTES: Final = 127
"""Longest PSDU (IEEE 802.15.4-2015, aMaxPhyPacketSize)."""
FCS_BYTES: Final = 2

FRAME_CONTROL: Final = 0x8841
"""Data frame, PAN identifier compressed, 16-bit addresses."""
BROADCAST: Final = 0xFFFF
BEACON_MAGIC: Final = 0xB053
"""The bytes 53 B0; the low half of the second is the version."""
MAGIC_MASK: Final = 0xF0FF
_MAGIC_AT: Final = slice(9, 11)
_START: Final = struct.Struct("<HBHHHH")

HEARD: Final = struct.Struct("<HBIB")
"""One ``heard`` entry in a frame: anchor, sequence number, low word and high byte of the RX stamp."""
HEARD_BYTES: Final = HEARD.size

# In beacons with phases a code takes the place of the stamp's high byte: 128 and the phase in steps, or 0 without one.
SHORT_BITS: Final = 32
"""Of the stamp of such an entry."""
PHASE_STEPS: Final = 128
"""In a cycle; also the bit that shows that there is a phase."""


class Heard(Struct, frozen=True, gc=False):
    """When a beacon of another anchor was last heard: a raw stamp of the relaying anchor's own counter."""

    anchor: int
    """Identifier of the anchor that was heard, 16 bits."""
    sequence: int
    """Sequence number (8 bits) of the frame that was heard."""
    rx_ticks: int
    """RX stamp in the relaying anchor's clock, 40 bits."""
    phase_cycles: float | None = None
    """Phase of the carrier at this reception, in [0, 1); only beacons with phases carry it."""
    is_short: bool = False
    """Whether only the lowest 32 bits of the stamp are known, as of such beacons."""

    def rx_ticks_near(self, expected_ticks: int) -> int:
        """The stamp, 40 bits; where only the lowest are known, the one nearest to the expected stamp."""
        return wrap(nearest(self.rx_ticks, expected_ticks, SHORT_BITS)) if self.is_short else self.rx_ticks


class PackedHeard(Struct, frozen=True, gc=False, eq=False):
    """``heard`` entries as the bytes of a frame, decoded when they are read; equal to a tuple of them."""

    packed: bytes
    has_phases: bool = False

    def __len__(self) -> int:
        return len(self.packed) // HEARD.size

    def __iter__(self) -> Iterator[Heard]:
        for anchor, sequence, low, high in HEARD.iter_unpack(self.packed):
            if self.has_phases:
                phase_cycles = None if high < PHASE_STEPS else (high - PHASE_STEPS) / PHASE_STEPS
                yield Heard(anchor, sequence, low, phase_cycles, is_short=True)
            else:
                yield Heard(anchor, sequence, low | high << 32)

    def __contains__(self, entry: object) -> bool:
        return entry in tuple(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, tuple | PackedHeard) and tuple(self) == tuple(other)

    def __hash__(self) -> int:
        return hash(tuple(self))


class Malformed(StrEnum):
    """Reason why bytes are not a beacon of this version (``docs/protocol.md``, "What is dropped")."""

    TOO_SHORT = "too-short"
    """Shorter than any frame of IEEE 802.15.4, or a beacon that ends before its fixed part does."""
    TOO_LONG = "too-long"
    """Longer than the 127 bytes of a PSDU."""
    BAD_FCS = "bad-fcs"
    """The frame check sequence does not fit the bytes."""
    NOT_A_BEACON = "not-a-beacon"
    """An intact frame of another system."""
    UNKNOWN_VERSION = "unknown-version"
    """A beacon of another version of the protocol."""
    BAD_FLAGS = "bad-flags"
    """A reserved flag is set."""
    BAD_LENGTH = "bad-length"
    """The length does not fit the flags and the number of relayed stamps."""
    BAD_HEARD = "bad-heard"
    """Impossible stamps: of the sender by itself, of the master in the wrong field, twice of one anchor."""
    BAD_PAGE = "bad-page"
    """A page of the almanac with an impossible value."""
    BAD_PERIOD = "bad-period"
    """A mean period that no anchor has (protocol 2)."""


def not_a_beacon(frame: bytes, version: int) -> Malformed | None:
    """Why an intact frame is no beacon of a version (its magic number), None if it is one."""
    if len(frame) < _START.size + FCS_BYTES:
        return Malformed.NOT_A_BEACON
    control, _, _, destination, _, magic = _START.unpack_from(frame)
    if control != FRAME_CONTROL or destination != BROADCAST or magic & MAGIC_MASK != BEACON_MAGIC:
        return Malformed.NOT_A_BEACON
    return Malformed.UNKNOWN_VERSION if magic != version else None


def has_version(frame: bytes, version: int) -> bool:
    """Whether bytes look like a beacon of a version (its magic number)."""
    return frame[_MAGIC_AT] == version.to_bytes(2, "little")
