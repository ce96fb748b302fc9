"""The watch of the anchors by the phases of their carriers: millimetres, but only modulo half a wavelength.

    −phase(b receives a) − phase(a receives b)  =  2·distance/λ + constant      (mod 1 cycle)

The clocks cancel where both phases are of one instant: those of one direction are interpolated at the receptions of the
other, along the difference of the clocks that the stamps show. The constant stays as long as both radios keep their
supply (``docs/watch.md``).
"""

import math
from collections import Counter, deque
from typing import Final

import numpy as np
from msgspec import Struct, field

from skyless.core.arrays import Array
from skyless.core.ticks import CARRIER_CYCLES, TICK_M, TICK_RATE_HZ, difference
from skyless.site.survey.stamps.legs import AnchorLeg
from skyless.site.survey.stamps.repeats import STD_OVER_MAD
from skyless.site.survey.two_way import MAX_BRACKET_RATE
from skyless.site.survey.watch.explain import Finding

BLOCK_S: Final = 2.0
_LIMIT_M: Final = 0.002
_SIGMAS: Final = 5.0
_LEARNING_BLOCKS: Final = 5
_USUAL_BLOCKS: Final = 300  # whose mean is the reference, without those that were off
_STRIKES: Final = 2  # blocks in a row after which a pair has changed, or has not any more
_FEWEST: Final = 8  # legs of each direction, and sums, in a block
_MOST: Final = 4096  # legs in a block
_LONGEST_GAP_S: Final = 0.1  # between two phases that one is interpolated from
_LARGEST_SCATTER: Final = 0.12  # cycles of one sum
_DRIFT_TICKS_PER_S: Final = MAX_BRACKET_RATE * TICK_RATE_HZ
_LONGEST_JUMP_TICKS: Final = TICK_RATE_HZ  # where clocks may have drifted farther, a restart cannot be recognised


def circular_mean(cycles: Array) -> tuple[float, float]:
    """Mean of phases, shape (n,), n > 0, without outliers, in [0, 1), and the scatter of one of them, in cycles."""
    kept, mean = cycles, 0.0
    for sigmas in (1e9, 5.0, 3.0, 3.0, 3.0, 3.0):  # many wild phases move the first means
        off = (cycles - mean + 0.5) % 1.0 - 0.5
        kept = off[np.abs(off) <= sigmas * STD_OVER_MAD * float(np.median(np.abs(off))) + 1e-9]
        mean += float(np.angle(np.exp(2j * np.pi * kept).sum()) / (2.0 * np.pi))
    return mean % 1.0, float(np.std(kept))


class _Pair(Struct):
    """The newest legs of a pair, its sums of blocks in which nothing had changed, and what has."""

    legs: list[AnchorLeg] = field(default_factory=list)
    block: int = 0
    """Number of the present one."""
    usual_cycles: deque[float] = field(default_factory=lambda: deque(maxlen=_USUAL_BLOCKS))
    clock_ticks: int = 0
    """Difference of the counters in the block ``clock_block``."""
    clock_block: int = 0
    change_cycles: float = 0.0
    strikes: int = 0
    since_s: float | None = None
    """When it changed; None while it has not."""

    def add(self, cycles: float, std_cycles: float, limit_cycles: float) -> None:
        """Compare the present block with the usual ones."""
        is_off = False
        if len(self.usual_cycles) >= _LEARNING_BLOCKS:
            usual, scatter = circular_mean(np.array(self.usual_cycles))
            change = math.remainder(cycles - usual, 1.0)
            is_off = abs(change) > max(limit_cycles, _SIGMAS * math.hypot(scatter, std_cycles))
            self.change_cycles = change if is_off else self.change_cycles
        self.strikes = min(self.strikes + 1, _STRIKES) if is_off else max(self.strikes - 1, 0)
        if self.strikes == _STRIKES and self.since_s is None:
            self.since_s = (self.block - _STRIKES + 1) * BLOCK_S
        elif self.strikes == 0:
            self.since_s = None
            self.usual_cycles.append(cycles)


