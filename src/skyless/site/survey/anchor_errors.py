"""Constant errors of anchors without a master: calibrated biases, antenna delays, and delays of relayed receptions."""

from collections.abc import Mapping
from math import dist, log
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.air.masterless_packets import PairTdoa, Point
from skyless.core.arrays import Array
from skyless.core.ticks import TICK_BITS, TICK_M
from skyless.site.survey.legs import RunningMedian, TwoWayRanging

MIN_NOISE_M: Final = 0.05
"""Smallest noise that is assumed: positions that a calibration has not seen differ somewhat."""

SLOPE_NEAREST_M: Final = 0.5
"""Below this range the slope does not apply."""

SHARED_NOISE_SCALE: Final = 1.5
"""Factor: successive differences share receptions and reflections, which the filter counts as new in each."""

TYPICAL_SLOPE_M: Final = 0.05
"""Slope of an uncalibrated DW1000: APS011 gives 0.03 to 0.10 m, recorded flights 0.03 to 0.08 m."""

KNOWN_STD_M: Final = 0.02
"""Standard deviation of a calibrated constant, without the error of the survey. With that error, constants of the same
anchors differ by 3 cm between recordings."""


class AnchorCalibration(Struct, frozen=True):
    """What is known of one anchor, metres."""

    bias_m: float
    slope_m: float = 0.0
    """Growth of the bias while the range grows by the factor e."""
    noise_m: float | None = None
    """Standard deviation of the differences that the anchor takes part in, outliers apart."""


NO_BIAS: Final = AnchorCalibration(0.0)
TYPICAL_ANCHOR: Final = AnchorCalibration(0.0, TYPICAL_SLOPE_M)


class DifferenceCalibration(Struct, frozen=True):
    """What is known of the anchors; others are typical ones."""

    anchors: dict[int, AnchorCalibration]

    def of(self, anchor: int) -> AnchorCalibration:
        """What is known of an anchor, or of any."""
        return self.anchors.get(anchor, TYPICAL_ANCHOR)

    def error_m(self, anchor: int, range_m: float) -> float:
        """By how much an anchor seems too far away."""
        known = self.of(anchor)
        return known.bias_m + known.slope_m * log(max(range_m, SLOPE_NEAREST_M))

    def constant_m(self, pair: PairTdoa) -> float:
        """By how much a difference is too large for its anchors' constants."""
        return self.of(pair.anchor_b).bias_m - self.of(pair.anchor_a).bias_m

    def difference_std_m(self, otherwise_m: float) -> float:
        """Standard deviation of a difference: from the median of the anchors' noise, at most ``otherwise_m``."""
        known = [anchor.noise_m for anchor in self.anchors.values() if anchor.noise_m is not None]
        return (
            min(SHARED_NOISE_SCALE * max(float(np.median(known)), MIN_NOISE_M), otherwise_m) if known else otherwise_m
        )


# Flights between anchors


RANGED_WINDOW: Final = 101
"""Exchanges over which the ranged flight of a pair is the median."""

Pair = tuple[int, int]


class AnchorFlights:
    """Median of the flights that either anchor of a pair stated recently, or of exchanges where neither states any."""

    def __init__(self) -> None:
        self._stated: dict[Pair, RunningMedian] = {}
        self._ranging = TwoWayRanging(TICK_BITS, window=RANGED_WINDOW)

    def update(self, a: int, b: int, tx_a: int, rx_b: int, stated_ticks: float | None) -> float | None:
        """Process b's reception of a's packet, both stamps unwrapped, with the flight that b states if there is one.

        Returns the flight between the two in ticks, None while it is unknown.
        """
        pair = (a, b) if a < b else (b, a)
        median = self._stated.get(pair)
        if stated_ticks is not None:
            if median is None:
                median = self._stated[pair] = RunningMedian()
            return median.add(stated_ticks)
        if median is not None:
            return median.value
        self._ranging.add(a, b, tx_a, rx_b)
        return self._ranging.flight_ticks(a, b)

    def forget(self, anchor: int) -> None:
        """Drop the open exchanges of an anchor whose clock restarted; its flights stay."""
        self._ranging.forget(anchor)


def distance_ticks(anchors_m: Mapping[int, Point], a: int, b: int) -> float | None:
    """Flight between two anchors by their positions, without any antenna delay; None where one is not known."""
    one, other = anchors_m.get(a), anchors_m.get(b)
    return None if one is None or other is None else dist(one, other) / TICK_M


# Antenna delays


EXCESS_STD_M: Final = 0.1
"""Parts of a pair's excess other than its nodes' delays: errors of positions, strong and weak signals."""

ANTENNA_DELAY_STD_M: Final = 0.07
"""How much the delays of nodes of one kind scatter: two of them as much as all else."""

BLOCKED_M: Final = 0.5
"""A pair whose excess is farther from all others' is blocked or reflected."""


def antenna_delays_m(excess_m: Mapping[Pair, float]) -> dict[int, float]:
    """Best linear estimate of each anchor's delay a, less the mean of all; ``excess_m``: flights less distances."""
    if not excess_m:
        return {}
    middle = float(np.median(list(excess_m.values())))
    kept = {pair: excess - middle for pair, excess in excess_m.items() if abs(excess - middle) <= BLOCKED_M}
    anchors = sorted({anchor for pair in kept for anchor in pair})
    H, excess = _design(kept, anchors), np.array(list(kept.values()))
    information = H.T @ H / EXCESS_STD_M**2
    information[range(len(anchors)), range(len(anchors))] += 1.0 / ANTENNA_DELAY_STD_M**2
    delays = np.linalg.solve(information, H.T @ excess / EXCESS_STD_M**2)
    return dict(zip(anchors, delays[:-1].tolist(), strict=True))


