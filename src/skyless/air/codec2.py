"""Beacons of protocol 2 and their bytes (``docs/protocol2.md``); little endian throughout, 127 bytes at most."""

import math
import struct
from collections.abc import Callable
from functools import lru_cache
from operator import index
from typing import Final, SupportsIndex

from skyless.air.beacon import HEARD, Heard, Malformed, PackedHeard
from skyless.air.beacon2 import (
    MAX_HEARD,
    MOST_PULSE_AGE,
    Authentication,
    Beacon2,
    SlotTime,
    StatedPosition,
    StatedSiteTime,
)
from skyless.air.codec import (
    BEACON_MAGIC,
    BROADCAST,
    FCS_BYTES,
    FRAME_CONTROL,
    MAX_FRAME_BYTES,
    SATURATED_STD,
    STD_STEPS_PER_TICK,
    not_a_beacon,
)
from skyless.air.ieee802154 import fcs, is_intact
from skyless.air.page_codec import PAGE_BYTES, decode_page, encode_page
from skyless.constants import SUBTICKS

VERSION_2: Final = BEACON_MAGIC | 0x0200
MAC_BYTES: Final = 8
"""Of a message authentication code: the first 64 bits of an HMAC-SHA-256."""
INTERVAL_BITS: Final = 16
"""Of the number of an interval that a frame states."""
CERTIFICATE_BYTES: Final = 94
"""Of a certificate (``skyless.authentication.certificate``)."""

RATE_STEPS: Final = 2.0**36
MAX_RATE: Final = ((1 << 23) - 1) / RATE_STEPS
MAX_STATED_COORDINATE_M: Final = ((1 << 23) - 1) / 1000.0
"""8388.6 m, along each axis from the origin."""
MOST_RESIDUAL_TICKS: Final = ((1 << 23) - 1) / SUBTICKS
"""0.51 µs, of site time about the nominal start of the slot."""

_HAS_SLOT_TIME: Final = 0x01
_HAS_POSITION: Final = 0x02
_HAS_SITE_TIME: Final = 0x04
_HAS_PAGE: Final = 0x08
_HAS_AUTHENTICATION: Final = 0x10
_HAS_CERTIFICATE: Final = 0x20
_RESERVED_FLAGS: Final = 0xC0
_NOT_WITH_CERTIFICATE: Final = _HAS_SLOT_TIME | _HAS_POSITION | _HAS_SITE_TIME | _HAS_PAGE
_COMBINATIONS: Final = 0x40

_FIXED: Final = struct.Struct("<HBHHHHBIBH")
_FLAGS_AT: Final = 11
_SLOT_TIME: Final = struct.Struct("<IBHIBBHb")
_POSITION: Final = struct.Struct("<HbHbHbBbB")
_SITE_TIME: Final = struct.Struct("<HbH")
_COUNT: Final = struct.Struct("<H")
_AUTHENTICATION: Final = struct.Struct("<H8s")
_COUNT_BITS: Final = 4
_COUNT_MASK: Final = (1 << _COUNT_BITS) - 1
_STD_STEPS_PER_M: Final = 1000
_MOST_STD_STEPS: Final = 0xFF


def _bare_bytes(flags: int) -> int:
    """Length of a frame with these flags that relays no receptions."""
    return (
        _count_at(flags)
        + _COUNT.size
        + (PAGE_BYTES if flags & _HAS_PAGE else 0)
        + (CERTIFICATE_BYTES if flags & _HAS_CERTIFICATE else 0)
        + (_AUTHENTICATION.size if flags & _HAS_AUTHENTICATION else 0)
        + FCS_BYTES
    )


