"""Time differences of a tag without site time: one anchor relays when it received another, and the tag receives both.

With T, S and R for stamps of transmission, of the anchor's and of the tag's reception, ``R_b − R_a − (T_b − S_ba)`` is
``|p − b| − |p − a| + D_ab + h_b − h_a``: D_ab is the range that the anchors themselves measure. No position is needed,
and D_ab includes every delay of the way between the two anchors.
"""

from collections import deque
from typing import Final

from msgspec import Struct

from skyless.core.air.frame import Malformed, Reception
from skyless.core.any_receiver import SiteBeacon, decode_any
from skyless.core.ticks import MAX_DRIFT, TICK_M, TICK_RATE_HZ, Unwrapper, difference

_LONGEST_TICKS: Final = round(0.3 * TICK_RATE_HZ)
"""Over a longer time two counters do not run evenly enough."""

_RATE_TICKS: Final = round(0.1 * TICK_RATE_HZ)
"""Least time over which a rate is measured; its noise is that of two stamps."""

_MAX_FRAMES: Final = 4096
_MAX_BEFORE: Final = 256


class RelayedDifference(Struct, frozen=True, gc=False):
    """One difference, of the moment when the tag received ``first``."""

    first: int
    second: int
    difference_m: float
    age_s: float
    """Time since then."""


class RelayedDifferences:
    """One tag's receptions, as they come, to differences of all pairs of anchors that relay each other."""

    def __init__(self, site_id: int) -> None:
        self._site_id = site_id
        self._ticks = Unwrapper()
        self._frames: dict[tuple[int, int], int] = {}
        """The tag's stamps, unwrapped, by anchor and sequence number, in the order of reception."""
        self._before: dict[int, deque[tuple[int, int]]] = {}
        """TX stamps and the tag's stamps of each anchor's last beacons."""
        self._last: dict[tuple[int, int], int] = {}
        """RX stamp of each directed pair's last relay: a stamp is relayed until there is another."""

    def add(self, reception: Reception) -> list[RelayedDifference]:
        """The differences that a reception completes; what is no beacon of the site gives none."""
        beacon = decode_any(reception.frame)
        if isinstance(beacon, Malformed) or beacon.site != self._site_id:
            return []
        now_ticks = self._ticks.unwrap(reception.rx_ticks, reception.host_s)
        relative_rate = self._relative_rate(beacon, now_ticks)
        found: list[RelayedDifference] = []
        for heard in beacon.relayed:
            pair = (heard.anchor, beacon.anchor)
            frame_ticks = self._frames.get((heard.anchor, heard.sequence))
            if frame_ticks is None or relative_rate is None or self._last.get(pair) == heard.rx_ticks:
                continue
            self._last[pair] = heard.rx_ticks
            age_ticks = now_ticks - frame_ticks
            held_ticks = difference(beacon.tx_ticks, heard.rx_ticks_near(beacon.tx_ticks - age_ticks))
            apart_ticks = age_ticks - held_ticks
            if not 0 < held_ticks <= _LONGEST_TICKS or abs(apart_ticks) > _most_apart(held_ticks):
                continue
            difference_m = (apart_ticks - relative_rate * held_ticks) * TICK_M
            found.append(RelayedDifference(*pair, difference_m, age_ticks / TICK_RATE_HZ))
        self._frames.pop((beacon.anchor, beacon.sequence), None)
        self._frames[beacon.anchor, beacon.sequence] = now_ticks
        if len(self._frames) > _MAX_FRAMES:
            del self._frames[next(iter(self._frames))]
        return found

    def _relative_rate(self, beacon: SiteBeacon, now_ticks: int) -> float | None:
        """By how much faster than the anchor's counter the tag's runs; None while that is not known.

        As the tag sees it, so the tag's motion is in it, and differences are those of one moment.
        """
        before = self._before.setdefault(beacon.anchor, deque(maxlen=_MAX_BEFORE))
        while before and now_ticks - before[0][1] > _LONGEST_TICKS:
            before.popleft()
        rate = None
        if before and now_ticks - before[0][1] >= _RATE_TICKS:
            sent_ticks = difference(beacon.tx_ticks, before[0][0])
            if abs(now_ticks - before[0][1] - sent_ticks) > _most_apart(sent_ticks):
                before.clear()
            else:
                rate = (now_ticks - before[0][1] - sent_ticks) / sent_ticks
        before.append((beacon.tx_ticks, now_ticks))
        return rate


def _most_apart(ticks: int) -> float:
    """Two counters do not differ by more over such a time, nor ways by more than 3 km."""
    return 2.0 * MAX_DRIFT * abs(ticks) + 3000.0 / TICK_M
