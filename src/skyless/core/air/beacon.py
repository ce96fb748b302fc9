"""Beacons of protocol 2 and their bytes (``docs/protocol2.md``); little endian throughout, 127 bytes at most."""

import math
import struct
from collections.abc import Callable
from functools import lru_cache
from operator import index
from typing import Annotated, Any, Final

import numpy as np
from msgspec import Struct

from skyless.core.air.almanac import LONGEST_PERIOD_CODE, Page
from skyless.core.air.frame import (
    BEACON_MAGIC,
    BROADCAST,
    FCS_BYTES,
    FRAME_CONTROL,
    HEARD,
    HEARD_BYTES,
    MAGIC_MASK,
    MAX_FRAME_BYTES,
    PHASE_STEPS,
    Heard,
    Malformed,
    PackedHeard,
    fcs,
    two_bytes,
    unsigned,
)
from skyless.core.air.neighbours import StatedPlace
from skyless.core.air.site_pages import PAGE_BYTES, decode_page, encode_page, is_possible_page
from skyless.core.native.library import compiled
from skyless.core.native.records import Array, Byte, Bytes, Record, Ticks, record
from skyless.core.native.views import view

MAX_HEARD: Final = 12
"""Largest number of entries that the count and the flags of ``heard`` can hold."""


class StatedPosition(Struct, frozen=True, gc=False):
    """Sender's antenna phase centre, to the millimetre, up to 8388 m from the origin along each axis."""

    x_m: float
    y_m: float
    z_m: float
    std_m: float = 0.0
    """Standard deviation of each coordinate; sent in millimetres, rounded up, at most 0.255 m."""
    floor: int = 0
    """Storey, −128 to 127."""
    zone: int = 0
    """Zone of the site, 0 to 255; 0 for none."""


class Authentication(Struct, frozen=True, gc=False):
    """Proof that a frame comes from an anchor of the site, checked once the key of its interval is known."""

    interval: int
    """Lowest 16 bits of the interval's number."""
    mac: bytes
    """Message authentication code (8 bytes) of all bytes before it."""


class Beacon(Struct, frozen=True, gc=False):
    """One decoded beacon frame, version 2."""

    site: int
    """Site identifier, 16 bits, sent as the PAN identifier."""
    anchor: int
    """Identifier of the sending anchor, 16 bits, sent as the short source address."""
    sequence: int
    """Frame counter of the sender, 8 bits."""
    tx_ticks: int
    """TX stamp in the sender's own clock, 40 bits."""
    almanac_issue: int
    """Checksum of the site's pages, 16 bits."""
    period_code: int
    """Mean period of the beacons from this one on, as a code (``skyless.core.air.almanac``), 8 bits."""
    position: StatedPosition | None
    """None while the sender's position is unknown."""
    heard: tuple[Heard, ...] | PackedHeard
    """Receptions of other anchors, most recent first; as many as fit."""
    weak: int
    """Bit k is set if the first path of entry k of ``heard`` was weak, so that its stamp may be late."""
    page: Page | None
    """One of the site's common pages."""
    certificate: bytes | None = None
    """Signed statement about the site's key chain (``skyless.core.keys.chain``). A beacon with a certificate has no
    position, receptions or page."""
    authentication: Authentication | None = None
    """None for anchors without keys."""
    has_phases: bool = False
    """Whether ``heard`` has phases; such a frame carries only the lowest 32 bits of its stamps."""

    @property
    def relayed(self) -> tuple[Heard, ...]:
        """Return all receptions of other anchors."""
        return tuple(self.heard)


INTACT: Final = 0
TOO_SHORT, TOO_LONG, BAD_FCS, NOT_A_BEACON, UNKNOWN_VERSION, BAD_FLAGS, BAD_LENGTH, BAD_HEARD, BAD_PAGE, BAD_PERIOD = (
    range(1, 11)
)
"""Reasons why bytes are not a beacon, in the order of ``Malformed``."""

HEADER_BYTES: Final = 11
"""Length of the frame up to the magic number."""
VERSION_2: Final = BEACON_MAGIC | 0x0200