class PhaseWatch:
    """Names anchors that have moved by more than 2 mm, or turned. Its time is ``t_s`` of the legs."""

    def __init__(self, carrier_cycles: int = CARRIER_CYCLES[5]) -> None:
        """``carrier_cycles``: of the carrier in 128 ticks."""
        self._cycles_per_tick = carrier_cycles / 128
        self._half_wave_m = TICK_M / self._cycles_per_tick / 2.0
        self._pairs: dict[tuple[int, int], _Pair] = {}

    def add(self, leg: AnchorLeg) -> None:
        """Add a leg, in any order within a second. One without a phase teaches nothing."""
        phase_cycles = leg.carrier_phase_cycles
        if phase_cycles is None or leg.sender == leg.receiver or not math.isfinite(phase_cycles + leg.t_s):
            return
        pair, block = (min(leg.sender, leg.receiver), max(leg.sender, leg.receiver)), math.floor(leg.t_s / BLOCK_S)
        one = self._pairs.setdefault(pair, _Pair(block=block))
        if not one.block - 1 <= block <= one.block:
            self._conclude(pair, one)
            one.block = block
        if len(one.legs) < _MOST:
            one.legs.append(leg)

    def _conclude(self, pair: tuple[int, int], one: _Pair) -> None:
        """Look at a block that is over. Where a counter has restarted, what is usual is learned again."""
        found = _sum_of(one.legs, pair[0], self._cycles_per_tick)
        one.legs.clear()
        if found is None:
            return
        cycles, std_cycles, clock_ticks = found
        limit_ticks = _DRIFT_TICKS_PER_S * BLOCK_S * (abs(one.block - one.clock_block) + 1)
        if not abs(difference(clock_ticks, one.clock_ticks)) <= limit_ticks <= _LONGEST_JUMP_TICKS:
            one.usual_cycles.clear()
        one.clock_ticks, one.clock_block = clock_ticks, one.block
        one.add(cycles, std_cycles, _LIMIT_M / self._half_wave_m)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The anchors most of whose pairs have changed, at least two, while most pairs of the others have not."""
        rest = {pair: one for pair, one in self._pairs.items() if len(one.usual_cycles) >= _LEARNING_BLOCKS}
        found = []
        while changed := {pair: one for pair, one in rest.items() if one.since_s is not None}:
            ends, all_ends = (Counter(end for pair in pairs for end in pair) for pairs in (changed, rest))
            worst = max(ends, key=lambda anchor: (ends[anchor] / all_ends[anchor], ends[anchor]))
            if ends[worst] < 2 or 2 * ends[worst] <= all_ends[worst]:
                break
            found.append(self._finding(worst, [one for pair, one in changed.items() if worst in pair]))
            rest = {pair: one for pair, one in rest.items() if worst not in pair}
        return tuple(found) if 2 * len(changed) <= len(rest) > 0 else ()

    def _finding(self, anchor: int, changed: list[_Pair]) -> Finding:
        half_m, size_m = self._half_wave_m, max(abs(one.change_cycles) for one in changed) * self._half_wave_m
        alike = ", ".join(f"{1e3 * other_m:.0f}" for other_m in (half_m - size_m, half_m + size_m, 2 * half_m - size_m))
        sentence = f"anchor {anchor} moved or turned by about {1e3 * size_m:.0f} mm (or {alike} …)"
        since_s = min(one.since_s for one in changed if one.since_s is not None)
        return Finding("check", (anchor,), size_m, None, since_s, f"{sentence}, by the phases of its carrier")


def _sum_of(legs: list[AnchorLeg], first: int, cycles_per_tick: float) -> tuple[float, float, int] | None:
    """Both directions' sum and its standard deviation in cycles, and the counters' difference; None of too few legs."""
    if len(legs) < 2 * _FEWEST:
        return None
    is_out = np.array([leg.sender == first for leg in legs])
    stamps = [(leg.tx_ticks, leg.rx_ticks) if leg.sender == first else (leg.rx_ticks, leg.tx_ticks) for leg in legs]
    clock_ticks = stamps[0][1] - stamps[0][0]
    gained = np.array([difference(y_ticks - x_ticks, clock_ticks) for x_ticks, y_ticks in stamps], np.float64)
    gained -= (middle := float(np.median(gained)))
    begin_ticks = stamps[int(np.argmin(np.abs(gained)))][0]
    t_s = np.array([difference(x_ticks, begin_ticks) for x_ticks, _ in stamps]) / TICK_RATE_HZ
    run = np.flatnonzero(np.abs(gained) < 2.0 * BLOCK_S * _DRIFT_TICKS_PER_S)  # of both counters
    run = run[np.argsort(t_s[run])]
    t_s, gained, is_out = t_s[run], gained[run], is_out[run]
    if min(is_out.sum(), (~is_out).sum()) < _FEWEST:
        return None
    way = np.where(is_out, 1.0, -1.0)
    terms = np.stack([t_s, t_s * t_s, way, np.ones(len(run))], axis=1)  # flight and delays have another sign each way
    off_ticks, fit = np.zeros(len(run)), np.zeros(4)
    for _ in range(2):
        near = np.abs(off_ticks) <= _SIGMAS * STD_OVER_MAD * float(np.median(np.abs(off_ticks)))
        fit = np.linalg.lstsq(terms[near], gained[near])[0]
        off_ticks = gained - terms @ fit
    off = -np.array([leg.carrier_phase_cycles for leg in legs])[run] % 1.0
    off -= way * cycles_per_tick * (terms[:, :2] @ fit[:2])
    back_s, at_s = t_s[~is_out], t_s[is_out]
    after = np.clip(np.searchsorted(back_s, at_s), 1, len(back_s) - 1)
    between = (back_s[after - 1] <= at_s) & (at_s <= back_s[after])
    between &= back_s[after] - back_s[after - 1] <= _LONGEST_GAP_S
    if between.sum() < _FEWEST:
        return None
    sums = off[is_out] + np.interp(at_s, back_s, np.unwrap(off[~is_out], period=1.0))
    cycles, scatter = circular_mean(sums[between])
    if scatter > _LARGEST_SCATTER:
        return None
    return cycles, scatter / math.sqrt(between.sum()), clock_ticks + round(middle)
