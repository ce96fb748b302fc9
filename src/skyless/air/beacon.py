"""The beacon: what every anchor broadcasts in its slots, and why bytes are none (``docs/protocol.md``)."""

import struct
from collections.abc import Iterator
from enum import StrEnum
from typing import Final

from msgspec import Struct

from skyless.air.almanac import Page

HEARD: Final = struct.Struct("<HBIB")
"""One ``heard`` entry in a frame: anchor, sequence number, low word and high byte of the RX stamp."""


class Heard(Struct, frozen=True, gc=False):
    """When a beacon of another anchor was last heard: a raw stamp of the relaying anchor's own counter."""

    anchor: int
    """Identifier of the anchor that was heard, 16 bits."""
    sequence: int
    """Sequence number (8 bits) of the frame that was heard."""
    rx_ticks: int
    """RX stamp in the relaying anchor's clock, 40 bits."""


class PackedHeard(Struct, frozen=True, gc=False, eq=False):
    """``heard`` entries as the bytes of a frame, decoded when they are read; equal to a tuple of them."""

    packed: bytes

    def __len__(self) -> int:
        return len(self.packed) // HEARD.size

    def __iter__(self) -> Iterator[Heard]:
        for anchor, sequence, low, high in HEARD.iter_unpack(self.packed):
            yield Heard(anchor, sequence, low | high << 32)

    def __contains__(self, entry: object) -> bool:
        return entry in tuple(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, tuple | PackedHeard) and tuple(self) == tuple(other)

    def __hash__(self) -> int:
        return hash(tuple(self))


class MasterTime(Struct, frozen=True, gc=False):
    """The frame's TX time on the master's scale, as the sending anchor's clock filter knows it."""

    tx_subticks_master: int
    """TX time on the site's scale, which the master keeps, in 1/256 tick, 48 bits."""
    std_ticks: float
    """Standard deviation of that time in ticks; sent in steps of 1/64 tick up to 1023.98."""


class Beacon(Struct, frozen=True, gc=False):
    """One decoded beacon frame, version 1."""

    site: int
    """Site identifier, 16 bits, sent as the PAN identifier."""
    anchor: int
    """Identifier of the sending anchor, 16 bits, sent as the short source address."""
    sequence: int
    """Frame counter of the sender, 8 bits."""
    superframe: int
    """Number of the superframe, 32 bits, counted by the master."""
    slot: int
    """Slot within the superframe in which this frame is sent, 8 bits."""
    tx_ticks: int
    """TX stamp in the sender's own clock, 40 bits."""
    almanac_issue: int
    """Changes when the almanac changes, 8 bits; a tag then discards the old one."""
    master: int
    """Identifier of the master whose time this anchor uses; its own for the master."""
    term: int
    """Counts the takeovers of the master's role, modulo 256 (8 bits)."""
    master_heard: Heard | None
    """The last master beacon that this anchor heard (raw stamp), None for the master or when none was heard."""
    master_time: MasterTime | None
    """None until the sender's clock is known against the master; exact (std 0) for the master itself."""
    heard: tuple[Heard, ...] | PackedHeard
    """The other anchors, the master excluded, in the order of the most recent first; as many as fit."""
    page: Page | None
    """One page of the almanac."""


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
