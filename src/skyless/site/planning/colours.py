"""Colours of predicted values, common to the page's map and the plan's pictures.

The scale is logarithmic: 1 cm and 2 cm differ as much as 1 m and 2 m. Plain Python, as the dashboard's process does not
load NumPy.
"""

import math
from collections.abc import Sequence
from typing import Final

from msgspec import Struct

COLOUR_STOPS: Final = (
    "#440154",
    "#482475",
    "#414487",
    "#355f8d",
    "#2a788e",
    "#21918c",
    "#22a884",
    "#44bf70",
    "#7ad151",
    "#bddf26",
    "#fde725",
)
"""Colours at equal steps from the best value to the worst, to be interpolated linearly: matplotlib's viridis (CC0),
which stays in order for colour-blind readers and in grey prints."""

LOW_QUANTILE: Final = 0.01
HIGH_QUANTILE: Final = 0.98
"""Quantiles at the ends of the scale, so that single extreme cells next to an anchor do not use up the colours."""

_MIN_SPAN: Final = 1.5
"""A scale reaches to at least this multiple of its lowest value, so that small differences look small."""

_MIN: Final = 1e-6
_MAX_TICKS: Final = 6
_WIDE: Final = 8.0  # scales wider than this have ticks at 1, 2 and 5 times powers of ten


class ValueScale(Struct, frozen=True):
    """Colour scale of values; values outside have the colour of the nearer end."""

    low: float
    high: float
    ticks: tuple[float, ...]
    """Round values between ``low`` and ``high``."""


def scale_of(ordered: Sequence[float]) -> ValueScale | None:
    """The scale for finite values in ascending order; None without any."""
    if len(ordered) == 0:
        return None
    low, high = (float(ordered[round(share * (len(ordered) - 1))]) for share in (LOW_QUANTILE, HIGH_QUANTILE))
    low = max(low, _MIN)
    high = max(high, _MIN_SPAN * low)
    return ValueScale(low, high, round_values(low, high))


def round_values(low: float, high: float) -> tuple[float, ...]:
    """A few round values from ``low`` to ``high``, both positive and different."""
    if high / low > _WIDE:
        decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        factors = (1, 2, 5) if high / low < 10.0 * _WIDE else (1,)
        values = [factor * 10.0**decade for decade in decades for factor in factors]
    else:
        rough = (high - low) / _MAX_TICKS
        decade = 10.0 ** math.floor(math.log10(rough))
        step = next(factor * decade for factor in (1, 2, 2.5, 5, 10) if factor * decade >= rough * (1.0 - 1e-9))
        values = [number * step for number in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return tuple(float(f"{value:.6g}") for value in values if low <= value <= high)
