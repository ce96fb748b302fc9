"""Beacons of protocol 2 and their bytes (``docs/protocol2.md``); little endian throughout, 127 bytes at most."""

import math
import struct
from collections.abc import Callable
from functools import lru_cache
from operator import index
from typing import Any, Final

from skyless.core.air.beacon import MAX_HEARD, Authentication, Beacon, StatedPosition
from skyless.core.air.frame import (
    BEACON_MAGIC,
    BROADCAST,
    FCS_BYTES,
    FRAME_CONTROL,
    HEARD,
    MAX_FRAME_BYTES,
    Heard,
    Malformed,
    PackedHeard,
    not_a_beacon,
)
from skyless.core.air.ieee802154 import fcs, is_intact
from skyless.core.air.instants import LONGEST_PERIOD_CODE
from skyless.core.air.page_codec import PAGE_BYTES, decode_page, encode_page

VERSION_2: Final = BEACON_MAGIC | 0x0200
MAC_BYTES: Final = 8
"""Length of a message authentication code: the first 64 bits of an HMAC-SHA-256."""
INTERVAL_BITS: Final = 16
"""How many bits of an interval's number a frame states."""
CERTIFICATE_BYTES: Final = 94
"""Length of a certificate (``skyless.core.keys.chain``)."""

MAX_STATED_COORDINATE_M: Final = ((1 << 23) - 1) / 1000.0
"""8388.6 m, along each axis from the origin."""

_HAS_POSITION: Final = 0x01
_HAS_PAGE: Final = 0x02
_HAS_AUTHENTICATION: Final = 0x04
_HAS_CERTIFICATE: Final = 0x08
_RESERVED_FLAGS: Final = 0xF0
_NOT_WITH_CERTIFICATE: Final = _HAS_POSITION | _HAS_PAGE
_COMBINATIONS: Final = 0x10

_FIXED: Final = struct.Struct("<HBHHHHBIBHB")
_FLAGS_AT: Final = 11
_POSITION: Final = struct.Struct("<HbHbHbBbB")
_COUNT: Final = struct.Struct("<H")
_AUTHENTICATION: Final = struct.Struct("<H8s")
_COUNT_BITS: Final = 4
_COUNT_MASK: Final = (1 << _COUNT_BITS) - 1
_STD_STEPS_PER_M: Final = 1000
_MAX_STD_STEPS: Final = 0xFF


def _count_at(flags: int) -> int:
    return _FIXED.size + (_POSITION.size if flags & _HAS_POSITION else 0)


def _bare_bytes(flags: int) -> int:
    """Length of a frame with these flags that relays no receptions."""
    return (
        _count_at(flags)
        + (CERTIFICATE_BYTES if flags & _HAS_CERTIFICATE else _COUNT.size)
        + (PAGE_BYTES if flags & _HAS_PAGE else 0)
        + (_AUTHENTICATION.size if flags & _HAS_AUTHENTICATION else 0)
        + FCS_BYTES
    )


