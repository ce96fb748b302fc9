"""A tag of protocol 2: from a frame's bytes to a fix, as long as it knows its site and where it is.

What is rare is left to its owner (``Receiver``): pages of the site, starts, anchors that join or have moved.
"""

from typing import Final

from skyless.core.air.beacon_fields import INTACT, BeaconFields, read_frame
from skyless.core.air.first_path import variance_factor
from skyless.core.air.instants import period_ticks
from skyless.core.air.neighbours import Neighbour, StatedPlace, is_relayed
from skyless.core.air.site_choice import MIN_ANCHORS, note_fix
from skyless.core.constants import TICK_S
from skyless.core.estimator.process import Packet
from skyless.core.estimator.state import AXES, State, find_anchor
from skyless.core.native.records import Bytes, Record, Ticks, record
from skyless.core.tag.admission import ADMITTED, Admission, admit_sender, admit_stamp
from skyless.core.tag.course import FIX, Course, is_surely_in_reach, process_in_course
from skyless.core.tag.selection import MIN_FITTING, add_power, add_relays, fitting_relays
from skyless.core.ticks import NEVER

IS_RARE: Final = 30
"""A beacon is admitted, and its sender's row is up to date; the rest is its owner's."""
MALFORMED: Final = 40
"""The bytes are no beacon; the fault's number is added."""
NO_ISSUE: Final = -1
_MM_PER_M: Final = 1000


@record
class Hearing(Record):
    """What a tag of protocol 2 keeps beside its filter."""

    admission: Admission
    beacon: BeaconFields
    """The one at hand."""
    packet: Packet
    """The same for the filter."""
    almanac_issue: int = NO_ISSUE
    """Issue of the pages in use."""
    is_starting: bool = True
    """Whether it does not know where it is."""
    is_moving: bool
    """Whether anchors of the site have moved recently."""
    has_moved: bool
    """Whether the sender of the beacon at hand has."""


def hear_frame(
    h: Hearing,
    c: Course,
    s: State,
    frame: Bytes,
    length: int,
    rx_counter: Ticks,
    host_s: float,
    rx_power_dbm: float,
    first_path_power_dbm: float,
    phase_cycles: float,
) -> int:
    """Process a frame from the air; what becomes of it: of ``DROP_COUNTERS``, of a course, or one of the above.

    ``host_s`` and the powers are NaN, and the phase is below 0, where they are not known. Course
    and state are not used while it is starting.
    """
    fault = read_frame(frame, length, h.beacon)
    if fault != INTACT:
        return MALFORMED + fault
    return hear_fields(h, c, s, rx_counter, host_s, rx_power_dbm, first_path_power_dbm, phase_cycles)


def hear_fields(
    h: Hearing,
    c: Course,
    s: State,
    rx_counter: Ticks,
    host_s: float,
    rx_power_dbm: float,
    first_path_power_dbm: float,
    phase_cycles: float,
) -> int:
    """The same of a beacon that has been read already."""
    a, b = h.admission, h.beacon
    outcome = admit_sender(a, b.site, b.anchor, rx_counter, host_s)
    if outcome == ADMITTED:
        outcome = admit_stamp(a, b.anchor, b.sequence, b.tx_ticks, period_ticks(b.period_code))
    h.is_starting = h.is_starting or a.events != 0
    if outcome != ADMITTED:
        return outcome
    n = a.neighbours.rows[a.neighbours.row]
    add_power(n, rx_power_dbm)
    n.was_relayed = _confirm(h, s)
    n.almanac_issue, n.period_code = b.almanac_issue, b.period_code
    h.has_moved = b.has_place and keep_place(n, b.place)
    _fill_packet(h.packet, h, n, variance_factor(rx_power_dbm, first_path_power_dbm))
    h.packet.has_phase, h.packet.phase_cycles = phase_cycles >= 0.0, phase_cycles
    if h.is_starting or h.has_moved or h.is_moving or b.almanac_issue != h.almanac_issue or not n.has_place:
        return IS_RARE
    if find_anchor(s, b.anchor) < 0:
        return IS_RARE
    n.used_ticks = a.rx_ticks
    if not is_surely_in_reach(c, a.rx_ticks):
        return IS_RARE
    outcome = process_in_course(c, s, a.time, h.packet, b.relays, b.relay_bytes)
    if outcome == FIX:
        note_fix(a.choice, a.rx_ticks)
    return outcome


def _confirm(h: Hearing, s: State) -> bool:
    """Process which anchors a beacon confirms by its relays; whether other anchors confirm its sender.

    Only then its pages take part in the majority, and its relays confirm others.
    """
    b, t, rx_ticks = h.beacon, h.admission.neighbours, h.admission.rx_ticks
    n = t.rows[t.row]
    in_use = not h.is_starting and find_anchor(s, b.anchor) >= 0
    by_others = is_relayed(n, rx_ticks) or (in_use and n.own_relays_ticks == NEVER)
    if by_others or h.is_starting or _has_too_few(s, rx_ticks):
        add_relays(t, b, rx_ticks)
    elif fitting_relays(t, s, b, rx_ticks) >= MIN_FITTING:
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


def _fill_packet(packet: Packet, h: Hearing, n: Neighbour, factor: float) -> None:
    """Write the beacon at hand as the filter takes it, but for its relays."""
    place = packet.place
    place.anchor, place.std_m, place.is_open = n.anchor, n.place.std_mm / _MM_PER_M, n.is_misfit
    for axis in range(AXES):
        place.position_m[axis] = n.place.position_mm[axis] / _MM_PER_M
    packet.sequence, packet.rx_ticks, packet.tx_ticks = n.sequence, h.admission.rx_ticks, n.tx_ticks
    packet.variance_factor, packet.master, packet.relay_count = factor, -1, 0
    packet.report_variance_m2, packet.relays_have_phases = 0.0, h.beacon.has_phases
