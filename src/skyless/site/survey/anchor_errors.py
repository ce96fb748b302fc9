"""Constant errors of anchors without a master: calibrated biases, antenna delays, and delays of relayed receptions."""

from collections import defaultdict
from collections.abc import Mapping
from math import dist, log
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.air.masterless_packets import PairTdoa, Point
from skyless.core.ticks import TICK_M
from skyless.site.survey.legs import AnchorFlights, RunningMedian
from skyless.site.survey.problem import incidence

MIN_NOISE_M: Final = 0.05
"""Least noise assumed, as positions outside the calibration differ somewhat."""

SLOPE_NEAREST_M: Final = 0.5
"""Below this range the slope does not apply."""

SHARED_NOISE_SCALE: Final = 1.5
"""Factor on the noise: successive differences share receptions and reflections, but the filter takes them as
independent."""

TYPICAL_SLOPE_M: Final = 0.05
"""Slope of an uncalibrated DW1000: APS011 gives 0.03 to 0.10 m, recorded flights 0.03 to 0.08 m."""

KNOWN_STD_M: Final = 0.02
"""Standard deviation of a calibrated constant, without the survey's error. With it, constants of the same anchors
differ by 3 cm between recordings."""


class AnchorCalibration(Struct, frozen=True):
    """Range errors of one anchor, metres."""

    bias_m: float
    slope_m: float = 0.0
    """Growth of the bias as the range grows by a factor of e."""
    noise_m: float | None = None
    """Standard deviation of the anchor's differences, without outliers."""


NO_BIAS: Final = AnchorCalibration(0.0)
TYPICAL_ANCHOR: Final = AnchorCalibration(0.0, TYPICAL_SLOPE_M)


class DifferenceCalibration(Struct, frozen=True):
    """Calibrated anchors; any other is taken as a typical one."""

    anchors: dict[int, AnchorCalibration]

    def of(self, anchor: int) -> AnchorCalibration:
        """The anchor's calibration, or a typical one."""
        return self.anchors.get(anchor, TYPICAL_ANCHOR)

    def error_m(self, anchor: int, range_m: float) -> float:
        """Error of a range to the anchor: bias and slope."""
        known = self.of(anchor)
        return known.bias_m + known.slope_m * log(max(range_m, SLOPE_NEAREST_M))

    def constant_m(self, pair: PairTdoa) -> float:
        """Error of a difference due to its anchors' biases."""
        return self.of(pair.anchor_b).bias_m - self.of(pair.anchor_a).bias_m

    def difference_std_m(self, otherwise_m: float) -> float:
        """Standard deviation of a difference, from the median noise of the anchors; at most ``otherwise_m``."""
        known = [anchor.noise_m for anchor in self.anchors.values() if anchor.noise_m is not None]
        return (
            min(SHARED_NOISE_SCALE * max(float(np.median(known)), MIN_NOISE_M), otherwise_m) if known else otherwise_m
        )


# Antenna delays


Pair = tuple[int, int]


def distance_ticks(anchors_m: Mapping[int, Point], a: int, b: int) -> float | None:
    """Time of flight between two anchors' positions, without antenna delays; None if a position is unknown."""
    one, other = anchors_m.get(a), anchors_m.get(b)
    return None if one is None or other is None else dist(one, other) / TICK_M


EXCESS_STD_M: Final = 0.1
"""Standard deviation of a pair's excess apart from its nodes' delays: position errors, strong and weak signals."""

ANTENNA_DELAY_STD_M: Final = 0.07
"""Standard deviation of the delays of nodes of one kind: two of them scatter as much as everything else."""

BLOCKED_M: Final = 0.5
"""A pair whose excess is farther than this from the median is blocked or reflected."""


def antenna_delays_m(excess_m: Mapping[Pair, float]) -> dict[int, float]:
    """Best linear estimate of each anchor's antenna delay, relative to the mean; ``excess_m``: flight less distance."""
    if not excess_m:
        return {}
    middle = float(np.median(list(excess_m.values())))
    kept = {pair: excess - middle for pair, excess in excess_m.items() if abs(excess - middle) <= BLOCKED_M}
    anchors = sorted({anchor for pair in kept for anchor in pair})
    first, second = np.searchsorted(anchors, list(kept)).T
    H = np.column_stack([incidence(len(anchors), first, second), np.ones(len(kept))])  # last what is common to all
    excess = np.array(list(kept.values()))
    information = H.T @ H / EXCESS_STD_M**2
    information[range(len(anchors)), range(len(anchors))] += 1.0 / ANTENNA_DELAY_STD_M**2
    return dict(zip(anchors, np.linalg.solve(information, H.T @ excess / EXCESS_STD_M**2)[:-1].tolist(), strict=True))


