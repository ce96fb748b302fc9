"""One timeline over many hops: of slots, and of site time where the site wants it (``docs/maths.md`` section 6).

An anchor compares its counter with the raw counters of up to three parents, each by a filter of its own, and carries
each parent's stated timeline over to its own counter. No filter follows what another filter states, so slow errors
do not grow from hop to hop. The root's timeline goes on by its own counter.
"""

import math
from collections import Counter
from collections.abc import Iterable
from typing import Final

from skyless.air.beacon2 import SlotTime, StatedSiteTime
from skyless.clocks.composition import (
    AVERAGING_S,
    GRID_VARIANCE_M2,
    MEAN_LATE_TICKS,
    SLOT_GAIN,
    by_parent,
)
from skyless.clocks.filter import MAX_RELATIVE_RATE, ClockFilter, ClockNoise
from skyless.clocks.site_clock import (
    GRID_SLACK_TICKS,
    MISFITS_BEFORE_RESTART,
    PLACEMENT_STD_M,
    STAMP_SLACK_TICKS,
    SiteTime,
    continued,
    own_counter,
)
from skyless.constants import MAX_DRIFT, SPEED_OF_LIGHT_MPS, SUBTICKS, TICK_M, TICK_S
from skyless.site.slots import Schedule
from skyless.ticks import nearest, wrap

MOST_PARENTS: Final = 3

SUPERFRAME_BITS: Final = 32

KNOWN_RATE_STD: Final = 1e-8
"""Least of a pair's rate that follows from both anchors' rates against one timeline: ten times what those err."""


class _Parent:
    """One parent's raw counter against the own one, and its stated timeline at its last TX stamp."""

    def __init__(self, noise: ClockNoise, variance_m2: float) -> None:
        self.pair = ClockFilter(noise, variance_m2)
        self.tx_ticks = self.rx_ticks = 0
        """Of the last accepted beacon, unwrapped; the pair's filter is at this instant."""
        self.subticks: int | None = None
        """Timeline at that TX stamp in 1/256 tick; None before it is known."""
        self.rate = 0.0
        """Fractional rate of the parent's counter against the timeline."""
        self.hop = 0
        self.variance_m2 = 0.0
        self.statements = 0
        """Accepted since the line began."""
        self.misfits = 0
        """Beacons in a row whose stamps did not fit."""
        self.line_misfits = 0
        """Beacons in a row whose stated timeline did not fit."""


