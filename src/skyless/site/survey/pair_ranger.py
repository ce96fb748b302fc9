"""Ranges of all pairs of anchors from arriving stamps: brackets, means of blocks, the earliest cluster of blocks.

A pair's mean has two kinds of noise (``docs/survey.md``): of RX stamps, which is the pair's own, and of TX stamps,
which all pairs of an anchor share. The shared part shows in two pairs bracketed with the same frame of an anchor.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Callable
from functools import partial
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array, Integers, Mask, Records
from skyless.core.ticks import TICK_BITS, TICK_M, TICK_RATE_HZ, Unwrapper
from skyless.site.survey.facts import PairBlock, PairRange, PairRanges
from skyless.site.survey.legs import (
    MAX_BRACKET_RATE,
    MAX_FLIGHT_TICKS,
    MEDIAN_VARIANCE,
    STD_OVER_MAD,
    earliest_cluster,
    group_medians,
)

_KEPT_S: Final = 5.0  # how long legs wait for the other direction, which another anchor may publish later
_LONGEST_BRACKET_S: Final = 0.5  # between the two frames of a bracket; at most half a wrap
_LARGEST_TICKS: Final = 1 << 62  # stamps are 64-bit integers
_MAX_BLOCKS: Final = 256
_MAX_PAIRS: Final = 1 << 16
_MAX_OPEN_LEGS: Final = 1 << 18  # a block with this many legs is closed early
_OUTLIER_SIGMAS: Final = 5.0
_PRIOR_WEIGHT: Final = 500.0  # weight of the site's noise in the estimate of a pair's, in flights
_PRIOR_PRODUCTS: Final = 200.0
"""Weight of the assumption that TX and RX stamps are equally good, in products of two pairs."""

_MIN_BATCHES: Final = 6
_MIN_OWN_SHARE: Final = 0.2  # share of a mean's variance that is the pair's own


# Brackets: like ``bracketed_flight_ticks`` in ``site/survey/legs.py``, for many pairs at once


LEGS: Final = np.dtype(
    [("pair", "i8"), ("a_ticks", "i8"), ("b_ticks", "i8"), ("is_back", "?"), ("is_used", "?"), ("t_s", "f8")]
)
"""Number of the pair, unwrapped stamps on the counters of its two anchors, whether the leg went from b to a, whether
its time of flight has already been computed, and its time."""

FLIGHTS: Final = np.dtype([("leg", "i8"), ("ticks", "f8"), ("part", "f8")])
"""Index of the bracketed leg, time of flight, and position of that leg between the two that bracket it, 0 to 1."""


def flights_of(legs: Records, longest_ticks: int) -> tuple[Records, Records, int]:
    """Times of flight of all legs that are not yet used and are bracketed within ``longest_ticks``.

    Returns the flights (which index ``legs``), the legs needed for later brackets, and the number of brackets that
    cannot belong to one pair of counters.
    """
    a_ticks, b_ticks, is_back = legs["a_ticks"], legs["b_ticks"], legs["is_back"]
    of_a, seen_by_a, is_needed_by_a, impossible_a = _bracketed(legs, a_ticks, b_ticks, is_back, longest_ticks)
    of_b, seen_by_b, is_needed_by_b, impossible_b = _bracketed(legs, b_ticks, a_ticks, ~is_back, longest_ticks)
    kept = legs.copy()
    kept["is_used"][np.concatenate([seen_by_a, seen_by_b])] = True
    return np.concatenate([of_a, of_b]), kept[is_needed_by_a | is_needed_by_b], impossible_a + impossible_b


def _bracketed(
    legs: Records, x_ticks: Integers, y_ticks: Integers, is_reply: Mask, longest_ticks: int
) -> tuple[Records, Integers, Mask, int]:
    """Flights of replies y → x that lie between two legs x → y on x's counter.

    Also returns the legs that were bracketed, with or without a time of flight, a mask of those that are still needed,
    and the number of impossible brackets.
    """
    order = np.lexsort((x_ticks, legs["pair"]))
    rows = np.stack([legs["pair"], x_ticks, is_reply])[:, order]
    order = order[np.append(True, (np.diff(rows) != 0).any(axis=0))[: len(order)]]  # without repeated legs
    pair, reply = legs["pair"][order], is_reply[order]
    row, n = np.arange(len(order)), len(order)
    before = np.maximum.accumulate(np.where(reply, -1, row)) if n else row
    after = np.minimum.accumulate(np.where(reply, n, row)[::-1])[::-1] if n else row
    has_before = (before >= 0) & (pair[np.maximum(before, 0)] == pair)
    has_after = (after < n) & (pair[np.minimum(after, n - 1)] == pair) if n else row > 0
    new = np.flatnonzero(reply & has_before & has_after & ~legs["is_used"][order])
    middle, first, last = order[new], order[before[new]], order[after[new]]
    span = (x_ticks[last] - x_ticks[first]).astype(np.float64)
    until = (x_ticks[middle] - x_ticks[first]).astype(np.float64)
    gained = (y_ticks[last] - y_ticks[first]).astype(np.float64) - span
    reply_ticks = until - (y_ticks[middle] - y_ticks[first]).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = gained / span
        ticks, part = (reply_ticks + rate * until) / 2.0, until / span
    in_time = (span > 0.0) & (span <= longest_ticks)
    good = in_time & (until > 0.0) & (until < span) & (np.abs(rate) <= MAX_BRACKET_RATE)
    good &= np.abs(ticks) < MAX_FLIGHT_TICKS
    # Later replies come after the pair's last reply, so only the leg that precedes it and newer ones are still needed.
    needed = np.ones(len(legs), dtype=bool)
    replies = np.flatnonzero(reply)
    if len(replies):
        last_of_pair = replies[np.append(pair[replies][1:] != pair[replies][:-1], True)]
        cut = np.zeros(int(pair.max()) + 1, dtype=np.int64)
        cut[pair[last_of_pair]] = np.where(has_before[last_of_pair], before[last_of_pair], last_of_pair)
        needed[:] = False
        needed[order[row >= cut[pair]]] = True
    flights = np.empty(np.count_nonzero(good), FLIGHTS)
    flights["leg"], flights["ticks"], flights["part"] = middle[good], ticks[good], part[good]
    return flights, middle, needed, int(np.sum(in_time & ~good))


# Steps: ranges in the order of time, to see whether they stayed the same


STEP_S: Final = 3.0
_MAX_STEPS: Final = 64  # with more, the older half is merged in pairs


class StepTable(Struct, frozen=True, eq=False):
    """``k`` steps of ``m`` pairs, in the order of time."""

    start_s: Array
    """Shape (k,)."""
    pairs: tuple[tuple[int, int], ...]
    range_m: Array
    """Shape (k, m), NaN where a pair has no range."""
    variance_m2: Array
    """Shape (k, m), from stamp noise."""


class _Step(Struct, frozen=True):
    start_s: float
    ranges: dict[tuple[int, int], tuple[float, float]]
    """Median and variance, by pair."""


class RangeSteps:
    """Reduces blocks to steps, in bounded memory."""

    def __init__(self) -> None:
        self._steps: list[_Step] = []
        self._open: list[PairBlock] = []

    def add(self, block: PairBlock) -> None:
        """Add a block, in the order of time. If the clock was set back, all steps are dropped."""
        step = math.floor(block.t_s / STEP_S)
        if self._open:
            now = math.floor(self._open[0].t_s / STEP_S)
            if step < now:
                self._steps, self._open = [], []
            elif step > now:
                self.finish()
        self._open.append(block)

    def finish(self) -> None:
        """Close the open step."""
        if not self._open:
            return
        gathered: dict[tuple[int, int], list[PairBlock]] = {}
        for block in self._open:
            gathered.setdefault((block.a, block.b), []).append(block)
        ranges = {
            pair: (
                float(np.median([one.mean_m for one in blocks])),
                MEDIAN_VARIANCE * float(np.mean([one.std_m**2 for one in blocks])) / len(blocks),
            )
            for pair, blocks in gathered.items()
        }
        self._steps.append(_Step(STEP_S * math.floor(self._open[0].t_s / STEP_S), ranges))
        self._open = []
        if len(self._steps) > _MAX_STEPS:
            old, new = self._steps[: _MAX_STEPS // 2], self._steps[_MAX_STEPS // 2 :]
            self._steps = [_joined_steps(*old[index : index + 2]) for index in range(0, len(old), 2)] + new

    def drop_before(self, t_s: float) -> None:
        """Drop the steps that began earlier."""
        self._steps = [one for one in self._steps if one.start_s >= t_s]

    def table(self) -> StepTable:
        """The closed steps as arrays."""
        pairs = tuple(sorted({pair for one in self._steps for pair in one.ranges}))
        nothing = (math.nan, math.nan)
        both = np.array([[one.ranges.get(pair, nothing) for pair in pairs] for one in self._steps])
        both = both.reshape(len(self._steps), len(pairs), 2)
        return StepTable(np.array([one.start_s for one in self._steps]), pairs, both[..., 0], both[..., 1])


def _joined_steps(one: _Step, other: _Step) -> _Step:
    ranges = one.ranges | other.ranges
    for pair in one.ranges.keys() & other.ranges.keys():
        (a_m, a_m2), (b_m, b_m2) = one.ranges[pair], other.ranges[pair]
        ranges[pair] = 0.5 * (a_m + b_m), 0.25 * (a_m2 + b_m2)
    return _Step(one.start_s, ranges)


# Ranges as legs arrive


class PairRanger:
    """Computes ranges from directed legs between anchors, in bounded memory.

    ``counters``: ``legs``, and dropped input: ``impossible`` (brackets that cannot belong to one pair of counters),
    ``unusable`` (legs from an anchor to itself, without a finite time, or with impossible stamps), ``too-many-pairs``.
    """

    def __init__(
        self, bits: int = TICK_BITS, block_s: float = 1.0, on_block: Callable[[PairBlock], None] | None = None
    ) -> None:
        """``bits``: width of the counters; ``block_s``: length of a block.

        ``on_block`` is called with every block of every pair once its time is over, even a late one; blocks of the same
        time come in succession.
        """
        self.counters: Counter[str] = Counter()
        self._block_s, self._on_block = block_s, on_block
        self._longest_ticks = min(round(_LONGEST_BRACKET_S * TICK_RATE_HZ), (1 << (bits - 1)) - 1)
        self._clocks: defaultdict[int, Unwrapper] = defaultdict(partial(Unwrapper, bits=bits))
        self._number: dict[tuple[int, int], int] = {}
        self._open: list[tuple[int, int, int, bool, bool, float]] = []
        """As in ``LEGS``."""
        self._kept = np.empty(0, LEGS)
        self._histories: list[_History] = []
        self._shared_m2 = self._products = 0.0
        """Sum of residual products of two pairs that share an anchor's frame, and their number."""
        self._block: int | None = None
        """Number of the open block, counted from time 0."""
        self._first_s = self._last_s = math.nan
        self._duration_s = 0.0
        self.steps = RangeSteps()
        """The ranges as a time series."""

    def add(self, sender: int, receiver: int, tx_ticks: int, rx_ticks: int, t_s: float) -> None:
        """Add one reception. ``t_s``: on a clock common to all legs, accurate to a second and to a quarter of a wrap.

        Order matters little: the two directions of a pair may come seconds apart.
        """
        if sender == receiver or not math.isfinite(t_s) or max(abs(tx_ticks), abs(rx_ticks)) > _LARGEST_TICKS:
            self.counters["unusable"] += 1
            return
        pair = (sender, receiver) if sender < receiver else (receiver, sender)
        number = self._number.get(pair)
        if number is None:
            if len(self._number) >= _MAX_PAIRS:
                self.counters["too-many-pairs"] += 1
                return
            number = self._number[pair] = len(self._number)
            self._histories.append(_History())
        self._pass_to(t_s)
        tx = self._clocks[sender].unwrap(tx_ticks, t_s)
        rx = self._clocks[receiver].unwrap(rx_ticks, t_s)
        self.counters["legs"] += 1
        is_back = sender > receiver
        self._open.append((number, *((rx, tx) if is_back else (tx, rx)), is_back, False, t_s))
        if len(self._open) >= _MAX_OPEN_LEGS:
            self._close_block()

    def forget(self, anchor: int) -> None:
        """Drop the open legs of an anchor whose counter has restarted, but keep its ranges."""
        self._clocks.pop(anchor, None)
        numbers = [number for pair, number in self._number.items() if anchor in pair]
        self._open = [leg for leg in self._open if leg[0] not in set(numbers)]
        self._kept = self._kept[~np.isin(self._kept["pair"], numbers)]

    def drop_before(self, t_s: float) -> None:
        """Drop the ranges from before a time, when an anchor was elsewhere."""
        self.steps.drop_before(t_s)
        for history in self._histories:
            history.drop_before(t_s)
        self._duration_s = max(min(self._duration_s, self._last_s - t_s), 0.0)

    def finish(self) -> None:
        """Close the open block, at the end of the data."""
        self._close_block()
        self.steps.finish()

    @property
    def tx_stamp_std_m(self) -> float:
        """Noise of one TX stamp, as far as it can be separated from RX noise; 0 before the first block.

        The means of two pairs that share an anchor have the covariance ``tx_stamp_std_m²/(4·exchanges)``.
        """
        assumed_m2 = self._leg_variance_m2() / 2.0
        shared_m2 = 4.0 * self._shared_m2 + _PRIOR_PRODUCTS * assumed_m2
        variance_m2 = shared_m2 / (self._products + _PRIOR_PRODUCTS)
        return math.sqrt(min(max(variance_m2, 0.0), 2.0 * assumed_m2))

    def ranges(self) -> PairRanges:
        """The ranges from all closed blocks."""
        site_m2, means = self._leg_variance_m2(), []
        for (a, b), number in sorted(self._number.items()):
            history = self._histories[number]
            if history.blocks:
                means.append((a, b, history.mean(history.leg_variance_m2(site_m2))))
        anchors = tuple(sorted({anchor for pair in self._number for anchor in pair}))
        tx_std_m = {}
        for anchor in anchors:
            exchanges = [mean.exchanges for a, b, mean in means if anchor in {a, b}]
            if exchanges:
                tx_std_m[anchor] = self.tx_stamp_std_m / (2.0 * math.sqrt(float(np.median(exchanges))))
        pairs = []
        for a, b, mean in means:
            own_m2 = mean.noise_m2 - tx_std_m[a] ** 2 - tx_std_m[b] ** 2
            std_m = math.sqrt(max(own_m2, _MIN_OWN_SHARE * mean.noise_m2) + mean.wander_m2)
            pairs.append(PairRange(a, b, mean.range_m, std_m, max(1, round(mean.exchanges)), mean.late_share))
        return PairRanges(tuple(pairs), anchors, tx_std_m, self._duration_s)

    def _pass_to(self, t_s: float) -> None:
        """Close the open block if its time is over. After a jump of the clock, blocks start again."""
        block, number = self._block, math.floor(t_s / self._block_s)
        if block is None or number > block or t_s < block * self._block_s - _KEPT_S:
            if block is not None:
                self._close_block()
            if block is None or not -_KEPT_S < t_s - self._last_s < _KEPT_S:
                self._kept, self._first_s = np.empty(0, LEGS), t_s
                self._clocks.clear()
            self._block = number
            self._last_s = t_s
        self._last_s = max(self._last_s, t_s)

    # Blocks

    def _close_block(self) -> None:
        if not self._open or self._block is None:
            return
        legs = np.concatenate([self._kept, np.array(self._open, LEGS)])
        self._open = []
        flights, kept, impossible = flights_of(legs, self._longest_ticks)
        self._kept = kept[kept["t_s"] > self._last_s - _KEPT_S]
        self._duration_s += self._last_s - self._first_s
        self._first_s = self._last_s
        self.counters["impossible"] += impossible
        if len(flights):
            self._add_block(legs, flights, (self._block + 0.5) * self._block_s)

    def _add_block(self, legs: Records, flights: Records, t_s: float) -> None:
        """Add the mean of each pair's flights without outliers, and learn the stamp noise from their scatter."""
        good = _inliers(legs["pair"][flights["leg"]], flights["ticks"] * TICK_M)
        leg, range_m, part = flights["leg"][good], flights["ticks"][good] * TICK_M, flights["part"][good]
        pair = legs["pair"][leg]
        count = len(self._histories)
        n = np.bincount(pair, minlength=count)
        back = np.bincount(pair, legs["is_back"][leg], minlength=count)
        one_each = 1.0 / np.maximum(back, 1.0) + 1.0 / np.maximum(n - back, 1.0)
        mean_m = np.bincount(pair, range_m, minlength=count) / np.maximum(n, 1)
        residual_m = range_m - mean_m[pair]
        squares_m2 = np.bincount(pair, residual_m**2, minlength=count)
        # A flight is half the sum of one leg and of the legs before and after it, with weights 1 - part and part.
        flight_weight = np.bincount(pair, 1.0 + part**2 + (1.0 - part) ** 2, minlength=count)
        freedom = flight_weight - n * one_each
        self._share(legs, leg, residual_m, n)
        for number in np.flatnonzero(n).tolist():
            history = self._histories[number]
            if freedom[number] > 0.0 and n[number] > 2:
                history.squares_m2 += 4.0 * float(squares_m2[number])
                history.freedom += float(freedom[number])
            history.add(t_s, float(mean_m[number]), 2.0 / float(one_each[number]), self._leg_variance_m2)
        pairs, site_m2 = list(self._number), self._leg_variance_m2()
        for number in np.flatnonzero(n).tolist():
            variance_m2 = self._histories[number].leg_variance_m2(site_m2) * float(one_each[number]) / 4.0
            exchanges = max(1, round(2.0 / float(one_each[number])))
            a, b = pairs[number]
            block = PairBlock(a, b, t_s, float(mean_m[number]), math.sqrt(variance_m2), exchanges)
            self.steps.add(block)
            if self._on_block is not None:
                self._on_block(block)

    def _share(self, legs: Records, leg: Integers, residual_m: Array, n: Integers) -> None:
        """Sum the residual products of pairs that were bracketed with the same frame of an anchor."""
        anchors = np.array(list(self._number), dtype=np.int64).reshape(-1, 2)
        pair, is_back = legs["pair"][leg], legs["is_back"][leg]
        sender = np.where(is_back, anchors[pair, 1], anchors[pair, 0])
        tx_ticks = np.where(is_back, legs["b_ticks"][leg], legs["a_ticks"][leg])
        order = np.lexsort((tx_ticks, sender))
        first = np.ones(len(order), dtype=bool)
        first[1:] = (np.diff(sender[order]) != 0) | (np.diff(tx_ticks[order]) != 0)
        group = np.cumsum(first) - 1
        total_m = np.bincount(group, residual_m[order])
        squares_m2 = np.bincount(group, residual_m[order] ** 2)
        size = np.bincount(group)
        # Subtracting the pairs' means has removed 2/n of that covariance.
        freedom = 1.0 - 2.0 * float(np.mean(1.0 / np.maximum(n[pair], 2)))
        self._shared_m2 += float(np.sum(total_m**2 - squares_m2))
        self._products += float(np.sum(size * (size - 1))) * max(freedom, 0.0)

    def _leg_variance_m2(self) -> float:
        """Noise of one TX and one RX stamp together: the median over the pairs."""
        known = [one.squares_m2 / one.freedom for one in self._histories if one.freedom > 0.0]
        return float(np.median(known)) if known else 0.0


