"""Validation of a site beyond the types of its values: limits of each number, then rules between them.

Every violation is a configuration error.
"""

import math
import re
from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import Final

from msgspec import UNSET, Struct
from msgspec.structs import replace

from skyless.core.air.frame import MAX_FRAME_BYTES, air_time_s
from skyless.core.air.site_pages import MAX_COORDINATE_M
from skyless.core.errors import ConfigurationError
from skyless.core.protocol1.beacon import Schedule, first_slots, schedule_of
from skyless.core.site import Site
from skyless.core.ticks import TICK_BITS, TICK_S
from skyless.site.alarm_rules import KINDS, BadAlarmRulesError, check_rules

ANY_ADDRESS: Final = 65_533
"""Highest identifier on the air; 65534 means "no short address" and 65535 is broadcast in IEEE 802.15.4."""


class Limits(Struct, frozen=True):
    """A closed interval; ``above`` excludes its lower end."""

    low: float
    high: float
    unit: str = ""
    whole: bool = False
    above: bool = False

    def contains(self, value: float) -> bool:
        """Whether the value is finite and within."""
        enough = value > self.low if self.above else value >= self.low
        return math.isfinite(value) and enough and value <= self.high

    def __str__(self) -> str:
        noun = "a whole number" if self.whole else "a number"
        unit = f" of {self.unit}" if self.unit else ""
        if self.above:
            return f"{noun}{unit} above {self.low:.12g} and up to {self.high:.12g}"
        return f"{noun}{unit} from {self.low:.12g} to {self.high:.12g}"


_ADDRESS = Limits(0, ANY_ADDRESS, whole=True)
_COORDINATE = Limits(-MAX_COORDINATE_M, MAX_COORDINATE_M, "metres")
_STD = Limits(0, 6.5, "metres")
"""Sent as a 16-bit number of 0.1 mm (``docs/protocol.md``, "Pages")."""
_STATED_STD = Limits(0, 0.255, "metres")
"""Sent as an 8-bit number of millimetres in protocol 2."""
_SLOT = Limits(0, 254, whole=True)
_MAX_BY_PAIRS: Final = 255  # anchors up to which all pairs are compared one by one
_DELAY = Limits(0, 65_535, "ticks (15.65 ps)", whole=True)

_SILENCE = Limits(10, 86400, "seconds")
_GROUP_SILENCE = Limits(10, 86400, "seconds for each group, as {vehicles = 60},")

SITE_LIMITS: Final = {
    "id": _ADDRESS,
    "master": _ADDRESS,
    "anchors.id": _ADDRESS,
    "anchors.x_m": _COORDINATE,
    "anchors.y_m": _COORDINATE,
    "anchors.z_m": _COORDINATE,
    "anchors.slot": _SLOT,
    "anchors.tx_antenna_delay_ticks": _DELAY,
    "anchors.rx_antenna_delay_ticks": _DELAY,
    "anchors.floor": Limits(-128, 127, whole=True),
    "anchors.zone": Limits(0, 255, whole=True),
    "anchors.std_m": _STATED_STD,
    "schedule.slot_s": Limits(0, 0.067, "seconds", above=True),
    "schedule.slots": Limits(1, 255, whole=True),
    "schedule.frames_per_node": Limits(1, 255, whole=True),
    "schedule.guard_s": Limits(0, 1, "seconds"),
    "schedule.rate_hz": Limits(1, 200, "beacons per second"),
    "noise.tx_stamp_ps": Limits(0, 1e6, "picoseconds", above=True),
    "noise.rx_stamp_ps": Limits(0, 1e6, "picoseconds", above=True),
    "noise.white_fm": Limits(0, 1e-6, above=True),
    "noise.random_walk_fm": Limits(0, 1e-6, "1/√s", above=True),
    "accuracy.survey_std_m": _STD,
    "accuracy.range_std_m": _STD,
    "accuracy.slope_std_m": _STD,
    "accuracy.place_std_m": _STD,
    "accuracy.place_distance_m": Limits(0, 650, "metres", above=True),
    "accuracy.place_time_s": Limits(0, 6000, "seconds", above=True),
    "tags.height_m": _COORDINATE,
    "tags.longest_silence_s": _SILENCE,
    "tags.group_silence_s": _GROUP_SILENCE,
    "walls.x1_m": _COORDINATE,
    "walls.y1_m": _COORDINATE,
    "walls.x2_m": _COORDINATE,
    "walls.y2_m": _COORDINATE,
    "walls.loss_db": Limits(0, 200, "decibels"),
    "walls.delay_m": Limits(0, 100, "metres"),
    "floors.number": Limits(-128, 127, whole=True),
    "floors.low_m": _COORDINATE,
    "floors.slab_loss_db": Limits(0, 200, "decibels"),
    "floors.slab_delay_m": Limits(0, 100, "metres"),
    "floors.width_m": Limits(0, MAX_COORDINATE_M, "metres", above=True),
    "floors.x_m": _COORDINATE,
    "floors.y_m": _COORDINATE,
    "floor_plan.width_m": Limits(0, MAX_COORDINATE_M, "metres", above=True),
    "floor_plan.x_m": _COORDINATE,
    "floor_plan.y_m": _COORDINATE,
    "georeference.latitude_deg": Limits(-90, 90, "degrees"),
    "georeference.longitude_deg": Limits(-180, 180, "degrees"),
    "georeference.height_m": Limits(-1e4, 1e5, "metres"),
    "georeference.heading_deg": Limits(-360, 360, "degrees"),
}
"""Limits by key, without indices in lists."""

