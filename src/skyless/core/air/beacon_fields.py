"""A beacon of protocol 2 as it is read from a frame (``docs/protocol2.md``); little endian throughout."""

from typing import Annotated, Final

from skyless.core.air.beacon import MAX_HEARD
from skyless.core.air.frame import (
    BEACON_MAGIC,
    BROADCAST,
    FCS_BYTES,
    FRAME_CONTROL,
    HEARD_BYTES,
    MAGIC_MASK,
    MAX_FRAME_BYTES,
)
from skyless.core.air.instants import LONGEST_PERIOD_CODE
from skyless.core.air.little_endian import two_bytes, unsigned
from skyless.core.air.neighbours import StatedPlace
from skyless.core.air.page_check import PAGE_BYTES, is_possible_page
from skyless.core.native.records import Array, Byte, Bytes, Record, Ticks, record

INTACT: Final = 0
TOO_SHORT, TOO_LONG, BAD_FCS, NOT_A_BEACON, UNKNOWN_VERSION, BAD_FLAGS, BAD_LENGTH, BAD_HEARD, BAD_PAGE, BAD_PERIOD = (
    range(1, 11)
)
"""Why bytes are no beacon, in the order of ``Malformed``."""

HEADER_BYTES: Final = 11
"""Up to the magic number."""
VERSION_2: Final = BEACON_MAGIC | 0x0200

HAS_POSITION: Final = 0x01
HAS_PAGE: Final = 0x02
HAS_AUTHENTICATION: Final = 0x04
HAS_CERTIFICATE: Final = 0x08
ALONGSIDE_CERTIFICATE: Final = HAS_CERTIFICATE | HAS_AUTHENTICATION
"""All flags that a frame with a certificate may have."""
HAS_PHASES: Final = 0x40
"""The receptions have a phase each and stamps of 32 bits, instead of stamps of 40."""
RESERVED_FLAGS: Final = 0xB0
FLAGS_AT: Final = 11
FIXED_BYTES: Final = 20
"""The fields that every beacon has."""
POSITION_BYTES: Final = 12
COUNT_BYTES: Final = 2
"""Number of receptions, and which of them are weak."""
COUNT_BITS: Final = 4
COUNT_MASK: Final = 15
CERTIFICATE_BYTES: Final = 94
"""Length of a certificate (``skyless.core.keys.chain``)."""
AUTHENTICATION_BYTES: Final = 10
"""Lowest 16 bits of the interval, then the code."""


@record
class BeaconFields(Record):
    """All that a frame says, and where it has the parts that are only passed on."""

    site: int
    anchor: int
    sequence: int
    tx_ticks: Ticks
    """In the sender's clock, 40 bits."""
    almanac_issue: int
    period_code: int
    has_place: bool
    place: StatedPlace
    heard_at: int
    """Where the receptions of other anchors stand."""
    heard_count: int
    weak: int
    """Bit k is set where the first path of reception k was weak: it may be late."""
    has_phases: bool
    """Whether the receptions have phases (``SHORT_BITS``)."""
    page_at: int
    """Where the page stands; 0 where there is none, as in the next two."""
    certificate_at: int
    authentication_at: int
    relay_bytes: int
    relays: Annotated[Array[Byte], MAX_HEARD * HEARD_BYTES]
    """The receptions without the weak ones, as in the frame."""


def read_frame(frame: Bytes, length: int, b: BeaconFields) -> int:
    """Read a whole frame, FCS included; why it is no beacon of version 2, ``INTACT`` if it is one."""
    fault = _header_fault(frame, length)
    if fault != INTACT:
        return fault
    flags, at = frame[FLAGS_AT], FIXED_BYTES
    b.sequence, b.period_code = frame[2], frame[19]
    b.site, b.anchor, b.almanac_issue = two_bytes(frame, 3), two_bytes(frame, 7), two_bytes(frame, 17)
    b.tx_ticks = unsigned(frame, 12, 5)
    b.has_place, b.has_phases = flags & HAS_POSITION != 0, flags & HAS_PHASES != 0
    b.heard_at = b.heard_count = b.weak = b.page_at = b.certificate_at = b.relay_bytes = 0
    if b.has_place:
        _read_place(frame, at, b.place)
        at += POSITION_BYTES
    if flags & HAS_CERTIFICATE != 0:
        b.certificate_at = at
        at += CERTIFICATE_BYTES
    else:
        entries = two_bytes(frame, at)
        b.heard_at, b.heard_count, b.weak = at + COUNT_BYTES, entries & COUNT_MASK, entries >> COUNT_BITS
        at = b.heard_at + b.heard_count * HEARD_BYTES
    if flags & HAS_PAGE != 0:
        b.page_at = at
        at += PAGE_BYTES
    b.authentication_at = at if flags & HAS_AUTHENTICATION != 0 else 0
    if b.period_code > LONGEST_PERIOD_CODE:
        return BAD_PERIOD
    if b.heard_count > MAX_HEARD or b.weak >> b.heard_count != 0 or not _read_relays(frame, b):
        return BAD_HEARD
    return BAD_PAGE if b.page_at > 0 and not is_possible_page(frame, b.page_at) else INTACT


