"""Legs between anchors, as any listener can reconstruct them from beacons, and ranges and differences from them.

A beacon states its TX stamp, and relays when its sender received which frame of which other anchor. A listener that
also received that frame knows both stamps of the leg. An anchor's own receptions are legs already.
"""

import math
from bisect import bisect_left, insort
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.air.frame import Heard, Malformed, Reception
from skyless.core.air.masterless_packets import Relay
from skyless.core.any_receiver import SiteBeacon, decode_any
from skyless.core.arrays import Array, Integers, Mask
from skyless.core.ticks import MAX_DRIFT, TICK_BITS, TICK_M, TICK_RATE_HZ, Unwrapper, difference, to_seconds
from skyless.site.survey.facts import PairRange, PairRanges

# Time of flight between two nodes that receive each other's broadcasts, by bracketing.
#
# Node x sends twice, at ``t1`` and ``t2`` of its clock, and y receives at ``r1`` and ``r2`` of its own. In between
# y sends at ``t`` (clock of y), and x receives at ``r`` (clock of x). The line through (t1, r1) and (t2, r2) maps a
# time of x to the time of y one flight later, so ``line(r) - t`` is twice the time of flight. The bracket itself gives
# the relative rate of the clocks, and a drift of that rate has only a second-order effect.


class RunningMedian:
    """Median of the last ``window`` values; fewer than half of them may be arbitrarily wrong."""

    def __init__(self, window: int = 31) -> None:
        self._window = window
        self._arrived: deque[float] = deque()
        self._sorted: list[float] = []

    def add(self, value: float) -> float:
        """Add one finite value and return the median (the upper one for an even number of values)."""
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
"""Twice the largest rate between crystals of ±20 ppm: a bracket beyond it mixes stamps of different clocks."""

MAX_FLIGHT_TICKS: Final = 1 << 18
"""1.2 km of flight and antenna delay; more is a pairing error."""


class Leg(Struct, frozen=True, gc=False):
    """One broadcast and its reception by the other node."""

    tx_ticks: int
    """On the sender's clock."""
    rx_ticks: int
    """On the receiver's clock."""


def bracketed_flight_ticks(before: Leg, back: Leg, after: Leg, bits: int) -> float | None:
    """Time of flight in ticks of y's clock, from ``before`` and ``after`` (x → y) and ``back`` (y → x).

    None if ``back`` is not between the two, or the stamps cannot belong to one pair of clocks. Counters have ``bits``
    bits, and the bracket must be shorter than half a wrap.
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


class AnchorFlights:
    """Median flight of each pair of nodes: as they state it, or ranged from their receptions if neither states any."""

    def __init__(self, window: int = 101) -> None:
        """``window``: exchanges in the running median of a ranged flight."""
        self._window = window
        self._last: dict[tuple[int, int], Leg] = {}
        self._stated: dict[tuple[int, int], RunningMedian] = {}
        self._ranged: dict[tuple[int, int], RunningMedian] = {}

    def update(self, a: int, b: int, tx_a: int, rx_b: int, stated_ticks: float | None = None) -> float | None:
        """Add b's reception of a's packet, with the flight that b states, if any. Stamps may be unwrapped.

        Returns the pair's flight in ticks, None while unknown.
        """
        pair = (a, b) if a < b else (b, a)
        median = self._stated.get(pair)
        if stated_ticks is not None:
            if median is None:
                median = self._stated[pair] = RunningMedian()
            return median.add(stated_ticks)
        if median is not None:
            return median.value
        leg = Leg(tx_a, rx_b)
        before, back = self._last.get((a, b)), self._last.get((b, a))
        self._last[a, b] = leg
        if before is not None and back is not None:
            flight = bracketed_flight_ticks(before, back, leg, TICK_BITS)
            if flight is not None:
                return self._ranged.setdefault(pair, RunningMedian(self._window)).add(flight)
        return None if (ranged := self._ranged.get(pair)) is None else ranged.value

    def forget(self, node: int) -> None:
        """Drop the open brackets of a node whose clock restarted, but keep its flights."""
        self._last = {pair: leg for pair, leg in self._last.items() if node not in pair}

    def ranged_ticks(self) -> dict[tuple[int, int], float]:
        """Ranged flight of every pair, the smaller identifier first."""
        return {pair: value for pair, median in self._ranged.items() if (value := median.value) is not None}


_LONGEST_AGE_TICKS: Final = round(2.0 * TICK_RATE_HZ)
"""Anchors relay stamps of the last second; an older frame only has the same sequence number."""

_MAX_FRAMES: Final = 1 << 14
"""More frames than fit on the air in ``_LONGEST_AGE_TICKS``."""
_MAX_LEGS: Final = 1 << 16


class AnchorLeg(Struct, frozen=True, gc=False):
    """One broadcast of an anchor and its reception by another."""

    sender: int
    receiver: int
    tx_ticks: int
    """On the sender's counter."""
    rx_ticks: int
    """On the receiver's counter."""
    t_s: float
    """When the listener received the same broadcast, on its own clock."""
    carrier_phase_cycles: float | None = None
    """Carrier phase at the receiver, if it was measured and relayed."""
    age_ticks: int = 0
    """Time from ``t_s`` until the listener received the relay, on its counter."""


