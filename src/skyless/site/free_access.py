"""Random instants: when an anchor of mode free sends (``docs/protocol.md``).

An anchor divides its own counter into windows of one beacon each, and sends at an instant in each that looks random
and depends on nothing but its identifier and the window's number. So a simulator that knows the counter knows the
instants, and two anchors that met once do not meet again in the next window.
"""

from typing import Final

from skyless.constants import DELAYED_TX_GRANULARITY_TICKS, TICK_RATE_HZ
from skyless.kernels.compiled import jitted
from skyless.ticks import from_seconds

FREE_MARGIN_TICKS: Final = from_seconds(2.5e-3)
"""Least time between two beacons of one anchor: the frame, and the time that a host needs for the next one."""

_MIXER: Final = 0x45D9F3B
_WORD: Final = 0xFFFFFFFF
_UNIFORM_BITS: Final = 23
"""So that a window of up to 2³⁹ ticks times the uniform number stays within 63 bits."""


def free_window_ticks(rate_hz: float) -> int:
    """Length of a window in ticks of the sender's counter, given the beacons per second of each anchor.

    A multiple of the radio's granularity, and at least twice the margin.
    """
    steps = round(TICK_RATE_HZ / rate_hz / DELAYED_TX_GRANULARITY_TICKS)
    return max(steps * DELAYED_TX_GRANULARITY_TICKS, 2 * FREE_MARGIN_TICKS)


@jitted
def _mixed(word: int) -> int:
    """32 bits that depend on all 32 of the argument; every product fits 63 bits."""
    word = ((word >> 16) ^ word) * _MIXER & _WORD
    word = ((word >> 16) ^ word) * _MIXER & _WORD
    return (word >> 16) ^ word


@jitted
def free_instant_ticks(anchor_id: int, window_number: int, window_ticks: int) -> int:
    """RMARKER of the beacon in a window of the anchor's own unwrapped counter.

    Window k lasts from k · ``window_ticks`` to (k + 1) · ``window_ticks``; its last ``FREE_MARGIN_TICKS`` stay free.
    """
    word = _mixed((_mixed(window_number & _WORD) ^ (anchor_id * 0x9E3779B1)) & _WORD)
    uniform = word >> (32 - _UNIFORM_BITS)
    return window_number * window_ticks + ((window_ticks - FREE_MARGIN_TICKS) * uniform >> _UNIFORM_BITS)
