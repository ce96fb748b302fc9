"""Which frames a tag accepts: those of its site whose stamps are possible on the sender's and on its own counter."""

from math import log as _log
from typing import Annotated, Final

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
from skyless.core.air.site_choice import CHANGED, FOREIGN, NO_SITE, SiteChoice, choose_site, restart_choice
from skyless.core.air.site_pages import SitePages
from skyless.core.estimator.process import Packet, Relays
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import AXES, State, find_anchor
from skyless.core.native.arithmetic import log, sqrt, square
from skyless.core.native.records import Integers, Record, Ticks, record
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
"""Two consecutive stamps that go back by more than radios and hosts reorder them mean that the tag's own counter has
restarted; a single one is damaged."""

ADMITTED: Final = STAMP_FITS
FOREIGN_SITE, IMPOSSIBLE_HOST_TIME = range(len(STAMP_COUNTERS), len(STAMP_COUNTERS) + 2)
"""Further outcomes of a frame, beside those of its stamp."""
DROP_COUNTERS: Final = (*STAMP_COUNTERS, ("foreign-site",), ("impossible-host-time",))
"""Counter of each outcome."""

COUNTER_JUMPED, HOST_JUMPED, SITE_CHANGED = 1, 2, 4
"""Events: the tag's counter has restarted, its host's clock was set, or it uses another site."""


@record
class Admission(Record):
    """What a tag knows of its own counter, of the sites and of the anchors."""

    own: Unwrapper
    former: Unwrapper
    """``own`` before the current frame; restored if that is rejected."""
    went_back: bool
    """Whether the newest frame's stamp is earlier than others by more than ``COUNTER_JUMP_TICKS``."""
    choice: SiteChoice
    time: FixTime
    neighbours: Neighbours
    rx_ticks: Ticks
    """The tag's unwrapped stamp of the current frame."""
    events: int
    """Events since the owner last looked."""


def admit_sender(a: Admission, site: int, anchor: int, rx_counter: Ticks, host_s: float) -> int:
    """Unwrap the tag's stamp of a frame and check its site. Returns ``ADMITTED`` or why it is rejected.

    ``host_s``: the host's time of reception, NaN if unknown.
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
    """Unwrap the TX stamp of a frame of the site in use. Returns ``ADMITTED`` or why it is rejected."""
    stamp = unwrap_stamp(a.neighbours, anchor, sequence, tx_counter, a.rx_ticks, period_ticks)
    if stamp == STAMP_FITS:
        a.choice.heard_ticks = a.rx_ticks
    else:
        a.own = a.former
    return stamp


# Which anchors of a large site a tag uses: the strongest of those that other anchors receive too

BETTER_DB: Final = 3.0
"""An anchor replaces the weakest one if it is stronger by this."""

MIN_FITTING: Final = 2
"""An anchor exists if it relays at least this many receptions of anchors in use that fit."""

POWER_GAIN: Final = 0.1
"""Weight of the newest value in the running mean of an anchor's received power."""

MAX_POWER_DBM: Final = 1000.0
"""Larger magnitudes are not a radio's power."""

NOMINAL_POWER_DBM: Final = -63.0
"""Assumed power at 1 m if the radio reports none, so that nearer anchors count as stronger."""
_DB_PER_LOG: Final = 20.0 / _log(10.0)
MM_PER_M: Final = 1000


def add_power(n: Neighbour, power_dbm: float) -> None:
    """Update an anchor's mean power; NaN if the radio reports none."""
    if abs(power_dbm) <= MAX_POWER_DBM:
        n.power_dbm = n.power_dbm + POWER_GAIN * (power_dbm - n.power_dbm) if n.has_power else power_dbm
        n.has_power = True


def add_relays(t: Neighbours, b: BeaconFields, rx_ticks: Ticks) -> None:
    """Mark the anchors that a beacon relays as confirmed."""
    for begin in range(0, b.relay_bytes, HEARD_BYTES):
        anchor = two_bytes(b.relays, begin)
        row = neighbour_of(t, anchor, rx_ticks)
        t.rows[row].relayed_ticks = rx_ticks
        t.rows[row].own_relays_ticks = NEVER


def fitting_relays(t: Neighbours, s: State, b: BeaconFields, rx_ticks: Ticks) -> int:
    """Number of relayed receptions consistent with the tag's own, which proves that the anchor really receives them.

    Only packets of anchors in use count. A reception fits if it precedes the anchor's own frame by as much on the
    anchor's counter as on the tag's, to 1 µs (300 m) and the drift of crystals.
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
    """Index of the weakest anchor in use if the newest anchor should replace it, otherwise −1."""
    weakest, least_dbm = -1, _power_dbm(t.rows[t.row], s, origin_mm) - BETTER_DB
    for index in range(s.count):
        row = find_neighbour(t, s.anchors[index].identifier)
        if row >= 0 and t.rows[row].has_place and _power_dbm(t.rows[row], s, origin_mm) < least_dbm:
            weakest, least_dbm = index, _power_dbm(t.rows[row], s, origin_mm)
    return weakest


def _power_dbm(n: Neighbour, s: State, origin_mm: Integers) -> float:
    """The mean power of an anchor; if the radio reports none, a nominal one at its distance."""
    if n.has_power:
        return n.power_dbm
    total = 0.0
    for axis in range(s.dim):
        total += square(place_m(n, origin_mm, axis) - s.x[axis])
    return NOMINAL_POWER_DBM - _DB_PER_LOG * log(max(sqrt(total), 0.1))


def place_m(n: Neighbour, origin_mm: Integers, axis: int) -> float:
    """A coordinate of an anchor relative to the origin."""
    return (n.place.position_mm[axis] - origin_mm[axis]) / MM_PER_M


# A tag's state beside its filter (``State``) and its search for a start (``Acquisition``)


@record
class Tag(Record):
    """A tag of protocol 2."""

    owner: EstimatorSettings
    """Settings chosen by the tag's owner; the site's pages state the rest."""
    admission: Admission
    pages: SitePages
    course: Course
    has_settings: bool
    """Whether the pages are known, so that the tag searches for a start or has a filter."""
    period_ticks: Ticks
    """Longest mean beacon period of an anchor when the settings were derived."""
    is_moving: bool
    """Whether anchors have stated other positions recently (``Neighbour.has_moved``)."""
    moved_ticks: Ticks
    """Time of the last such statement."""
    uses_moved: bool
    """Whether the moved anchors are in use rather than the others."""
    origin_mm: Annotated[Integers, AXES]
    """Origin of all positions, if ``HAS_ORIGIN``."""
    has_origin: bool
    most_relays: int
    """Relays used of each beacon while there is a filter, newest first: fewer on a processor that falls behind."""
    # The current beacon
    beacon: BeaconFields
    has_moved: bool
    """Whether its sender states another position than before."""
    packet: Packet
    """The beacon as the filter takes it."""
    relays: Relays
    events: int
    """Its events (``COUNTER_JUMPED`` and others)."""
