"""Which frames a tag admits: of the site in use, with stamps that are possible on its sender's and its own counter."""

from math import log as _log
from typing import Annotated, Final

from skyless.core.air.almanac import LONGEST_PERIOD_CODE
from skyless.core.air.beacon import BeaconFields
from skyless.core.air.frame import HEARD_BYTES, SHORT_BITS, two_bytes, unsigned
from skyless.core.air.neighbours import (
    OUT_OF_ORDER,
    STAMP_COUNTERS,
    STAMP_FITS,
    Neighbour,
    Neighbours,
    find_neighbour,
    forget_times,
    neighbour_of,
    unwrap_stamp,
)
from skyless.core.air.site_choice import (
    CHANGED,
    FOREIGN,
    NO_SITE,
    SiteChoice,
    choose_site,
    restart_choice,
)
from skyless.core.air.site_pages import SitePages
from skyless.core.estimator.process import Packet, Relays
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import AXES, State, find_anchor
from skyless.core.native.arithmetic import log, sqrt, square
from skyless.core.native.records import MAX_COUNTED, MAX_NEIGHBOURS, MAX_SITES, Integers, Record, Ticks, first, record
from skyless.core.tag.following import Course
from skyless.core.ticks import (
    FLIGHT_SLACK_TICKS,
    LAST_TICKS,
    NEVER,
    TICK_BITS,
    FixTime,
    Unwrapper,
    from_seconds,
    may_elapse,
    nearest,
    unwrap,
)

COUNTER_JUMP_TICKS: Final = from_seconds(1.0)
"""Two stamps in a row that go back farther than radios and hosts reorder them mean that the tag's own counter has
restarted; a single one is damaged."""

ADMITTED: Final = STAMP_FITS
FOREIGN_SITE, IMPOSSIBLE_HOST_TIME = range(len(STAMP_COUNTERS), len(STAMP_COUNTERS) + 2)
"""What becomes of a frame, beside what its stamp is."""
DROP_COUNTERS: Final = (*STAMP_COUNTERS, ("foreign-site",), ("impossible-host-time",))
"""By what each is counted."""

COUNTER_JUMPED, HOST_JUMPED, SITE_CHANGED = 1, 2, 4
"""What has happened: the tag's counter has restarted, its host's clock was set, or it uses another site."""


@record
class Admission(Record):
    """What a tag knows of its own counter, of sites and of anchors."""

    own: Unwrapper
    former: Unwrapper
    """``own`` before the frame at hand, restored where that is not admitted."""
    went_back: bool
    """Whether the stamp of the newest frame is from before others by more than ``COUNTER_JUMP_TICKS``."""
    choice: SiteChoice
    time: FixTime
    neighbours: Neighbours
    rx_ticks: Ticks
    """The tag's stamp of the frame at hand, unwrapped."""
    events: int
    """What has happened since its owner last looked."""


def admit_sender(a: Admission, site: int, anchor: int, rx_counter: Ticks, host_s: float) -> int:
    """Unwrap the tag's stamp of a frame, and find out whether its site is in use; ``ADMITTED`` or why not.

    ``host_s``: the host's time of it, NaN where that is not known.
    """
    a.former = a.own
    a.rx_ticks = unwrap(a.own, rx_counter, host_s)
    t, went_back = a.neighbours, a.went_back
    is_possible = -LAST_TICKS <= a.rx_ticks <= LAST_TICKS
    a.went_back = t.has_newest and a.rx_ticks < t.newest_rx_ticks - COUNTER_JUMP_TICKS
    if is_possible and a.went_back and not went_back:
        a.own = a.former
        return OUT_OF_ORDER
    if not is_possible or a.went_back:
        a.went_back = False
        forget_times(t)
        a.events |= COUNTER_JUMPED if is_possible else HOST_JUMPED
        restart_choice(a.choice, a.rx_ticks if is_possible else 0)
        if not is_possible:
            a.own.has_stamp = False
            return IMPOSSIBLE_HOST_TIME
    had_site = a.choice.site != NO_SITE
    use = choose_site(a.choice, site, anchor, a.rx_ticks)
    if use == FOREIGN:
        return FOREIGN_SITE
    if use == CHANGED and had_site:
        t.count, t.has_newest = 0, False
        a.events |= SITE_CHANGED
    return ADMITTED


def admit_stamp(a: Admission, anchor: int, sequence: int, tx_counter: Ticks, period_ticks: Ticks) -> int:
    """Unwrap the TX stamp of a frame of the site in use; ``ADMITTED`` or why it is not used."""
    stamp = unwrap_stamp(a.neighbours, anchor, sequence, tx_counter, a.rx_ticks, period_ticks)
    if stamp == STAMP_FITS:
        a.choice.heard_ticks = a.rx_ticks
    else:
        a.own = a.former
    return stamp


def check(a: Admission) -> None:
    """Check what compiled functions use as indices, in a record that may come from anywhere.

    Raises:
        ValueError: one is beyond its table.
    """
    limits = [
        ("anchors", a.neighbours.count, MAX_NEIGHBOURS),
        ("rows", a.neighbours.row + 1, MAX_NEIGHBOURS),
        ("sites", a.choice.count, MAX_SITES),
        ("failed sites", a.choice.failed_count, MAX_SITES),
        *(("bits other than a radio's", abs(one.bits - TICK_BITS), 0) for one in (a.own, a.former)),
        *(("anchors of a site", one.count, MAX_COUNTED) for one in first(a.choice.sites, MAX_SITES)),
        *(
            ("as a period's code", one.period_code, LONGEST_PERIOD_CODE)
            for one in first(a.neighbours.rows, MAX_NEIGHBOURS)
        ),
    ]
    for name, number, most in limits:
        if not 0 <= number <= most:
            raise ValueError(f"the receiver's state has {number} {name}; it can have up to {most}")