_BARE_BYTES: Final = tuple(_bare_bytes(flags) for flags in range(_COMBINATIONS))
_COUNT_AT: Final = tuple(_count_at(flags) for flags in range(_COMBINATIONS))
_CAPACITY: Final = tuple(
    0
    if flags & _HAS_CERTIFICATE
    else min((MAX_FRAME_BYTES - _bare_bytes(flags | _HAS_AUTHENTICATION)) // HEARD.size, MAX_HEARD)
    for flags in range(_COMBINATIONS)
)
_TRAILER_BYTES: Final = _AUTHENTICATION.size + FCS_BYTES
_HEARD_ANCHORS: Final = tuple(struct.Struct("<" + count * "H6x") for count in range(MAX_HEARD + 4))


def heard_capacity(*, position: bool = False, page: bool = True, certificate: bool = False) -> int:
    """How many ``heard`` entries a frame with these parts may carry, with space for authentication: 0, or 8 to 12."""
    return _CAPACITY[position * _HAS_POSITION | page * _HAS_PAGE | certificate * _HAS_CERTIFICATE]


def encode(beacon: Beacon) -> bytes:
    """Return the whole frame, FCS included. Standard deviations are rounded up, so that they are never too optimistic.

    Raises:
        ValueError: a field is out of its range, there are more ``heard`` than fit, or one is impossible; the message
            names it.
    """
    flags = _flags(beacon)
    fault = _fault(beacon, _CAPACITY[flags]) or _authentication_fault(beacon, flags)
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
        std = min(math.ceil(round(position.std_m * _STD_STEPS_PER_M, 6)), _MAX_STD_STEPS)
        parts.append(_POSITION.pack(*coordinates, std, position.floor, position.zone))
    if beacon.certificate is None:
        parts += [_COUNT.pack(len(beacon.heard) | beacon.weak << _COUNT_BITS), _packed(beacon.heard)]
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
    signed[_FLAGS_AT] |= _HAS_AUTHENTICATION
    signed += interval.to_bytes(2, "little")
    signed += mac_of(bytes(signed))
    return bytes(signed) + fcs(bytes(signed))


def signed_bytes(frame: bytes) -> bytes:
    """The bytes of an authenticated frame that its code is made of: all before the code."""
    return frame[: -FCS_BYTES - MAC_BYTES]


def decode(frame: bytes) -> Beacon | Malformed:
    """Return the beacon in a whole frame of version 2 (FCS included), or why there is none; never raises."""
    fault = _frame_fault(frame)
    if fault is not None:
        return fault
    flags = frame[_FLAGS_AT]
    _, sequence, site, _, anchor, _, _, tx_low, tx_high, issue, period_code = _FIXED.unpack_from(frame)
    if period_code > LONGEST_PERIOD_CODE:
        return Malformed.BAD_PERIOD
    if flags & _HAS_CERTIFICATE:
        certificate = frame[_FIXED.size : _FIXED.size + CERTIFICATE_BYTES]
        return Beacon(
            site, anchor, sequence, tx_low | tx_high << 32, issue, period_code, None, PackedHeard(b""), 0, None,
            certificate, _authentication(frame, flags),
        )  # fmt: skip
    (entries,) = _COUNT.unpack_from(frame, _COUNT_AT[flags])
    count, weak = entries & _COUNT_MASK, entries >> _COUNT_BITS
    heard_at = _COUNT_AT[flags] + _COUNT.size
    page_at = heard_at + count * HEARD.size
    named = {anchor, *_HEARD_ANCHORS[count].unpack_from(frame, heard_at)}
    if len(named) != count + 1 or count > MAX_HEARD or weak >> count:
        return Malformed.BAD_HEARD
    page = decode_page(frame[page_at : page_at + PAGE_BYTES]) if flags & _HAS_PAGE else None
    if isinstance(page, Malformed):
        return page
    position = _position(frame, _FIXED.size) if flags & _HAS_POSITION else None
    return Beacon(
        site, anchor, sequence, tx_low | tx_high << 32, issue, period_code, position,
        PackedHeard(frame[heard_at:page_at]), weak, page, None, _authentication(frame, flags),
    )  # fmt: skip


decode_cached = lru_cache(maxsize=256)(decode)
"""``decode`` that remembers the last 256 frames: for a program that runs many tags which receive the same bytes."""


def _frame_fault(frame: bytes) -> Malformed | None:
    """Why bytes are no beacon of version 2, as far as length, header and flags show it."""
    length = len(frame)
    if not FCS_BYTES < length <= MAX_FRAME_BYTES:
        return Malformed.TOO_LONG if length > MAX_FRAME_BYTES else Malformed.TOO_SHORT
    if not is_intact(frame):
        return Malformed.BAD_FCS
    fault = not_a_beacon(frame, VERSION_2)
    if fault is None:
        fault = Malformed.TOO_SHORT if length < _BARE_BYTES[0] else _length_fault(frame)
    return fault


def _length_fault(frame: bytes) -> Malformed | None:
    flags, length = frame[_FLAGS_AT], len(frame)
    if flags & _RESERVED_FLAGS or (flags & _HAS_CERTIFICATE and flags & _NOT_WITH_CERTIFICATE):
        return Malformed.BAD_FLAGS
    if length < _BARE_BYTES[flags]:
        return Malformed.BAD_LENGTH
    if flags & _HAS_CERTIFICATE:
        return None if length == _BARE_BYTES[flags] else Malformed.BAD_LENGTH
    (entries,) = _COUNT.unpack_from(frame, _COUNT_AT[flags])
    fits = length == _BARE_BYTES[flags] + (entries & _COUNT_MASK) * HEARD.size
    return None if fits else Malformed.BAD_LENGTH


def _authentication(frame: bytes, flags: int) -> Authentication | None:
    if not flags & _HAS_AUTHENTICATION:
        return None
    return Authentication(*_AUTHENTICATION.unpack_from(frame, len(frame) - _TRAILER_BYTES))


def _position(frame: bytes, at: int) -> StatedPosition:
    x, x_high, y, y_high, z, z_high, std, floor, zone = _POSITION.unpack_from(frame, at)
    x_mm, y_mm, z_mm = x | x_high << 16, y | y_high << 16, z | z_high << 16
    return StatedPosition(x_mm / 1000, y_mm / 1000, z_mm / 1000, std / _STD_STEPS_PER_M, floor, zone)


def _packed(heard: tuple[Heard, ...] | PackedHeard) -> bytes:
    if isinstance(heard, PackedHeard):
        return heard.packed
    return b"".join(
        HEARD.pack(entry.anchor, entry.sequence, entry.rx_ticks & 0xFFFFFFFF, entry.rx_ticks >> 32) for entry in heard
    )


def packed_relays(beacon: Beacon) -> bytes:
    """The receptions that a decoded beacon relays, ``HEARD`` after ``HEARD``, without those of a weak first path."""
    packed: bytes = beacon.heard.packed  # type: ignore[union-attr]  # it is of a frame
    if not beacon.weak:
        return packed
    entries = (packed[at : at + HEARD.size] for at in range(0, len(packed), HEARD.size))
    return b"".join(entry for number, entry in enumerate(entries) if not beacon.weak >> number & 1)


def _flags(beacon: Beacon) -> int:
    return (
        (beacon.position is not None) * _HAS_POSITION
        | (beacon.page is not None) * _HAS_PAGE
        | (beacon.authentication is not None) * _HAS_AUTHENTICATION
        | (beacon.certificate is not None) * _HAS_CERTIFICATE
    )


def _authentication_fault(beacon: Beacon, flags: int) -> str | None:
    certificate, authentication = beacon.certificate, beacon.authentication
    if certificate is not None:
        if flags & _NOT_WITH_CERTIFICATE:
            return "a beacon with a certificate has neither position nor page"
        if len(certificate) != CERTIFICATE_BYTES:
            return f"certificate has {len(certificate)} bytes; it must have {CERTIFICATE_BYTES}"
    if authentication is not None:
        if len(authentication.mac) != MAC_BYTES:
            return f"authentication.mac has {len(authentication.mac)} bytes; it must have {MAC_BYTES}"
        if not 0 <= authentication.interval < 1 << INTERVAL_BITS:
            return f"authentication.interval is {authentication.interval!r}; it must be from 0 to 65535"
    return None


def _millimetres(value_m: float) -> tuple[int, int]:
    """Low half-word and signed high byte of a coordinate."""
    value = round(value_m * 1000)
    return value & 0xFFFF, value >> 16


def _fault(beacon: Beacon, capacity: int) -> str | None:
    """The first field that is impossible or does not fit its bits, None where there is none."""
    if len(beacon.heard) > capacity:
        return f"heard has {len(beacon.heard)} entries; {capacity} fit"
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
