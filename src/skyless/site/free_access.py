"""When an anchor of a site without a schedule speaks: once in each window of its own counter, at a random instant.

The instant is a function of the anchor's identifier and of the window's number alone, so that the anchor's machine and
a simulation of thousands of anchors agree about it, and nobody has to be asked. Windows are counted from 0 of the
unwrapped counter.
"""

from typing import Final

from skyless.constants import TICK_RATE_HZ
from skyless.kernels.compiled import jitted

FREE_REST_TICKS: Final = round(1.5e-3 * TICK_RATE_HZ)
"""At the end of each window, without a frame's RMARKER. A driver asks for the next frame when one has ended (0.2 ms
after its RMARKER) and needs it a lead time (1 ms) before its own RMARKER: with less rest windows would be left out."""

_LOW: Final = 0xFFFFFFFF


def free_window_ticks(rate_hz: float) -> int:
    """Length of the windows for that many frames per second.

    Raises:
        ValueError: the rate is not above 0, or the windows would be shorter than twice the rest.
    """
    if not 0.0 < rate_hz <= TICK_RATE_HZ / (2 * FREE_REST_TICKS):
        most = TICK_RATE_HZ / (2 * FREE_REST_TICKS)
        raise ValueError(f"rate_hz is {rate_hz:g}; it should be more than 0 and at most {most:.0f} frames per second")
    return round(TICK_RATE_HZ / rate_hz)


@jitted
def _mixed(value: int) -> int:
    """32 bits that depend on all bits of 32 (Wellons' lowbias32); the same from Python's integers and from int64."""
    value = ((value >> 16) ^ value) * 0x7FEB352D & _LOW
    value = ((value >> 15) ^ value) * 0x846CA68B & _LOW
    return (value >> 16) ^ value


@jitted
def free_instant_ticks(anchor_id: int, window_number: int, window_ticks: int) -> int:
    """Instant in that window, own unwrapped ticks, uniform over the window less its rest; before the radio's grid."""
    drawn = _mixed(_mixed(_mixed(anchor_id) ^ (window_number & _LOW)) ^ ((window_number >> 32) & _LOW))
    return window_number * window_ticks + int((window_ticks - FREE_REST_TICKS) * (drawn / 4294967296.0))


@jitted
def first_free_window(anchor_id: int, earliest_ticks: int, window_ticks: int) -> int:
    """Number of the first window whose instant is ``earliest_ticks`` (own unwrapped counter) or later."""
    window = earliest_ticks // window_ticks
    if free_instant_ticks(anchor_id, window, window_ticks) < earliest_ticks:
        window += 1
    return window
