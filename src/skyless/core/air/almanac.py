"""The almanac: all that a tag must know about a site, sent as rotating pages of 17 bytes."""

from msgspec import Struct


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
