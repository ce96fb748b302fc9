"""Whom ``joint`` believes: single messages by their innovations, anchors by what those add up to (``joint_faults``).

Late messages are the rule where paths are blocked, early ones are not. How many are late is estimated, and what is
believed follows: with none, all within the gate counts in full, so that clean data lose nothing (``docs/maths.md`` 6).
"""

from typing import Final

import numpy as np

from skyless.compiled import borrowing_kernel
from skyless.positioning.joint_faults import CHANGE, exclude_likeliest, take_back
from skyless.positioning.joint_state import (
    CLOCK_AGILITY,
    CLOCK_SHARE,
    DIM,
    EXCLUDED,
    GATE,
    IN_ROW,
    LAG,
    LAG_SQUARED,
    LATE_SHARE,
    MOST_CLOCK_AGILITY,
    OUT,
    SCORE,
    SLOTS,
    WEIGHT,
    JointArrays,
    Vector,
    values,
)
from skyless.positioning.tracker import (
    ACCEPTED,
    CHI2,
    FORGETTING,
    REJECTED,
    REJECTED_IN_ROW,
    REJECTED_SHARE,
    RESIDUAL_SQUARED,
    adapt_agility,
)

LATE_FORGETTING: Final = 0.005
LATE_DENSITY: Final = 0.05
"""Probability density of a late message's normalised innovation: a standard deviation of 5 cm, a metre of lateness."""

LATE_ENOUGH: Final = 0.02
HUBER: Final = 1.5
"""With more late messages than that, innovations beyond so many standard deviations weigh less."""

DOUBTFUL: Final = 2.0
"""Receptions with at least this factor on their variance are no sign of a filter that is lost if they do not fit."""

SCORE_GAIN: Final = 0.1
SCORE_CLIP: Final = 2.5
EXCLUDE_AT: Final = 4.5 * float(np.sqrt(SCORE_GAIN / (2.0 - SCORE_GAIN)))
"""Of the running mean of an anchor's normalised innovations, 4.5 standard deviations of it: some anchor is wrong."""

READMIT_AT: Final = 0.5 * EXCLUDE_AT
READMIT_AFTER: Final = 20
"""Packets of it: where the position had given way to a liar, its innovations look ordinary at first."""

CONTAMINATION_M: Final = 0.1
"""What an anchor that is excluded may have done to the position before, per axis."""

LAG_GAIN: Final = 0.05
LAG_FORGETTING: Final = 0.01
RESTLESS_LAG: Final = 2.3
"""Innovations along an axis, averaged over some 40 messages, are as large as noise alone makes them where the mean of
their squares is 1 (the sum over the axes in the plane); larger ones show a tag more agile than assumed."""

CLOCK_FORGETTING: Final = 0.01
RESTLESS_CLOCKS: Final = 0.45
"""Share of receptions beyond one standard deviation: 0.317 with noise alone, 0.43 with one liar of six."""

CLOCK_GAIN: Final = 1.02
CLOCK_LOSS: Final = 0.999


@borrowing_kernel
def gate_of(s: JointArrays) -> float:
    """Beyond how many standard deviations a message is more likely late than not."""
    late = s.statistics[LATE_SHARE]
    odds = late * LATE_DENSITY * 2.5066282746310002 / (1.0 - late)
    gate = s.settings[GATE]
    return float(min(gate, np.sqrt(-2.0 * np.log(odds)))) if odds > 1e-6 else float(gate)


