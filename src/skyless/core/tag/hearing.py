"""A tag of protocol 2: from a frame's bytes to a fix."""

from typing import Final

from skyless.core.air.almanac import period_ticks
from skyless.core.air.beacon import INTACT, MAX_HEARD, read_frame
from skyless.core.air.frame import HEARD_BYTES, signed, variance_factor
from skyless.core.air.neighbours import (
    Neighbour,
    StatedPlace,
    find_neighbour,
    is_confirmed,
    is_present,
    is_relayed,
    wake_times,
)
from skyless.core.air.site_choice import note_fix, restart_choice
from skyless.core.air.site_pages import (
    ACCURACY_KIND,
    HEIGHT_FLAG_AT,
    HEIGHT_GIVEN,
    MIN_ANCHORS,
    NO_ISSUE,
    NOISE_KIND,
    OTHER_SETTINGS,
    SITE_KIND,
    SitePages,
    note_page,
)
from skyless.core.estimator.process import leave, take_relays
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import AXES, State, at, find_anchor
from skyless.core.integrity import horizontal_limit, vertical_limit
from skyless.core.native.arithmetic import floor, sqrt
from skyless.core.native.records import HAS_ORIGIN, MAX_ANCHORS_IN_USE, Bytes, Ticks
from skyless.core.tag.acquisition import Acquisition, forget_all, forget_packets, gather_packet
from skyless.core.tag.admission import (
    ADMITTED,
    MIN_FITTING,
    MM_PER_M,
    SITE_CHANGED,
    Admission,
    Tag,
    add_power,
    add_relays,
    admit_sender,
    admit_stamp,
    fitting_relays,
    place_m,
    replaced_by,
)
from skyless.core.tag.following import FIX, START_FIX, Course, begin_course, follow
from skyless.core.tag.joint import fill_ages, read_accuracy
from skyless.core.ticks import NEVER, TICK_RATE_HZ, TICK_S, from_seconds

# What changes rarely for a tag: its site, the site's pages, its counter, anchors that move or join.

MOVED_HOLD_TICKS: Final = from_seconds(0.3)
MOVE_TICKS: Final = from_seconds(10.0)
"""A survey moves all anchors of a site, some of them seconds after the others, and positions from before and after it
must not be mixed. So a tag uses either the anchors that have stated another position or those that have not, until none
has moved for ``MOVE_TICKS``. It switches to the moved ones once they are the majority and none has moved for
``MOVED_HOLD_TICKS``."""

NO_PAGES, MOVED_ANCHOR, NO_POSITION, UNCONFIRMED_ANCHOR, WEAKER_ANCHOR = range(30, 35)
"""Further outcomes of a beacon (see ``following.py``)."""
JOINS: Final = 0


# Start, wake, counter restarts


def begin_tag(
    t: Tag,
    site: int,
    qa: float,
    lowest_m: float,
    highest_m: float,
    height_std_m: float,
    integrity_risk: float,
    alert_limit_m: float,
) -> None:
    """Initialise a tag that listens to one site or, with ``NO_SITE``, to the one with most anchors.

    The other arguments are fields of ``EstimatorSettings``.
    """
    t.owner = EstimatorSettings()
    t.admission = Admission()
    t.pages = SitePages()
    t.course = Course()
    t.owner.qa, t.owner.lowest_m, t.owner.highest_m = qa, lowest_m, highest_m
    t.owner.height_std_m, t.owner.integrity_risk, t.owner.alert_limit_m = height_std_m, integrity_risk, alert_limit_m
    t.admission.choice.only_site = site
    t.course.most_anchors = MAX_ANCHORS_IN_USE
    t.course.horizontal_k, t.course.vertical_k = horizontal_limit(integrity_risk), vertical_limit(integrity_risk)
    t.has_settings = t.has_origin = False
    t.most_relays = MAX_HEARD
    _forget_moves(t)


def wake(t: Tag, s: State, q: Acquisition, rx_counter: Ticks, slept_s: float) -> None:
    """Start again at the same site and near the same height after a sleep in which the tag's counter was lost.

    ``rx_counter`` is the counter's present reading.
    """
    a, c = t.admission, t.course
    had_height = not c.is_starting and c.dim == AXES
    height_m, std_m = 0.0, 0.0
    if had_height:
        height_m, std_m = s.x[2], sqrt(s.P[at(2, 2)]) + slept_s * c.settings.start_speed_std_mps
    wake_times(a.neighbours, a.rx_ticks, rx_counter)
    restart_choice(a.choice, rx_counter)
    a.own.has_stamp = a.went_back = False
    a.time.first_ticks_master += rx_counter - a.time.last_ticks_master - floor(slept_s * TICK_RATE_HZ)
    a.time.last_ticks_master = a.time.last_rx_ticks_tag = rx_counter
    _forget_stamps(t, q)
    if had_height:
        q.has_bounds = True
        q.low_m, q.high_m = height_m - c.settings.gate * std_m, height_m + c.settings.gate * std_m


