"""The colours of predicted values, the same on the page's map and in the plan's pictures.

A value's colour depends on the logarithm of its ratio to the lowest value of the scale: 1 cm and 2 cm differ
as much as 1 m and 2 m. Plain Python, because the dashboard's process does without NumPy.
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
"""Red, green and blue at equal steps from the best value to the worst, with straight lines between; they are those of
viridis (matplotlib's, CC0), which colour-blind readers and grey prints keep in order."""

LOW_QUANTILE: Final = 0.01
HIGH_QUANTILE: Final = 0.98
"""Ends of the scale among the values; otherwise single extreme cells next to an anchor would use up the colours."""

_MIN_SPAN: Final = 1.5
"""A scale reaches to at least this multiple of its lowest value, so that small differences look small."""

_LEAST: Final = 1e-6
_MOST_TICKS: Final = 6
_WIDE: Final = 8.0
"""Scales wider than this have ticks at 1, 2 and 5 times powers of ten."""


class ValueScale(Struct, frozen=True):
    """Which values have which colours; values outside have the colour of the nearer end."""

    low: float
    high: float
    ticks: tuple[float, ...]
    """Round values between both."""

    def fraction(self, value: float) -> float:
        """Position of a value on the scale, from 0 at ``low`` to 1 at ``high``."""
        if not value > self.low:
            return 0.0
        return min(math.log(value / self.low) / math.log(self.high / self.low), 1.0)


def scale_of(ordered: Sequence[float]) -> ValueScale | None:
    """The scale of finite values in ascending order; None without any."""
    if len(ordered) == 0:
        return None
    low, high = (float(ordered[round(share * (len(ordered) - 1))]) for share in (LOW_QUANTILE, HIGH_QUANTILE))
    low = max(low, _LEAST)
    high = max(high, _MIN_SPAN * low)
    return ValueScale(low, high, round_values(low, high))


def round_values(low: float, high: float) -> tuple[float, ...]:
    """A few round values from ``low`` to ``high``, both positive and different."""
    if high / low > _WIDE:
        decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        factors = (1, 2, 5) if high / low < 10.0 * _WIDE else (1,)
        values = [factor * 10.0**decade for decade in decades for factor in factors]
    else:
        rough = (high - low) / _MOST_TICKS
        decade = 10.0 ** math.floor(math.log10(rough))
        step = next(factor * decade for factor in (1, 2, 2.5, 5, 10) if factor * decade >= rough * (1.0 - 1e-9))
        values = [number * step for number in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return tuple(float(f"{value:.6g}") for value in values if low <= value <= high)


def colour_at(fraction: float) -> tuple[float, float, float]:
    """Red, green and blue, 0 to 255, at a position on a scale from 0 (best) to 1 (worst)."""
    at = min(max(fraction, 0.0), 1.0) * (len(COLOUR_STOPS) - 1)
    index = min(int(at), len(COLOUR_STOPS) - 2)
    first, second = (_parts(stop) for stop in COLOUR_STOPS[index : index + 2])
    red, green, blue = (a + (at - index) * (b - a) for a, b in zip(first, second, strict=True))
    return red, green, blue


def _parts(stop: str) -> tuple[int, int, int]:
    return int(stop[1:3], 16), int(stop[3:5], 16), int(stop[5:7], 16)
