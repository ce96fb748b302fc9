"""Choice of the pages in use, among those that beacons carry, by a majority of the anchors."""

import struct
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Annotated, Any, Final, Literal
from zlib import crc32

from msgspec import Struct
from msgspec.structs import asdict

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
from skyless.core.air.frame import SIGN, Malformed, signed, unsigned
from skyless.core.air.neighbours import PRESENT_TICKS, Neighbours, StatedPlace, is_present
from skyless.core.native.records import (
    MAX_PAGES,
    MAX_SENDERS,
    Array,
    Byte,
    Bytes,
    Integers,
    Record,
    Ticks,
    first,
    record,
)

# Checks of page contents (``docs/protocol.md``, "Pages"): frames may carry any values.

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
"""Longest superframe: under half a wrap of the counter (8.6 s), as stamps would become ambiguous."""
CIRCLE: Final = 3_600_000_000
"""A whole turn in steps of 1e-7 degree."""

STD_STEPS_PER_M: Final = 10_000
STEPS_PER_M: Final = 100
STEPS_PER_S: Final = 10
"""Units of an accuracy page: standard deviations, distance, time."""

HEIGHT_GIVEN: Final = 0x01
"""Flag of a site or schedule page that states the height of the tags."""
HEIGHT_FLAG_AT: Final = 8
"""Offset of the flags in a site page; the height follows."""

_MAX_NOISE_BITS: Final = 0x36000000
"""2⁻¹⁹ as a float32; non-negative float32 values are ordered by their bits."""


def is_possible_page(data: Bytes, at: int) -> bool:  # noqa: PLR0911 - one for each type
    """Whether the page at ``at`` has possible values; pages of unknown types count as possible."""
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


MIN_ANCHORS: Final = 3
"""With fewer anchors no majority counts, unless the tag receives no more for ``PRESENT_TICKS``."""

NOISE_KIND, EARTH_KIND, ACCURACY_KIND, SITE_KIND = range(4)
"""Number of page types on the air, from ``NOISE_PAGE`` on; the georeference may be missing."""
PAGE_KINDS: Final = 4
NO_ISSUE: Final = -1
NO_PAGE: Final = -1

SAME_PAGES, OTHER_PAGES, OTHER_SETTINGS = range(3)
"""What a beacon has changed; the last is a page on which the filters' settings depend."""

_MAX_TRIALS: Final = 256
_CRC_32: Final = 0xEDB88320
"""Polynomial of Ethernet's check sequence, bits reversed."""
_ONES: Final = 0xFFFFFFFF


@record
class UsedPage(Record):
    """A page in use."""

    contents: Annotated[Array[Byte], PAGE_BYTES]
    """All zeros if there is none."""


@record
class CollectedPage(Record):
    """A page of an issue that is not complete yet."""

    issue: int
    support: int
    """How many of the anchors that sent it are received by others."""
    contents: Annotated[Array[Byte], PAGE_BYTES]
    sender_count: int
    senders: Annotated[Integers, MAX_SENDERS]


@record
class Choices(Record):
    """Candidates for each page of an issue."""

    counts: Annotated[Integers, PAGE_KINDS]
    places: Annotated[Array[Integers], PAGE_KINDS, MAX_PAGES]
    """Their rows in the table, those of most anchors first."""
    chosen: Annotated[Integers, PAGE_KINDS]


@record
class SitePages(Record):
    """What a tag has learnt of the site's common pages.

    Pages count once a majority of the recently received anchors states their issue and they match it; those in use
    stay until all pages of another such issue are there.
    """

    issue: int = NO_ISSUE
    """Issue of the pages in use."""
    used: Annotated[Array[UsedPage], PAGE_KINDS]
    has_first: bool
    first_ticks: Ticks
    """When the first beacon was received."""
    count: int
    collected: Annotated[Array[CollectedPage], MAX_PAGES]


def note_page(p: SitePages, t: Neighbours, frame: Bytes, page_at: int, rx_ticks: Ticks) -> int:
    """Process the page at ``page_at`` (0: none) of the newest anchor's beacon. Return what this changed."""
    n = t.rows[t.row]
    if not p.has_first:
        p.has_first, p.first_ticks = True, rx_ticks
    if n.almanac_issue == p.issue:
        return SAME_PAGES
    if page_at > 0 and NOISE_PAGE <= frame[page_at] <= SITE_PAGE:
        _collect(p, t, frame, page_at)
    return _complete(p, t, n.almanac_issue) if _is_majority(p, t, n.almanac_issue, rx_ticks) else SAME_PAGES


