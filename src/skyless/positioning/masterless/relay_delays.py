"""What to take off the receptions that anchors tell, so that light alone is left between them.

Anchor i tells of a packet of anchor j: S − T = |p_i − p_j| + b_j − b_i + D_ij. The b are the clocks as a listener sees
them, its own delay and the senders' TX delays in them, and D_ij is i's TX and RX delay together. From the flight F that
the two range, D_ij = F − |p_i − p_j| + a_i − a_j with the a of ``antenna_delays``: so both ways agree with F, whatever
is wrong with the positions.
"""

from collections.abc import Mapping
from typing import Final

from skyless.air.masterless_packets import Point
from skyless.clocks.running_median import RunningMedian
from skyless.constants import TICK_M
from skyless.positioning.masterless.anchor_flights import AnchorFlights, distance_ticks
from skyless.positioning.masterless.antenna_delays import antenna_delays_m, contradictions_m

SETTLED: Final = 32
REFRESH: Final = 8
"""After so many receptions of a pair, one way, only every eighth is asked for the flight."""

FIRST_ESTIMATE: Final = 128
LONGEST_WAIT: Final = 1024
"""Flights heard between two estimates of the antenna delays: twice as many each time, up to so many."""

UNRANGED: Final = 20
"""Receptions of a pair after which nobody is expected to range it any more: then it has the others' excess."""

EXCESSES: Final = 101

Pair = tuple[int, int]


class _Way:
    """Receptions by one anchor of another's packets."""

    __slots__ = ("delay_ticks", "heard", "skip", "unranged")

    def __init__(self) -> None:
        self.delay_ticks: int | None = None
        self.heard = self.skip = self.unranged = 0


class RelayDelays:
    """Delays of all pairs, for anchors that stand where ``anchors_m`` says, or comes to say."""

    def __init__(self, anchors_m: Mapping[int, Point], estimate: bool) -> None:
        """``estimate``: the anchors' own delays too; otherwise a pair shares its delay equally."""
        self._anchors_m = anchors_m
        self._flights = AnchorFlights()
        self._ways: dict[Pair, _Way] = {}
        self._excess_m: dict[Pair, RunningMedian] = {}
        self.own_m: dict[int, float] = {}
        """The anchors' own delays, each half of TX and RX together, less what all have in common."""
        self.contradictions_m: dict[Pair, float] = {}
        """Pairs that range each other nearer, or farther, than the positions say while others seem nearer."""
        self._estimates_own = estimate
        self._until_estimate = self._wait = FIRST_ESTIMATE

    def ticks(self, listener: int, sender: int, tx_ticks: int, rx_ticks: int, told_ticks: float | None) -> int | None:
        """What to take off this reception, whole ticks; None while the pair's flight is unknown.

        Stamps are unwrapped, each on its own clock.
        """
        way = self._ways.get((listener, sender))
        if way is None:
            way = self._ways[listener, sender] = _Way()
        if told_ticks is not None and way.skip > 0:
            way.skip -= 1
            return way.delay_ticks
        flight = self._flights.hear(sender, listener, tx_ticks, rx_ticks, told_ticks)
        self._refresh(way, listener, sender, flight)
        self._until_estimate -= 1
        if self._until_estimate == 0:
            self._estimate()
        return way.delay_ticks

    def forget(self, anchor: int) -> None:
        """An anchor's clock restarted."""
        self._flights.forget(anchor)

    def _refresh(self, way: _Way, listener: int, sender: int, flight: float | None) -> None:
        distance = distance_ticks(self._anchors_m, listener, sender)
        if distance is None:
            return
        if flight is None:
            way.unranged += 1
            if way.unranged < UNRANGED:
                return
            excess_m = self._usual_excess_m()
        else:
            excess_m = (flight - distance) * TICK_M
            pair = (listener, sender) if listener < sender else (sender, listener)
            self._excess_m.setdefault(pair, RunningMedian(EXCESSES)).add(excess_m)
        way.heard += 1
        way.skip = REFRESH - 1 if way.heard > SETTLED else 0
        own_m = self.own_m.get(listener, 0.0) - self.own_m.get(sender, 0.0)
        way.delay_ticks = round((excess_m + own_m) / TICK_M)

    def _usual_excess_m(self) -> float:
        known = sorted(value for median in self._excess_m.values() if (value := median.value) is not None)
        return known[len(known) // 2] if known else 0.0

    def _estimate(self) -> None:
        """Estimate the anchors' own delays; the pairs' follow with their next flights."""
        self._wait = min(2 * self._wait, LONGEST_WAIT)
        self._until_estimate = self._wait
        known = {pair: value for pair, median in self._excess_m.items() if (value := median.value) is not None}
        own_m = antenna_delays_m(known)
        self.contradictions_m = contradictions_m(known, own_m)
        if self._estimates_own:
            self.own_m = own_m
