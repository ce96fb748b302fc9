"""The almanac's pages, all that a tag must know about a site, and the published instants of beacons."""

from typing import Final

from msgspec import Struct

from skyless.core.air.frame import MAX_FRAME_BYTES, air_time_s
from skyless.core.native.records import Ticks
from skyless.core.ticks import DELAYED_TX_GRANULARITY_TICKS, TICK_RATE_HZ


class AnchorPage(Struct, frozen=True, gc=False, tag="anchor"):
    """Position of one anchor (antenna phase centre), to the millimetre."""

    anchor: int
    x_m: float
    y_m: float
    z_m: float
    slot: int
    """Its first slot in the superframe."""


class SchedulePage(Struct, frozen=True, gc=False, tag="schedule"):
    """The superframe, and the height of the tags."""

    slot_ticks: int
    slots: int
    frames_per_node: int
    master: int
    anchors: int
    """Number of anchors of the site, so that a tag knows when its almanac is complete."""
    tag_height_m: float | None
    """Height at which every tag of the site moves (2-D positioning); None where height is to be estimated."""


class NoisePage(Struct, frozen=True, gc=False, tag="noise"):
    """The site's noise figures, for the filters of its tags."""

    tx_stamp_s: float
    rx_stamp_s: float
    white_fm: float
    """Oscillators' white frequency noise: Allan deviation at 1 s, dimensionless."""
    random_walk_fm: float
    """Oscillators' random-walk frequency noise in 1/√s: standard deviation of the rate gained in 1 s."""


class AccuracyPage(Struct, frozen=True, gc=False, tag="accuracy"):
    """Accuracy of the site's survey and of a tag's ranges, for its filters (``skyless.core.site.AccuracySite``)."""

    survey_std_m: float
    range_std_m: float
    slope_std_m: float
    place_std_m: float
    place_distance_m: float
    place_time_s: float


class GeoreferencePage(Struct, frozen=True, gc=False, tag="georeference"):
    """Position of the site's origin on the Earth (WGS 84), and azimuth of its axes."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    heading_deg: float
    """Azimuth of the site's y axis, clockwise from true north."""


class SitePage(Struct, frozen=True, gc=False, tag="site"):
    """What is common to a site of protocol 2, other than noise, accuracy and georeference."""

    pages: int
    """Number of pages, this one included, so that a tag knows when it has them all."""
    tag_height_m: float | None
    """Height at which every tag of the site moves (2-D positioning); None where height is to be estimated."""


class KeyPage(Struct, frozen=True, gc=False, tag="key"):
    """A disclosed key of the site's chain: that of the interval of its frame less the lag of the chain."""

    key: bytes
    """16 bytes."""


Page = AnchorPage | SchedulePage | NoisePage | AccuracyPage | GeoreferencePage | SitePage | KeyPage


# When an anchor of protocol 2 sends: at random instants that everybody can predict (``docs/protocol2.md``).
#
# The gap between two beacons of an anchor is a function of its identifier, of the first one's sequence number and of
# the mean period that this one states. So a receiver of one beacon knows when the next ones leave, by the anchor's
# counter, however many of them get lost; and two anchors whose beacons collided hardly collide again the next time.
#
# A period is stated as a code of 8 bits, as floating-point numbers are: 16 steps for each doubling, from 4 ms on.

PERIOD_CHANGES: Final = 16
"""An anchor changes its period only before a beacon whose sequence number is a multiple of this."""

LONGEST_PERIOD_CODE: Final = 0x9F
"""4 s: a gap of one and a half periods is shorter than half a wrap of a counter."""

OFFERED_HZ: Final = 3.0 / (20.0 * air_time_s(MAX_FRAME_BYTES))
"""Beacons per second that the anchors in reach of a tag should send in all: 476.

In free space a frame of length tau is lost to others within sqrt(10) times its sender's distance, so a tag gets
1 / (20 tau) * (1 - exp(-20 tau * offered)) beacons a second, which 3 / (20 tau) brings to 95 % of its most.
"""

SHORTEST_PERIOD_S: Final = 0.015
"""No anchor sends more often, 67 times a second, however few there are."""

_UNIT_STEPS: Final = round(0.25e-3 * TICK_RATE_HZ) // DELAYED_TX_GRANULARITY_TICKS
"""31,200 steps of the delayed transmission: a quarter of a millisecond, the unit of periods."""

_STEPS: Final = 16
_LOW: Final = 0xFFFFFFFF


def period_ticks(code: int) -> Ticks:
    """Mean time between two beacons of an anchor that states this code."""
    unit: Ticks = _UNIT_STEPS * DELAYED_TX_GRANULARITY_TICKS
    return int(unit * ((_STEPS + (code & 15)) << (code >> 4)))


def period_code(period_s: float) -> int:
    """Code of the shortest period that is not shorter than this, or of the longest one."""
    wanted_ticks = period_s * TICK_RATE_HZ
    codes = range(LONGEST_PERIOD_CODE)
    return next((code for code in codes if period_ticks(code) >= wanted_ticks), LONGEST_PERIOD_CODE)


def suitable_period_s(anchors: float, rate_hz: float | None) -> float:
    """Mean period of an anchor that has this number in reach, itself included; ``rate_hz``: what the site file says."""
    return max(SHORTEST_PERIOD_S, anchors / OFFERED_HZ) if rate_hz is None else 1.0 / rate_hz


def mixed(value: int) -> int:
    """32 bits that depend on all bits of 32 (Wellons' lowbias32); the same from Python's integers and from int64."""
    value = ((value >> 16) ^ value) * 0x7FEB352D & _LOW
    value = ((value >> 15) ^ value) * 0x846CA68B & _LOW
    return (value >> 16) ^ value


def gap_ticks(anchor_id: int, sequence: int, code: int) -> int:
    """Time from the beacon with this sequence number (8 bits) to the next one, by the anchor's counter.

    Uniform from half a period to one and a half; whole steps of the delayed transmission.
    """
    drawn = mixed(mixed(anchor_id) ^ (sequence & 0xFF))
    steps = ((_STEPS + (code & 15)) << (code >> 4)) * _UNIT_STEPS
    return int((steps // 2 + (steps * drawn >> 32)) * DELAYED_TX_GRANULARITY_TICKS)


def ticks_ahead(anchor_id: int, sequence: int, code: int, beacons: int) -> int:
    """Time from the beacon with this sequence number to the one that follows as the given number after it."""
    ahead = 0
    for number in range(beacons):
        ahead += gap_ticks(anchor_id, sequence + number, code)
    return ahead
