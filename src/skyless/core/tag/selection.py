"""Which anchors of a large site a tag uses: the strongest of those that other anchors receive too."""

from math import log as _log
from typing import Final

from skyless.core.air.beacon_fields import BeaconFields
from skyless.core.air.frame import HEARD_BYTES, SHORT_BITS
from skyless.core.air.little_endian import two_bytes, unsigned
from skyless.core.air.neighbours import Neighbour, Neighbours, find_neighbour, neighbour_of
from skyless.core.constants import TICK_BITS
from skyless.core.estimator.state import State, find_anchor
from skyless.core.native.arithmetic import log, sqrt, square
from skyless.core.native.records import Integers, Ticks
from skyless.core.ticks import FLIGHT_SLACK_TICKS, NEVER, may_elapse, nearest

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
