"""Which anchors of a large site a tag uses: the strongest of those that other anchors receive too."""

import math
from collections.abc import Collection
from typing import Final

from skyless.core.air.beacon_fields import BeaconFields
from skyless.core.air.frame import HEARD_BYTES, SHORT_BITS
from skyless.core.air.little_endian import two_bytes, unsigned
from skyless.core.air.neighbours import Neighbour, Neighbours, find_neighbour, neighbour_of
from skyless.core.constants import TICK_BITS
from skyless.core.estimator.state import State, find_anchor
from skyless.core.native.records import Ticks
from skyless.core.ticks import FLIGHT_SLACK_TICKS, NEVER, may_elapse, nearest

MAX_ANCHORS_IN_USE: Final = 24
"""In the estimator's state; more cost accuracy, as each then sends less, and time."""

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


def replaced_by(anchor: int, powers_dbm: dict[int, float], ranges_m: dict[int, float]) -> int | None:
    """The anchor in use that ``anchor`` should replace, None if ``anchor`` is too weak.

    ``ranges_m``: ranges of ``anchor`` and of all anchors in use; ``powers_dbm``: those that are known.
    """
    powers = {one: powers_dbm.get(one, _nominal_dbm(range_m)) for one, range_m in ranges_m.items()}
    own_dbm = powers.pop(anchor)
    if not powers:
        return None
    weakest = min(powers, key=lambda one: powers[one])
    return weakest if own_dbm > powers[weakest] + BETTER_DB else None


def is_full(anchors: Collection[int]) -> bool:
    """Whether another anchor can only be used instead of one of these."""
    return len(anchors) >= MAX_ANCHORS_IN_USE


def _nominal_dbm(range_m: float) -> float:
    return NOMINAL_POWER_DBM - 20.0 * math.log10(max(range_m, 0.1))
