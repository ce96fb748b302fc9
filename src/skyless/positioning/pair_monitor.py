"""Whom the filter of pair differences believes: differences by their innovations, anchors by what those add up to.

An anchor whose direct path is blocked is late for seconds, often by metres, and a difference does not say which of its
two anchors is wrong. So for each anchor the filter keeps what the state would err for each metre of lateness since
lately (``faults``), and with it how well such a fault explains the innovations (the generalised likelihood ratio of
Willsky and Jones, 1976, with a memory that fades). The anchor that explains them best is left out, the state is doubted
where the anchor may have moved it, and it comes back when its innovations are ordinary again.
"""

from typing import Final

import numpy as np

from skyless.compiled import borrowing_kernel
from skyless.positioning.estimator.monitor import HUBER, LAG_FORGETTING, LAG_GAIN, LAG_LIMIT
from skyless.positioning.pair_state import (
    AGE_S,
    BEYOND_REPAIR,
    DIM,
    EXCLUSIONS,
    GATE,
    INFORMATION,
    LAG,
    LAG_SQUARED,
    MISFIT,
    PLACE,
    READMISSIONS,
    SLOTS,
    SUM,
    WORTH,
    PairArrays,
    along,
    constant_of,
    forget_evidence,
    states,
)
from skyless.positioning.tracker import (
    ACCEPTED,
    CHI2,
    FORGETTING,
    REJECTED,
    REJECTED_IN_ROW,
    REJECTED_SHARE,
    RESIDUAL_SQUARED,
    Vector,
    adapt_agility,
)

MEMORY_S: Final = 0.5
"""A fault is looked for in the innovations of so long."""

FAULTY: Final = 15.0
"""Twice the logarithm of the likelihood ratio from which an anchor is faulty."""

EARLY: Final = 0.8
"""Weight of anchors that seem early: obstacles make them late."""

CLIP: Final = 3.0
"""Standard deviations that one innovation counts at most as evidence."""

MOST_EXCLUDED: Final = 2
SPARE: Final = 2
"""So many anchors more than dimensions remain."""

IN_VIEW_S: Final = 2.0
MISFIT_GAIN: Final = 0.05
MISFIT_MOST: Final = 16.0
READMIT_AT: Final = 2.0
"""An excluded anchor is believed again when the mean of its normalised innovations squared is below this."""

WORTH_GAIN: Final = 0.005
WORTH_MOST: Final = 9.0


@borrowing_kernel
def spread_factor(s: PairArrays) -> float:
    """By how much innovations vary more than expected: where all anchors scatter, none is faulty."""
    return float(min(max(1.0, s.statistics[WORTH]), WORTH_MOST))


@borrowing_kernel
def watch_excluded(s: PairArrays, slot: int, normalised: float) -> None:
    """Take back an anchor that was left out once its innovations are ordinary."""
    squared = min(normalised * normalised, MISFIT_MOST)
    s.slots[slot, MISFIT] += MISFIT_GAIN * (squared - s.slots[slot, MISFIT])
    if s.slots[slot, MISFIT] < READMIT_AT:
        s.excluded[slot] = 0
        s.counts[READMISSIONS] += 1
        forget_evidence(s, slot)


@borrowing_kernel
def gather(s: PairArrays, a: int, b: int, dt_s: float, innovation: float, spread: float) -> int:
    """Add an innovation to the evidence against every anchor; the one that is faulty, or −1."""
    fading = np.exp(-dt_s / MEMORY_S)
    most = CLIP * np.sqrt(spread)
    clipped = min(max(innovation, -most), most)
    faulty, likely = -1, FAULTY
    for slot in range(s.counts[SLOTS]):
        part = -along(s, a, b, s.faults, slot)
        if slot == b:
            part += 1.0
        elif slot == a:
            part -= 1.0
        s.parts[slot] = part
        total = fading * s.slots[slot, SUM] + part * clipped / spread
        information = fading * s.slots[slot, INFORMATION] + part * part / spread
        s.slots[slot, SUM], s.slots[slot, INFORMATION] = total, information
        ratio = total * total / max(information, 1e-9) * (1.0 if total > 0.0 else EARLY)
        if ratio > likely:
            faulty, likely = slot, ratio
    return faulty


