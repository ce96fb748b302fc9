"""Arithmetic of the functions that are also translated to C: the same bits on every processor, without a C library."""

from math import floor as _floor
from math import sqrt
from typing import Final

__all__ = ["exp", "floor", "hypot", "log", "sqrt", "square"]

_LN_2_HIGH: Final = 0.6931471803691238
"""The leading bits of ln 2: products with small whole numbers are exact."""
_LN_2_LOW: Final = 1.9082149292705877e-10
_LOWEST: Final = -700.0
"""Its exponential counts as 0."""
_LARGEST: Final = 9e18
"""Whole numbers of 64 bits are smaller."""


def floor(x: float) -> int:
    """The largest whole number that is not larger, of 64 bits; 0 for what has none."""
    return _floor(x) if -_LARGEST < x < _LARGEST else 0


def exp(x: float) -> float:
    """The exponential of a number up to 0, to four units in the last place.

    x = k·ln 2 + r with |r| ≤ ½·ln 2, where the diagonal Padé approximant of order 6 leaves less than rounding.
    """
    if x < _LOWEST:
        return 0.0
    halvings = -floor(x / 0.6931471805599453 + 0.5)
    r = x + halvings * _LN_2_HIGH + halvings * _LN_2_LOW
    square = r * r
    even = 665280.0 + square * (75600.0 + square * (840.0 + square))
    odd = r * (332640.0 + square * (10080.0 + square * 42.0))
    result = (even + odd) / (even - odd)
    for _ in range(halvings):
        result *= 0.5
    return result


def log(x: float) -> float:
    """The natural logarithm of a positive number, to four units in the last place.

    x = m·2ᵏ with m between √½ and √2, and log m = 2·artanh((m − 1)/(m + 1)) by its series.
    """
    twos = 0
    while x > 1.4142135623730951:
        x *= 0.5
        twos += 1
    while x < 0.7071067811865476 and twos > -1100:
        x *= 2.0
        twos -= 1
    s = (x - 1.0) / (x + 1.0)
    square, total = s * s, 0.0
    for term in range(12, -1, -1):
        total = total * square + 1.0 / (2 * term + 1)
    return twos * 0.6931471805599453 + 2.0 * s * total


def hypot(x: float, y: float) -> float:
    """The length of a vector; for lengths in a site, whose squares are numbers."""
    return sqrt(x * x + y * y)


def square(x: float) -> float:
    """x²."""
    return x * x