def contradictions_m(excess_m: Mapping[Pair, float], delays_m: Mapping[int, float]) -> dict[Pair, float]:
    """Excess of each pair whose flight contradicts the positions; empty unless a flight is too short.

    Obstacles can only lengthen a flight, so one that is too short means wrong positions.
    """
    if not excess_m:
        return {}
    middle = float(np.median(list(excess_m.values())))
    off_m = {
        (a, b): excess - middle - delays_m.get(a, 0.0) - delays_m.get(b, 0.0) for (a, b), excess in excess_m.items()
    }
    wrong = {pair: round(off, 3) for pair, off in off_m.items() if abs(off) > BLOCKED_M}
    return wrong if min(wrong.values(), default=0.0) < 0.0 else {}


# Delays of relayed receptions


ALWAYS_REFRESHED: Final = 32
REFRESH: Final = 8
"""After ``ALWAYS_REFRESHED`` receptions in one direction, only every eighth updates the flight."""

FIRST_ESTIMATE: Final = 128
MAX_BETWEEN_ESTIMATES: Final = 1024
"""Flights received between two estimates of the antenna delays: doubled each time, up to the maximum."""

UNRANGED: Final = 20
"""Receptions without a ranged flight after which a pair gets the median excess of the others."""

EXCESSES: Final = 101


class _Direction:
    """One anchor's receptions of another's packets."""

    __slots__ = ("delay_ticks", "heard", "skip", "unranged")

    def __init__(self) -> None:
        self.delay_ticks: int | None = None
        self.heard = self.skip = self.unranged = 0


class RelayDelays:
    """Delays of relayed receptions for all pairs of the anchors in ``anchors_m``, which may grow."""

    def __init__(self, anchors_m: Mapping[int, Point], estimate: bool) -> None:
        """``estimate``: also estimate each anchor's own delay; otherwise a pair shares its delay equally."""
        self._anchors_m = anchors_m
        self._flights = AnchorFlights()
        self._directions: defaultdict[Pair, _Direction] = defaultdict(_Direction)
        self._excess_m: dict[Pair, RunningMedian] = {}
        self.own_m: dict[int, float] = {}
        """Each anchor's own delay, half of TX and RX together, relative to the mean."""
        self.contradictions_m: dict[Pair, float] = {}
        """See ``contradictions_m``."""
        self._estimates_own = estimate
        self._until_estimate = self._wait = FIRST_ESTIMATE

    def ticks(self, listener: int, sender: int, tx_ticks: int, rx_ticks: int, stated_ticks: float | None) -> int | None:
        """Whole ticks to subtract from this reception; None while the pair's flight is unknown.

        Stamps are unwrapped, each on its own clock.
        """
        direction = self._directions[listener, sender]
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
        """Drop the open exchanges of an anchor whose clock restarted."""
        self._flights.forget(anchor)

    def _refresh(self, direction: _Direction, listener: int, sender: int, flight: float | None) -> None:
        distance = distance_ticks(self._anchors_m, listener, sender)
        if distance is None:
            return
        if flight is None:
            direction.unranged += 1
            if direction.unranged < UNRANGED:
                return
            known = sorted(value for median in self._excess_m.values() if (value := median.value) is not None)
            excess_m = known[len(known) // 2] if known else 0.0
        else:
            excess_m = (flight - distance) * TICK_M
            pair = (listener, sender) if listener < sender else (sender, listener)
            self._excess_m.setdefault(pair, RunningMedian(EXCESSES)).add(excess_m)
        direction.heard += 1
        direction.skip = REFRESH - 1 if direction.heard > ALWAYS_REFRESHED else 0
        own_m = self.own_m.get(listener, 0.0) - self.own_m.get(sender, 0.0)
        direction.delay_ticks = round((excess_m + own_m) / TICK_M)

    def _estimate(self) -> None:
        """Estimate the anchors' own delays; pairs use them from their next flights."""
        self._wait = min(2 * self._wait, MAX_BETWEEN_ESTIMATES)
        self._until_estimate = self._wait
        known = {pair: value for pair, median in self._excess_m.items() if (value := median.value) is not None}
        own_m = antenna_delays_m(known)
        self.contradictions_m = contradictions_m(known, own_m)
        if self._estimates_own:
            self.own_m = own_m
