"""Beacons of protocol 2 and their bytes (``docs/protocol2.md``); little endian throughout, 127 bytes at most."""

import math
import struct
from collections.abc import Callable
from functools import lru_cache
from operator import index
from typing import Any, Final

import numpy as np

from skyless.core.air.almanac import Page
from skyless.core.air.beacon import MAX_HEARD, Authentication, Beacon, StatedPosition
from skyless.core.air.beacon_fields import (
    ALONGSIDE_CERTIFICATE,
    AUTHENTICATION_BYTES,
    CERTIFICATE_BYTES,
    COUNT_BITS,
    FLAGS_AT,
    HAS_AUTHENTICATION,
    HAS_CERTIFICATE,
    HAS_PAGE,
    HAS_PHASES,
    HAS_POSITION,
    INTACT,
    RESERVED_FLAGS,
    VERSION_2,
    BeaconFields,
    bare_bytes,
    read_frame,
)
from skyless.core.air.frame import (
    BROADCAST,
    FCS_BYTES,
    FRAME_CONTROL,
    HEARD,
    MAX_FRAME_BYTES,
    PHASE_STEPS,
    Heard,
    Malformed,
    PackedHeard,
)
from skyless.core.air.ieee802154 import fcs
from skyless.core.air.instants import LONGEST_PERIOD_CODE
from skyless.core.air.page_check import PAGE_BYTES
from skyless.core.air.page_codec import decode_page, encode_page
from skyless.core.native.library import compiled
from skyless.core.native.views import view

FAULTS: Final = tuple(Malformed)
"""In the order of the numbers that ``read_frame`` returns."""

MAC_BYTES: Final = AUTHENTICATION_BYTES - 2
"""Length of a message authentication code: the first 64 bits of an HMAC-SHA-256."""
INTERVAL_BITS: Final = 16
"""How many bits of an interval's number a frame states."""

MAX_STATED_COORDINATE_M: Final = ((1 << 23) - 1) / 1000.0
"""8388.6 m, along each axis from the origin."""

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
    """How many ``heard`` entries a frame with these parts may carry, with space for authentication: 0, or 8 to 12."""
    return _CAPACITY[position * HAS_POSITION | page * HAS_PAGE | certificate * HAS_CERTIFICATE]


def encode(beacon: Beacon) -> bytes:
    """Return the whole frame, FCS included. Standard deviations are rounded up, so that they are never too optimistic.

    Raises:
        ValueError: a field is out of its range, there are more ``heard`` than fit, or one is impossible; the message
            names it.
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
    """Return a frame of ``encode`` without authentication as one with it.

    ``interval``: its lowest 16 bits; ``mac_of`` gives the code of the bytes from the first to the interval.
    """
    signed = bytearray(frame[:-FCS_BYTES])
    signed[FLAGS_AT] |= HAS_AUTHENTICATION
    signed += interval.to_bytes(2, "little")
    signed += mac_of(bytes(signed))
    return bytes(signed) + fcs(bytes(signed))


def signed_bytes(frame: bytes) -> bytes:
    """The bytes of an authenticated frame that its code is made of: all before the code."""
    return frame[: -FCS_BYTES - MAC_BYTES]


def decode(frame: bytes) -> Beacon | Malformed:
    """Return the beacon in a whole frame of version 2 (FCS included), or why there is none; never raises."""
    fields = BeaconFields()
    fault = _read_frame(frame, len(frame), fields)
    return beacon_of(fields, frame) if fault == INTACT else FAULTS[fault - 1]


def beacon_of(b: BeaconFields, frame: bytes) -> Beacon:
    """The beacon that was read from a frame."""
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
    """The page in a frame that has been read; None where there is none, or its type is not known here."""
    page = decode_page(frame[b.page_at : b.page_at + PAGE_BYTES]) if b.page_at else None
    assert page is not Malformed.BAD_PAGE, "read_frame refuses such frames"
    return page


def fields_of(beacon: Beacon) -> BeaconFields:
    """What ``read_frame`` makes of the frame of a beacon, but for what is only passed on."""
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
"""``decode`` that remembers the last 256 frames: for a program that runs many tags which receive the same bytes."""


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
    """A phase as frames carry it, in the nearest step; 0 where there is none."""
    return 0 if entry.phase_cycles is None else PHASE_STEPS + round(entry.phase_cycles * PHASE_STEPS) % PHASE_STEPS


def packed_relays(beacon: Beacon) -> bytes:
    """The receptions that a beacon relays, ``HEARD`` after ``HEARD``, without those of a weak first path."""
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
    """A standard deviation in the steps of a frame, rounded up."""
    return min(math.ceil(round(std_m * _STD_STEPS_PER_M, 6)), _MAX_STD_STEPS)


def _millimetres(value_m: float) -> tuple[int, int]:
    """Low half-word and signed high byte of a coordinate."""
    value = round(value_m * 1000)
    return value & 0xFFFF, value >> 16


def _fault(beacon: Beacon, capacity: int) -> str | None:
    """The first field that is impossible or does not fit its bits, None where there is none."""
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
