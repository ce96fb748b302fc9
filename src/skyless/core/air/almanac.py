"""The almanac's pages, all that a tag must know about a site, and the published instants of beacons."""

from typing import Final

from msgspec import Struct

from skyless.core.air.frame import MAX_FRAME_BYTES, air_time_s
from skyless.core.native.records import Ticks
from skyless.core.ticks import DELAYED_TX_GRANULARITY_TICKS, TICK_RATE_HZ


class AnchorPage(Struct, frozen=True, gc=False, tag="anchor"):
    """Position of one anchor's antenna phase centre, to the millimetre."""

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
    """Height of every tag of the site (2-D positioning); None if the height is to be estimated."""


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
    """Data common to a protocol 2 site, other than noise, accuracy and georeference."""

    pages: int
    """Number of pages, this one included, so that a tag knows when it has them all."""
    tag_height_m: float | None
    """Height of every tag of the site (2-D positioning); None if the height is to be estimated."""


class KeyPage(Struct, frozen=True, gc=False, tag="key"):
    """A disclosed key of the site's chain: the key of the frame's interval minus the lag of the chain."""

    key: bytes
    """16 bytes."""


Page = AnchorPage | SchedulePage | NoisePage | AccuracyPage | GeoreferencePage | SitePage | KeyPage


# When an anchor of protocol 2 sends: at pseudo-random instants that any receiver can predict (``docs/protocol2.md``).
# The gap between two beacons follows from the anchor's identifier, the sequence number and the stated mean period.
# Periods are coded in 8 bits like floating-point numbers: 16 steps per doubling, from 4 ms on.

PERIOD_CHANGES: Final = 16
"""An anchor changes its period only before a beacon whose sequence number is a multiple of this."""

LONGEST_PERIOD_CODE: Final = 0x9F
"""4 s: a gap of one and a half periods is shorter than half a wrap of a counter."""

OFFERED_HZ: Final = 3.0 / (20.0 * air_time_s(MAX_FRAME_BYTES))
"""Total beacons per second that the anchors in reach of a tag should send: 476.

In free space a frame of length tau is lost to others within sqrt(10) times its sender's distance, so a tag receives
1 / (20 tau) * (1 - exp(-20 tau * offered)) beacons a second; 3 / (20 tau) gives 95 % of the maximum.
"""

SHORTEST_PERIOD_S: Final = 0.015
"""Shortest mean period: no anchor sends more than 67 times a second."""

_UNIT_STEPS: Final = round(0.25e-3 * TICK_RATE_HZ) // DELAYED_TX_GRANULARITY_TICKS
"""Unit of periods: 31,200 steps of the delayed transmission, a quarter of a millisecond."""

_STEPS: Final = 16
_LOW: Final = 0xFFFFFFFF


def period_ticks(code: int) -> Ticks:
    """Return the mean time between two beacons of an anchor that states this code."""
    unit: Ticks = _UNIT_STEPS * DELAYED_TX_GRANULARITY_TICKS
    return int(unit * ((_STEPS + (code & 15)) << (code >> 4)))


def period_code(period_s: float) -> int:
    """Return the code of the shortest period not shorter than this, or of the longest period."""
    wanted_ticks = period_s * TICK_RATE_HZ
    codes = range(LONGEST_PERIOD_CODE)
    return next((code for code in codes if period_ticks(code) >= wanted_ticks), LONGEST_PERIOD_CODE)


def suitable_period_s(anchors: float, rate_hz: float | None) -> float:
    """Return an anchor's mean period from the number in reach, itself included; ``rate_hz``: the site file's rate."""
    return max(SHORTEST_PERIOD_S, anchors / OFFERED_HZ) if rate_hz is None else 1.0 / rate_hz


def mixed(value: int) -> int:
    """Hash 32 bits (Wellons' lowbias32); the result is the same for Python integers and arrays of int64."""
    value = ((value >> 16) ^ value) * 0x7FEB352D & _LOW
    value = ((value >> 15) ^ value) * 0x846CA68B & _LOW
    return (value >> 16) ^ value


def gap_ticks(anchor_id: int, sequence: int, code: int) -> int:
    """Return the ticks from the beacon with this sequence number (8 bits) to the next, in the anchor's counter.

    Uniform between half a period and one and a half, in whole steps of the delayed transmission. The arguments may be
    arrays of int64.
    """
    drawn = mixed(mixed(anchor_id) ^ (sequence & 0xFF))
    steps = ((_STEPS + (code & 15)) << (code >> 4)) * _UNIT_STEPS
    return (steps // 2 + (steps * drawn >> 32)) * DELAYED_TX_GRANULARITY_TICKS