class _Received(Struct, frozen=True, gc=False):
    tx_ticks: int
    listener_ticks: int
    """Unwrapped."""
    t_s: float


class RelayMatcher:
    """Matches relays with the frames that one listener has received, which gives legs.

    Memory is bounded by the frames of two seconds. ``counters``: ``legs``, and relays without a leg:
    ``frame-not-received`` (the listener missed the relayed frame), ``other-frame`` (the relay means an earlier frame
    with the same sequence number, or a counter has restarted).
    """

    def __init__(self, bits: int = TICK_BITS) -> None:
        """``bits``: width of the anchors' counters."""
        self.counters: Counter[str] = Counter()
        self._bits = bits
        self._frames: dict[tuple[int, int], _Received] = {}
        """By anchor and sequence number, in the order of reception."""
        self._last: dict[tuple[int, int], int] = {}
        """RX stamp of each directed pair's last leg, as a stamp is relayed until there is a newer one."""

    def add(
        self, anchor: int, sequence: int, tx_ticks: int, relays: Iterable[Relay | Heard], now_ticks: int, t_s: float
    ) -> list[AnchorLeg]:
        """Add a frame and return the legs that its relays complete.

        ``now_ticks``, ``t_s``: the listener's unwrapped counter, and its clock.
        """
        legs = [leg for relay in relays if (leg := self._leg(anchor, tx_ticks, relay, now_ticks)) is not None]
        self._frames.pop((anchor, sequence), None)
        self._frames[anchor, sequence] = _Received(tx_ticks, now_ticks, t_s)
        self._prune(now_ticks)
        return legs

    def _leg(self, anchor: int, tx_ticks: int, relay: Relay | Heard, now_ticks: int) -> AnchorLeg | None:
        """The leg that a relay describes, if the listener received the relayed frame."""
        pair = (relay.anchor, anchor)
        if relay.anchor == anchor or self._last.get(pair) == relay.rx_ticks:
            return None
        frame = self._frames.get((relay.anchor, relay.sequence))
        if frame is None:
            self.counters["frame-not-received"] += 1
            return None
        # Between the two frames the listener's and the relaying anchor's counters must advance equally: this rejects
        # another frame with the same sequence number, and a restarted counter.
        age_ticks = now_ticks - frame.listener_ticks
        rx_ticks = relay.rx_ticks_near(tx_ticks - age_ticks) if isinstance(relay, Heard) else relay.rx_ticks
        apart_ticks = abs(difference(tx_ticks, rx_ticks + age_ticks, self._bits))
        if not 0 < age_ticks <= _LONGEST_AGE_TICKS or apart_ticks > 2 * MAX_FLIGHT_TICKS + MAX_BRACKET_RATE * age_ticks:
            self.counters["other-frame"] += 1
            return None
        self._last.pop(pair, None)
        self._last[pair] = relay.rx_ticks
        self.counters["legs"] += 1
        phase_cycles = relay.phase_cycles if isinstance(relay, Heard) else relay.carrier_phase_cycles
        return AnchorLeg(relay.anchor, anchor, frame.tx_ticks, rx_ticks, frame.t_s, phase_cycles, age_ticks)

    def _prune(self, now_ticks: int) -> None:
        """Remove frames that are too old to be relayed."""
        oldest_ticks = now_ticks - _LONGEST_AGE_TICKS
        while self._frames:
            key = next(iter(self._frames))
            if len(self._frames) <= _MAX_FRAMES and oldest_ticks <= self._frames[key].listener_ticks:
                break
            del self._frames[key]
        while len(self._last) > _MAX_LEGS:
            del self._last[next(iter(self._last))]