def handle_events(t: Tag, q: Acquisition) -> None:
    """Forget what the current beacon's events have made invalid."""
    t.events, t.admission.events = t.admission.events, 0
    if t.events & SITE_CHANGED != 0:
        t.pages = SitePages()
        t.has_origin = False
    if t.events != 0:
        _forget_stamps(t, q)


def _forget_stamps(t: Tag, q: Acquisition) -> None:
    """Forget everything but the site's own data, because the tag's counter has restarted."""
    t.pages.has_first = t.has_settings = False
    t.course.is_starting = True
    forget_all(q)
    _forget_moves(t)
    if t.pages.issue != NO_ISSUE:
        _begin_here(t, q)


# The site's pages


def _read_pages(t: Tag) -> None:
    """Derive the settings from the pages in use."""
    c, site = t.course, t.pages.used[SITE_KIND].contents
    c.settings = t.owner
    read_accuracy(c.settings, t.pages.used[NOISE_KIND].contents, t.pages.used[ACCURACY_KIND].contents)
    c.superframe_s = t.period_ticks * TICK_S
    fill_ages(c.settings, c.superframe_s)
    c.dim = AXES
    if site[HEIGHT_FLAG_AT] & HEIGHT_GIVEN != 0:
        c.settings.height_m, c.dim = signed(site, HEIGHT_FLAG_AT + 1) / MM_PER_M, AXES - 1


def _begin_here(t: Tag, q: Acquisition) -> None:
    """Start with the pages in use."""
    _read_pages(t)
    begin_course(t.course, q)
    t.has_settings = True


def _begin_with_pages(t: Tag, q: Acquisition) -> None:
    """Start with the pages in use and the longest period of the anchors that are present."""
    newest_ticks: Ticks = 0
    neighbours = t.admission.neighbours
    for row in range(neighbours.count):
        if neighbours.rows[row].frames > 0:
            newest_ticks = max(newest_ticks, neighbours.rows[row].rx_ticks)
    t.period_ticks = 0
    for row in range(neighbours.count):
        n = neighbours.rows[row]
        if n.frames > 0 and is_present(n, newest_ticks):
            t.period_ticks = max(t.period_ticks, period_ticks(n.period_code))
    if t.course.is_starting:
        _forget_unconfirmed(t, q)
    _begin_here(t, q)


def _forget_unconfirmed(t: Tag, q: Acquisition) -> None:
    """Forget the packets of anchors that no other anchor confirms."""
    neighbours = t.admission.neighbours
    for place in range(q.count - 1, -1, -1):
        anchor = q.heard[place].newer.packet.place.anchor
        row = find_neighbour(neighbours, anchor)
        if row < 0 or not is_confirmed(neighbours.rows[row], t.admission.rx_ticks):
            forget_packets(q, anchor)


# Beacons that are more than the next one of an anchor in use


def process_rare(t: Tag, s: State, q: Acquisition, frame: Bytes) -> int:
    """Process the current beacon while something is new: page, anchor, position or start. Returns the outcome."""
    a, c = t.admission, t.course
    n = a.neighbours.rows[a.neighbours.row]
    was_starting = c.is_starting
    if note_page(t.pages, a.neighbours, frame, t.beacon.page_at, a.rx_ticks) == OTHER_SETTINGS:
        _begin_with_pages(t, q)
    if t.has_moved:
        _separate_moved(t, s, q, n)
    _follow_moves(t, q, n)
    if _is_kept_apart(t, n):
        return MOVED_ANCHOR
    if not t.has_settings:
        if n.has_place:  # other anchors may confirm this one before the pages are complete
            take_relays(t.packet, t.relays, t.beacon.relays, t.beacon.relay_bytes)
            gather_packet(q, t.packet, t.relays)
        return NO_PAGES
    if not n.has_place:
        return NO_POSITION
    outcome = _join(t, s, n)
    if outcome != JOINS:
        return outcome
    outcome = follow(c, s, q, a.time, t.packet, t.relays, t.beacon.relays, t.beacon.relay_bytes)
    if was_starting and not c.is_starting:  # from now on only what anchors in use have received or relayed counts
        for row in range(a.neighbours.count):
            other = a.neighbours.rows[row]
            other.relayed_ticks = other.own_relays_ticks = NEVER
            other.is_misfit = other.anchor == c.misfit
    return outcome