HAS_POSITION: Final = 0x01
HAS_PAGE: Final = 0x02
HAS_AUTHENTICATION: Final = 0x04
HAS_CERTIFICATE: Final = 0x08
ALONGSIDE_CERTIFICATE: Final = HAS_CERTIFICATE | HAS_AUTHENTICATION
"""All flags allowed in a frame with a certificate."""
HAS_PHASES: Final = 0x40
"""Set if receptions carry a phase each and stamps of 32 bits instead of 40."""
RESERVED_FLAGS: Final = 0xB0
FLAGS_AT: Final = 11
FIXED_BYTES: Final = 20
"""Length of the fields that every beacon has."""
POSITION_BYTES: Final = 12
COUNT_BYTES: Final = 2
"""Number of receptions, and the mask of weak ones."""
COUNT_BITS: Final = 4
COUNT_MASK: Final = 15
CERTIFICATE_BYTES: Final = 94
"""Length of a certificate (``skyless.core.keys.chain``)."""
AUTHENTICATION_BYTES: Final = 10
"""Lowest 16 bits of the interval, then the code."""


@record
class BeaconFields(Record):
    """Contents of a frame, and the offsets of the parts that are passed on unread."""

    site: int
    anchor: int
    sequence: int
    tx_ticks: Ticks
    """TX stamp in the sender's clock, 40 bits."""
    almanac_issue: int
    period_code: int
    has_place: bool
    place: StatedPlace
    heard_at: int
    """Offset of the receptions of other anchors."""
    heard_count: int
    weak: int
    """Bit k is set if the first path of reception k was weak, so that its stamp may be late."""
    has_phases: bool
    """Whether the receptions have phases (``SHORT_BITS``)."""
    page_at: int
    """Offset of the page; 0 if there is none, as for the next two."""
    certificate_at: int
    authentication_at: int
    relay_bytes: int
    relays: Annotated[Array[Byte], MAX_HEARD * HEARD_BYTES]
    """Receptions without the weak ones, encoded as in the frame."""


def read_frame(frame: Bytes, length: int, b: BeaconFields) -> int:
    """Read a whole frame, FCS included. Return ``INTACT``, or why it is not a beacon of version 2."""
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
    """Return why bytes are not a beacon of version 2, judging by length, check sequence, header and flags."""
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
    """Return the length of a frame with these flags and no relayed receptions."""
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
    """Copy the receptions that are not weak. Return False if one is of the sender, or two are of the same anchor."""
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
    """Return CRC-16 x¹⁶ + x¹² + x⁵ + 1, initially 0, bit 0 of each byte first (clause 7.2.10); 0 with the frame's FCS.

    The polynomial is applied to four bits at a time, so no table is needed. Python uses the faster ``ieee802154.fcs``.
    """
    crc = 0
    for at in range(length):
        low = (crc ^ data[at]) & 0xFF
        mixed = (low ^ low << 4) & 0xFF
        crc = crc >> 8 ^ mixed << 8 ^ mixed << 3 ^ mixed >> 4
    return crc


FAULTS: Final = tuple(Malformed)
"""Reasons in the order of the numbers that ``read_frame`` returns."""

MAC_BYTES: Final = AUTHENTICATION_BYTES - 2
"""Length of a message authentication code: the first 64 bits of an HMAC-SHA-256."""
INTERVAL_BITS: Final = 16
"""Number of bits of an interval's number that a frame states."""

MAX_STATED_COORDINATE_M: Final = ((1 << 23) - 1) / 1000.0
"""Largest coordinate along each axis from the origin, 8388.6 m."""

_FIXED: Final = struct.Struct("<HBHHHHBIBHB")
_POSITION: Final = struct.Struct("<HbHbHbBbB")
_COUNT: Final = struct.Struct("<H")
_AUTHENTICATION: Final = struct.Struct("<H8s")
_STD_STEPS_PER_M: Final = 1000
_MAX_STD_STEPS: Final = 0xFF


