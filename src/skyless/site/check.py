"""The rules of a site beyond the types of its values: limits of each number, then rules between them.

Every violation is a configuration error.
"""

import math
import re
from collections.abc import Iterable, Iterator
from itertools import combinations
from math import dist
from pathlib import Path
from typing import Final

from msgspec import Struct

from skyless.air.codec import MAX_FRAME_BYTES
from skyless.air.ieee802154 import air_time_s
from skyless.air.page_codec import MAX_COORDINATE_M
from skyless.constants import TICK_BITS, TICK_S
from skyless.errors import ConfigurationError
from skyless.site.image import image_size
from skyless.site.model import AnchorSite, Site
from skyless.site.slots import Schedule, first_slots, schedule_of

ANY_ADDRESS: Final = 65_533
"""Highest identifier on the air; 65534 means "no short address" and 65535 is broadcast in IEEE 802.15.4."""


class Limits(Struct, frozen=True):
    """A closed interval, without its lower end where ``above`` is set."""

    low: float
    high: float
    unit: str = ""
    whole: bool = False
    above: bool = False

    def contains(self, value: float) -> bool:
        """Whether the value is finite and lies within."""
        enough = value > self.low if self.above else value >= self.low
        return math.isfinite(value) and enough and value <= self.high

    def __str__(self) -> str:
        """Return their text for error messages."""
        noun = "a whole number" if self.whole else "a number"
        unit = f" of {self.unit}" if self.unit else ""
        if self.above:
            return f"{noun}{unit} above {self.low:.12g} and up to {self.high:.12g}"
        return f"{noun}{unit} from {self.low:.12g} to {self.high:.12g}"


_ADDRESS = Limits(0, ANY_ADDRESS, whole=True)
_COORDINATE = Limits(-MAX_COORDINATE_M, MAX_COORDINATE_M, "metres")
_STD = Limits(0, 6.5, "metres")
"""Sent as a 16-bit number of 0.1 mm (``docs/protocol.md``, "Pages")."""
_DELAY = Limits(0, 65_535, "ticks (15.65 ps)", whole=True)

SITE_LIMITS: Final = {
    "id": _ADDRESS,
    "master": _ADDRESS,
    "anchors.id": _ADDRESS,
    "anchors.x_m": _COORDINATE,
    "anchors.y_m": _COORDINATE,
    "anchors.z_m": _COORDINATE,
    "anchors.slot": Limits(0, 254, whole=True),
    "anchors.tx_antenna_delay_ticks": _DELAY,
    "anchors.rx_antenna_delay_ticks": _DELAY,
    "schedule.slot_s": Limits(0, 0.067, "seconds", above=True),
    "schedule.slots": Limits(1, 255, whole=True),
    "schedule.frames_per_node": Limits(1, 255, whole=True),
    "schedule.guard_s": Limits(0, 1, "seconds"),
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
    "walls.x1_m": _COORDINATE,
    "walls.y1_m": _COORDINATE,
    "walls.x2_m": _COORDINATE,
    "walls.y2_m": _COORDINATE,
    "walls.loss_db": Limits(0, 200, "decibels"),
    "walls.delay_m": Limits(0, 100, "metres"),
    "floor_plan.width_m": Limits(0, MAX_COORDINATE_M, "metres", above=True),
    "floor_plan.x_m": _COORDINATE,
    "floor_plan.y_m": _COORDINATE,
    "georeference.latitude_deg": Limits(-90, 90, "degrees"),
    "georeference.longitude_deg": Limits(-180, 180, "degrees"),
    "georeference.height_m": Limits(-1e4, 1e5, "metres"),
    "georeference.heading_deg": Limits(-360, 360, "degrees"),
}
"""By key, without the indices in lists."""

_OTHERS: Final = {
    "name": "a text",
    "anchors": "a list of [[anchors]] tables, one for each anchor",
    "walls": "a list of [[walls]] tables",
    "floor_plan.image": "the path of a PNG or JPEG file, relative to the site file",
}


