"""The values of a validated site file (``skyless.site.file.load`` creates them), and how two sites differ."""

import math
from hashlib import sha256
from typing import Final, Literal

import msgspec
from msgspec import UNSET, Struct, UnsetType

from skyless.core.ticks import DEFAULT_ANTENNA_DELAY_TICKS, TICK_M

# A rule that raises alarms at a site, as in its file (``[[alarms]]``) or on MQTT.

RuleKind = Literal[
    "inside", "outside", "silent", "near", "crowded", "anchor-offline", "anchor-moved", "protection-level", "battery"
]
"""A tag is in a zone; a tag is not in it; a tag sends no fixes; two tags are near each other; too many tags are in a
zone; an anchor is offline; an anchor has moved; a tag's protection level is too large; a tag's battery is low."""

Severity = Literal["info", "warning", "critical"]


class AlarmRule(Struct, frozen=True, forbid_unknown_fields=True):
    """When an alarm is raised, for which tags, and when it ends. Each tag, pair, zone or anchor has its own alarm."""

    id: str
    """1 to 32 letters, digits, dashes and underscores; unique at the site."""
    kind: RuleKind
    name: str = ""
    """Display name; by default the identifier."""
    zone: str | None = None
    """Identifier of the zone; kinds ``inside``, ``outside`` and ``crowded``."""
    tags: tuple[str, ...] = ()
    """Names of tags, and of groups of assets as ``group:NAME``; empty means all."""
    others: tuple[str, ...] = ()
    """Kind ``near``: tags that those of ``tags`` must not come near; empty means any other tag."""
    limit: float | None = None
    """``near``: distance in metres; ``crowded``: the most tags allowed; ``protection-level``: metres; ``battery``:
    share from 0 to 1."""
    hysteresis: float = 0.0
    """By how much the value must be back within the limit before the alarm ends, in the limit's unit."""
    after_s: float = 0.0
    """How long the condition must have held."""
    clear_after_s: float = 1.0
    """How long the condition must not have held before the alarm ends."""
    severity: Severity = "warning"
    hours: str = ""
    """When the rule applies, in the local time of the page's server, as ``mon-fri 06:00-18:00, sat 08:00-12:00``; empty
    means always."""


ScheduleMode = Literal["master", "free"]
"""How the anchors of a site share the air: in slots on a master's time (protocol 1), or at random instants (2)."""


Outline = tuple[tuple[float, float], ...]
"""Corners of a room in order, x and y in metres."""


class AnchorSite(Struct, frozen=True, forbid_unknown_fields=True):
    """One anchor: the position of its antenna and its slot."""

    id: int
    x_m: float
    y_m: float
    z_m: float = 0.0
    slot: int | None = None
    """First slot; by default in the order of the file, the master first."""
    tx_antenna_delay_ticks: int = DEFAULT_ANTENNA_DELAY_TICKS
    rx_antenna_delay_ticks: int = DEFAULT_ANTENNA_DELAY_TICKS
    floor: int = 0
    """Storey; sent with the position in protocol 2, as are the next two."""
    zone: int = 0
    """Zone of the site; 0 for none."""
    std_m: float | None = None
    """Standard deviation of the position per axis; by default ``AccuracySite.survey_std_m``."""


class UnplacedAnchor(Struct, frozen=True, forbid_unknown_fields=True):
    """An anchor of protocol 2 with an unknown position; it sends and relays."""

    id: int
    slot: int | None = None
    tx_antenna_delay_ticks: int = DEFAULT_ANTENNA_DELAY_TICKS
    rx_antenna_delay_ticks: int = DEFAULT_ANTENNA_DELAY_TICKS


class ScheduleSite(Struct, frozen=True, forbid_unknown_fields=True):
    """Who sends when."""

    mode: ScheduleMode = "master"
    """master: slots on the master's clock (protocol 1); free: every anchor sends at random instants (protocol 2)."""
    slot_s: float = 2**27 / 63.8976e9
    """Length of a slot; rounded to whole steps of the delayed transmission (8.013 ns)."""
    slots: int | None = None
    """Slots in a superframe; by default one for each frame of each anchor."""
    frames_per_node: int = 1
    """1: one frame per node and superframe; 2: the paper's pair in every superframe."""
    guard_s: float = 0.5e-3
    """Time at the end of each slot in which no frame may be on the air."""
    rate_hz: float | None = None
    """Mode free: beacons per second of each anchor; by default derived from the number of anchors in reach."""
    carrier_phase: bool | UnsetType = UNSET
    """Mode free: whether anchors relay carrier phases too. Omitted if unset: earlier versions refuse a site with it and
    drop such beacons."""

    @property
    def needs_master(self) -> bool:
        """Whether the site speaks protocol 1."""
        return self.mode == "master"

    @property
    def sends_phases(self) -> bool:
        """Whether beacons carry the phases of the relayed receptions."""
        return self.carrier_phase is True and not self.needs_master


