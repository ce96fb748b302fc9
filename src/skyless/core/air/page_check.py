"""Which contents of a page are possible (``docs/protocol.md``, "Pages"); what frames carry may be anything."""

from typing import Final

from skyless.core.air.little_endian import SIGN, signed, unsigned
from skyless.core.native.records import Bytes

PAGE_BYTES: Final = 17
"""A type, then 16 bytes of contents."""
ANCHOR_PAGE: Final = 1
SCHEDULE_PAGE: Final = 2
NOISE_PAGE: Final = 3
GEOREFERENCE_PAGE: Final = 4
ACCURACY_PAGE: Final = 5
SITE_PAGE: Final = 6
KEY_PAGE: Final = 7

MAX_COORDINATE_MM: Final = 1_000_000_000
"""Coordinates and heights beyond 1000 km from the origin are errors; a page has 32-bit millimetres, ±2147 km."""
MAX_SUPERFRAME_TICKS: Final = (1 << 39) - 1
"""A superframe is shorter than half a wrap of the counter (8.6 s), else stamps become ambiguous."""
CIRCLE: Final = 3_600_000_000
"""A whole turn in steps of 1e-7 degree."""

STD_STEPS_PER_M: Final = 10_000
STEPS_PER_M: Final = 100
STEPS_PER_S: Final = 10
"""Units of an accuracy page: of standard deviations, of its distance and of its time."""

HEIGHT_GIVEN: Final = 0x01
"""The flag of a site or schedule page with the height of the tags."""
HEIGHT_FLAG_AT: Final = 8
"""Where it stands in a site page; the height follows."""

_MAX_NOISE_BITS: Final = 0x36000000
"""2⁻¹⁹ as a float32: those from 0 on are in the order of their bits."""


def is_possible_page(data: Bytes, at: int) -> bool:  # noqa: PLR0911 - one for each type
    """Whether the page in these bytes, from ``at`` on, can be; one of a type that is not known here can."""
    kind = data[at]
    if kind == ANCHOR_PAGE:
        return _is_coordinate(data, at + 3) and _is_coordinate(data, at + 7) and _is_coordinate(data, at + 11)
    if kind == SCHEDULE_PAGE:
        slots, frames_per_node, anchors = data[at + 5], data[at + 6], data[at + 9]
        slot_ticks = unsigned(data, at + 1, 4)
        if slot_ticks == 0 or slot_ticks * slots > MAX_SUPERFRAME_TICKS or frames_per_node == 0:
            return False
        return 0 < anchors * frames_per_node <= slots and _is_coordinate(data, at + 11)
    if kind == NOISE_PAGE:
        return (
            _is_noise(data, at + 1) and _is_noise(data, at + 5) and _is_noise(data, at + 9) and _is_noise(data, at + 13)
        )
    if kind == GEOREFERENCE_PAGE:
        is_on_earth = abs(signed(data, at + 1)) <= CIRCLE // 4 and abs(signed(data, at + 5)) <= CIRCLE // 2
        return is_on_earth and _is_coordinate(data, at + 9) and unsigned(data, at + 13, 4) < CIRCLE
    if kind == ACCURACY_PAGE:
        return unsigned(data, at + 9, 2) > 0 and unsigned(data, at + 11, 2) > 0
    if kind == SITE_PAGE:
        return data[at + 1] > 0 and _is_coordinate(data, at + HEIGHT_FLAG_AT + 1)
    return True


def _is_coordinate(data: Bytes, at: int) -> bool:
    return abs(signed(data, at)) <= MAX_COORDINATE_MM


def _is_noise(data: Bytes, at: int) -> bool:
    bits = unsigned(data, at, 4)
    return bits <= _MAX_NOISE_BITS or bits == SIGN