@borrowing_kernel
def follow_faults(s: PairArrays, dt_s: float, accepted: bool, spread: float) -> None:
    """Let the errors that faults would make follow the update; older faults fade."""
    n, fading = states(s), np.exp(-dt_s / MEMORY_S)
    gain = 1.0 / spread if accepted else 0.0
    for slot in range(s.counts[SLOTS]):
        for state in range(n):
            s.faults[slot, state] = fading * (s.faults[slot, state] + gain * s.parts[slot] * s.ph[state])


@borrowing_kernel
def judge_pair(s: PairArrays, innovation: float, spread: float) -> float:
    """How much more spread a difference is to be given, as a factor; 0 if it is not to be used. Keeps the counts."""
    counts, statistics = s.counts, s.statistics
    normalised = innovation / np.sqrt(spread)
    squared = normalised * normalised
    if not np.isfinite(squared):
        squared = np.inf
    worth = min(squared, WORTH_MOST) * spread_factor(s)
    statistics[WORTH] += WORTH_GAIN * (worth - statistics[WORTH])
    statistics[REJECTED_SHARE] *= 1.0 - FORGETTING
    if not squared <= s.settings[GATE] * s.settings[GATE]:
        counts[REJECTED] += 1
        counts[REJECTED_IN_ROW] += 1
        statistics[REJECTED_SHARE] += FORGETTING
        return 0.0
    counts[ACCEPTED] += 1
    counts[REJECTED_IN_ROW] = 0
    statistics[CHI2] += FORGETTING * (squared - statistics[CHI2])
    statistics[RESIDUAL_SQUARED] += FORGETTING * (innovation * innovation - statistics[RESIDUAL_SQUARED])
    return float(max(1.0, abs(normalised) / HUBER))


@borrowing_kernel
def exclude(s: PairArrays, slot: int) -> None:
    """Leave a faulty anchor out and doubt what it may have done; where none can be spared, the state is beyond repair.

    The state itself stays: while wild innovations were refused, the fault did less than they let think.
    """
    n = states(s)
    if not _can_be_spared(s):
        s.counts[BEYOND_REPAIR] += 1
        return
    fault_m = s.slots[slot, SUM] / s.slots[slot, INFORMATION]
    variance = fault_m * fault_m
    for row in range(n):
        error = s.faults[slot, row]
        for column in range(n):
            s.P[row, column] += variance * error * s.faults[slot, column]
    s.excluded[slot] = 1
    s.counts[EXCLUSIONS] += 1
    place = constant_of(s, slot) + 1
    s.x[place] = 0.0
    for state in range(n):
        s.P[place, state] = 0.0
        s.P[state, place] = 0.0
    s.P[place, place] = s.settings[PLACE]
    for other in range(s.counts[SLOTS]):
        forget_evidence(s, other)
    s.slots[slot, MISFIT] = MISFIT_MOST


@borrowing_kernel
def _can_be_spared(s: PairArrays) -> bool:
    """Whether one more anchor can be left out."""
    left, excluded = 0, 0
    for slot in range(s.counts[SLOTS]):
        if s.slots[slot, AGE_S] < IN_VIEW_S:
            left += 1 - s.excluded[slot]
            excluded += s.excluded[slot]
    return bool(excluded < MOST_EXCLUDED and left - 1 >= int(s.settings[DIM]) + SPARE)


@borrowing_kernel
def follow_motion(s: PairArrays, normalised: float) -> None:
    """Adapt the agility, as in ``joint``: where the position lags, innovations along an axis have one sign for long."""
    statistics, dim = s.statistics, int(s.settings[DIM])
    length = 1e-9
    for axis in range(dim):
        length += s.h[axis] ** 2
    squared = 0.0
    for axis in range(dim):
        toward = s.h[axis] / np.sqrt(length) * normalised
        statistics[LAG + axis] += LAG_GAIN * (toward - statistics[LAG + axis])
        squared += statistics[LAG + axis] ** 2
    follow_lag(statistics, LAG_SQUARED, squared)


@borrowing_kernel
def follow_lag(statistics: Vector, place: int, squared: float) -> None:
    """Adapt the agility to the squares of the lag along the axes, whose running mean stands at ``place``."""
    squared *= (2.0 - LAG_GAIN) / LAG_GAIN
    statistics[place] += LAG_FORGETTING * (squared - statistics[place])
    adapt_agility(statistics, statistics[place] > LAG_LIMIT)