_STATED_COORDINATE = Limits(-8388, 8388, "metres in mode free, where anchors state their positions,")
"""Sent as a 24-bit number of millimetres."""

PROTOCOL_2_LIMITS: Final = {
    "anchors.x_m": _STATED_COORDINATE,
    "anchors.y_m": _STATED_COORDINATE,
    "anchors.z_m": _STATED_COORDINATE,
}
"""Limits that are narrower in protocol 2."""

_FEWEST_CORNERS: Final = 3
_MAX_CORNERS: Final = 1000

_OTHERS: Final = {
    "schedule.mode": '"master" or "free"',
    "schedule.carrier_phase": "true or false",
    "name": "a text",
    "anchors": "a list of [[anchors]] tables, one for each anchor",
    "walls": "a list of [[walls]] tables",
    "alarms": "a list of [[alarms]] tables",
    "alarms.id": "a text of 1 to 32 letters, digits, dashes and underscores",
    "alarms.kind": f"one of {', '.join(KINDS)}",
    "alarms.severity": "info, warning or critical",
    "alarms.tags": "a list of tags' names and of group:NAME",
    "alarms.others": "a list of tags' names and of group:NAME",
    **dict.fromkeys(("alarms.name", "alarms.zone", "alarms.hours"), "a text"),
    **dict.fromkeys(("alarms.limit", "alarms.hysteresis", "alarms.after_s", "alarms.clear_after_s"), "a number"),
    "outline_m": f"the room's {_FEWEST_CORNERS} to {_MAX_CORNERS} corners in order, [x, y] each in metres",
    "floors": "a list of [[floors]] tables, the lowest floor first",
    "floors.name": "a text",
    "floors.image": "the path of a PNG or JPEG file, relative to the site file",
    "floor_plan.image": "the path of a PNG or JPEG file, relative to the site file",
}


def expected(key: str, *, protocol_2: bool = False) -> str:
    """Describe valid values of a key (without indices in lists)."""
    limits = {**SITE_LIMITS, **PROTOCOL_2_LIMITS} if protocol_2 else SITE_LIMITS
    if key in limits:
        return str(limits[key])
    return _OTHERS.get(key, f"a [{key}] table")


HALF_WRAP_S: Final = (1 << (TICK_BITS - 1)) * TICK_S
"""Longest gap over which a stamp can be unwrapped without a host time."""

_CLOSEST_M: Final = 1e-3
_MAX_LISTED: Final = 20
_MAX_FLOORS: Final = 100


