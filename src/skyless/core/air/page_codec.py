"""Almanac pages and their 17 bytes: a type, then 16 bytes of contents (``docs/protocol.md``, "Pages")."""

import struct
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final, Literal

from skyless.core.air.almanac import (
    AccuracyPage,
    AnchorPage,
    GeoreferencePage,
    KeyPage,
    NoisePage,
    Page,
    SchedulePage,
    SitePage,
)
from skyless.core.air.frame import Malformed
from skyless.core.air.page_check import (
    ACCURACY_PAGE,
    ANCHOR_PAGE,
    CIRCLE,
    GEOREFERENCE_PAGE,
    HEIGHT_GIVEN,
    KEY_PAGE,
    MAX_COORDINATE_MM,
    MAX_SUPERFRAME_TICKS,
    NOISE_PAGE,
    PAGE_BYTES,
    SCHEDULE_PAGE,
    SITE_PAGE,
    STD_STEPS_PER_M,
    STEPS_PER_M,
    STEPS_PER_S,
    is_possible_page,
)

MAX_COORDINATE_M: Final = MAX_COORDINATE_MM / 1000
MAX_NOISE: Final = 2.0**-19
"""Stamp noise beyond 1.9 µs (572 m) and oscillator noise beyond 1.9 ppm are errors; float32 keeps the bound."""

_ANCHOR: Final = struct.Struct("<BHiiiBx")
_SCHEDULE: Final = struct.Struct("<BIBBHBBixx")
_NOISE: Final = struct.Struct("<Bffff")
_GEOREFERENCE: Final = struct.Struct("<BiiiI")
_ACCURACY: Final = struct.Struct("<BHHHHHH4x")
_SITE: Final = struct.Struct("<BB6xBi4x")


@lru_cache(maxsize=1024)
def encode_page(page: Page) -> bytes:
    """Return the 17 bytes of a page.

    Coordinates are rounded to 1 mm, angles to 1e-7 degree (at most 5.6 mm on the ground), noise to float32.
    In an accuracy page standard deviations are rounded to 0.1 mm, the distance to 1 cm and the time to 0.1 s; neither
    of the latter two to 0.

    Raises:
        ValueError: a field is out of its range; the message names it.
    """
    return _ENCODERS[type(page)](page)


@lru_cache(maxsize=1024)
def decode_page(data: bytes) -> Page | Literal[Malformed.BAD_PAGE] | None:
    """Return the page in 17 bytes, ``BAD_PAGE`` where a value is impossible, None for a type not known here."""
    decode = _DECODERS.get(data[0])
    if decode is None:
        return None
    return decode(data) if is_possible_page(data, 0) else Malformed.BAD_PAGE


def _whole(name: str, value: int, low: int, high: int) -> int:
    if not low <= value <= high or value != int(value):
        raise ValueError(f"{name} is {value!r}; it must be a whole number from {low} to {high}")
    return int(value)


def _real(name: str, value: float, low: float, high: float) -> float:
    if not low <= value <= high:
        raise ValueError(f"{name} is {value!r}; it must be from {low:g} to {high:g}")
    return value


def _millimetres(name: str, value_m: float) -> int:
    return round(_real(name, value_m, -MAX_COORDINATE_M, MAX_COORDINATE_M) * 1000)


def _steps(name: str, value: float, per_unit: int, least: int = 0) -> int:
    return max(least, round(_real(name, value, 0.0, 0xFFFF / per_unit) * per_unit))


def _encode_anchor(page: AnchorPage) -> bytes:
    return _ANCHOR.pack(
        ANCHOR_PAGE,
        _whole("AnchorPage.anchor", page.anchor, 0, 0xFFFF),
        _millimetres("AnchorPage.x_m", page.x_m),
        _millimetres("AnchorPage.y_m", page.y_m),
        _millimetres("AnchorPage.z_m", page.z_m),
        _whole("AnchorPage.slot", page.slot, 0, 0xFF),
    )