def _join(t: Tag, s: State, n: Neighbour) -> int:
    """Return ``JOINS`` if an anchor is in use or may be: others confirm it, and it is no weaker than those in use."""
    c = t.course
    if not c.is_starting and find_anchor(s, n.anchor) >= 0:
        return JOINS
    if not is_confirmed(n, t.admission.rx_ticks):
        return UNCONFIRMED_ANCHOR
    if c.is_starting or s.count < MAX_ANCHORS_IN_USE:
        return JOINS
    replaced = replaced_by(t.admission.neighbours, s, t.origin_mm)
    if replaced < 0:
        return WEAKER_ANCHOR
    leave(s, s.anchors[replaced].identifier)
    return JOINS


# Anchors that have moved


def _forget_moves(t: Tag) -> None:
    """Use all anchors together again."""
    t.is_moving, t.uses_moved, t.moved_ticks = False, False, NEVER
    for row in range(t.admission.neighbours.count):
        t.admission.neighbours.rows[row].has_moved = False


def _separate_moved(t: Tag, s: State, q: Acquisition, n: Neighbour) -> None:
    """Take an anchor that states another position out of use. If too few anchors are left, start again."""
    if t.uses_moved and n.has_moved:  # the anchors in use move a second time
        _forget_moves(t)
    n.has_moved, t.is_moving = True, True
    t.moved_ticks = max(t.moved_ticks, t.admission.rx_ticks)
    if t.course.is_starting:
        forget_packets(q, n.anchor)
    else:
        leave(s, n.anchor)
        if s.count < MIN_ANCHORS:
            _begin_with_pages(t, q)


def _follow_moves(t: Tag, q: Acquisition, n: Neighbour) -> None:
    """End a move that is over, and start again with the moved anchors once they are the majority."""
    calm_ticks = t.admission.rx_ticks - t.moved_ticks
    if t.is_moving and calm_ticks >= MOVE_TICKS:
        _forget_moves(t)
    elif t.is_moving and not t.uses_moved and n.has_moved and calm_ticks >= MOVED_HOLD_TICKS and _have_most_moved(t):
        t.uses_moved = True
        forget_all(q)
        if t.has_settings:
            _begin_with_pages(t, q)


def _is_kept_apart(t: Tag, n: Neighbour) -> bool:
    """Whether an anchor states its position before a move while the anchors in use have moved, or the reverse."""
    return t.is_moving and n.has_moved != t.uses_moved


def _have_most_moved(t: Tag) -> bool:
    """Whether most of the present anchors with a position have moved."""
    present, moved = 0, 0
    for row in range(t.admission.neighbours.count):
        n = t.admission.neighbours.rows[row]
        if n.has_place and n.was_relayed and is_present(n, t.admission.rx_ticks):
            present += 1
            moved += 1 if n.has_moved else 0
    return 2 * moved > present


MALFORMED: Final = 40
"""Added to the fault's number if the bytes are no beacon."""


def hear_frame(
    t: Tag,
    s: State,
    q: Acquisition,
    frame: Bytes,
    length: int,
    rx_counter: Ticks,
    host_s: float,
    rx_power_dbm: float,
    first_path_power_dbm: float,
    phase_cycles: float,
) -> int:
    """Process a frame from the air. Returns the outcome.

    That is one of ``DROP_COUNTERS``, of the outcomes in ``following.py`` or here, or ``MALFORMED`` plus a fault.
    If unknown, ``host_s`` and the powers are NaN and the phase is negative.
    """
    fault = read_frame(frame, length, t.beacon)
    t.packet.report_variance_m2 = 0.0  # only protocol 1 has reports
    if fault != INTACT:
        return MALFORMED + fault
    return hear_fields(t, s, q, frame, rx_counter, host_s, rx_power_dbm, first_path_power_dbm, phase_cycles)


