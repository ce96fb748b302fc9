"""The time of fixes: the master's, carried on by the tag's own clock where the master's scale jumps."""

from typing import Final

from skyless.constants import MAX_DRIFT, TICK_S
from skyless.ticks import from_seconds

SLACK_TICKS: Final = from_seconds(1e-6)
"""Flight times differ between anchors by less than this (300 m)."""


class FixTime:
    """Counts from the first fix of a receiver and never goes back, whatever becomes of master and method."""

    def __init__(self) -> None:
        self._first_ticks_master: int | None = None
        self._last_ticks_master = 0
        self._last_rx_ticks_tag = 0

    def time_s(self, ticks_master: int, rx_ticks_tag: int) -> float:
        """Time in seconds of a fix that holds at this master time, given the tag's reading for it, both unwrapped."""
        if self._first_ticks_master is None:
            self._first_ticks_master = ticks_master
        else:
            elapsed = rx_ticks_tag - self._last_rx_ticks_tag
            off = ticks_master - self._last_ticks_master - elapsed
            if elapsed <= 0 or (abs(off) > SLACK_TICKS and abs(off) > MAX_DRIFT * elapsed + SLACK_TICKS):
                self._first_ticks_master += off + elapsed - max(elapsed, 1)
        self._last_ticks_master, self._last_rx_ticks_tag = ticks_master, rx_ticks_tag
        return (ticks_master - self._first_ticks_master) * TICK_S