def contradictions_m(excess_m: Mapping[Pair, float], delays_m: Mapping[int, float]) -> dict[Pair, float]:
    """Pairs whose flights cannot be had by their positions, by how much they are too long; empty where all can.

    Obstacles make flights longer, and only that; where one is too short, positions are wrong.
    """
    if not excess_m:
        return {}
    middle = float(np.median(list(excess_m.values())))
    off_m = {
        (a, b): excess - middle - delays_m.get(a, 0.0) - delays_m.get(b, 0.0) for (a, b), excess in excess_m.items()
    }
    wrong = {pair: round(off, 3) for pair, off in off_m.items() if abs(off) > BLOCKED_M}
    return wrong if min(wrong.values(), default=0.0) < 0.0 else {}


def _design(pairs: Mapping[Pair, float], anchors: list[int]) -> Array:
    """A row for each pair: its two anchors, and what all have in common in the last column."""
    column = {anchor: k for k, anchor in enumerate(anchors)}
    H = np.zeros((len(pairs), len(anchors) + 1))
    H[:, -1] = 1.0
    for row, (a, b) in enumerate(pairs):
        H[row, column[a]] = H[row, column[b]] = 1.0
    return H


# Delays of relayed receptions


ALWAYS_REFRESHED: Final = 32
REFRESH: Final = 8
"""After this number of receptions of a pair in one direction, only every eighth updates the flight."""

FIRST_ESTIMATE: Final = 128
MAX_BETWEEN_ESTIMATES: Final = 1024
"""Flights received between two estimates of the antenna delays: twice as many each time, up to this number."""

UNRANGED: Final = 20
"""Receptions of a pair after which no ranging of it is expected: then it has the others' excess."""

EXCESSES: Final = 101


class _Direction:
    """Receptions by one anchor of another's packets."""

    __slots__ = ("delay_ticks", "heard", "skip", "unranged")

    def __init__(self) -> None:
        self.delay_ticks: int | None = None
        self.heard = self.skip = self.unranged = 0


class RelayDelays:
    """Delays of all pairs, for anchors at ``anchors_m``, which may grow."""

    def __init__(self, anchors_m: Mapping[int, Point], estimate: bool) -> None:
        """``estimate``: the anchors' own delays too; otherwise a pair shares its delay equally."""
        self._anchors_m = anchors_m
        self._flights = AnchorFlights()
        self._directions: dict[Pair, _Direction] = {}
        self._excess_m: dict[Pair, RunningMedian] = {}
        self.own_m: dict[int, float] = {}
        """The anchors' own delays, each half of TX and RX together, less what all have in common."""
        self.contradictions_m: dict[Pair, float] = {}
        """Pairs that range each other nearer, or farther, than their positions are while others seem nearer."""
        self._estimates_own = estimate
        self._until_estimate = self._wait = FIRST_ESTIMATE

    def ticks(self, listener: int, sender: int, tx_ticks: int, rx_ticks: int, stated_ticks: float | None) -> int | None:
        """What to subtract from this reception, whole ticks; None while the pair's flight is unknown.

        Stamps are unwrapped, each on its own clock.
        """
        direction = self._directions.get((listener, sender))
        if direction is None:
            direction = self._directions[listener, sender] = _Direction()
        if stated_ticks is not None and direction.skip > 0:
            direction.skip -= 1
            return direction.delay_ticks
        flight = self._flights.update(sender, listener, tx_ticks, rx_ticks, stated_ticks)
        self._refresh(direction, listener, sender, flight)
        self._until_estimate -= 1
        if self._until_estimate == 0:
            self._estimate()
        return direction.delay_ticks

    def forget(self, anchor: int) -> None:
        """An anchor's clock restarted."""
        self._flights.forget(anchor)

    def _refresh(self, direction: _Direction, listener: int, sender: int, flight: float | None) -> None:
        distance = distance_ticks(self._anchors_m, listener, sender)
        if distance is None:
            return
        if flight is None:
            direction.unranged += 1
            if direction.unranged < UNRANGED:
                return
            excess_m = self._usual_excess_m()
        else:
            excess_m = (flight - distance) * TICK_M
            pair = (listener, sender) if listener < sender else (sender, listener)
            self._excess_m.setdefault(pair, RunningMedian(EXCESSES)).add(excess_m)
        direction.heard += 1
        direction.skip = REFRESH - 1 if direction.heard > ALWAYS_REFRESHED else 0
        own_m = self.own_m.get(listener, 0.0) - self.own_m.get(sender, 0.0)
        direction.delay_ticks = round((excess_m + own_m) / TICK_M)

    def _usual_excess_m(self) -> float:
        known = sorted(value for median in self._excess_m.values() if (value := median.value) is not None)
        return known[len(known) // 2] if known else 0.0

    def _estimate(self) -> None:
        """Estimate the anchors' own delays; the pairs' follow with their next flights."""
        self._wait = min(2 * self._wait, MAX_BETWEEN_ESTIMATES)
        self._until_estimate = self._wait
        known = {pair: value for pair, median in self._excess_m.items() if (value := median.value) is not None}
        own_m = antenna_delays_m(known)
        self.contradictions_m = contradictions_m(known, own_m)
        if self._estimates_own:
            self.own_m = own_m