class NoiseSite(Struct, frozen=True, forbid_unknown_fields=True):
    """Noise figures that the filters assume (never under-tune: docs/maths.md section 5)."""

    tx_stamp_ps: float = 100.0
    rx_stamp_ps: float = 100.0
    white_fm: float = 2e-11
    random_walk_fm: float = 1e-9


class AccuracySite(Struct, frozen=True, forbid_unknown_fields=True):
    """Accuracy of the survey and of a tag's ranges, beyond the noise of single stamps; each std is one sigma."""

    survey_std_m: float = 0.02
    """Standard deviation of each anchor's measured position, per axis."""
    range_std_m: float = 0.03
    """Constant error of a tag's ranges, different for each anchor."""
    slope_std_m: float = 0.05
    """Range error that depends on received power: a constant times clip((d - 4 m) / 4 m, -1, 1) at distance d;
    this is the constant's standard deviation."""
    place_std_m: float = 0.005
    """Part of a range's error that changes as the tag moves (reflections)."""
    place_distance_m: float = 1.0
    """Distance moved over which that part changes."""
    place_time_s: float = 100.0
    """Time over which that part changes while the tag is at rest."""

    @property
    def is_exact(self) -> bool:
        """Whether survey and ranges are assumed exact."""
        return self.survey_std_m == self.range_std_m == self.slope_std_m == self.place_std_m == 0.0


EXACT: Final = AccuracySite(survey_std_m=0.0, range_std_m=0.0, slope_std_m=0.0, place_std_m=0.0)
"""Survey and ranges without error, as in the ideal simulated world."""


class TagsSite(Struct, frozen=True, forbid_unknown_fields=True):
    """What is known of the tags."""

    height_m: float | None = None
    """All tags move at this height (2-D positioning); leave out to estimate the height."""
    longest_silence_s: float | UnsetType = UNSET
    """A tag that has been silent for longer has gone, however rarely it sends; 900 s by default.
    Omitted if unset, as earlier versions refuse it."""
    group_silence_s: dict[str, float] | UnsetType = UNSET
    """The same for groups of assets, by name. Omitted if unset too."""


class FloorPlanSite(Struct, frozen=True, forbid_unknown_fields=True):
    """An image of the floor, and its position."""

    image: str
    """Path of a PNG or JPEG, relative to the site file."""
    width_m: float
    """Width of the floor that the image covers."""
    x_m: float = 0.0
    y_m: float = 0.0
    """Site coordinates of the image's lower left corner."""


class FloorSite(Struct, frozen=True, forbid_unknown_fields=True):
    """One storey of a building, with the image of its plan if it has its own."""

    number: int
    """As used by its anchors."""
    low_m: float
    """Height of its ground: a tag between it and the next floor's is on this floor."""
    name: str = ""
    image: str | None = None
    """As in ``FloorPlanSite``, like the next three."""
    width_m: float | None = None
    x_m: float = 0.0
    y_m: float = 0.0
    slab_loss_db: float | UnsetType = UNSET
    """Loss of a signal that crosses its ground; 25 dB by default (reinforced concrete, assumed).
    Not used for the lowest floor. Omitted if unset, as earlier versions refuse it."""
    slab_delay_m: float | UnsetType = UNSET
    """Delay of such a signal; 0.4 m by default (assumed)."""

    @property
    def slab(self) -> tuple[float, float]:
        """Loss in dB and delay in metres of a signal that crosses its ground."""
        loss_db = 25.0 if isinstance(self.slab_loss_db, UnsetType) else self.slab_loss_db
        return loss_db, 0.4 if isinstance(self.slab_delay_m, UnsetType) else self.slab_delay_m


class GeoreferenceSite(Struct, frozen=True, forbid_unknown_fields=True):
    """Position of the site's origin on the Earth (WGS 84)."""

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0
    heading_deg: float = 0.0
    """Azimuth of the site's y axis, clockwise from true north."""


