"""Whole numbers in frames, the lowest byte first."""

from skyless.core.native.records import Bytes, Ticks


def unsigned(data: Bytes, at: int, size: int) -> Ticks:
    """That in this number of bytes."""
    number: Ticks = 0
    for byte in range(size - 1, -1, -1):
        number = number << 8 | data[at + byte]
    return number


def two_bytes(data: Bytes, at: int) -> int:
    """That in two bytes, which needs no 64 bits."""
    return data[at] | data[at + 1] << 8