def _count_at(flags: int) -> int:
    return (
        _FIXED.size
        + (_SLOT_TIME.size if flags & _HAS_SLOT_TIME else 0)
        + (_POSITION.size if flags & _HAS_POSITION else 0)
        + (_SITE_TIME.size if flags & _HAS_SITE_TIME else 0)
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


def heard_capacity_2(
    *,
    slot_time: bool = False,
    position: bool = False,
    site_time: bool = False,
    page: bool = True,
    certificate: bool = False,
) -> int:
    """How many ``heard`` entries a frame with these parts may carry, with space for authentication: 5 to 11."""
    if certificate:
        return 0
    flags = slot_time * _HAS_SLOT_TIME | position * _HAS_POSITION | site_time * _HAS_SITE_TIME | page * _HAS_PAGE
    return _CAPACITY[flags]


def encode_2(beacon: Beacon2) -> bytes:
    """Return the whole frame, FCS included. Standard deviations are rounded up, so that they are never too optimistic.

    Raises:
        ValueError: a field is out of its range, there are more ``heard`` than fit, or one is impossible; the message
            names it.
    """
    flags = _flags(beacon)
    fault = _fault(beacon, _CAPACITY[flags]) or _authentication_fault(beacon, flags)
    if fault is not None:
        raise ValueError(fault)
    slot_time, position, site_time = beacon.slot_time, beacon.position, beacon.site_time
    parts = [
        _FIXED.pack(
            FRAME_CONTROL, beacon.sequence, beacon.site, BROADCAST, beacon.anchor, VERSION_2, flags,
            beacon.tx_ticks & 0xFFFFFFFF, beacon.tx_ticks >> 32, beacon.almanac_issue,
        )
    ]  # fmt: skip
    if slot_time is not None:
        parts.append(
            _SLOT_TIME.pack(
                slot_time.superframe, slot_time.slot, slot_time.root, slot_time.term, slot_time.hop,
                slot_time.pulse_age, *_split24(round(slot_time.rate * RATE_STEPS)),
            )
        )  # fmt: skip
    if position is not None:
        coordinates = [half for value in (position.x_m, position.y_m, position.z_m) for half in _millimetres(value)]
        std = min(math.ceil(round(position.std_m * _STD_STEPS_PER_M, 6)), _MOST_STD_STEPS)
        parts.append(_POSITION.pack(*coordinates, std, position.floor, position.zone))
    if site_time is not None:
        std_steps = min(math.ceil(site_time.std_ticks * STD_STEPS_PER_TICK), SATURATED_STD)
        parts.append(_SITE_TIME.pack(*_split24(round(site_time.residual_ticks * SUBTICKS)), std_steps))
    parts.append(_COUNT.pack(len(beacon.heard) | beacon.weak << _COUNT_BITS))
    parts.append(_packed(beacon.heard))
    if beacon.page is not None:
        parts.append(encode_page(beacon.page))
    if beacon.certificate is not None:
        parts.append(beacon.certificate)
    if beacon.authentication is not None:
        parts.append(_AUTHENTICATION.pack(beacon.authentication.interval, beacon.authentication.mac))
    body = b"".join(parts)
    return body + fcs(body)


def authenticate_2(frame: bytes, interval: int, mac_of: Callable[[bytes], bytes]) -> bytes:
    """Return a frame of ``encode_2`` without authentication as one with it.

    ``interval``: its lowest 16 bits; ``mac_of`` gives the code of the bytes from the first to the interval.
    """
    signed = bytearray(frame[:-FCS_BYTES])
    signed[_FLAGS_AT] |= _HAS_AUTHENTICATION
    signed += interval.to_bytes(2, "little")
    signed += mac_of(bytes(signed))
    return bytes(signed) + fcs(bytes(signed))


def is_authenticated_2(frame: bytes) -> bool:
    """Whether a whole and well-formed frame of version 2 carries authentication."""
    return bool(frame[_FLAGS_AT] & _HAS_AUTHENTICATION)


def signed_bytes_2(frame: bytes) -> bytes:
    """The bytes of an authenticated frame that its code is made of: all before the code."""
    return frame[: -FCS_BYTES - MAC_BYTES]


def decode_2(frame: bytes) -> Beacon2 | Malformed:
    """Return the beacon in a whole frame of version 2 (FCS included), or why there is none; never raises."""
    fault = _frame_fault(frame)
    if fault is not None:
        return fault
    flags = frame[_FLAGS_AT]
    _, sequence, site, _, anchor, _, _, tx_low, tx_high, issue = _FIXED.unpack_from(frame)
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
    slot_time = position = site_time = None
    at = _FIXED.size
    if flags & _HAS_SLOT_TIME:
        slot_time = _slot_time(frame, at)
        at += _SLOT_TIME.size
    if flags & _HAS_POSITION:
        position = _position(frame, at)
        at += _POSITION.size
    if flags & _HAS_SITE_TIME:
        low, high, std_steps = _SITE_TIME.unpack_from(frame, at)
        site_time = StatedSiteTime((low | high << 16) / SUBTICKS, std_steps / STD_STEPS_PER_TICK)
    certificate = frame[page_at : page_at + CERTIFICATE_BYTES] if flags & _HAS_CERTIFICATE else None
    authentication = None
    if flags & _HAS_AUTHENTICATION:
        authentication = Authentication(*_AUTHENTICATION.unpack_from(frame, len(frame) - _TRAILER_BYTES))
    return Beacon2(
        site, anchor, sequence, tx_low | tx_high << 32, issue, slot_time, position, site_time,
        PackedHeard(frame[heard_at:page_at]), weak, page, certificate, authentication,
    )  # fmt: skip


decode_2_cached = lru_cache(maxsize=256)(decode_2)
"""``decode_2`` that remembers the last 256 frames."""


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
    is_alone = not flags & _NOT_WITH_CERTIFICATE
    if (
        flags & _RESERVED_FLAGS
        or (flags & _HAS_SITE_TIME and not flags & _HAS_SLOT_TIME)
        or (flags & _HAS_CERTIFICATE and not is_alone)
    ):
        return Malformed.BAD_FLAGS
    if length < _BARE_BYTES[flags]:
        return Malformed.BAD_LENGTH
    (entries,) = _COUNT.unpack_from(frame, _COUNT_AT[flags])
    fits = length == _BARE_BYTES[flags] + (entries & _COUNT_MASK) * HEARD.size
    return None if fits else Malformed.BAD_LENGTH


def _slot_time(frame: bytes, at: int) -> SlotTime:
    superframe, slot, root, term, hop, age, low, high = _SLOT_TIME.unpack_from(frame, at)
    return SlotTime(superframe, slot, root, term, hop, age, (low | high << 16) / RATE_STEPS)


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


def packed_relays_2(beacon: Beacon2) -> bytes:
    """The receptions that a decoded beacon relays, ``HEARD`` after ``HEARD``, without those of a weak first path."""
    packed: bytes = beacon.heard.packed  # type: ignore[union-attr]  # it is of a frame
    if not beacon.weak:
        return packed
    entries = (packed[at : at + HEARD.size] for at in range(0, len(packed), HEARD.size))
    return b"".join(entry for number, entry in enumerate(entries) if not beacon.weak >> number & 1)


def _flags(beacon: Beacon2) -> int:
    return (
        (beacon.slot_time is not None) * _HAS_SLOT_TIME
        | (beacon.position is not None) * _HAS_POSITION
        | (beacon.site_time is not None) * _HAS_SITE_TIME
        | (beacon.page is not None) * _HAS_PAGE
        | (beacon.authentication is not None) * _HAS_AUTHENTICATION
        | (beacon.certificate is not None) * _HAS_CERTIFICATE
    )


def _authentication_fault(beacon: Beacon2, flags: int) -> str | None:
    certificate, authentication = beacon.certificate, beacon.authentication
    if certificate is not None:
        if flags & _NOT_WITH_CERTIFICATE:
            return "a beacon with a certificate has no slot_time, position, site_time or page"
        if len(certificate) != CERTIFICATE_BYTES:
            return f"certificate has {len(certificate)} bytes; it must have {CERTIFICATE_BYTES}"
    if authentication is not None:
        if len(authentication.mac) != MAC_BYTES:
            return f"authentication.mac has {len(authentication.mac)} bytes; it must have {MAC_BYTES}"
        if not 0 <= authentication.interval < 1 << INTERVAL_BITS:
            return f"authentication.interval is {authentication.interval!r}; it must be from 0 to 65535"
    return None


def _split24(value: int) -> tuple[int, int]:
    """Low half-word and signed high byte of a number of 24 bits."""
    return value & 0xFFFF, value >> 16


def _millimetres(value_m: float) -> tuple[int, int]:
    return _split24(round(value_m * 1000))


def _fault(beacon: Beacon2, capacity: int) -> str | None:
    """The first field that is impossible or does not fit its bits, None where there is none."""
    if beacon.site_time is not None and beacon.slot_time is None:
        return "site_time needs slot_time, to whose slot it refers"
    if len(beacon.heard) > capacity:
        return f"heard has {len(beacon.heard)} entries; {capacity} fit"
    others: tuple[int, ...]
    if isinstance(beacon.heard, PackedHeard):
        others = _HEARD_ANCHORS[len(beacon.heard)].unpack(beacon.heard.packed)
    else:
        others = tuple(entry.anchor for entry in beacon.heard)
    if len({beacon.anchor, *others}) <= len(others):
        return f"heard has the sender {beacon.anchor}, or an anchor twice: {list(others)}"
    if not isinstance(beacon.weak, SupportsIndex) or not 0 <= beacon.weak < 1 << len(beacon.heard):
        return f"weak is {beacon.weak!r}; it must have one bit for each of {len(beacon.heard)} entries of heard"
    return _whole_fault(beacon) or _real_fault(beacon)


def _whole_fault(beacon: Beacon2) -> str | None:
    fields: list[tuple[str, object, int]] = [
        ("site", beacon.site, 16),
        ("anchor", beacon.anchor, 16),
        ("sequence", beacon.sequence, 8),
        ("tx_ticks", beacon.tx_ticks, 40),
        ("almanac_issue", beacon.almanac_issue, 16),
    ]
    for number, entry in enumerate(() if isinstance(beacon.heard, PackedHeard) else beacon.heard):
        fields.append((f"heard[{number}].anchor", entry.anchor, 16))
        fields.append((f"heard[{number}].sequence", entry.sequence, 8))
        fields.append((f"heard[{number}].rx_ticks", entry.rx_ticks, 40))
    time, position = beacon.slot_time, beacon.position
    if time is not None:
        fields += [
            ("slot_time.superframe", time.superframe, 32),
            ("slot_time.slot", time.slot, 8),
            ("slot_time.root", time.root, 16),
            ("slot_time.term", time.term, 32),
            ("slot_time.hop", time.hop, 8),
            ("slot_time.pulse_age", time.pulse_age, 8),
        ]
    if position is not None:
        fields += [("position.zone", position.zone, 8)]
        if not isinstance(position.floor, SupportsIndex) or not -128 <= position.floor <= 127:
            return f"position.floor is {position.floor!r}; it must be a whole number from -128 to 127"
    for name, value, bits in fields:
        if not isinstance(value, SupportsIndex) or not 0 <= index(value) < 1 << bits:
            return f"{name} is {value!r}; it must be a whole number of {bits} bits, 0 to {(1 << bits) - 1}"
    return None


def _real_fault(beacon: Beacon2) -> str | None:
    time, position, site_time = beacon.slot_time, beacon.position, beacon.site_time
    fields: list[tuple[str, float, float, float]] = []
    if time is not None:
        fields.append(("slot_time.rate", time.rate, -MAX_RATE, MAX_RATE))
    if position is not None:
        reach_m = MAX_STATED_COORDINATE_M
        fields += [(f"position.{axis}_m", getattr(position, f"{axis}_m"), -reach_m, reach_m) for axis in "xyz"]
        fields.append(("position.std_m", position.std_m, 0.0, math.inf))
    if site_time is not None:
        residual_ticks = site_time.residual_ticks
        fields.append(("site_time.residual_ticks", residual_ticks, -MOST_RESIDUAL_TICKS, MOST_RESIDUAL_TICKS))
        fields.append(("site_time.std_ticks", site_time.std_ticks, 0.0, math.inf))
    for name, value, low, high in fields:
        if not low <= value <= high:
            return f"{name} is {value!r}; it must be from {low:g} to {high:g}"
    return None


def pulse_age(superframe: int, pulse: int) -> int:
    """How many superframes ago the root sent last, as a beacon states it; both are unwrapped numbers."""
    return min(max(superframe - pulse, 0), MOST_PULSE_AGE)