class WallSite(Struct, frozen=True, forbid_unknown_fields=True):
    """A wall on the floor plan, full height, with its loss and delay for a crossing signal."""

    x1_m: float
    y1_m: float
    x2_m: float
    y2_m: float
    loss_db: float = 6.0
    delay_m: float = 0.1


class Site(Struct, frozen=True, forbid_unknown_fields=True):
    """A whole site."""

    name: str
    id: int
    """Identifier on the air, 16 bits."""
    master: int
    """The anchor that starts the site's time; if it fails, the others take over in the order of the file.

    Without meaning in protocol 2, where it is the first anchor if the file has none.
    """
    anchors: tuple[AnchorSite, ...]
    """The placed anchors; in protocol 1 all."""
    schedule: ScheduleSite = ScheduleSite()
    noise: NoiseSite = NoiseSite()
    tags: TagsSite = TagsSite()
    accuracy: AccuracySite = AccuracySite()
    walls: tuple[WallSite, ...] = ()
    floor_plan: FloorPlanSite | None = None
    georeference: GeoreferenceSite | None = None
    unplaced: tuple[UnplacedAnchor, ...] = ()
    """Anchors without known positions, in protocol 2."""
    outline_m: Outline | UnsetType = UNSET
    """The room, if the file has it. Sent beside the site in messages: earlier versions refuse a site with it."""
    floors: tuple[FloorSite, ...] | UnsetType = UNSET
    """The storeys, lowest first, if the file has them. Sent beside the site too."""
    alarms: tuple[AlarmRule, ...] | UnsetType = UNSET
    """The alarm rules, if the file has any. Sent beside the site too."""

    @property
    def storeys(self) -> tuple[FloorSite, ...]:
        """The floors; empty if the file has none."""
        return () if isinstance(self.floors, UnsetType) else self.floors

    @property
    def all_anchors(self) -> tuple[AnchorSite | UnplacedAnchor, ...]:
        """All anchors, those with known positions first."""
        return (*self.anchors, *self.unplaced)


# What a survey changes


_DIGITS: Final = 16


def site_digest(site: Site) -> str:
    """16 hexadecimal digits that depend on the site's name and number, and on its anchors, and on nothing else.

    Identifiers, positions, slots and antenna delays of the anchors count. Their order does not.
    """
    anchors = [
        (
            anchor.id,
            (anchor.x_m, anchor.y_m, anchor.z_m) if isinstance(anchor, AnchorSite) else None,
            anchor.slot,
            anchor.tx_antenna_delay_ticks,
            anchor.rx_antenna_delay_ticks,
        )
        for anchor in sorted(site.all_anchors, key=lambda one: one.id)
    ]
    return sha256(msgspec.json.encode((site.name, site.id, anchors))).hexdigest()[:_DIGITS]


def is_same_but_placed(one: Site, other: Site) -> bool:
    """Whether two sites differ only in positions and delays: same number, anchors, slots and schedule."""
    return _frame_of(one) == _frame_of(other)


def largest_change_m(one: Site, other: Site) -> float:
    """The largest range error that using one site instead of the other can cause.

    It is the anchor's displacement plus the change of its delays: both delays are in the time between a received beacon
    and its own. Both sites have the same anchors. An anchor with a position only in the second site has an infinite
    change.
    """
    others = {anchor.id: anchor for anchor in other.all_anchors}
    return max(_change_m(anchor, others[anchor.id]) for anchor in one.all_anchors)


def _change_m(one: AnchorSite | UnplacedAnchor, other: AnchorSite | UnplacedAnchor) -> float:
    moved_m = 0.0
    if isinstance(other, AnchorSite):
        moved_m = math.inf
        if isinstance(one, AnchorSite):
            moved_m = math.dist((one.x_m, one.y_m, one.z_m), (other.x_m, other.y_m, other.z_m))
    tx_ticks = other.tx_antenna_delay_ticks - one.tx_antenna_delay_ticks
    rx_ticks = other.rx_antenna_delay_ticks - one.rx_antenna_delay_ticks
    return moved_m + TICK_M * max(abs(tx_ticks), abs(rx_ticks), abs(tx_ticks + rx_ticks))


def _frame_of(site: Site) -> object:
    slots = sorted((anchor.id, anchor.slot) for anchor in site.all_anchors)
    return (
        site.id,
        site.schedule,
        slots,
        (site.master, [one.id for one in site.anchors]) if site.schedule.needs_master else None,
    )
