"""What of an anchor's site time comes from each parent, and how certain it is (``docs/maths.md`` section 6).

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
"""Of the first-order loop on stated slots: their grid's noise falls to a sixth, 0.4 ns a hop."""

NOISE_SHARE: Final = (0.75, 0.5, 0.25)
"""Parts of a settled filter's variance, covariance and rate variance that come from its measurements' noise.

The steady state of continuous measurements and a rate that walks; the rest comes half from each of the two clocks.
"""


@jitted
def shares(
    stated_variance: float,
    hop: int,
    age_s: float,
    delay_s: float,
    parents: float,
    pair: TwoState,
    white: float,
    walk: float,
) -> tuple[float, float]:
    """Variance in m² of the timeline by way of one parent: what all parents share, and what is this pair's alone.

    ``stated_variance`` is the parent's at its last TX stamp and ``hop`` its own; that was ``age_s`` ago. ``delay_s`` is
    the mean age at a hop, ``parents`` the effective number of parents that each hop averages. ``white`` and ``walk``
    are the process noise of the difference of two clocks.
    """
    variance, covariance, rate_variance = pair
    noise = 0.75 * variance, 0.5 * covariance, 0.25 * rate_variance
    clocks = 0.25 * variance, 0.5 * covariance, 0.75 * rate_variance
    way_s = hop * delay_s
    rate_noise = hop * noise[2] / parents
    common_rate = clocks[2] + rate_noise + 0.5 * walk * way_s
    common_covariance = (
        clocks[1]
        + hop * noise[1] / parents
        + 0.5 * way_s * rate_noise
        + way_s * 0.5 * clocks[2]
        + 0.25 * walk * way_s * way_s
    )
    common = stated_variance if hop > 0 else clocks[0]
    common += age_s * (2.0 * common_covariance + age_s * common_rate)
    common += abs(age_s) * (white + walk * age_s * age_s / 3.0)
    own = noise[0] + age_s * (2.0 * noise[1] + age_s * noise[2])
    return common, own