class _Mean(Struct, frozen=True):
    range_m: float
    noise_m2: float
    """Variance of the mean from stamp noise."""
    wander_m2: float
    """Further variance, from the scatter between blocks."""
    exchanges: float
    late_share: float


class _History:
    """The blocks of one pair in the order of time; if there are too many, neighbours are merged."""

    def __init__(self) -> None:
        self.blocks: list[tuple[float, float, float]] = []
        """Middle time, mean range in metres, exchanges."""
        self.squares_m2 = self.freedom = 0.0
        """Their ratio is the noise of a TX and an RX stamp together."""
        self._early = self._late = 0.0
        """Exchanges of dropped blocks before and after the cluster."""

    def leg_variance_m2(self, site_m2: float) -> float:
        """Noise of one TX and one RX stamp together, with the site's noise as a prior worth some hundred flights."""
        return (self.squares_m2 + _PRIOR_WEIGHT * site_m2) / (self.freedom + _PRIOR_WEIGHT)

    def add(self, t_s: float, range_m: float, exchanges: float, site_m2: Callable[[], float]) -> None:
        """Add a block; ``site_m2()``: noise of a leg at the site."""
        self.blocks.append((t_s, range_m, exchanges))
        if len(self.blocks) > _MAX_BLOCKS:
            self._merge(self.leg_variance_m2(site_m2()))

    def drop_before(self, t_s: float) -> None:
        self.blocks = [block for block in self.blocks if block[0] >= t_s]
        self._early = self._late = 0.0

    def mean(self, leg_m2: float) -> _Mean:
        """Mean of the earliest cluster; ``leg_m2``: noise of a leg."""
        blocks = np.array(self.blocks)
        inside, late, total = self._cluster(blocks, leg_m2)
        range_m, exchanges = blocks[inside, 1], blocks[inside, 2]
        noise_m2 = 0.5 * leg_m2 / float(np.sum(exchanges))
        wander_m2 = _wander_m2(range_m, exchanges, noise_m2)
        mean_m = float(np.average(range_m, weights=exchanges))
        return _Mean(mean_m, noise_m2, wander_m2, float(np.sum(exchanges)), late / total)

    def _cluster(self, blocks: Array, leg_m2: float) -> tuple[Mask, float, float]:
        """Mask of the blocks in the earliest cluster, number of later exchanges, and of all exchanges."""
        range_m, exchanges = blocks[:, 1], blocks[:, 2]
        total = self._early + self._late + float(np.sum(exchanges))
        std_m = math.sqrt(0.5 * leg_m2 / float(np.median(exchanges)))
        inside = earliest_cluster(range_m, exchanges, std_m, total)
        is_late = ~inside & (range_m > np.mean(range_m[inside]))
        return inside, self._late + float(np.sum(exchanges[is_late])), total

    def _merge(self, leg_m2: float) -> None:
        """Drop the blocks outside the cluster, and join neighbours of the rest."""
        blocks = np.array(self.blocks)
        inside, self._late, total = self._cluster(blocks, leg_m2)
        self._early = total - self._late - float(np.sum(blocks[inside, 2]))
        rest, merged = blocks[inside].tolist(), []
        for index in range(0, len(rest) - 1, 2):
            (t_s, range_m, exchanges), (next_s, next_m, more) = rest[index], rest[index + 1]
            part = more / (exchanges + more)
            merged.append((t_s + part * (next_s - t_s), range_m + part * (next_m - range_m), exchanges + more))
        self.blocks = merged + [tuple(row) for row in rest[len(rest) // 2 * 2 :]]


def _wander_m2(range_m: Array, exchanges: Array, noise_m2: float) -> float:
    """Variance of the mean beyond stamp noise, from the scatter of blocks, joined step by step to show slow errors.

    Only scatter beyond chance counts, so that a pair without such errors keeps the variance of its noise.
    """
    wander_m2, value, weight = 0.0, range_m, exchanges
    while len(value) >= _MIN_BATCHES:
        freedom = len(value) - 1
        deviation = value - np.average(value, weights=weight)
        scatter_m2 = float(np.sum(weight * deviation**2)) / (freedom * float(np.sum(weight)))
        if scatter_m2 > noise_m2 * (1.0 + 4.0 * math.sqrt(2.0 / freedom)):
            wander_m2 = max(wander_m2, scatter_m2 - noise_m2)
        even = len(value) // 2 * 2
        joined = weight[:even].reshape(-1, 2)
        value = np.sum(value[:even].reshape(-1, 2) * joined, axis=1) / np.sum(joined, axis=1)
        weight = np.sum(joined, axis=1)
    return wander_m2


def _inliers(pair: Integers, value: Array) -> Mask:
    """Mask of flights within 5 sigma of their pair's median, by the larger of the pair's and the site's scatter."""
    count = int(pair.max()) + 1
    distance = np.abs(value - group_medians(pair, value, count, upper=True)[pair])
    own = group_medians(pair, distance, count, upper=True)
    scatter = STD_OVER_MAD * np.maximum(own, np.median(distance))
    return np.asarray(distance <= _OUTLIER_SIGMAS * scatter[pair] + TICK_M)
