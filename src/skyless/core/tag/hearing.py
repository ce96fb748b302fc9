"""A tag of protocol 2: from a frame's bytes to a fix."""

from typing import Final

from skyless.core.air.beacon_fields import INTACT, read_frame
from skyless.core.air.first_path import variance_factor
from skyless.core.air.frame import HEARD_BYTES
from skyless.core.air.instants import period_ticks
from skyless.core.air.neighbours import Neighbour, StatedPlace, is_relayed
from skyless.core.air.site_choice import MIN_ANCHORS, note_fix
from skyless.core.constants import TICK_S
from skyless.core.estimator.state import AXES, State, find_anchor
from skyless.core.native.records import Bytes, Ticks
from skyless.core.native.sizes import HAS_ORIGIN
from skyless.core.tag.acquisition import Acquisition
from skyless.core.tag.admission import ADMITTED, admit_sender, admit_stamp
from skyless.core.tag.changes import handle_events, process_rare
from skyless.core.tag.course import FIX
from skyless.core.tag.following import START_FIX, follow
from skyless.core.tag.selection import MIN_FITTING, MM_PER_M, add_power, add_relays, fitting_relays, place_m
from skyless.core.tag.tag import Tag
from skyless.core.ticks import NEVER

MALFORMED: Final = 40
"""The bytes are no beacon; the fault's number is added."""


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
    """Process a frame from the air; what becomes of it.

    That is one of ``DROP_COUNTERS``, of ``course.py``, ``following.py`` or ``changes.py``, or ``MALFORMED`` and more.
    ``host_s`` and the powers are NaN, and the phase is below 0, where they are not known.
    """
    fault = read_frame(frame, length, t.beacon)
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
    """The same of a beacon that has been read already; its page stands in ``frame``."""
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
    """Process a beacon that is admitted."""
    c, b = t.course, t.beacon
    is_new = t.has_moved or t.is_moving or b.almanac_issue != t.pages.issue or not n.has_place
    if c.is_starting or is_new or find_anchor(s, b.anchor) < 0:
        return process_rare(t, s, q, frame)
    n.used_ticks = t.admission.rx_ticks
    relay_bytes = min(b.relay_bytes, t.most_relays * HEARD_BYTES)
    return follow(c, s, q, t.admission.time, t.packet, t.relays, b.relays, relay_bytes)


def _confirm(t: Tag, s: State) -> bool:
    """Process which anchors a beacon confirms by its relays; whether other anchors confirm its sender.

    Only then its pages take part in the majority, and its relays confirm others.
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
    """Whether fewer anchors in use are still received than a fix takes, so that relays of any anchor confirm.

    A tag may come to where none of its anchors is received, nor receives the next ones: out of a lift.
    """
    heard = 0
    for anchor in range(s.count):
        a = s.anchors[anchor]
        if a.packets > 0 and (rx_ticks - a.rx_ticks) * TICK_S <= s.settings.drop_s:
            heard += 1
    return heard < MIN_ANCHORS


def keep_place(n: Neighbour, place: StatedPlace) -> bool:
    """Keep where an anchor says that it is; whether that is used from now on instead of another place."""
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
    """Write the beacon at hand as the filter takes it, but for its relays."""
    packet, place = t.packet, t.packet.place
    if HAS_ORIGIN and n.has_place and not t.has_origin:
        t.has_origin = True
        for axis in range(2):
            t.origin_mm[axis] = n.place.position_mm[axis] // MM_PER_M * MM_PER_M
    place.anchor, place.std_m, place.is_open = n.anchor, n.place.std_mm / MM_PER_M, n.is_misfit
    for axis in range(AXES):
        place.position_m[axis] = place_m(n, t.origin_mm, axis)
    packet.sequence, packet.rx_ticks, packet.tx_ticks = n.sequence, t.admission.rx_ticks, n.tx_ticks
    packet.variance_factor, packet.master, t.relays.count = factor, -1, 0
    packet.report_variance_m2, packet.relays_have_phases = 0.0, t.beacon.has_phases