class LegCollector:
    """The legs between the anchors of one site, from the beacons (of either protocol) that one listener receives.

    ``counters``: those of ``RelayMatcher``, ``foreign-site``, and the reasons of ``decode_any``.
    """

    def __init__(self, site_id: int) -> None:
        self._site_id = site_id
        self._ticks = Unwrapper()
        self._matcher = RelayMatcher()
        self.counters = self._matcher.counters

    def add(self, reception: Reception) -> list[AnchorLeg]:
        """Add a reception and return the legs that it completes."""
        beacon = decode_any(reception.frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return []
        if beacon.site != self._site_id:
            self.counters["foreign-site"] += 1
            return []
        now_ticks = self._ticks.unwrap(reception.rx_ticks, reception.host_s)
        t_s = to_seconds(now_ticks) if reception.host_s is None else reception.host_s
        return self._matcher.add(beacon.anchor, beacon.sequence, beacon.tx_ticks, beacon.relayed, now_ticks, t_s)


# One range of each pair from repeated ranges: the mean of the earliest cluster.
#
# A signal can be late but not early, so if a pair's ranges form clusters, the earliest with enough of them is the
# direct path.

STD_OVER_MAD: Final = 1.4826
"""Ratio of the standard deviation to the median absolute deviation of a normal distribution."""

MEDIAN_VARIANCE: Final = math.pi / 2.0
"""Ratio of the variance of a median to that of the mean of normal values."""

MIN_CLUSTER_SHARE: Final = 0.1
"""An early cluster with a smaller share of all exchanges is taken as an error."""


def group_medians(group_of: Integers, values: Array, groups: int, *, upper: bool = False) -> Array:
    """Lower or upper median of each group, shape (groups,); 0 for a group without a value."""
    order, size = np.lexsort((values, group_of)), np.bincount(group_of, minlength=groups)
    middle = np.cumsum(size) - size + (size if upper else size - 1) // 2
    medians = np.zeros(groups)
    medians[size > 0] = values[order][middle[size > 0]]
    return medians


_SIGMAS: Final = 4.0
_DENSE_SHARE: Final = 0.3
_DENSE_WIDTH: Final = 0.771  # standard deviations that hold this share of a normal distribution


def earliest_cluster(value: Array, weight: Array, std: float, total: float | None = None) -> Mask:
    """Mask of the earliest cluster that holds a tenth of the weight, shape (n,); of the heaviest if none does.

    ``value``, ``weight``: shape (n,), n > 0; ``std``: least standard deviation within a cluster; ``total``: total
    weight, if more than the sum of ``weight``.
    """
    order = np.argsort(value, kind="stable")
    ordered, until = value[order], np.cumsum(weight[order])
    ends = np.searchsorted(until, np.concatenate([[0.0], until[:-1]]) + _DENSE_SHARE * until[-1] * (1.0 - 1e-9))
    whole = ends < len(ordered)
    densest = float(np.min(ordered[ends[whole]] - ordered[whole]))  # the shortest interval that holds that share
    width = 2.0 * _SIGMAS * max(std, densest / _DENSE_WIDTH)
    ends = np.searchsorted(ordered, ordered + width, side="right") - 1
    held = until[ends] - until + weight[order]
    enough = np.flatnonzero(held >= MIN_CLUSTER_SHARE * max(until[-1], total or 0.0))
    begin = int(enough[0]) if len(enough) else int(np.argmax(held))
    centre = half_sample_mode(ordered[begin : ends[begin] + 1])
    for _ in range(2):
        inside = np.abs(value - centre) <= 0.5 * width + 1e-9
        centre = float(np.average(value[inside], weights=weight[inside]))
    return np.asarray(inside)


def half_sample_mode(ordered: Array) -> float:
    """Half-sample mode of ascending values: repeatedly keep the densest half."""
    while len(ordered) > 3:
        half = (len(ordered) + 1) // 2
        begin = int(np.argmin(ordered[half - 1 :] - ordered[: len(ordered) - half + 1]))
        ordered = ordered[begin : begin + half]
    if len(ordered) == 3:
        ordered = ordered[:2] if ordered[1] - ordered[0] <= ordered[2] - ordered[1] else ordered[1:]
    return float(np.mean(ordered))


_ENOUGH: Final = 5  # ranges of a pair needed to look for clusters; of fewer the median is used
_MIN_COUNT: Final = 3  # ranges in a cluster, and of a pair whose scatter is used
_MEDIAN_OVER_MEAN: Final = 1.25  # standard deviation of a median over that of the mean
_MIN_NOISE_M: Final = 1e-3
_UNKNOWN_NOISE_M: Final = 0.05  # of a range where no pair was measured more than once


def mean_ranges(ranges_m: Mapping[tuple[int, int], Sequence[float]]) -> PairRanges:
    """Reduce repeated ranges, by pair ``(a, b)`` with a < b, to one range per pair.

    Ranges that are not finite are left out, and so are pairs without a finite one.
    """
    finite_m = {pair: [value for value in values if math.isfinite(value)] for pair, values in ranges_m.items()}
    noise_m = _noise(finite_m)
    pairs = tuple(_mean(a, b, np.sort(values), noise_m) for (a, b), values in sorted(finite_m.items()) if values)
    return PairRanges(pairs, tuple(sorted({anchor for pair in ranges_m for anchor in pair})))


def _noise(ranges_m: Mapping[tuple[int, int], Sequence[float]]) -> float:
    """Noise of one range, common to all pairs: RMS over the pairs, without the noisiest quarter."""
    own, weight = [], []
    for values in ranges_m.values():
        if len(values) >= _MIN_COUNT:
            deviation = float(np.median(np.abs(np.asarray(values) - np.median(values))))
            own.append((STD_OVER_MAD * deviation * math.sqrt(len(values) / (len(values) - 1.0))) ** 2)
            weight.append(len(values) - 1)
    if not own:
        return _UNKNOWN_NOISE_M
    quiet = np.argsort(own)[: math.ceil(0.75 * len(own))]
    return max(math.sqrt(float(np.average(np.array(own)[quiet], weights=np.array(weight)[quiet]))), _MIN_NOISE_M)


def _mean(a: int, b: int, values_m: Array, noise_m: float) -> PairRange:
    count = len(values_m)
    if count < _ENOUGH:
        std_m = noise_m * (_MEDIAN_OVER_MEAN if count > 2 else 1.0) / math.sqrt(count)
        return PairRange(a, b, float(np.median(values_m)), std_m, count)
    total = max(float(count), _MIN_COUNT / MIN_CLUSTER_SHARE)
    cluster = values_m[earliest_cluster(values_m, np.ones(count), noise_m, total)]
    std_m = max(float(np.std(cluster, ddof=1)) if len(cluster) > 1 else 0.0, noise_m) / math.sqrt(len(cluster))
    return PairRange(a, b, float(cluster.mean()), std_m, len(cluster), float(np.mean(values_m > cluster.max())))


# Time differences of a tag without site time: one anchor relays when it received another, and the tag receives both.
#
# With stamps T of transmission, S of the anchor's reception and R of the tag's, ``R_b − R_a − (T_b − S_ba)`` is
# ``|p − b| − |p − a| + D_ab + h_b − h_a``, where D_ab is the range that the anchors measure. No position is needed, and
# D_ab includes every delay between the two anchors.

_LONGEST_TICKS: Final = round(0.3 * TICK_RATE_HZ)
"""Two counters do not run evenly enough over a longer time."""

_RATE_TICKS: Final = round(0.1 * TICK_RATE_HZ)
"""Least time over which a rate is measured, with the noise of two stamps."""


class RelayedDifference(Struct, frozen=True, gc=False):
    """A time difference, valid at the moment when the tag received ``first``."""

    first: int
    second: int
    difference_m: float
    age_s: float
    """Time since then."""


class RelayedDifferences:
    """Turns one tag's receptions into differences of all pairs of anchors that relay each other."""

    def __init__(self, site_id: int) -> None:
        self._site_id = site_id
        self._ticks, self._matcher = Unwrapper(), RelayMatcher()
        self._before: dict[int, deque[tuple[int, int]]] = {}
        """TX stamps and the tag's stamps of each anchor's last beacons."""

    def add(self, reception: Reception) -> list[RelayedDifference]:
        """Add a reception and return the differences that it completes; none unless it is a beacon of the site."""
        beacon = decode_any(reception.frame)
        if isinstance(beacon, Malformed) or beacon.site != self._site_id:
            return []
        now_ticks = self._ticks.unwrap(reception.rx_ticks, reception.host_s)
        relative_rate = self._relative_rate(beacon, now_ticks)
        relays = () if relative_rate is None else beacon.relayed
        found: list[RelayedDifference] = []
        for leg in self._matcher.add(beacon.anchor, beacon.sequence, beacon.tx_ticks, relays, now_ticks, 0.0):
            held_ticks = difference(beacon.tx_ticks, leg.rx_ticks)
            if relative_rate is not None and 0 < held_ticks <= _LONGEST_TICKS:
                difference_m = (leg.age_ticks - held_ticks - relative_rate * held_ticks) * TICK_M
                found.append(RelayedDifference(leg.sender, leg.receiver, difference_m, leg.age_ticks / TICK_RATE_HZ))
        return found

    def _relative_rate(self, beacon: SiteBeacon, now_ticks: int) -> float | None:
        """Relative rate by which the tag's counter runs faster than the anchor's; None while unknown.

        It includes the tag's motion, so that differences apply to one moment.
        """
        before = self._before.setdefault(beacon.anchor, deque(maxlen=256))
        while before and now_ticks - before[0][1] > _LONGEST_TICKS:
            before.popleft()
        rate = None
        if before and now_ticks - before[0][1] >= _RATE_TICKS:
            sent_ticks = difference(beacon.tx_ticks, before[0][0])
            # Paths differ by up to 3 km.
            if abs(now_ticks - before[0][1] - sent_ticks) > 2.0 * MAX_DRIFT * abs(sent_ticks) + 3000.0 / TICK_M:
                before.clear()
            else:
                rate = (now_ticks - before[0][1] - sent_ticks) / sent_ticks
        before.append((beacon.tx_ticks, now_ticks))
        return rate
