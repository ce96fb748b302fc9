"""Arithmetic of the functions that are also translated to C: the same bits on every processor, without a C library."""

from math import floor as _floor
from math import sqrt

__all__ = ["exp", "floor", "hypot", "log", "sqrt"]

_LARGEST = 9e18


def floor(x: float) -> int:
    """The largest whole number that is not larger, of 64 bits; 0 for what has none."""
    return _floor(x) if -_LARGEST < x < _LARGEST else 0
