"""Where a DT-anchor is, as FiRa's messages state it: WGS 84, or relative to some point.

The coordinates follow each other as one string of bits, each from its lowest byte on; of the bits that fill no byte,
which are its highest, those come first that count most. WGS 84: latitude and longitude of 33 bits in 2⁻²⁴ degrees,
altitude of 30 bits in 2⁻²¹ kilometres. Relative: x and y of 28 bits, z of 24 bits, in millimetres.

In version 2 of the measurements a location begins with its kind; Android's stack expects that kind once more in the
byte after it (b0 set, kind in b1-3), Qorvo's does not. Kinds 2, 3 and 5 end with 6 bytes about the storey.

Sources: AOSP ``UwbAnchorLocation``, whose tests' bytes serve our tests, and Qorvo's client for QM35.
"""

from typing import Final

from msgspec import Struct

from skyless.air.masterless_packets import Point
from skyless.air.uci import RELATIVE_LOCATION, WGS84_LOCATION, DtMeasurement


class GeodeticPoint(Struct, frozen=True, gc=False):
    """A point in WGS 84."""

    latitude_deg: float
    longitude_deg: float
    height_m: float


_WGS84_BITS: Final = (33, 33, 30)
_RELATIVE_BITS: Final = (28, 28, 24)
_PER_DEGREE: Final = 1 << 24
_PER_KM: Final = 1 << 21

_WGS84_KINDS: Final = frozenset((0, 2))
_RELATIVE_KINDS: Final = frozenset((1, 3, 4, 5))
_WITH_STOREY: Final = frozenset((2, 3, 5))
_STOREY_BYTES: Final = 6


def location_of(measurement: DtMeasurement) -> Point | GeodeticPoint | None:
    """Where the sender is; None where it is not stated, or in a way that is not known."""
    data = measurement.location
    if not data:
        return None
    if measurement.location_kind == WGS84_LOCATION:
        return decode_wgs84(data)
    if measurement.location_kind == RELATIVE_LOCATION:
        return decode_relative(data)
    return _location_2(data)


def _location_2(data: bytes) -> Point | GeodeticPoint | None:
    kind = data[0]
    if kind not in _WGS84_KINDS | _RELATIVE_KINDS:
        return None
    bits = _WGS84_BITS if kind in _WGS84_KINDS else _RELATIVE_BITS
    size = sum(bits) // 8
    header = len(data) - size - (_STOREY_BYTES if kind in _WITH_STOREY else 0)
    if header not in (1, 2) or (header == 2 and data[1] & 0xF != 1 | kind << 1):
        return None
    body = data[header : header + size]
    return decode_wgs84(body) if kind in _WGS84_KINDS else decode_relative(body)


def encode_wgs84(point: GeodeticPoint) -> bytes:
    """12 bytes. Raises ValueError for a point that they cannot hold."""
    height = round(point.height_m / 1000.0 * _PER_KM)
    return _pack(
        (round(point.latitude_deg * _PER_DEGREE), round(point.longitude_deg * _PER_DEGREE), height), _WGS84_BITS
    )


def decode_wgs84(data: bytes) -> GeodeticPoint | None:
    """Point of 12 bytes; None where it is none of the earth."""
    latitude, longitude, height = _unpack(data, _WGS84_BITS)
    point = GeodeticPoint(latitude / _PER_DEGREE, longitude / _PER_DEGREE, height / _PER_KM * 1000.0)
    return point if abs(point.latitude_deg) <= 90.0 and abs(point.longitude_deg) <= 180.0 else None


def encode_relative(position_m: Point) -> bytes:
    """10 bytes. Raises ValueError for a position that they cannot hold."""
    x, y, z = (round(value * 1000.0) for value in position_m)
    return _pack((x, y, z), _RELATIVE_BITS)


def decode_relative(data: bytes) -> Point:
    """Position of 10 bytes."""
    x, y, z = _unpack(data, _RELATIVE_BITS)
    return x / 1000.0, y / 1000.0, z / 1000.0


def _pack(values: tuple[int, int, int], widths: tuple[int, int, int]) -> bytes:
    string = 0
    for value, width in zip(values, widths, strict=True):
        if not -(1 << width - 1) <= value < 1 << width - 1:
            raise ValueError(f"{value} does not fit {width} bits")
        for done in range(0, width, 8):
            bits = min(width - done, 8)
            string = string << bits | value >> done & ((1 << bits) - 1)
    return string.to_bytes(sum(widths) // 8, "big")


def _unpack(data: bytes, widths: tuple[int, int, int]) -> tuple[int, ...]:
    string, left, values = int.from_bytes(data, "big"), 8 * len(data), []
    for width in widths:
        value = 0
        for done in range(0, width, 8):
            bits = min(width - done, 8)
            left -= bits
            value |= (string >> left & ((1 << bits) - 1)) << done
        values.append(value - (1 << width) if value >> width - 1 else value)
    return tuple(values)