@borrowing_kernel
def believe(s: JointArrays, slot: int, innovation: float, spread: float) -> float:
    """How much more spread a reception of the tag is to be given, as a factor; 0 if it is not to be used.

    Keeps the counts and running means, and those of the anchor. In all means doubtful receptions count less, by
    their factor: that they are late is known, and tells nothing of the others.
    """
    normalised = innovation / np.sqrt(spread)
    if not np.isfinite(normalised):  # the state is no number any more: a few in a row begin anew
        s.counts[REJECTED] += 1
        s.counts[REJECTED_IN_ROW] += 1
        return 0.0
    clipped = min(max(normalised, -SCORE_CLIP), SCORE_CLIP)
    doubt = s.anchors[slot, WEIGHT]
    s.anchors[slot, SCORE] += SCORE_GAIN / doubt * (clipped - s.anchors[slot, SCORE])
    gate = s.settings[GATE]
    within = -gate <= normalised <= gate
    _watch(s, slot)
    s.slots[slot, IN_ROW] = 0 if within and not s.slots[slot, EXCLUDED] else s.slots[slot, IN_ROW] + 1
    statistics, counts = s.statistics, s.counts
    if s.slots[slot, EXCLUDED]:
        counts[OUT] += 1
        return 0.0
    follow_clocks(s, 2.0 if normalised < -1.0 else 0.0)
    statistics[LATE_SHARE] += LATE_FORGETTING / doubt * ((0.0 if within else 1.0) - statistics[LATE_SHARE])
    statistics[REJECTED_SHARE] *= 1.0 - FORGETTING / doubt
    if not within or normalised > gate_of(s):
        counts[REJECTED] += 1
        if not within:
            counts[REJECTED_IN_ROW] += 1 if doubt < DOUBTFUL else 0
            statistics[REJECTED_SHARE] += FORGETTING / doubt
        return 0.0
    counts[ACCEPTED] += 1
    counts[REJECTED_IN_ROW] = 0
    statistics[CHI2] += FORGETTING / doubt * (normalised * normalised - statistics[CHI2])
    statistics[RESIDUAL_SQUARED] += FORGETTING * (innovation * innovation - statistics[RESIDUAL_SQUARED])
    if statistics[LATE_SHARE] > LATE_ENOUGH and abs(normalised) > HUBER:
        return float(abs(normalised) / HUBER)
    return 1.0


@borrowing_kernel
def follow(s: JointArrays, normalised: float) -> None:
    """Adapt the agility: where the position lags, innovations in one direction have one sign for long.

    Sums along the axes show that long before single innovations do, which are mostly the stamps' noise.
    """
    statistics, dim = s.statistics, int(s.settings[DIM])
    squared = 0.0
    for axis in range(dim):
        statistics[LAG + axis] += LAG_GAIN * (statistics[LAG + 3 + axis] * normalised - statistics[LAG + axis])
        squared += statistics[LAG + axis] ** 2
    follow_lag(statistics, LAG_SQUARED, squared)


@borrowing_kernel
def follow_lag(statistics: Vector, place: int, squared: float) -> None:
    """Adapt the agility to the squares of the lag along the axes, whose running mean stands at ``place``."""
    squared *= (2.0 - LAG_GAIN) / LAG_GAIN
    statistics[place] += LAG_FORGETTING * (squared - statistics[place])
    adapt_agility(statistics, statistics[place] > RESTLESS_LAG)


@borrowing_kernel
def follow_clocks(s: JointArrays, beyond: float) -> None:
    """Adapt the oscillators' random walk to how many receptions lie beyond one standard deviation.

    A share, unlike a mean square, hardly grows when what one anchor tells is wrong. Of the tag's own receptions early
    ones count twice (2 or 0 for ``beyond``, instead of 1 or 0), as late ones are due to the path.
    """
    statistics = s.statistics
    statistics[CLOCK_SHARE] += CLOCK_FORGETTING * (beyond - statistics[CLOCK_SHARE])
    if statistics[CLOCK_SHARE] > RESTLESS_CLOCKS:
        statistics[CLOCK_AGILITY] = min(statistics[CLOCK_AGILITY] * CLOCK_GAIN, s.settings[MOST_CLOCK_AGILITY])
    else:
        statistics[CLOCK_AGILITY] = max(statistics[CLOCK_AGILITY] * CLOCK_LOSS, 1.0)


@borrowing_kernel
def _watch(s: JointArrays, slot: int) -> None:
    """Take an anchor back whose innovations are ordinary; where they are off for long, see who is wrong."""
    score, out = abs(s.anchors[slot, SCORE]), s.slots[slot, EXCLUDED] != 0
    if out and score < READMIT_AT and s.slots[slot, IN_ROW] >= READMIT_AFTER:
        take_back(s, slot)
        return
    off = score >= EXCLUDE_AT + SCORE_CLIP * s.statistics[LATE_SHARE]
    if (out or off) and exclude_likeliest(s, CHANGE if out else 0.0):
        _doubt(s)


@borrowing_kernel
def _doubt(s: JointArrays) -> None:
    """Take back what an anchor may have done to the position and the tag's clock, and what others seemed to be."""
    dim, half, variance = int(s.settings[DIM]), values(s), CONTAMINATION_M * CONTAMINATION_M
    for axis in range(dim):
        s.P[axis, axis] += variance
    for one in range(dim, half):
        for other in range(dim, half):
            s.P[one, other] += variance
    for other in range(s.counts[SLOTS]):
        if not s.slots[other, EXCLUDED]:
            s.anchors[other, SCORE] = 0.0