class ComposedTime:
    """Own counter to the timeline and back. All own readings are unwrapped; those of parents are raw, 40 bits."""

    def __init__(self, noise: ClockNoise, variance_m2: float, schedule: Schedule, counters: Counter[str]) -> None:
        """``noise`` of the difference of two clocks; ``variance_m2`` of a TX and an RX stamp together."""
        self._noise = noise
        self._variance_m2 = variance_m2
        self._schedule = schedule
        self._counters = counters
        self._parents: dict[int, _Parent] = {}
        self._map: SiteTime | None = None
        self._map_ticks = 0
        """Own reading of the last renewal of the map."""
        self._rate_std = MAX_RELATIVE_RATE
        """Of the own rate then, as far as the pairs go."""
        self._age_s = 0.0
        """Mean age of the parents' statements then."""
        self._delay_s = 0.5 * schedule.superframe_ticks * TICK_S
        """Mean age of the parents' statements at any time."""
        self._weights: list[tuple[_Parent, float]] = []
        self.is_root = False

    @property
    def is_known(self) -> bool:
        """Whether readings can be converted."""
        return self._map is not None

    @property
    def parents(self) -> tuple[int, ...]:
        """Identifiers of the present parents."""
        return tuple(self._parents)

    @property
    def rate(self) -> float:
        """Fractional rate of the own counter against the timeline; 0 before it is known."""
        return 0.0 if self._map is None else self._map.rate

    def updates(self, parent: int) -> int:
        """Beacons that the filter of that pair has processed since it began; 0 of others than parents."""
        state = self._parents.get(parent)
        return 0 if state is None else state.pair.updates

    def set_parents(self, parents: Iterable[int]) -> None:
        """Compare with these anchors from now on, three at most; the map stays until the next beacon."""
        wanted = tuple(parents)[:MOST_PARENTS]
        kept = self._parents
        self._parents = {parent: kept.get(parent) or _Parent(self._noise, self._variance_m2) for parent in wanted}
        self._weights = [(state, share) for state, share in self._weights if state in self._parents.values()]

    def lead(self, ticks_own: int) -> None:
        """Be the root: the timeline goes on by the own counter at the present rate, else it is the own counter."""
        self.is_root = True
        self.set_parents(())
        if self._map is None:
            self._map, self._map_ticks = own_counter(), ticks_own

    def stop_leading(self) -> None:
        """Be no root any longer: the next beacon of a parent counts."""
        self.is_root = False

    def correct_ranges(self) -> None:
        """Expect other distances to the parents, and corrected antenna delays; the timeline goes on."""
        for parent in self._parents.values():
            parent.pair.add_offset_variance(PLACEMENT_STD_M**2)

    def restart(self) -> None:
        """Forget the timeline, as another one counts from now on; the pairs' filters on raw counters stay."""
        self.is_root = False
        self._map = None
        self._weights = []
        for parent in self._parents.values():
            parent.subticks, parent.statements, parent.line_misfits = None, 0, 0

    def subticks(self, ticks_own: int) -> int:
        """Timeline at an own reading, in 1/256 tick. Raises ValueError before it is known."""
        return self._known().subticks(ticks_own)

    def ticks_own(self, ticks: int) -> int:
        """Nearest own reading of a time of the timeline in whole ticks. Raises ValueError before it is known."""
        return self._known().ticks_own(ticks)

    def variance_m2(self, ticks_own: int) -> float:
        """Variance of the timeline at an own reading, in m²; 0 for the root, infinite before it is known."""
        if self.is_root:
            return 0.0
        if not self._weights:
            return math.inf
        total = 0.0
        for parent, weight in self._weights:
            common, alone = self._by_parent(parent, ticks_own)
            total += weight * (common + weight * alone)
        return total

    def stated(self, ticks_own: int, superframe: int, slot: int) -> StatedSiteTime:
        """What the own beacon states at its TX stamp, superframe unwrapped. Raises ValueError before it is known."""
        start = self._schedule.slot_start_ticks(superframe, slot)
        residual = self.subticks(ticks_own) - start * SUBTICKS
        return StatedSiteTime(residual / SUBTICKS, math.sqrt(self.variance_m2(ticks_own)) / TICK_M)

    def superframe(self, ticks_own: int) -> int:
        """Unwrapped number of the superframe at an own reading. Raises ValueError before the timeline is known."""
        return self.subticks(ticks_own) // (self._schedule.superframe_ticks * SUBTICKS)

    def on_beacon(
        self,
        parent: int,
        tx_ticks: int,
        rx_ticks_own: int,
        range_m: float,
        slot_time: SlotTime,
        site_time: StatedSiteTime | None = None,
    ) -> bool:
        """Process a parent's beacon; False where it changes nothing, which is counted."""
        state = self._parents.get(parent)
        if state is None or self.is_root:
            return False
        if state.pair.updates and wrap(tx_ticks) == wrap(state.tx_ticks):
            self._counters["duplicate"] += 1
            return False
        if slot_time.slot >= self._schedule.slots or abs(slot_time.rate) > MAX_DRIFT:
            self._counters["impossible-slot-time"] += 1
            return False
        if not self._compare(state, tx_ticks, rx_ticks_own, range_m, slot_time):
            return False
        if not self._read(state, slot_time, site_time):
            return False
        self._renew(rx_ticks_own)
        return True

    def _known(self) -> SiteTime:
        if self._map is None:
            raise ValueError("the timeline is not known yet; see is_known")
        return self._map

    def _compare(self, state: _Parent, tx_counter: int, rx_ticks: int, range_m: float, slot_time: SlotTime) -> bool:
        """Update the pair's filter with the raw stamps; begin again after several that do not fit."""
        if state.pair.updates == 0:
            self._begin(state, wrap(tx_counter), rx_ticks, range_m, slot_time)
            return True
        elapsed = rx_ticks - state.rx_ticks
        tx_ticks = nearest(wrap(tx_counter), state.tx_ticks + elapsed)
        gone = tx_ticks - state.tx_ticks
        if gone <= 0 or abs(gone - elapsed) > MAX_DRIFT * elapsed + STAMP_SLACK_TICKS:
            self._counters["impossible-stamp"] += 1
            return self._misfit(state, tx_counter, rx_ticks, range_m, slot_time)
        before, rate = state.subticks, state.rate
        rejected_before = state.pair.rejected
        state.pair.update(tx_ticks, rx_ticks, range_m)
        if before is not None:  # the filter has moved to this instant, so the line does as well
            state.subticks = before + gone * SUBTICKS - round(gone * SUBTICKS * (rate / (1.0 + rate)))
        state.tx_ticks, state.rx_ticks = tx_ticks, rx_ticks
        if state.pair.rejected > rejected_before:
            self._counters["clock-outlier"] += 1
            return self._misfit(state, tx_counter, rx_ticks, range_m, slot_time)
        state.misfits = 0
        return True

    def _misfit(self, state: _Parent, tx_counter: int, rx_ticks: int, range_m: float, slot_time: SlotTime) -> bool:
        state.misfits += 1
        if state.misfits < MISFITS_BEFORE_RESTART:
            return False
        self._counters["clock-restart"] += 1
        self._begin(state, wrap(tx_counter), rx_ticks, range_m, slot_time, known=False)
        return True

    def _begin(
        self,
        state: _Parent,
        tx_ticks: int,
        rx_ticks: int,
        range_m: float,
        slot_time: SlotTime,
        *,
        known: bool = True,
    ) -> None:
        """Begin a pair's filter, with the rate that follows from the timeline where both know it."""
        rate = (1.0 + self._map.rate) / (1.0 + slot_time.rate) - 1.0 if known and self._map is not None else None
        if rate is None:
            state.pair.restart(tx_ticks, rx_ticks, range_m)
        else:
            rate_std = min(max(2.0 * self._rate_std, KNOWN_RATE_STD), MAX_RELATIVE_RATE)
            state.pair.restart(tx_ticks, rx_ticks, range_m, rate, rate_std)
        state.tx_ticks, state.rx_ticks = tx_ticks, rx_ticks
        state.subticks, state.statements = None, 0
        state.misfits = state.line_misfits = 0

    def _read(self, state: _Parent, slot_time: SlotTime, site_time: StatedSiteTime | None) -> bool:
        """Take over what the parent states of its timeline at this TX stamp."""
        superframe = slot_time.superframe
        if self._map is not None:
            superframe = nearest(superframe, self.superframe(state.rx_ticks), SUPERFRAME_BITS)
        start = self._schedule.slot_start_ticks(superframe, slot_time.slot) * SUBTICKS
        if site_time is None:
            stated = start - MEAN_LATE_TICKS * SUBTICKS
            gain = max(1.0 / (state.statements + 1), SLOT_GAIN)
            variance_m2 = (slot_time.hop + 1) * GRID_VARIANCE_M2 * gain / (2.0 - gain)
        else:
            stated = start + round(site_time.residual_ticks * SUBTICKS)
            gain = 1.0
            variance_m2 = (site_time.std_ticks * TICK_M) ** 2
        state.rate, state.hop, state.variance_m2 = slot_time.rate, slot_time.hop, variance_m2
        error = 0 if state.subticks is None else stated - state.subticks
        if abs(error) > GRID_SLACK_TICKS * SUBTICKS:
            self._counters["timeline-step"] += 1
            state.line_misfits += 1
            if state.line_misfits < MISFITS_BEFORE_RESTART:
                return False
            state.subticks, state.statements = None, 0
        state.line_misfits = 0
        state.subticks = stated if state.subticks is None else state.subticks + round(gain * error)
        state.statements += 1
        return True

    def _by_parent(self, parent: _Parent, ticks_own: int) -> tuple[float, float]:
        age_s = (ticks_own - parent.rx_ticks) * TICK_S
        pair, noise = parent.pair.covariance, self._noise
        return by_parent(parent.variance_m2, parent.hop, age_s, self._delay_s, pair, noise.white, noise.walk)

    def _renew(self, ticks_own: int) -> None:
        """The map from the mean of what follows by way of each parent, at this own reading."""
        if self._weights:
            elapsed_s = (ticks_own - self._map_ticks) * TICK_S
            age_s = self._age_s + 0.5 * elapsed_s
            self._delay_s += min(elapsed_s / AVERAGING_S, 1.0) * (age_s - self._delay_s)
        base: int | None = None
        total = mean = mean_rate = ages_s = 0.0
        weights: list[tuple[_Parent, float]] = []
        for state in self._parents.values():
            if state.subticks is None:
                continue
            weight = 1.0 / sum(self._by_parent(state, ticks_own))
            ticks_parent, fraction, _ = state.pair.to_master(ticks_own)
            elapsed = (ticks_parent - state.tx_ticks) * SUBTICKS
            line = state.subticks + elapsed - round(elapsed * (state.rate / (1.0 + state.rate)))
            base = line if base is None else base
            total += weight
            mean += weight * ((line - base) + fraction * SUBTICKS)
            mean_rate += weight * ((1.0 + state.pair.rate) * (1.0 + state.rate) - 1.0)
            ages_s += (ticks_own - state.rx_ticks) * TICK_S
            weights.append((state, weight))
        assert base is not None
        subticks = base + math.floor(mean / total + 0.5)
        ticks, rest = divmod(subticks, SUBTICKS)
        self._map = continued(ticks_own, ticks, rest / SUBTICKS, mean_rate / total)
        rate_variance = min(state.pair.covariance[2] for state, _ in weights)
        self._rate_std = math.sqrt(rate_variance) / SPEED_OF_LIGHT_MPS
        self._map_ticks, self._age_s = ticks_own, ages_s / len(weights)
        self._weights = [(state, weight / total) for state, weight in weights]