def expected(key: str) -> str:
    """What the value of a key (without indices in lists) should be."""
    if key in SITE_LIMITS:
        return str(SITE_LIMITS[key])
    return _OTHERS.get(key, f"a [{key}] table")


HALF_WRAP_S: Final = (1 << (TICK_BITS - 1)) * TICK_S
"""Longest gap over which a stamp can be unwrapped without a host time."""

_CLOSEST_M: Final = 1e-3


def check_site(site: Site, file: Path) -> None:
    """Check the values of a site.

    Raises:
        ConfigurationError: naming ``file``, the key, its value and what would be right.
    """
    if not site.name.strip():
        raise ConfigurationError(file, "name", site.name, "a text of at least one character")
    for path, value in _numbers(site):
        key = re.sub(r"\[\d+\]", "", path)
        if not SITE_LIMITS[key].contains(value):
            raise ConfigurationError(file, with_anchor(path, site.anchors), value, expected(key))
    _check_anchors(site, file)
    _check_slots(site, file)
    _check_times(site, file)


def check_floor_plan(site: Site, file: Path) -> None:
    """Check that the floor plan's image is a PNG or JPEG that can be read.

    Raises:
        ConfigurationError: when it is not.
    """
    if site.floor_plan is None:
        return
    image = site.floor_plan.image
    path = file.parent / image
    try:
        size = image_size(path.read_bytes())
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigurationError(
            file, "floor_plan.image", image, f"a file that can be read ({path}: {reason})"
        ) from None
    if size is None:
        raise ConfigurationError(file, "floor_plan.image", image, "a PNG or JPEG image")


def with_anchor(path: str, anchors: Iterable[object]) -> str:
    """Add the anchor's identifier, which its owner knows, to the path of a value in the list of anchors."""
    match = re.match(r"anchors\[(\d+)\]", path)
    if match is None:
        return path
    anchor = list(anchors)[int(match[1])]
    identifier = anchor.get("id") if isinstance(anchor, dict) else getattr(anchor, "id", None)
    return path if identifier is None else f"{path} (anchor {identifier})"


def _numbers(value: object, path: str = "") -> Iterator[tuple[str, float]]:
    """Every number in a tree of structs, with its path."""
    if isinstance(value, Struct):
        for field in value.__struct_fields__:
            yield from _numbers(getattr(value, field), f"{path}.{field}".lstrip("."))
    elif isinstance(value, tuple):
        for index, entry in enumerate(value):
            yield from _numbers(entry, f"{path}[{index}]")
    elif isinstance(value, int | float):
        yield path, value


def _check_anchors(site: Site, file: Path) -> None:
    if not site.anchors:
        raise ConfigurationError(file, "anchors", [], "at least one [[anchors]] table")
    identifiers = [anchor.id for anchor in site.anchors]
    for index, identifier in enumerate(identifiers):
        if identifier in identifiers[:index]:
            first = identifiers.index(identifier)
            right = f"an identifier of its own; anchors[{first}] has this one already"
            raise ConfigurationError(file, f"anchors[{index}].id", identifier, right)
    if site.master not in identifiers:
        right = f"the id of an anchor: {', '.join(map(str, identifiers))}"
        raise ConfigurationError(file, "master", site.master, right)
    for (_, one), (index, other) in combinations(enumerate(site.anchors), 2):
        if dist(_point(one), _point(other)) < _CLOSEST_M:
            key = with_anchor(f"anchors[{index}]", site.anchors)
            raise ConfigurationError(
                file, key, f"at {_point(other)}", f"elsewhere; anchor {one.id} is at the same point"
            )


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
    """Check the slots that the file sets; other anchors get free ones."""
    taken: dict[int, int] = {}
    for index, anchor in enumerate(site.anchors):
        if anchor.slot is None:
            continue
        key = with_anchor(f"anchors[{index}].slot", site.anchors)
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


def _point(anchor: AnchorSite) -> tuple[float, float, float]:
    return anchor.x_m, anchor.y_m, anchor.z_m