def check_site(site: Site, file: Path) -> None:
    """Check the values of a site. Raises ConfigurationError that names ``file``, key, value and what would be right."""
    if not site.name.strip():
        raise ConfigurationError(file, "name", site.name, "a text of at least one character")
    limits = SITE_LIMITS if site.schedule.needs_master else {**SITE_LIMITS, **PROTOCOL_2_LIMITS}
    for key, row, value in _numbers(replace(site, outline_m=UNSET, alarms=UNSET)):
        name, _, field = key.partition(".")
        limit = limits[f"anchors.{field}" if name == "unplaced" else key]
        if not limit.contains(value):
            path = key if row is None else f"{name}[{row}].{field}"
            raise ConfigurationError(file, _with_anchor(path, site), value, str(limit))
    _check_outline(site, file)
    _check_floors(site, file)
    _check_alarms(site, file)
    _check_anchors(site, file)
    if site.schedule.needs_master:
        _check_slots(site, file)
        _check_times(site, file)
    else:
        _check_protocol_2(site, file)


def _check_floors(site: Site, file: Path) -> None:
    """Check that floors are listed once each from the lowest up, and that an image has its width."""
    if site.floors is UNSET:
        return
    if len(site.floors) > _MAX_FLOORS:
        raise ConfigurationError(file, "floors", f"{len(site.floors)} tables", f"at most {_MAX_FLOORS}")
    for row, floor in enumerate(site.floors):
        if (floor.image is None) != (floor.width_m is None):
            key = "image" if floor.image is None else "width_m"
            right = "given, as image and width_m belong together"
            raise ConfigurationError(file, f"floors[{row}].{key}", None, right)
    for row, (below, floor) in enumerate(pairwise(site.floors), 1):
        for key in ("number", "low_m"):
            least = getattr(below, key)
            if getattr(floor, key) <= least:
                right = f"above {least}, that of the floor before it: the lowest comes first"
                raise ConfigurationError(file, f"floors[{row}].{key}", getattr(floor, key), right)


def plan_files(site: Site, file: Path) -> dict[int | None, Path]:
    """Images of a site's floors by number; None for the image of the whole site."""
    named: dict[int | None, str | None] = {None: None if site.floor_plan is None else site.floor_plan.image}
    named |= {floor.number: floor.image for floor in (() if site.floors is UNSET else site.floors)}
    return {number: file.parent / image for number, image in named.items() if image is not None}


def check_floor_plans(site: Site, file: Path) -> None:
    """Check that the images of all floors are readable PNGs or JPEGs. Raises ConfigurationError if one is not."""
    if site.floor_plan is not None:
        _check_image(file, "floor_plan.image", site.floor_plan.image)
    for row, floor in enumerate(() if site.floors is UNSET else site.floors):
        if floor.image is not None:
            _check_image(file, f"floors[{row}].image", floor.image)


def _check_image(file: Path, key: str, image: str) -> None:
    path = file.parent / image
    try:
        size = image_size(path.read_bytes())
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigurationError(file, key, image, f"a file that can be read ({path}: {reason})") from None
    if size is None:
        raise ConfigurationError(file, key, image, "a PNG or JPEG image")


def with_anchor(path: str, anchors: Sequence[object], unplaced: Sequence[object] = ()) -> str:
    """Add the anchor's identifier, which users know, to the path of a value in the lists of anchors."""
    match = re.match(r"(anchors|unplaced)\[(\d+)\]", path)
    if match is None:
        return path
    anchor = (anchors if match[1] == "anchors" else unplaced)[int(match[2])]
    identifier = anchor.get("id") if isinstance(anchor, dict) else getattr(anchor, "id", None)
    return path if identifier is None else f"{path} (anchor {identifier})"


def _with_anchor(path: str, site: Site) -> str:
    return with_anchor(path, site.anchors, site.unplaced)


def _numbers(value: object, path: str = "", row: int | None = None) -> Iterator[tuple[str, int | None, float]]:
    """Every number in a tree of structs: its key without indices and names, its row if in a list, and its value."""
    if isinstance(value, Struct):
        for field in value.__struct_fields__:
            yield from _numbers(getattr(value, field), f"{path}.{field}" if path else field, row)
    elif isinstance(value, tuple):
        for index, entry in enumerate(value):
            yield from _numbers(entry, path, index)
    elif isinstance(value, dict):
        for entry in value.values():
            yield from _numbers(entry, path, row)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, row, value


