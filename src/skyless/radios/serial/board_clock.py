"""A board's counter, as its host knows it from stamps that arrive late by an unknown time."""

from typing import Final

from skyless.constants import TICK_RATE_HZ
from skyless.ticks import difference, wrap

GIVEN_UP: Final = 100e-6
"""Both crystals together run apart by less; the estimate loses as much between stamps that took a short way."""

JUMP_TICKS: Final = round(TICK_RATE_HZ)
"""A stamp that is wrong by more than a second means that the counter began anew."""


class BoardClock:
    """Believes the stamp that took the shortest way, so it lags by the shortest transfer."""

    def __init__(self) -> None:
        self._ticks: int | None = None
        self._host_s = 0.0

    def hear(self, ticks: int, host_s: float) -> None:
        """Take a stamp of the counter that arrived at a moment of the host's monotonic clock."""
        known = self.read(host_s, GIVEN_UP)
        if known is None or difference(ticks, known) >= 0 or difference(ticks, known) < -JUMP_TICKS:
            self._ticks, self._host_s = ticks, host_s

    def read(self, host_s: float, given_up: float = 0.0) -> int | None:
        """The 40-bit counter at a moment of the host's clock; None before the first stamp."""
        if self._ticks is None:
            return None
        return wrap(self._ticks + round((host_s - self._host_s) * (1.0 - given_up) * TICK_RATE_HZ))

    def forget(self) -> None:
        """The board has gone."""
        self._ticks = None
