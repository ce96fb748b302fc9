"""Whole numbers in frames, the lowest byte first."""

from typing import Final

from skyless.core.native.records import Bytes, Ticks

SIGN: Final = 0x80000000
"""The highest bit of four bytes; as a float32 alone it is −0."""


def unsigned(data: Bytes, at: int, size: int) -> Ticks:
    """That in this number of bytes."""
    number: Ticks = 0
    for byte in range(size - 1, -1, -1):
        number = number << 8 | data[at + byte]
    return number


def two_bytes(data: Bytes, at: int) -> int:
    """That in two bytes, which needs no 64 bits."""
    return data[at] | data[at + 1] << 8


def signed(data: Bytes, at: int) -> Ticks:
    """That in four bytes, which may be negative."""
    number = unsigned(data, at, 4)
    return number if number < SIGN else number - 2 * SIGN