# Which anchors of a large site a tag uses: the strongest of those that other anchors receive too.

BETTER_DB: Final = 3.0
"""By which another anchor must be stronger to replace the weakest."""

MIN_FITTING: Final = 2
"""An anchor that relays this number of receptions of anchors in use, and they fit, is there."""

POWER_GAIN: Final = 0.1
"""Weight of the newest value in the running mean of an anchor's received power."""

MAX_POWER_DBM: Final = 1000.0
"""No radio reports more, nor less than its negative."""

NOMINAL_POWER_DBM: Final = -63.0
"""Assumed power at 1 m where the radio reports none, so that nearer anchors count as stronger."""
_DB_PER_LOG: Final = 20.0 / _log(10.0)
MM_PER_M: Final = 1000


def add_power(n: Neighbour, power_dbm: float) -> None:
    """Process the power of a beacon; NaN where the radio reports none."""
    if abs(power_dbm) <= MAX_POWER_DBM:
        n.power_dbm = n.power_dbm + POWER_GAIN * (power_dbm - n.power_dbm) if n.has_power else power_dbm
        n.has_power = True


def add_relays(t: Neighbours, b: BeaconFields, rx_ticks: Ticks) -> None:
    """Process what an anchor relays, so that it confirms others."""
    for begin in range(0, b.relay_bytes, HEARD_BYTES):
        anchor = two_bytes(b.relays, begin)
        row = neighbour_of(t, anchor, rx_ticks)
        t.rows[row].relayed_ticks = rx_ticks
        t.rows[row].own_relays_ticks = NEVER


def fitting_relays(t: Neighbours, s: State, b: BeaconFields, rx_ticks: Ticks) -> int:
    """How many receptions that an anchor relays fit what the tag has received itself: so it really receives them.

    Only packets of anchors in use count. A reception fits if, on the anchor's counter, it lies as long before its own
    frame as on the tag's, to 1 µs (300 m) and the drift of crystals.
    """
    fitting, bits = 0, SHORT_BITS if b.has_phases else TICK_BITS
    tx_ticks = t.rows[t.row].tx_ticks
    for begin in range(0, b.relay_bytes, HEARD_BYTES):
        anchor = two_bytes(b.relays, begin)
        row = find_neighbour(t, anchor)
        if row >= 0 and t.rows[row].frames > 0 and t.rows[row].sequence == b.relays[begin + 2]:
            elapsed = rx_ticks - t.rows[row].rx_ticks
            received_ticks = nearest(unsigned(b.relays, begin + 3, bits // 8), tx_ticks - elapsed, bits)
            if find_anchor(s, anchor) >= 0 and may_elapse(tx_ticks - received_ticks, elapsed, FLIGHT_SLACK_TICKS):
                fitting += 1
    return fitting


def replaced_by(t: Neighbours, s: State, origin_mm: Integers) -> int:
    """The index of the anchor in use that the newest anchor should replace: the weakest; −1 where none is weaker."""
    weakest, least_dbm = -1, _power_dbm(t.rows[t.row], s, origin_mm) - BETTER_DB
    for index in range(s.count):
        row = find_neighbour(t, s.anchors[index].identifier)
        if row >= 0 and t.rows[row].has_place and _power_dbm(t.rows[row], s, origin_mm) < least_dbm:
            weakest, least_dbm = index, _power_dbm(t.rows[row], s, origin_mm)
    return weakest


def _power_dbm(n: Neighbour, s: State, origin_mm: Integers) -> float:
    """The mean power of an anchor or, where the radio reports none, a nominal one at its distance."""
    if n.has_power:
        return n.power_dbm
    total = 0.0
    for axis in range(s.dim):
        total += square(place_m(n, origin_mm, axis) - s.x[axis])
    return NOMINAL_POWER_DBM - _DB_PER_LOG * log(max(sqrt(total), 0.1))


def place_m(n: Neighbour, origin_mm: Integers, axis: int) -> float:
    """A coordinate of an anchor from the origin."""
    return (n.place.position_mm[axis] - origin_mm[axis]) / MM_PER_M


# What a tag of protocol 2 keeps beside its filter (``State``) and its search for a start (``Acquisition``).


@record
class Tag(Record):
    """A tag of protocol 2."""

    owner: EstimatorSettings
    """What its owner has chosen; the site's pages state the rest."""
    admission: Admission
    pages: SitePages
    course: Course
    has_settings: bool
    """Whether the pages are known, so that it looks for a start or follows its course."""
    period_ticks: Ticks
    """Longest mean time between two beacons of an anchor, when the settings were made."""
    is_moving: bool
    """Whether anchors of the site have stated other positions recently (``Neighbour.has_moved``)."""
    moved_ticks: Ticks
    """When the last one did."""
    uses_moved: bool
    """Whether those are in use, and not the others."""
    origin_mm: Annotated[Integers, AXES]
    """To be added to all positions, where ``HAS_ORIGIN``."""
    has_origin: bool
    most_relays: int
    """Of a beacon that follows its course, the newest ones: fewer where its processor is late."""
    # The beacon at hand
    beacon: BeaconFields
    has_moved: bool
    """Whether its sender states another position than before."""
    packet: Packet
    """The same for the filter."""
    relays: Relays
    events: int
    """What has happened with it (``admission.COUNTER_JUMPED`` and others)."""