def _collect(p: SitePages, t: Neighbours, frame: Bytes, page_at: int) -> None:
    """Note that the newest anchor has sent a page; if there is no space, replace the worst page."""
    n, place = t.rows[t.row], 0
    while place < p.count and not (p.collected[place].issue == n.almanac_issue and _is_page(p, place, frame, page_at)):
        place += 1
    if place == p.count:
        if p.count == MAX_PAGES:
            place = _worst(p, t)
        p.count = max(p.count, place + 1)
        p.collected[place].issue, p.collected[place].sender_count = n.almanac_issue, 0
        for byte in range(PAGE_BYTES):
            p.collected[place].contents[byte] = frame[page_at + byte]
    one = p.collected[place]
    for sender in range(one.sender_count):
        if one.senders[sender] == n.anchor:
            return
    if one.sender_count < MAX_SENDERS:
        one.senders[one.sender_count] = n.anchor
        one.sender_count += 1


def _is_page(p: SitePages, place: int, frame: Bytes, page_at: int) -> bool:
    same = 0
    while same < PAGE_BYTES and p.collected[place].contents[same] == frame[page_at + same]:
        same += 1
    return same == PAGE_BYTES


def _worst(p: SitePages, t: Neighbours) -> int:
    """Return the page to replace: of the issue, then of the senders, with the fewest supporters that others receive.

    The number of strangers does not matter.
    """
    worst, least_issue, least = 0, 0, 0
    for place in range(p.count):
        one, of_issue = p.collected[place], 0
        for row in range(t.count):
            if t.rows[row].was_relayed and t.rows[row].almanac_issue == one.issue:
                of_issue += 1
        support = _supporters(one, t)
        if place == 0 or of_issue < least_issue or (of_issue == least_issue and support < least):
            worst, least_issue, least = place, of_issue, support
    return worst


def _supporters(one: CollectedPage, t: Neighbours) -> int:
    support = 0
    for row in range(t.count):
        for sender in range(one.sender_count):
            if t.rows[row].was_relayed and t.rows[row].anchor == one.senders[sender]:
                support += 1
    return support


def _is_majority(p: SitePages, t: Neighbours, issue: int, rx_ticks: Ticks) -> bool:
    """Whether most of the anchors present state this issue."""
    present, stating = 0, 0
    for row in range(t.count):
        n = t.rows[row]
        if n.was_relayed and is_present(n, rx_ticks):
            present += 1
            stating += 1 if n.almanac_issue == issue else 0
    is_enough = present >= MIN_ANCHORS or (present > 0 and rx_ticks - p.first_ticks >= PRESENT_TICKS)
    return is_enough and 2 * stating > present


def _complete(p: SitePages, t: Neighbours, issue: int) -> int:
    """Use the pages of an issue if all are there; among several contents, those of most anchors that match it."""
    c, trials = Choices(), 1
    for place in range(p.count):
        if p.collected[place].issue == issue:
            p.collected[place].support = _supporters(p.collected[place], t)
            _add_choice(c, p, place)
    for kind in range(PAGE_KINDS):
        trials *= _options(c, kind)
    for trial in range(min(trials, _MAX_TRIALS)):
        rest, pages = trial, 0
        for kind in range(PAGE_KINDS):
            option = rest % _options(c, kind)
            rest //= _options(c, kind)
            c.chosen[kind] = c.places[kind][option] if option < c.counts[kind] else NO_PAGE
            pages += 1 if option < c.counts[kind] else 0
        if p.collected[c.chosen[SITE_KIND]].contents[1] == pages and _issue_of(p, c) == issue:
            return _use_chosen(p, c, issue)
    return SAME_PAGES


def _options(c: Choices, kind: int) -> int:
    """Return the number of candidates for a page; a site may have no georeference."""
    return c.counts[kind] + (1 if kind == EARTH_KIND else 0)


def _add_choice(c: Choices, p: SitePages, place: int) -> None:
    """Add a page to those of its type, after those that more anchors support."""
    kind = p.collected[place].contents[0] - NOISE_PAGE
    index = c.counts[kind]
    while index > 0 and p.collected[c.places[kind][index - 1]].support < p.collected[place].support:
        c.places[kind][index] = c.places[kind][index - 1]
        index -= 1
    c.places[kind][index] = place
    c.counts[kind] += 1


