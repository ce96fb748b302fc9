"""Time of flight between two nodes that both broadcast and receive each other, by bracketing.

Node x sends twice, at ``t1`` and ``t2`` of its clock, and y receives it at ``r1`` and ``r2`` of its own. In between x
receives y at ``r`` (clock of x), sent at ``t`` (clock of y). The line through (t1, r1) and (t2, r2) maps a time of x to
the time of y one flight later, so ``line(r) - t`` is twice the time of flight. The rate of the two clocks comes from
the bracket itself, and a rate that drifts acts only in the second order.
"""

from bisect import bisect_left, insort
from collections import deque
from typing import Final

from msgspec import Struct

from skyless.core.ticks import difference


class RunningMedian:
    """Median of the last ``window`` values; fewer than half of them may be arbitrarily wrong."""

    def __init__(self, window: int = 31) -> None:
        self._window = window
        self._arrived: deque[float] = deque()
        self._sorted: list[float] = []

    def __len__(self) -> int:
        return len(self._sorted)

    def add(self, value: float) -> float:
        """Add one finite value and return the median, the upper one of an even number of values."""
        ordered = self._sorted
        if len(ordered) == self._window:
            del ordered[bisect_left(ordered, self._arrived.popleft())]
        self._arrived.append(value)
        insort(ordered, value)
        return ordered[len(ordered) >> 1]

    @property
    def value(self) -> float | None:
        """The median, None before the first value."""
        return self._sorted[len(self._sorted) >> 1] if self._sorted else None


MAX_BRACKET_RATE: Final = 80e-6
"""Twice what two crystals of ±20 ppm can differ: a bracket beyond it mixes stamps of different clocks."""

MAX_FLIGHT_TICKS: Final = 1 << 18
"""1.2 km of flight and antenna delay; more than that is a pairing error."""


class Leg(Struct, frozen=True, gc=False):
    """One broadcast and its reception by the other node."""

    tx_ticks: int
    """In the clock of the sender."""
    rx_ticks: int
    """In the clock of the receiver."""


def bracketed_flight_ticks(before: Leg, back: Leg, after: Leg, bits: int) -> float | None:
    """Time of flight in ticks of the answering node y; ``before`` and ``after`` went x → y, ``back`` y → x.

    None when ``back`` does not lie between the two, or when the stamps cannot belong to one pair of clocks.
    Counters have ``bits`` bits and the bracket must be shorter than half a wrap.
    """
    span_x = difference(after.tx_ticks, before.tx_ticks, bits)
    until_back_x = difference(back.rx_ticks, before.tx_ticks, bits)
    if not 0 < until_back_x < span_x:
        return None
    gained = difference(after.rx_ticks, before.rx_ticks, bits) - span_x
    rate = gained / span_x
    if abs(rate) > MAX_BRACKET_RATE:
        return None
    reply = until_back_x - difference(back.tx_ticks, before.rx_ticks, bits)
    flight = (reply + rate * until_back_x) / 2
    return flight if abs(flight) < MAX_FLIGHT_TICKS else None


class TwoWayRanging:
    """Times of flight of all pairs of nodes, reception by reception; each pair's answer is a running median."""

    def __init__(self, bits: int, window: int = 1001) -> None:
        self._bits = bits
        self._window = window
        self._last: dict[tuple[int, int], Leg] = {}
        self._flights: dict[tuple[int, int], RunningMedian] = {}

    def add(self, sender: int, receiver: int, tx_ticks: int, rx_ticks: int) -> float | None:
        """Add one reception; return the time of flight in ticks that it completes, if it does."""
        leg = Leg(tx_ticks, rx_ticks)
        before = self._last.get((sender, receiver))
        self._last[sender, receiver] = leg
        back = self._last.get((receiver, sender))
        if before is None or back is None:
            return None
        flight = bracketed_flight_ticks(before, back, leg, self._bits)
        if flight is not None:
            pair = _pair(sender, receiver)
            self._flights.setdefault(pair, RunningMedian(self._window)).add(flight)
        return flight

    def forget(self, node: int) -> None:
        """Drop the open brackets of a node whose clock restarted; its times of flight stay."""
        self._last = {pair: leg for pair, leg in self._last.items() if node not in pair}

    def flight_ticks(self, x: int, y: int) -> float | None:
        """Median time of flight of a pair in ticks, None before its first bracket."""
        median = self._flights.get(_pair(x, y))
        return None if median is None else median.value

    def flights_ticks(self) -> dict[tuple[int, int], float]:
        """Median time of flight of every pair, the smaller identifier first."""
        return {pair: value for pair, median in self._flights.items() if (value := median.value) is not None}


def _pair(x: int, y: int) -> tuple[int, int]:
    return (x, y) if x < y else (y, x)
