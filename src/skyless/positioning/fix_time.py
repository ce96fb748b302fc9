"""The time of fixes: the master's, carried on by the tag's own clock where the master's scale jumps."""

from typing import Final

from msgspec import Struct

from skyless.constants import MAX_DRIFT, TICK_S
from skyless.ticks import from_seconds

SLACK_TICKS: Final = from_seconds(1e-6)
"""Flight times differ between anchors by less than this (300 m)."""


class FixTime(Struct):
    """Counts from the first fix of a receiver and never goes back, whatever becomes of master and method."""

    first_ticks_master: int | None = None
    last_ticks_master: int = 0
    last_rx_ticks_tag: int = 0

    def time_s(self, ticks_master: int, rx_ticks_tag: int) -> float:
        """Time in seconds of a fix that holds at this master time, given the tag's reading for it, both unwrapped."""
        if self.first_ticks_master is None:
            self.first_ticks_master = ticks_master
        else:
            elapsed = rx_ticks_tag - self.last_rx_ticks_tag
            off = ticks_master - self.last_ticks_master - elapsed
            if elapsed <= 0 or (abs(off) > SLACK_TICKS and abs(off) > MAX_DRIFT * elapsed + SLACK_TICKS):
                self.first_ticks_master += off + elapsed - max(elapsed, 1)
        self.last_ticks_master, self.last_rx_ticks_tag = ticks_master, rx_ticks_tag
        return (ticks_master - self.first_ticks_master) * TICK_S
