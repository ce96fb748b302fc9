"""What each number of a site file may be, and how to say so."""

import math
from typing import Final

from msgspec import Struct

ANY_ADDRESS: Final = 65_533
"""Highest identifier on the air; 65534 means "no short address" and 65535 is broadcast in IEEE 802.15.4."""
FARTHEST_M: Final = 1e6
"""Coordinates travel as 32-bit millimetres, ±2147 km; far beyond a building, metres are probably something else."""


class Limits(Struct, frozen=True):
    """A closed interval, without its lower end where ``above`` is set."""

    low: float
    high: float
    unit: str = ""
    whole: bool = False
    above: bool = False

    def hold(self, value: float) -> bool:
        """Whether the value is finite and lies within."""
        enough = value > self.low if self.above else value >= self.low
        return math.isfinite(value) and enough and value <= self.high

    def __str__(self) -> str:
        """Return what an error message says of them."""
        noun = "a whole number" if self.whole else "a number"
        unit = f" of {self.unit}" if self.unit else ""
        if self.above:
            return f"{noun}{unit} above {self.low:.12g} and up to {self.high:.12g}"
        return f"{noun}{unit} from {self.low:.12g} to {self.high:.12g}"


_ADDRESS = Limits(0, ANY_ADDRESS, whole=True)
_COORDINATE = Limits(-FARTHEST_M, FARTHEST_M, "metres")
_STD = Limits(0, 6.5, "metres")
"""Travels as a 16-bit number of 0.1 mm (``docs/protocol.md``, "Pages")."""
_DELAY = Limits(0, 65_535, "ticks (15.65 ps)", whole=True)

LIMITS: Final = {
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
    "floor_plan.width_m": Limits(0, FARTHEST_M, "metres", above=True),
    "floor_plan.x_m": _COORDINATE,
    "floor_plan.y_m": _COORDINATE,
    "georeference.latitude_deg": Limits(-90, 90, "degrees"),
    "georeference.longitude_deg": Limits(-180, 180, "degrees"),
    "georeference.height_m": Limits(-1e4, 1e5, "metres"),
    "georeference.heading_deg": Limits(-360, 360, "degrees"),
}
"""By key, without the places in lists."""

_OTHERS: Final = {
    "name": "a text",
    "anchors": "a list of [[anchors]] tables, one for each anchor",
    "walls": "a list of [[walls]] tables",
    "floor_plan.image": "the path of a PNG or JPEG file, relative to the site file",
}


def expected(key: str) -> str:
    """What the value of a key (without places in lists) should be."""
    if key in LIMITS:
        return str(LIMITS[key])
    return _OTHERS.get(key, f"a [{key}] table")