_CAPACITY: Final = tuple(
    0
    if flags & HAS_CERTIFICATE
    else min((MAX_FRAME_BYTES - bare_bytes(flags | HAS_AUTHENTICATION)) // HEARD.size, MAX_HEARD)
    for flags in range(RESERVED_FLAGS & -RESERVED_FLAGS)
)
_HEARD_ANCHORS: Final = tuple(struct.Struct("<" + count * "H6x") for count in range(MAX_HEARD + 4))


def heard_capacity(*, position: bool = False, page: bool = True, certificate: bool = False) -> int:
    """Return how many ``heard`` entries fit a frame with these parts and authentication: 0, or 8 to 12."""
    return _CAPACITY[position * HAS_POSITION | page * HAS_PAGE | certificate * HAS_CERTIFICATE]


def encode(beacon: Beacon) -> bytes:
    """Encode a beacon as a whole frame, FCS included. Standard deviations are rounded up, never too optimistic.

    Raises ValueError: a field is out of range, or ``heard`` has too many or impossible entries; the message names it.
    """
    flags = _flags(beacon)
    fault = _fault(beacon, _CAPACITY[flags & ~HAS_PHASES]) or _authentication_fault(beacon, flags)
    if fault is not None:
        raise ValueError(fault)
    parts = [
        _FIXED.pack(
            FRAME_CONTROL, beacon.sequence, beacon.site, BROADCAST, beacon.anchor, VERSION_2, flags,
            beacon.tx_ticks & 0xFFFFFFFF, beacon.tx_ticks >> 32, beacon.almanac_issue, beacon.period_code,
        )
    ]  # fmt: skip
    position = beacon.position
    if position is not None:
        coordinates = [half for value in (position.x_m, position.y_m, position.z_m) for half in _millimetres(value)]
        parts.append(_POSITION.pack(*coordinates, _std_steps(position.std_m), position.floor, position.zone))
    if beacon.certificate is None:
        parts += [_COUNT.pack(len(beacon.heard) | beacon.weak << COUNT_BITS), _packed(beacon)]
    else:
        parts.append(beacon.certificate)
    if beacon.page is not None:
        parts.append(encode_page(beacon.page))
    if beacon.authentication is not None:
        parts.append(_AUTHENTICATION.pack(beacon.authentication.interval, beacon.authentication.mac))
    body = b"".join(parts)
    return body + fcs(body)


def with_authentication(frame: bytes, interval: int, mac_of: Callable[[bytes], bytes]) -> bytes:
    """Add authentication to a frame made by ``encode``.

    ``interval``: its lowest 16 bits; ``mac_of`` returns the code of the bytes from the first to the interval.
    """
    signed = bytearray(frame[:-FCS_BYTES])
    signed[FLAGS_AT] |= HAS_AUTHENTICATION
    signed += interval.to_bytes(2, "little")
    signed += mac_of(bytes(signed))
    return bytes(signed) + fcs(bytes(signed))


def signed_bytes(frame: bytes) -> bytes:
    """Return the bytes of an authenticated frame that its code covers: all before the code."""
    return frame[: -FCS_BYTES - MAC_BYTES]


def decode(frame: bytes) -> Beacon | Malformed:
    """Decode a whole frame of version 2 (FCS included). Return the beacon, or why it is not one; never raises."""
    fields = BeaconFields()
    fault = _read_frame(frame, len(frame), fields)
    return beacon_of(fields, frame) if fault == INTACT else FAULTS[fault - 1]


def beacon_of(b: BeaconFields, frame: bytes) -> Beacon:
    """Build a ``Beacon`` from the fields read from a frame."""
    stated, place, certificate, authentication = b.place, None, None, None
    if b.has_place:
        x_m, y_m, z_m = (one_mm / 1000 for one_mm in stated.position_mm)
        place = StatedPosition(x_m, y_m, z_m, stated.std_mm / _STD_STEPS_PER_M, stated.floor, stated.zone)
    if b.certificate_at:
        certificate = frame[b.certificate_at : b.certificate_at + CERTIFICATE_BYTES]
    if b.authentication_at:
        authentication = Authentication(*_AUTHENTICATION.unpack_from(frame, b.authentication_at))
    heard = frame[b.heard_at : b.heard_at + b.heard_count * HEARD.size]
    return Beacon(
        b.site, b.anchor, b.sequence, b.tx_ticks, b.almanac_issue, b.period_code, place,
        PackedHeard(heard, b.has_phases), b.weak, page_of(frame, b), certificate, authentication, b.has_phases,
    )  # fmt: skip


_read_frame: Final = compiled(read_frame)


def page_of(frame: bytes, b: BeaconFields) -> Page | None:
    """Return the page in a frame that has been read; None if there is none or its type is unknown."""
    page = decode_page(frame[b.page_at : b.page_at + PAGE_BYTES]) if b.page_at else None
    assert page is not Malformed.BAD_PAGE, "read_frame refuses such frames"
    return page


def fields_of(beacon: Beacon) -> BeaconFields:
    """Return the fields that ``read_frame`` reads from a beacon's frame, without the parts that are only passed on."""
    place, relays = beacon.position, packed_relays(beacon)
    fields = BeaconFields(
        site=beacon.site,
        anchor=beacon.anchor,
        sequence=beacon.sequence,
        tx_ticks=beacon.tx_ticks,
        almanac_issue=beacon.almanac_issue,
        period_code=beacon.period_code,
        has_place=place is not None,
        has_phases=beacon.has_phases,
        relay_bytes=len(relays),
    )
    view(fields.relays)[: len(relays)] = np.frombuffer(relays, np.uint8)
    if place is not None:
        view(fields.place.position_mm)[:] = [round(value_m * 1000) for value_m in (place.x_m, place.y_m, place.z_m)]
        fields.place.std_mm = _std_steps(place.std_m)
        fields.place.floor, fields.place.zone = place.floor, place.zone
    return fields


decode_cached = lru_cache(maxsize=256)(decode)
"""``decode`` with a cache of the last 256 frames, for programs that run many tags which receive the same bytes."""


def _packed(beacon: Beacon) -> bytes:
    if isinstance(beacon.heard, PackedHeard):
        return beacon.heard.packed
    return b"".join(
        HEARD.pack(
            entry.anchor, entry.sequence, entry.rx_ticks & 0xFFFFFFFF,
            _phase_code(entry) if beacon.has_phases else entry.rx_ticks >> 32,
        )
        for entry in beacon.heard
    )  # fmt: skip


def _phase_code(entry: Heard) -> int:
    """Return the code of a phase in a frame, rounded to the nearest step; 0 without a phase."""
    return 0 if entry.phase_cycles is None else PHASE_STEPS + round(entry.phase_cycles * PHASE_STEPS) % PHASE_STEPS


def packed_relays(beacon: Beacon) -> bytes:
    """Encode the receptions that a beacon relays, one ``HEARD`` each, without those of a weak first path."""
    packed = _packed(beacon)
    if not beacon.weak:
        return packed
    entries = (packed[at : at + HEARD.size] for at in range(0, len(packed), HEARD.size))
    return b"".join(entry for number, entry in enumerate(entries) if not beacon.weak >> number & 1)


def _flags(beacon: Beacon) -> int:
    return (
        (beacon.position is not None) * HAS_POSITION
        | (beacon.page is not None) * HAS_PAGE
        | (beacon.authentication is not None) * HAS_AUTHENTICATION
        | (beacon.certificate is not None) * HAS_CERTIFICATE
        | beacon.has_phases * HAS_PHASES
    )


def _authentication_fault(beacon: Beacon, flags: int) -> str | None:
    certificate, authentication = beacon.certificate, beacon.authentication
    if certificate is not None:
        if flags & ~ALONGSIDE_CERTIFICATE:
            return "a beacon with a certificate has neither position nor page nor phases"
        if len(certificate) != CERTIFICATE_BYTES:
            return f"certificate has {len(certificate)} bytes; it must have {CERTIFICATE_BYTES}"
    if authentication is not None:
        if len(authentication.mac) != MAC_BYTES:
            return f"authentication.mac has {len(authentication.mac)} bytes; it must have {MAC_BYTES}"
        if not 0 <= authentication.interval < 1 << INTERVAL_BITS:
            return f"authentication.interval is {authentication.interval!r}; it must be from 0 to 65535"
    return None


def _std_steps(std_m: float) -> int:
    """Convert a standard deviation to the frame's steps, rounded up."""
    return min(math.ceil(round(std_m * _STD_STEPS_PER_M, 6)), _MAX_STD_STEPS)


def _millimetres(value_m: float) -> tuple[int, int]:
    """Return the low half-word and the signed high byte of a coordinate."""
    value = round(value_m * 1000)
    return value & 0xFFFF, value >> 16


def _fault(beacon: Beacon, capacity: int) -> str | None:
    """Describe the first field that is impossible or does not fit its bits; None if all do."""
    if len(beacon.heard) > capacity:
        return f"heard has {len(beacon.heard)} entries; {capacity} fit"
    if isinstance(beacon.heard, PackedHeard) and beacon.heard.has_phases is not beacon.has_phases:
        return f"heard is packed with{'' if beacon.heard.has_phases else 'out'} phases, and has_phases is not so"
    others: tuple[int, ...]
    if isinstance(beacon.heard, PackedHeard):
        others = _HEARD_ANCHORS[len(beacon.heard)].unpack(beacon.heard.packed)
    else:
        others = tuple(entry.anchor for entry in beacon.heard)
    if len({beacon.anchor, *others}) <= len(others):
        return f"heard has the sender {beacon.anchor}, or an anchor twice: {list(others)}"
    if not _is_whole(beacon.weak) or not 0 <= beacon.weak < 1 << len(beacon.heard):
        return f"weak is {beacon.weak!r}; it must have one bit for each of {len(beacon.heard)} entries of heard"
    return _whole_fault(beacon) or _position_fault(beacon.position)


def _is_whole(value: object) -> bool:
    """Whether this is an integer of Python or NumPy. ``isinstance`` with ``SupportsIndex`` takes 50 times as long."""
    return hasattr(value, "__index__")


def _whole_fault(beacon: Beacon) -> str | None:
    fields: list[tuple[str, Any, int]] = [
        ("site", beacon.site, 0xFFFF),
        ("anchor", beacon.anchor, 0xFFFF),
        ("sequence", beacon.sequence, 0xFF),
        ("tx_ticks", beacon.tx_ticks, (1 << 40) - 1),
        ("almanac_issue", beacon.almanac_issue, 0xFFFF),
        ("period_code", beacon.period_code, LONGEST_PERIOD_CODE),
    ]
    for number, entry in enumerate(() if isinstance(beacon.heard, PackedHeard) else beacon.heard):
        fields.append((f"heard[{number}].anchor", entry.anchor, 0xFFFF))
        fields.append((f"heard[{number}].sequence", entry.sequence, 0xFF))
        fields.append((f"heard[{number}].rx_ticks", entry.rx_ticks, (1 << 40) - 1))
    for name, value, last in fields:
        if not _is_whole(value) or not 0 <= index(value) <= last:
            return f"{name} is {value!r}; it must be a whole number from 0 to {last}"
    return None if isinstance(beacon.heard, PackedHeard) else _phase_fault(beacon)


def _phase_fault(beacon: Beacon) -> str | None:
    for number, entry in enumerate(beacon.heard):
        if entry.is_short and not beacon.has_phases:
            return f"heard[{number}].is_short, but the beacon is without phases"
        if entry.phase_cycles is not None and not (beacon.has_phases and 0.0 <= entry.phase_cycles < 1.0):
            right = "it must be from 0 up to 1" if beacon.has_phases else "the beacon is without phases"
            return f"heard[{number}].phase_cycles is {entry.phase_cycles!r}; {right}"
    return None


def _position_fault(position: StatedPosition | None) -> str | None:
    if position is None:
        return None
    for name, low, high in (("floor", -128, 127), ("zone", 0, 0xFF)):
        value = getattr(position, name)
        if not _is_whole(value) or not low <= index(value) <= high:
            return f"position.{name} is {value!r}; it must be a whole number from {low} to {high}"
    reach_m = MAX_STATED_COORDINATE_M
    for name, least, most in (*((f"{axis}_m", -reach_m, reach_m) for axis in "xyz"), ("std_m", 0.0, math.inf)):
        value = getattr(position, name)
        if not least <= value <= most:
            return f"position.{name} is {value!r}; it must be from {least:g} to {most:g}"
    return None