def _check_outline(site: Site, file: Path) -> None:
    if site.outline_m is UNSET:
        return
    corners = site.outline_m
    if not _FEWEST_CORNERS <= len(corners) <= _MAX_CORNERS:
        raise ConfigurationError(file, "outline_m", f"{len(corners)} corners", expected("outline_m"))
    for number, corner in enumerate(corners):
        for axis, value in enumerate(corner):
            if not _COORDINATE.contains(value):
                raise ConfigurationError(file, f"outline_m[{number}][{axis}]", value, str(_COORDINATE))
        if math.dist(corner, corners[number - 1]) < _CLOSEST_M:
            right = "elsewhere than the corner before it; the last side leads back to the first corner by itself"
            raise ConfigurationError(file, f"outline_m[{number}]", list(corner), right)

    import numpy as np  # noqa: PLC0415 - most sites need none of it

    from skyless.core.geometry import area, sides_that_meet  # noqa: PLC0415

    outline_m = np.array(corners)
    meeting = sides_that_meet(outline_m)
    if meeting is not None:
        one, other = (f"{list(corners[side])}–{list(corners[(side + 1) % len(corners)])}" for side in meeting)
        right = "corners in their order along the walls, so that no two sides meet but neighbours"
        raise ConfigurationError(file, "outline_m", f"sides {one} and {other}", right)
    if abs(area(outline_m)) < _CLOSEST_M:
        raise ConfigurationError(file, "outline_m", "corners in one line", expected("outline_m"))


def _check_alarms(site: Site, file: Path) -> None:
    try:
        check_rules(() if site.alarms is UNSET else site.alarms)
    except BadAlarmRulesError as error:
        key = "alarms" if error.row is None else f"alarms[{error.row}].{error.key} (rule {error.rule[:40]})"
        raise ConfigurationError(file, key, error.value, error.expected) from None


def _check_anchors(site: Site, file: Path) -> None:
    if not site.all_anchors:
        raise ConfigurationError(file, "anchors", [], "at least one [[anchors]] table")
    rows: dict[int, str] = {}
    places = [f"{name}[{row}]" for name in ("anchors", "unplaced") for row in range(len(getattr(site, name)))]
    for row, anchor in zip(places, site.all_anchors, strict=True):
        if anchor.id in rows:
            right = f"an identifier of its own; {rows[anchor.id]} has this one already"
            raise ConfigurationError(file, f"{row}.id", anchor.id, right)
        rows[anchor.id] = row
    if site.master not in rows:
        identifiers = ", ".join(map(str, sorted(rows)[:_MAX_LISTED]))
        right = f"the id of an anchor: {identifiers}{', …' if len(rows) > _MAX_LISTED else ''}"
        raise ConfigurationError(file, "master", site.master, right)
    same_point = min(_at_one_point(site), key=lambda pair: pair[1], default=None)
    if same_point is not None:
        one, other = (site.anchors[row] for row in same_point)
        key = _with_anchor(f"anchors[{same_point[1]}]", site)
        point = other.x_m, other.y_m, other.z_m
        raise ConfigurationError(file, key, f"at {point}", f"elsewhere; anchor {one.id} is at the same point")