def _header_fault(frame: Bytes, length: int) -> int:  # noqa: PLR0911 - one for each fault
    """Why bytes are no beacon of version 2, as far as length, check sequence, header and flags show it."""
    if length > MAX_FRAME_BYTES:
        return TOO_LONG
    if length <= FCS_BYTES:
        return TOO_SHORT
    if checksum(frame, length) != 0:
        return BAD_FCS
    if length < HEADER_BYTES + FCS_BYTES or two_bytes(frame, 0) != FRAME_CONTROL or two_bytes(frame, 5) != BROADCAST:
        return NOT_A_BEACON
    magic = two_bytes(frame, 9)
    if magic & MAGIC_MASK != BEACON_MAGIC:
        return NOT_A_BEACON
    if magic != VERSION_2:
        return UNKNOWN_VERSION
    if length < FIXED_BYTES + COUNT_BYTES + FCS_BYTES:
        return TOO_SHORT
    return _length_fault(frame, length)


def _length_fault(frame: Bytes, length: int) -> int:
    flags = frame[FLAGS_AT]
    if flags & RESERVED_FLAGS != 0 or (flags & HAS_CERTIFICATE != 0 and flags & ~ALONGSIDE_CERTIFICATE != 0):
        return BAD_FLAGS
    bare = bare_bytes(flags)
    if length < bare:
        return BAD_LENGTH
    if flags & HAS_CERTIFICATE == 0:
        at = FIXED_BYTES + (POSITION_BYTES if flags & HAS_POSITION != 0 else 0)
        bare += (two_bytes(frame, at) & COUNT_MASK) * HEARD_BYTES
    return INTACT if length == bare else BAD_LENGTH


def bare_bytes(flags: int) -> int:
    """Length of a frame with these flags that relays no receptions."""
    size = FIXED_BYTES + FCS_BYTES + (CERTIFICATE_BYTES if flags & HAS_CERTIFICATE != 0 else COUNT_BYTES)
    size += POSITION_BYTES if flags & HAS_POSITION != 0 else 0
    size += PAGE_BYTES if flags & HAS_PAGE != 0 else 0
    return size + (AUTHENTICATION_BYTES if flags & HAS_AUTHENTICATION != 0 else 0)


def _read_place(frame: Bytes, at: int, place: StatedPlace) -> None:
    for axis in range(3):
        low, high = two_bytes(frame, at + 3 * axis), frame[at + 3 * axis + 2]
        place.position_mm[axis] = low + 65536 * (high - 256 if high > 127 else high)
    floor = frame[at + 10]
    place.std_mm, place.floor, place.zone = frame[at + 9], floor - 256 if floor > 127 else floor, frame[at + 11]


def _read_relays(frame: Bytes, b: BeaconFields) -> bool:
    """Copy the receptions that are not weak; False where one is of the sender, or two of the same anchor."""
    for one in range(b.heard_count):
        at = b.heard_at + one * HEARD_BYTES
        anchor = two_bytes(frame, at)
        if anchor == b.anchor:
            return False
        for before in range(one):
            if two_bytes(frame, b.heard_at + before * HEARD_BYTES) == anchor:
                return False
        if b.weak >> one & 1 == 0:
            for byte in range(HEARD_BYTES):
                b.relays[b.relay_bytes + byte] = frame[at + byte]
            b.relay_bytes += HEARD_BYTES
    return True


def checksum(data: Bytes, length: int) -> int:
    """CRC-16 of x¹⁶ + x¹² + x⁵ + 1, initially 0, bit 0 of each byte first (clause 7.2.10); 0 with a frame's FCS.

    A byte's four low and four high bits each shift the polynomial in once, so no table is needed. Python's own frames
    have theirs from ``ieee802154.fcs``, which is faster there.
    """
    crc = 0
    for at in range(length):
        low = (crc ^ data[at]) & 0xFF
        mixed = (low ^ low << 4) & 0xFF
        crc = crc >> 8 ^ mixed << 8 ^ mixed << 3 ^ mixed >> 4
    return crc
