"""Times of flight between anchors, antenna delays and all: as they tell them, or ranged two ways."""

from collections.abc import Mapping
from math import dist
from typing import Final

from skyless.air.masterless_packets import Point
from skyless.clocks.running_median import RunningMedian
from skyless.clocks.two_way import TwoWayRanging
from skyless.constants import TICK_BITS, TICK_M

RANGED: Final = 101
"""Exchanges over which the ranged flight of a pair is the median."""

Pair = tuple[int, int]


class AnchorFlights:
    """The median of what either anchor of a pair told lately; of exchanges, where neither tells."""

    def __init__(self) -> None:
        self._told: dict[Pair, RunningMedian] = {}
        self._ranging = TwoWayRanging(TICK_BITS, window=RANGED)

    def hear(self, a: int, b: int, tx_a: int, rx_b: int, told_ticks: float | None) -> float | None:
        """Take b's reception of a's packet, both stamps unwrapped, with the flight told of it if there is one.

        The flight between the two in ticks, None while it is unknown.
        """
        pair = (a, b) if a < b else (b, a)
        median = self._told.get(pair)
        if told_ticks is not None:
            if median is None:
                median = self._told[pair] = RunningMedian()
            return median.add(told_ticks)
        if median is not None:
            return median.value
        self._ranging.hear(a, b, tx_a, rx_b)
        return self._ranging.flight_ticks(a, b)

    def forget(self, anchor: int) -> None:
        """Drop the open exchanges of an anchor whose clock restarted; its flights stay."""
        self._ranging.forget(anchor)


def distance_ticks(anchors_m: Mapping[int, Point], a: int, b: int) -> float | None:
    """Flight between two anchors by their positions, without any antenna delay; None where one is not known."""
    one, other = anchors_m.get(a), anchors_m.get(b)
    return None if one is None or other is None else dist(one, other) / TICK_M