def _at_one_point(site: Site) -> Iterator[tuple[int, int]]:
    """Pairs of rows of placed anchors at the same point."""
    if len(site.anchors) <= _MAX_BY_PAIRS:
        points = [(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors]
        pairs = combinations(range(len(points)), 2)
        yield from ((one, other) for one, other in pairs if math.dist(points[one], points[other]) < _CLOSEST_M)
        return
    from skyless.core.geometry import anchor_positions, pairs_within  # noqa: PLC0415 - only large sites need NumPy

    for ones, others, _ in pairs_within(anchor_positions(site), _CLOSEST_M):
        yield from zip(ones.tolist(), others.tolist(), strict=True)


def _check_protocol_2(site: Site, file: Path) -> None:
    """Check that anchors can state their standard deviations."""
    most = _STATED_STD.high
    if site.accuracy.survey_std_m > most and any(anchor.std_m is None for anchor in site.anchors):
        right = f"at most {most:g} in mode free, which is the largest std_m that an anchor can state"
        raise ConfigurationError(file, "accuracy.survey_std_m", site.accuracy.survey_std_m, right)


def _check_slots(site: Site, file: Path) -> None:
    frames = site.schedule.frames_per_node
    schedule = schedule_of(site)
    needed = len(site.anchors) * frames
    share = f"{len(site.anchors)} anchors × {frames} frames"
    if schedule.slots < needed:
        raise ConfigurationError(file, "schedule.slots", schedule.slots, f"at least {needed} ({share})")
    if schedule.slots > SITE_LIMITS["schedule.slots"].high:
        right = f"less: {share} need more than 255 slots"
        raise ConfigurationError(file, "schedule.frames_per_node", frames, right)
    _check_own_slots(site, schedule, file)
    try:
        first_slots(site)
    except ValueError as error:
        right = f"more, best a multiple of frames_per_node: {error}"
        raise ConfigurationError(file, "schedule.slots", schedule.slots, right) from None


def _check_own_slots(site: Site, schedule: Schedule, file: Path) -> None:
    taken: dict[int, int] = {}
    for index, anchor in enumerate(site.anchors):
        if anchor.slot is None:
            continue
        key = _with_anchor(f"anchors[{index}].slot", site)
        if anchor.slot >= schedule.slots:
            raise ConfigurationError(file, key, anchor.slot, f"a whole number from 0 to {schedule.slots - 1}")
        for slot in schedule.slots_of(anchor.slot):
            if slot in taken:
                right = f"another slot; anchor {taken[slot]} sends in slot {slot} already"
                raise ConfigurationError(file, key, anchor.slot, right)
            taken[slot] = anchor.id


def _check_times(site: Site, file: Path) -> None:
    schedule = site.schedule
    longest_s = air_time_s(MAX_FRAME_BYTES)
    if schedule.slot_s < longest_s + schedule.guard_s:
        right = (
            f"at least {longest_s + schedule.guard_s:.6f}: the longest frame is {longest_s * 1e6:.0f} µs on the "
            f"air and schedule.guard_s is {schedule.guard_s * 1e6:.0f} µs"
        )
        raise ConfigurationError(file, "schedule.slot_s", schedule.slot_s, right)
    slots = schedule_of(site).slots
    if slots * schedule.slot_s >= HALF_WRAP_S:
        right = (
            f"below {HALF_WRAP_S / slots:.4g}: {slots} slots make a superframe, which must be shorter than half a "
            f"wrap of the radios' counters ({HALF_WRAP_S:.2f} s)"
        )
        raise ConfigurationError(file, "schedule.slot_s", schedule.slot_s, right)


# Images of the floor


_STANDALONE: Final = frozenset({0x01, *range(0xD0, 0xD8)})
_START_OF_FRAME: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def image_kind(data: bytes) -> str | None:
    """``png`` or ``jpeg``, by the first bytes; None for other files."""
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    return "jpeg" if data.startswith(b"\xff\xd8\xff") else None


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels of a PNG or JPEG; None for other or damaged files.

    Sources: PNG (W3C, third edition) 11.2.2, JPEG (ITU-T T.81) B.1 and B.2.2.
    """
    kind = image_kind(data)
    if kind == "png":
        is_whole = len(data) >= 24 and data[12:16] == b"IHDR"
        return _positive(int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")) if is_whole else None
    return _jpeg_size(data) if kind == "jpeg" else None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Find the frame header, marker by marker."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # padding
            at += 1
        elif marker in _STANDALONE:  # a marker without a segment
            at += 2
        elif marker in _START_OF_FRAME:
            return _positive(int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big"))
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def _positive(width: int, height: int) -> tuple[int, int] | None:
    return (width, height) if width > 0 and height > 0 else None
