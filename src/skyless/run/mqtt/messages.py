"""The messages on MQTT, version 1: JSON objects, one struct for each topic of ``topics.py`` (``docs/mqtt.md``).

SI units. ``unix_s`` is seconds since 1970 by the sender's clock. Fields may be added within a version; readers ignore
those that they do not know.
"""

from collections import deque
from typing import TYPE_CHECKING, Final, Literal, TypeVar

import msgspec
from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace

from skyless.core.site import AlarmRule, FloorPlanSite, FloorSite, Outline, RuleKind, Severity, Site
from skyless.site.survey.facts import Facts, PairRange, Survey

if TYPE_CHECKING:
    from skyless.core.fix import Fix

_T = TypeVar("_T")
Vector = tuple[float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
"""3 × 3, row by row."""

System = Literal["tdoa", "dl-tdoa"]
"""Other systems, none with a master; in dl-tdoa, FiRa's, anchors are called by their MAC addresses."""

MAX_LEASES: Final = 64
MAX_LEASE_S: Final = 60.0


class SiteMessage(Struct, frozen=True):
    """The site as in its file, retained so that a new tag or page has it at once."""

    site: Site
    """Without outline, floors and alarm rules, which earlier versions refuse here."""
    simulated: bool
    """True when its radios are emulated."""
    unix_s: float
    outline_m: Outline | UnsetType = UNSET
    """The room's corners, where the site's file has them."""
    floors: tuple[FloorSite, ...] | UnsetType = UNSET
    """The storeys, where the site's file has them."""
    alarms: tuple[AlarmRule, ...] = ()
    """The alarm rules in the site's file."""
    system: System | UnsetType = UNSET
    """Whose anchors they are; omitted for Skyless's own."""

    @property
    def whole_site(self) -> Site:
        """The site as in its file."""
        return replace(self.site, outline_m=self.outline_m, floors=self.floors, alarms=self.alarms or UNSET)


def site_message(site: Site, *, simulated: bool, unix_s: float) -> SiteMessage:
    """Make the message of a site, with outline, floors and alarm rules in their own fields."""
    inner = replace(site, outline_m=UNSET, floors=UNSET, alarms=UNSET)
    alarms = () if site.alarms is UNSET else site.alarms
    return SiteMessage(inner, simulated, unix_s, site.outline_m, site.floors, alarms)


class StatusMessage(Struct, frozen=True):
    """Whether a node is online, retained. As its last will, the broker itself publishes ``online: false``."""

    online: bool
    kind: str
    name: str
    version: str = ""
    host: str = ""
    pid: int = 0
    unix_s: float = 0.0
    """When it came online; 0 in a last will."""


LEVEL_VARIANCE: Final = 0.002
"""Variance of roll and pitch of a known orientation [rad²]: 2.5 degrees."""


class FixMessage(Struct, frozen=True):
    """One fix of one tag. A tag publishes at its configured rate; ``serial`` counts all its fixes."""

    tag: str
    serial: int
    """Number of the fix since the tag's start."""
    unix_s: float
    """When the last frame of the fix ended, by the clock of the tag's host."""
    time_s: float
    """Master time at which the position holds, since the receiver's first fix."""
    position_m: Vector
    covariance_m2: Matrix
    velocity_mps: Vector | None
    velocity_covariance: Matrix | None
    std_m: float
    """One-sigma radial error."""
    gdop: float | None
    pdop: float | None
    hdop: float | None
    vdop: float | None
    anchors: tuple[int, ...]
    chi2: float
    dof: int
    residual_rms_m: float
    method: str
    height_known: bool
    latency_s: float
    """From the end of the last frame to the computed fix."""
    hpl_m: float | None = None
    """Horizontal protection level; None if there is no guarantee, or if the method has none."""
    vpl_m: float | None = None
    integrity_risk: float | None = None
    """Probability, for each fix, that the error exceeds its level."""
    alert: str | None = None
    """A value of ``skyless.core.alert.Alert``."""
    verified_until_s: float | None = None
    """Up to this time, on the scale of ``time_s``, all beacons that count are verified; None if none is verified."""
    unverified: float = 1.0
    """Share of the beacons of the last second that are not verified, or not yet."""
    orientation: tuple[float, float, float, float] | None = None
    """Quaternion w, x, y, z that turns the frame of the tag's motion sensor into the site's; None if unknown."""
    heading_std_rad: float | None = None
    """Standard deviation of its heading."""


class Counters(Struct, frozen=True):
    """Counts of a node's MQTT link."""

    published: int
    dropped: int
    """Messages dropped because the broker was away or slow."""
    reconnects: int


class Phase(Struct, frozen=True, array_like=True):
    """One message of a tag's last superframe. Times are in s since the superframe's first message was heard."""

    superframe: int
    slot: int
    anchor: int
    heard_s: float
    """The frame's end."""
    done_s: float
    """The end of its processing."""
    fix: bool


class TagHealth(Struct, frozen=True):
    """A tag's state, once a second."""

    tag: str
    unix_s: float
    uptime_s: float
    method: str
    receptions: int
    fixes: int
    updates_per_s: float
    """Fixes in the last second."""
    reason: str | None
    """Why there is no fix; None if there is one."""
    first_fix_s: float | None
    """From the start to the first fix."""
    latency_p50_s: float | None
    latency_p99_s: float | None
    """From a frame's end to its fix, over the last second."""
    counters: dict[str, int]
    """Dropped frames by reason."""
    mqtt: Counters
    cpu: float
    """Share of a core that the process uses, divided among its tags if it has several."""
    memory_bytes: int
    """Resident memory of the process."""
    phases: tuple[Phase, ...]
    """The messages of the last whole superframe."""
    late: int = 0
    """Receptions dropped because they were too old when their turn came, and fixes withheld for the same reason;
    ``counters`` has them as ``late-reception`` and ``late-fix``."""
    lateness_s: float = 0.0
    """Largest age in the last second of a reception when its turn came, or of a fix when it was made."""
    trust: Literal["open", "verified"] | None = None
    """Which fixes a tag that verifies beacons outputs; None for a tag without the site's public key."""
    is_verified: bool = False
    """Whether beacons have been verified within the last seconds."""
    faults: dict[str, str] = {}
    """Anchors whose beacons, genuine or forged, were rejected within the last seconds, and why
    (``skyless.core.keys.fault.Fault``)."""
    clock_error_s: float | None = None
    """How far the host's clock is ahead of the site's, if by more than the bound; None otherwise."""
    multipath_std_m: float | None = None
    """Standard deviation by which ranges change as the tag moves, if it exceeds the site file's."""
    multipath_distance_m: float | None = None
    """Distance walked within which ranges change by ``multipath_std_m``."""
    carrier_phase_anchors: tuple[int, ...] = ()
    """Identifiers of the anchors whose carrier phases are in use."""
    carrier_phase_hypotheses: int = 0
    """Number of positions that are possible by these phases (``Fix.hypotheses``)."""
    on_board: bool = False
    """Whether the tag's board computes the fixes, and its program only passes them on."""
    battery_share: float | None = None
    """Remaining charge of the tag's battery, from 0 to 1; None if unknown."""
    interval_s: float | None = None
    """Usual time between its fixes, where it knows that it is longer than a second."""
    sleeps_s: float | None = None
    """For how long from now it sends no fixes, as it is going to sleep; None while it is awake."""
    notes: tuple[str, ...] = ()
    """What is wrong with another system's anchors or with the tag's motion sensor, in sentences."""


NOT_DROPS: Final = frozenset({"heard", "sent", "takeover"})
"""Counters of anchors that do not count dropped frames."""


class AnchorHealth(Struct, frozen=True):
    """An anchor's state, once a second."""

    anchor: int
    unix_s: float
    uptime_s: float
    role: Literal["master", "anchor", "listening"]
    master: int | None
    """The anchor whose time it uses; None in mode free, which has no master."""
    term: int | None
    """Counts the masters; None in mode free."""
    synchronised: bool
    """Whether it may send; always in mode free."""
    offset_s: float | None
    """Own counter minus the master's scale, modulo the wrap, in (-8.6, 8.6]; None in mode free."""
    rate_ppm: float | None
    """Own rate relative to the master's."""
    offset_std_m: float | None
    sent: int
    late: int
    """Transmissions that came too late and were skipped."""
    heard: int
    superframe: int | None
    heard_age_s: dict[str, float]
    """Time since each other anchor was last heard."""
    counters: dict[str, int]
    mqtt: Counters
    mode: Literal["master", "free"] = "master"
    """Mode of the site's schedule."""
    missed_share: float = 0.0
    """Share of the last second's transmissions that came too late."""
    chain: int | None = None
    """Serial number of the key chain in use; None for an anchor without keys."""
    chain_ends_unix_s: float | None = None
    """When the last of its key chains ends."""
    code_fault: str | None = None
    """Why an anchor with keys sends without codes (``skyless.core.keys.fault.Fault``); None if it sends them."""
    faults: dict[str, str] = {}
    """Other anchors whose beacons, genuine or forged, were rejected within the last seconds, and why."""


class EtherHealth(Struct, frozen=True):
    """Counts of the emulated air."""

    unix_s: float
    simulated_s: float
    transmissions: int
    late: int
    at_anchors: dict[str, int]
    at_tags: dict[str, int]
    stalls: int
    """How often the ether fell behind real time."""
    overruns: int
    """Receptions lost because a process did not read."""
    missed_share: float = 0.0
    """Share of the last second's transmissions that were missed because this computer was too slow."""


class TrueMotion(Struct, frozen=True, array_like=True):
    """True position and velocity of a simulated tag."""

    position_m: Vector
    velocity_mps: Vector


class TruthMessage(Struct, frozen=True):
    """True motion of all simulated tags at one moment."""

    unix_s: float
    tags: dict[str, TrueMotion]


class RequestMessage(Struct, frozen=True):
    """A request for raw receptions; must be repeated before the lease ends."""

    by: str
    receptions: tuple[str, ...]
    """Names of tags; ``*`` means all of them. Empty ends the request."""
    lease_s: float
    stamps: bool = False
    """Whether anchors should publish their stamps (``StampsMessage``)."""


class Leases:
    """Leases on something that costs work or bandwidth: who holds one, and until when. Times are passed in."""

    def __init__(self) -> None:
        self._until_s: dict[str, float] = {}

    @property
    def are_held(self) -> bool:
        """Whether any lease is held, as of the last call with a time."""
        return bool(self._until_s)

    def holds(self, by: str) -> bool:
        """Whether this requester holds a lease."""
        return by in self._until_s

    def grant(self, by: str, lease_s: float, now_s: float) -> bool:
        """Begin or extend a lease; return False if too many are held."""
        self.expire(now_s)
        if by not in self._until_s and len(self._until_s) >= MAX_LEASES:
            return False
        self._until_s[by] = now_s + min(max(lease_s, 0.0), MAX_LEASE_S)
        return True

    def end(self, by: str) -> None:
        """End a lease early."""
        self._until_s.pop(by, None)

    def expire(self, now_s: float) -> None:
        """End the leases whose time is over."""
        for by in [by for by, until_s in self._until_s.items() if until_s <= now_s]:
            del self._until_s[by]


class RawReception(Struct, frozen=True, array_like=True):
    """One reception as the radio reported it; bytes are base64 in JSON."""

    frame: bytes
    rx_ticks: int
    host_s: float | None
    rx_power_dbm: float | None = None
    first_path_power_dbm: float | None = None
    carrier_offset_ppm: float | None = None
    carrier_phase_cycles: float | None = None


class ReceptionsMessage(Struct, frozen=True):
    """A run of receptions of one tag, none missing within a segment."""

    tag: str
    segment: str
    """A new segment begins when the run is interrupted; its first message has ``start``."""
    first: int
    """Number of the first reception within the segment; the next message continues where this one ends."""
    unix_less_host_s: float
    """What to add to ``host_s`` to get ``unix_s``."""
    receptions: tuple[RawReception, ...]
    start: "SegmentStart | None" = None
    """Only in the first message of a segment."""


class SegmentStart(Struct, frozen=True):
    """What a receiver of a segment's receptions needs besides them."""

    settings: dict[str, str | float | int | None]
    """Arguments of the receiver."""


class Zone(Struct, frozen=True):
    """A polygon on the floor."""

    id: str
    name: str
    polygon_m: tuple[tuple[float, float], ...]
    colour: str | None = None
    floor: int | None = None
    """Number of the zone's floor; None means all floors."""


class SiteZones(Struct, frozen=True):
    """The zones of one site."""

    site: str
    """The site's name."""
    zones: tuple[Zone, ...]


class ZonesMessage(Struct, frozen=True):
    """All zones of a site, retained."""

    zones: tuple[Zone, ...]
    site: str = ""
    """Name of the site for which they were drawn, as another site may have the same number; empty if unknown."""
    others: tuple[SiteZones, ...] = ()
    """Zones of other sites that had this number before, kept in case these sites return."""


class ZoneEvent(Struct, frozen=True):
    """A tag has entered or left a zone."""

    zone: str
    name: str
    tag: str
    kind: Literal["enter", "leave"]
    unix_s: float
    position_m: Vector


class TagZones(Struct, frozen=True):
    """The zones that a tag is in now, retained; published by the bridge that announces tags to Home Assistant."""

    tag: str
    unix_s: float
    """Time of the fix that led to this state."""
    usable: bool
    """Whether the tag has usable fixes; if not, it is in no zone."""
    zone: str | None = None
    """The id of the smallest zone."""
    name: str | None = None
    """The name of the smallest zone."""
    zones: tuple[str, ...] = ()
    """The ids of all zones, the smallest first."""
    by: str = ""
    """Name of the publishing bridge."""


class TagPosition(Struct, frozen=True):
    """A tag's position, retained; at most once a second and only if it has changed, for programs that store each."""

    tag: str
    unix_s: float
    """Time of the fix."""
    position_m: Vector
    std_m: float
    """One-sigma radial error, at least 1 cm in each axis."""
    horizontal_std_m: float
    """The same in the horizontal plane."""
    latitude_deg: float | None = None
    """WGS 84; None without a georeference of the site."""
    longitude_deg: float | None = None
    height_m: float | None = None
    """Above the ellipsoid."""


class Stamp(Struct, frozen=True, array_like=True):
    """One reception of an anchor by another."""

    anchor: int
    """The anchor that was received."""
    tx_ticks: int
    """The sender's TX stamp, as its frame states it, 40 bits."""
    rx_ticks: int
    """The publishing anchor's RX stamp, 40 bits."""
    carrier_phase_cycles: float | None = None
    """Phase of the carrier at this reception, in [0, 1), if it was measured."""


class StampsMessage(Struct, frozen=True):
    """An anchor's receptions of other anchors since its last message, in order."""

    anchor: int
    run: str
    """Changes when the anchor's counter has restarted."""
    unix_s: float
    stamps: tuple[Stamp, ...]
    missed: int = 0
    """Stamps dropped before these because nobody collected them in time."""


class SurveyFactsMessage(Struct, frozen=True):
    """Facts about a site from a user; they replace all earlier ones."""

    facts: Facts
    floor_plan: FloorPlanSite | None = None
    """Placement of the floor's image; ``image`` is empty for the image on MQTT."""
    by: str = ""


class SurveySaveMessage(Struct, frozen=True):
    """A request to use the result with this number: write the site file, and let the anchors adopt it."""

    by: str
    serial: int


class SurveyMessage(Struct, frozen=True):
    """State of the survey program."""

    unix_s: float
    serial: int
    """Number of the result; ``SurveySaveMessage`` names it."""
    anchors: tuple[int, ...]
    """Anchors that are received."""
    missing: tuple[int, ...]
    """Anchors of the site file that are not received."""
    duration_s: float
    pairs: tuple[PairRange, ...]
    facts: Facts
    survey: Survey | None
    """None while too few pairs are known."""
    error: str | None = None
    """A sentence: why there is no result, or why the last one could not be saved."""
    saved_serial: int | None = None
    """Number of the result that this run of the program saved last."""
    saved_unix_s: float | None = None
    """When that result was saved."""
    file: str | None = None
    """The site file that the program writes."""
    state: Literal["collecting", "surveyed", "no data"] = "collecting"
    """``no data``: no stamps have come for 5 s, so ``survey``, if present, is an earlier result."""
    by: str = ""
    """Name of this run of the program, by which two programs at one site notice each other."""


class PlacementMessage(Struct, frozen=True):
    """The site after a survey. An anchor adopts it if its own site is that before the survey, else ignores it."""

    unix_s: float
    before: str
    """Digest of the site before the survey (``site/digest.py``)."""
    site: Site
    earlier: tuple[str, ...] = ()
    """Digests of still earlier sites, the newest first: an anchor with an older file adopts the new site, too."""


class WatchFinding(Struct, frozen=True):
    """A change at the anchors since the survey."""

    kind: Literal["moved", "delay", "link", "check"]
    """An anchor has moved; its delay has changed; one link is blocked; something has changed, unclear what."""
    anchors: tuple[int, ...]
    """The anchor, or both ends of the link; for ``check`` those in question."""
    size_m: float
    std_m: float | None
    since_unix_s: float
    sentence: str


class WatchMessage(Struct, frozen=True):
    """The present findings of the watch over the anchors."""

    unix_s: float
    state: Literal["learning", "watching", "no data"]
    findings: tuple[WatchFinding, ...]
    pairs: int
    """Pairs of anchors that are watched."""


class Asset(Struct, frozen=True):
    """The thing or person that a tag is attached to."""

    tag: str
    """The tag's name."""
    name: str = ""
    """The asset's name; if empty, the tag's name is shown."""
    group: str = ""
    icon: str = ""
    """A few characters, such as an emoji."""
    colour: str = ""
    """``#rrggbb``; if empty, the group's colour."""
    owner: str = ""
    notes: str = ""


class AssetsMessage(Struct, frozen=True):
    """All assets of a site, retained."""

    assets: tuple[Asset, ...]
    site: str = ""
    """Name of the site, as another one may have the same number."""


class AlarmRulesMessage(Struct, frozen=True):
    """The alarm rules made on the page, retained; those of the site's file are in ``SiteMessage``."""

    rules: tuple[AlarmRule, ...]
    site: str = ""
    """Name of the site, as in ``AssetsMessage``."""


class AlarmMessage(Struct, frozen=True):
    """One alarm. Its topic names rule and subject, which together have one alarm at a time."""

    id: str
    """Identifies this occurrence: the rule, the subject and the time in milliseconds."""
    rule: str
    name: str
    """The rule's name."""
    kind: RuleKind
    severity: Severity
    subject: str
    """``<tag>``, ``<tag>~<tag>``, ``zone-<id>`` or ``anchor-<id>``."""
    since_unix_s: float
    """When the condition began to hold."""
    unix_s: float
    """When the alarm was raised."""
    sentence: str
    """Text for people: who, where, what; with the worst value so far, updated at most once a second."""
    tags: tuple[str, ...] = ()
    zone: str | None = None
    place: str = ""
    """Names of the tag's zones, or its coordinates."""
    position_m: Vector | None = None
    ended_unix_s: float | None = None
    acknowledged_unix_s: float | None = None
    acknowledged_by: str = ""
    worst: float | None = None
    """The worst value so far in the unit of the rule's limit, or for how many seconds the condition has held; None
    if there is no value, or if it is a protection level that cannot be computed."""


class AcknowledgeMessage(Struct, frozen=True):
    """Somebody has seen an alarm."""

    id: str
    """``id`` of the occurrence that was seen; others stay unacknowledged."""
    by: str
    unix_s: float


class WrongMessageError(ValueError):
    """A message does not fit its topic."""


def read_message(payload: bytes, kind: type[_T]) -> _T:
    """Decode a message from JSON. Raises WrongMessageError."""
    try:
        return msgspec.json.decode(payload, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise WrongMessageError(str(error)) from None


_AS_IN_THE_FIX: Final = (
    *("time_s", "std_m", "anchors", "chi2", "dof", "residual_rms_m", "method", "height_known", "hpl_m", "vpl_m"),
    *("integrity_risk", "verified_until_s", "unverified", "orientation", "heading_std_rad"),
)
"""Fields that a message takes from its fix unchanged."""


def fix_message(tag: str, serial: int, fix: "Fix", unix_s: float, latency_s: float) -> FixMessage:
    """Make the message of a fix; ``unix_s`` is the time at which its last frame ended."""
    dops = fix.dops
    moving = fix.velocity_mps is not None and fix.velocity_covariance is not None
    return FixMessage(
        tag=tag,
        serial=serial,
        unix_s=unix_s,
        position_m=vector(fix.position_m.tolist()),
        covariance_m2=_matrix(fix.covariance_m2.ravel().tolist()),
        velocity_mps=vector(fix.velocity_mps.tolist()) if moving else None,  # type: ignore[union-attr]
        velocity_covariance=_matrix(fix.velocity_covariance.ravel().tolist()) if moving else None,  # type: ignore[union-attr]
        gdop=dops.gdop,
        pdop=dops.pdop,
        hdop=dops.hdop,
        vdop=dops.vdop,
        latency_s=latency_s,
        alert=None if fix.alert is None else fix.alert.value,
        **{name: getattr(fix, name) for name in _AS_IN_THE_FIX},
    )


def vector(values: list[float]) -> Vector:
    """Three numbers as a tuple."""
    x, y, z = values
    return x, y, z


def _matrix(values: list[float]) -> Matrix:
    xx, xy, xz, yx, yy, yz, zx, zy, zz = values
    return xx, xy, xz, yx, yy, yz, zx, zy, zz


REACH_S: Final = 0.25
"""How long before and after its time a message is extrapolated along a straight line; a turning tag leaves the line by
then."""

_MAX_MESSAGES: Final = 64


class TruthBuffer:
    """Keeps the newest truth messages of an emulated air."""

    def __init__(self) -> None:
        self._truths: deque[TruthMessage] = deque(maxlen=_MAX_MESSAGES)

    def add(self, truth: TruthMessage) -> None:
        """Add a message. If it is older than the last one, as after the ether's restart, it replaces all."""
        if self._truths and truth.unix_s < self._truths[-1].unix_s:
            self._truths.clear()
        self._truths.append(truth)

    def at(self, tag: str, unix_s: float) -> Vector | None:
        """True position of a tag, extrapolated from the message nearest in time; None if none is near."""
        best, ahead_s = None, REACH_S
        for truth in reversed(self._truths):
            gap_s = unix_s - truth.unix_s
            if abs(gap_s) <= abs(ahead_s) and tag in truth.tags:
                best, ahead_s = truth.tags[tag], gap_s
            if gap_s > 0.0:
                break
        if best is None:
            return None
        (x, y, z), (vx, vy, vz) = best.position_m, best.velocity_mps
        return x + ahead_s * vx, y + ahead_s * vy, z + ahead_s * vz