def _issue_of(p: SitePages, c: Choices) -> int:
    """Return ``site_issue`` of the chosen pages."""
    crc: Ticks = _ONES
    for kind in range(PAGE_KINDS):
        if c.chosen[kind] != NO_PAGE:
            for byte in range(PAGE_BYTES):
                crc = crc ^ p.collected[c.chosen[kind]].contents[byte]
                for _ in range(8):
                    crc = crc >> 1 ^ _CRC_32 * (crc & 1)
    crc = crc ^ _ONES
    return int((crc ^ crc >> 16) & 0xFFFF)


def _use_chosen(p: SitePages, c: Choices, issue: int) -> int:
    """Use the chosen pages."""
    outcome = OTHER_PAGES
    for kind in range(PAGE_KINDS):
        for byte in range(PAGE_BYTES):
            place = c.chosen[kind]
            value = p.collected[place].contents[byte] if place != NO_PAGE else 0
            is_setting = kind != EARTH_KIND and (kind != SITE_KIND or byte >= HEIGHT_FLAG_AT)
            if is_setting and value != p.used[kind].contents[byte]:
                outcome = OTHER_SETTINGS
            p.used[kind].contents[byte] = value
    p.issue, p.count = issue, 0
    return outcome


# Almanac pages and their 17 bytes: a type, then 16 bytes of contents (``docs/protocol.md``, "Pages").

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
    """Encode a page as 17 bytes.

    Coordinates are rounded to 1 mm, angles to 1e-7 degree (at most 5.6 mm on the ground), noise to float32.
    An accuracy page rounds standard deviations to 0.1 mm, the distance to 1 cm and the time to 0.1 s, the latter two
    never to 0.

    Raises ValueError: a field is out of its range; the message names it.
    """
    return _ENCODERS[type(page)](page)


@lru_cache(maxsize=1024)
def decode_page(data: bytes) -> Page | Literal[Malformed.BAD_PAGE] | None:
    """Decode 17 bytes to a page; ``BAD_PAGE`` if a value is impossible, None for an unknown type."""
    decode = _DECODERS.get(data[0])
    if decode is None:
        return None
    return decode(data) if is_possible_page(data, 0) else Malformed.BAD_PAGE


def site_issue(pages: Iterable[Page]) -> int:
    """A 16-bit checksum of the contents of all pages."""
    checksum = crc32(b"".join(sorted(map(encode_page, pages))))
    return (checksum ^ checksum >> 16) & 0xFFFF


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
        NOISE_PAGE, *(_real(f"NoisePage.{name}", value, 0.0, MAX_NOISE) for name, value in asdict(page).items())
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
    # Division by 1e7 restores the exact float of a configured angle of up to seven decimals.
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


# What a tag has learnt


class CommonPages(Struct, frozen=True):
    """The complete pages of a site."""

    site: SitePage
    noise: NoisePage
    accuracy: AccuracyPage
    georeference: GeoreferencePage | None = None


class LocalAlmanac:
    """What a tag has learnt about a site of protocol 2."""

    def __init__(self, site_pages: SitePages, neighbours: Neighbours) -> None:
        """The site's pages and the anchors' statements, both of which keep changing."""
        self._site_pages, self._neighbours = site_pages, neighbours

    @property
    def issue(self) -> int | None:
        """Issue of the pages in use."""
        return None if self._site_pages.issue == NO_ISSUE else self._site_pages.issue

    @property
    def pages(self) -> CommonPages | None:
        """The pages in use; None until they are complete."""
        if self._site_pages.issue == NO_ISSUE:
            return None
        noise, earth, accuracy, site = (decode_page(bytes(one.contents)) for one in self._site_pages.used)
        return CommonPages(site, noise, accuracy, earth)  # type: ignore[arg-type]  # in the order of their types

    def points_m(self) -> dict[int, tuple[float, float, float]]:
        """Position of each anchor that has stated one."""
        rows = first(self._neighbours.rows, self._neighbours.count)
        return {row.anchor: _point_m(row.place) for row in rows if row.has_place}


def _point_m(place: StatedPlace) -> tuple[float, float, float]:
    """The position that an anchor states."""
    x_m, y_m, z_m = (one_mm / 1000 for one_mm in place.position_mm)
    return x_m, y_m, z_m