def _encode_schedule(page: SchedulePage) -> bytes:
    slots = _whole("SchedulePage.slots", page.slots, 1, 0xFF)
    longest_slot_ticks = min(0xFFFFFFFF, MAX_SUPERFRAME_TICKS // slots)
    frames_per_node = _whole("SchedulePage.frames_per_node", page.frames_per_node, 1, slots)
    height_m = page.tag_height_m
    return _SCHEDULE.pack(
        SCHEDULE_PAGE,
        _whole("SchedulePage.slot_ticks", page.slot_ticks, 1, longest_slot_ticks),
        slots,
        frames_per_node,
        _whole("SchedulePage.master", page.master, 0, 0xFFFF),
        _whole("SchedulePage.anchors", page.anchors, 1, slots // frames_per_node),
        0 if height_m is None else HEIGHT_GIVEN,
        0 if height_m is None else _millimetres("SchedulePage.tag_height_m", height_m),
    )


def _encode_noise(page: NoisePage) -> bytes:
    return _NOISE.pack(
        NOISE_PAGE,
        _real("NoisePage.tx_stamp_s", page.tx_stamp_s, 0.0, MAX_NOISE),
        _real("NoisePage.rx_stamp_s", page.rx_stamp_s, 0.0, MAX_NOISE),
        _real("NoisePage.white_fm", page.white_fm, 0.0, MAX_NOISE),
        _real("NoisePage.random_walk_fm", page.random_walk_fm, 0.0, MAX_NOISE),
    )


def _encode_georeference(page: GeoreferencePage) -> bytes:
    return _GEOREFERENCE.pack(
        GEOREFERENCE_PAGE,
        round(_real("GeoreferencePage.latitude_deg", page.latitude_deg, -90.0, 90.0) * 1e7),
        round(_real("GeoreferencePage.longitude_deg", page.longitude_deg, -180.0, 180.0) * 1e7),
        _millimetres("GeoreferencePage.height_m", page.height_m),
        round(_real("GeoreferencePage.heading_deg", page.heading_deg, 0.0, 360.0) * 1e7) % CIRCLE,
    )


def _encode_accuracy(page: AccuracyPage) -> bytes:
    return _ACCURACY.pack(
        ACCURACY_PAGE,
        _steps("AccuracyPage.survey_std_m", page.survey_std_m, STD_STEPS_PER_M),
        _steps("AccuracyPage.range_std_m", page.range_std_m, STD_STEPS_PER_M),
        _steps("AccuracyPage.slope_std_m", page.slope_std_m, STD_STEPS_PER_M),
        _steps("AccuracyPage.place_std_m", page.place_std_m, STD_STEPS_PER_M),
        _steps("AccuracyPage.place_distance_m", page.place_distance_m, STEPS_PER_M, least=1),
        _steps("AccuracyPage.place_time_s", page.place_time_s, STEPS_PER_S, least=1),
    )


def _encode_site(page: SitePage) -> bytes:
    height_m = page.tag_height_m
    return _SITE.pack(
        SITE_PAGE,
        _whole("SitePage.pages", page.pages, 1, 0xFF),
        0 if height_m is None else HEIGHT_GIVEN,
        0 if height_m is None else _millimetres("SitePage.tag_height_m", height_m),
    )


def _encode_key(page: KeyPage) -> bytes:
    if len(page.key) != PAGE_BYTES - 1:
        raise ValueError(f"KeyPage.key has {len(page.key)} bytes; it must have {PAGE_BYTES - 1}")
    return bytes((KEY_PAGE,)) + page.key


def _decode_anchor(data: bytes) -> AnchorPage:
    _, anchor, x_mm, y_mm, z_mm, slot = _ANCHOR.unpack(data)
    return AnchorPage(anchor, x_mm / 1000, y_mm / 1000, z_mm / 1000, slot)


def _decode_schedule(data: bytes) -> SchedulePage:
    _, slot_ticks, slots, frames_per_node, master, anchors, flags, height_mm = _SCHEDULE.unpack(data)
    height_m = height_mm / 1000 if flags & HEIGHT_GIVEN else None
    return SchedulePage(slot_ticks, slots, frames_per_node, master, anchors, height_m)


def _decode_noise(data: bytes) -> NoisePage:
    _, *figures = _NOISE.unpack(data)
    return NoisePage(*figures)


def _decode_georeference(data: bytes) -> GeoreferencePage:
    _, latitude, longitude, height_mm, heading = _GEOREFERENCE.unpack(data)
    # Division by 1e7 gives back the very float of a configured angle of up to seven decimals.
    return GeoreferencePage(latitude / 1e7, longitude / 1e7, height_mm / 1000, heading / 1e7)


def _decode_accuracy(data: bytes) -> AccuracyPage:
    _, *stds, distance, time = _ACCURACY.unpack(data)
    survey_m, range_m, slope_m, place_m = (std / STD_STEPS_PER_M for std in stds)
    distance_m, time_s = distance / STEPS_PER_M, time / STEPS_PER_S
    return AccuracyPage(survey_m, range_m, slope_m, place_m, distance_m, time_s)


def _decode_site(data: bytes) -> SitePage:
    _, pages, flags, height_mm = _SITE.unpack(data)
    return SitePage(pages, height_mm / 1000 if flags & HEIGHT_GIVEN else None)


_ENCODERS: Final[dict[type, Callable[[Any], bytes]]] = {
    AnchorPage: _encode_anchor,
    SchedulePage: _encode_schedule,
    NoisePage: _encode_noise,
    GeoreferencePage: _encode_georeference,
    AccuracyPage: _encode_accuracy,
    SitePage: _encode_site,
    KeyPage: _encode_key,
}
_DECODERS: Final[dict[int, Callable[[bytes], Page]]] = {
    ANCHOR_PAGE: _decode_anchor,
    SCHEDULE_PAGE: _decode_schedule,
    NOISE_PAGE: _decode_noise,
    GEOREFERENCE_PAGE: _decode_georeference,
    ACCURACY_PAGE: _decode_accuracy,
    SITE_PAGE: _decode_site,
    KEY_PAGE: lambda data: KeyPage(data[1:]),
}