def hear_fields(
    t: Tag,
    s: State,
    q: Acquisition,
    frame: Bytes,
    rx_counter: Ticks,
    host_s: float,
    rx_power_dbm: float,
    first_path_power_dbm: float,
    phase_cycles: float,
) -> int:
    """Process a beacon that has been decoded into ``t.beacon``, with its page in ``frame``. Returns the outcome."""
    a, b = t.admission, t.beacon
    outcome = admit_sender(a, b.site, b.anchor, rx_counter, host_s)
    if outcome == ADMITTED:
        outcome = admit_stamp(a, b.anchor, b.sequence, b.tx_ticks, period_ticks(b.period_code))
    handle_events(t, q)
    if outcome != ADMITTED:
        return outcome
    n = a.neighbours.rows[a.neighbours.row]
    add_power(n, rx_power_dbm)
    n.was_relayed = _confirm(t, s)
    n.almanac_issue, n.period_code = b.almanac_issue, b.period_code
    t.has_moved = b.has_place and keep_place(n, b.place)
    _fill_packet(t, n, variance_factor(rx_power_dbm, first_path_power_dbm))
    t.packet.has_phase, t.packet.phase_cycles = phase_cycles >= 0.0, phase_cycles
    outcome = _hear_admitted(t, s, q, n, frame)
    if outcome in (FIX, START_FIX):
        note_fix(a.choice, a.rx_ticks)
    return outcome


def _hear_admitted(t: Tag, s: State, q: Acquisition, n: Neighbour, frame: Bytes) -> int:
    """Process an admitted beacon. Returns the outcome."""
    c, b = t.course, t.beacon
    is_new = t.has_moved or t.is_moving or b.almanac_issue != t.pages.issue or not n.has_place
    if c.is_starting or is_new or find_anchor(s, b.anchor) < 0:
        return process_rare(t, s, q, frame)
    n.used_ticks = t.admission.rx_ticks
    relay_bytes = min(b.relay_bytes, t.most_relays * HEARD_BYTES)
    return follow(c, s, q, t.admission.time, t.packet, t.relays, b.relays, relay_bytes)


def _confirm(t: Tag, s: State) -> bool:
    """Record the anchors this beacon confirms. Return True if its own sender is confirmed by others.

    Only then do its pages count for the majority and its relays confirm others.
    """
    b, rows, rx_ticks, is_starting = t.beacon, t.admission.neighbours, t.admission.rx_ticks, t.course.is_starting
    n = rows.rows[rows.row]
    in_use = not is_starting and find_anchor(s, b.anchor) >= 0
    by_others = is_relayed(n, rx_ticks) or (in_use and n.own_relays_ticks == NEVER)
    if by_others or is_starting or _has_too_few(s, rx_ticks):
        add_relays(rows, b, rx_ticks)
    elif fitting_relays(rows, s, b, rx_ticks) >= MIN_FITTING:
        n.own_relays_ticks = rx_ticks
    return by_others


def _has_too_few(s: State, rx_ticks: Ticks) -> bool:
    """Whether fewer anchors in use are still received than a fix needs, so that relays of any anchor confirm.

    This lets a tag go on where none of its anchors is received or receives the new ones, such as after a lift.
    """
    heard = 0
    for anchor in range(s.count):
        a = s.anchors[anchor]
        if a.packets > 0 and (rx_ticks - a.rx_ticks) * TICK_S <= s.settings.drop_s:
            heard += 1
    return heard < MIN_ANCHORS


def keep_place(n: Neighbour, place: StatedPlace) -> bool:
    """Keep the position that an anchor states. Return True if it is used from now on instead of another one.

    Another position is used once it has been stated twice in a row.
    """
    if n.has_place and _is_same(n.place, place):
        n.has_other = False
        return False
    has_moved = n.has_place and n.has_other and _is_same(n.other, place)
    if has_moved or not n.has_place:
        n.place, n.has_place, n.has_other = place, True, False
    else:
        n.other, n.has_other = place, True
    return has_moved


def _is_same(one: StatedPlace, other: StatedPlace) -> bool:
    for axis in range(AXES):
        if one.position_mm[axis] != other.position_mm[axis]:
            return False
    return one.std_mm == other.std_mm and one.floor == other.floor and one.zone == other.zone


def _fill_packet(t: Tag, n: Neighbour, factor: float) -> None:
    """Fill ``t.packet`` from the current beacon, without its relays."""
    packet, place = t.packet, t.packet.place
    if HAS_ORIGIN and n.has_place and not t.has_origin:
        t.has_origin = True
        for axis in range(2):
            t.origin_mm[axis] = n.place.position_mm[axis] // MM_PER_M * MM_PER_M
    place.anchor, place.std_m, place.is_open = n.anchor, n.place.std_mm / MM_PER_M, n.is_misfit
    for axis in range(AXES):
        place.position_m[axis] = place_m(n, t.origin_mm, axis)
    packet.sequence, packet.rx_ticks, packet.tx_ticks = n.sequence, t.admission.rx_ticks, n.tx_ticks
    packet.variance_factor, t.relays.count, packet.relays_have_phases = factor, 0, t.beacon.has_phases
