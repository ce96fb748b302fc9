"""What of an anchor's timeline comes from each parent, and how certain it is (``docs/maths.md`` section 6).

Plain arithmetic on floats, in metres of light and seconds: ``clocks/composed_time.py`` uses it in Python, the study
``sitetime`` in a kernel.
"""

from typing import Final

from skyless.constants import DELAYED_TX_GRANULARITY_TICKS, TICK_M
from skyless.kernels.compiled import jitted
from skyless.kernels.two_state import TwoState

MEAN_LATE_TICKS: Final = DELAYED_TX_GRANULARITY_TICKS // 2
"""A slot begins 0 to 511 ticks after the TX stamp of its frame, which lies on the radio's grid."""

GRID_VARIANCE_M2: Final = (DELAYED_TX_GRANULARITY_TICKS * TICK_M) ** 2 / 12.0

SLOT_GAIN: Final = 1.0 / 16.0
"""Of the first-order loop on stated slots: the grid's noise falls to a sixth, 0.4 ns a hop."""

MAX_SLOT_STD_M: Final = 3.0
"""An anchor speaks only while its slots are known to 10 ns: neighbours' slots are to lie within 50."""

AVERAGING_S: Final = 10.0
"""Time over which an anchor averages the age of its parents' statements, which losses make longer."""


@jitted
def by_parent(
    stated_variance: float, hop: int, age_s: float, delay_s: float, pair: TwoState, white: float, walk: float
) -> tuple[float, float]:
    """Variance in m² of the timeline by way of one parent: what parents have in common, and this pair's noise.

    ``stated_variance`` is the parent's at its last TX stamp, ``age_s`` ago, and ``hop`` its distance from the root;
    each hop between delays the root's time by ``delay_s``. ``white`` and ``walk`` are the process noise of the
    difference of two clocks.

    A settled filter owes its measurements' noise 3/4 of the variance, 1/2 of the covariance and 1/4 of the rate's
    variance; the rest comes half from each of its two clocks. A clock between two pairs enters both with opposite
    signs, so that of the clocks only the root's and the own one remain, and the root's grows with the delay.
    """
    variance, covariance, rate_variance = pair
    way_s = hop * delay_s
    rates = 0.75 * rate_variance + 0.5 * walk * way_s
    covariances = 0.5 * covariance + way_s * (0.375 * rate_variance + 0.25 * walk * way_s)
    common = stated_variance if hop > 0 else 0.25 * variance
    common += age_s * (2.0 * covariances + age_s * rates)
    common += abs(age_s) * (white + walk * age_s * age_s / 3.0)
    alone = 0.75 * variance + age_s * (covariance + 0.25 * age_s * rate_variance)
    return common, alone
