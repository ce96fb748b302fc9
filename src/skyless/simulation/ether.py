"""The shared medium: which frames are on the air at once, and what can become of a frame at a listener."""

from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from skyless.constants import TICK_RATE_HZ, TICK_S
from skyless.kernels.arrays import Array


class Outcome(StrEnum):
    """What became of a frame at a listener; the values are what reports show."""

    HEARD = "heard"
    WEAK = "below-sensitivity"
    HALF_DUPLEX = "half-duplex"
    COLLISION = "collision"
    LOST = "message-loss"


OUTCOMES: Final = tuple(Outcome)


@dataclass(slots=True, eq=False)
class Flight:
    """One frame on its way; times are true time in whole ticks."""

    sender: int
    """Node that sends."""
    boot: int
    """How often the sender had been switched on, so that a frame of its last life is not sent."""
    frame: bytes
    marker_local_ticks: int
    """Sender's unwrapped counter when the RMARKER leaves, noise and delay error apart."""
    begin_ticks: int
    """Start of the preamble."""
    marker_ticks: int
    end_ticks: int
    emission_ticks: int = 0
    emission_fraction: float = 0.0
    """With ``emission_ticks``: when the RMARKER really left."""


_NO_OTHERS: Final = np.empty((0, 3))
_KEPT_TICKS: Final = round(2e-3 * TICK_RATE_HZ)
_FARTHEST_TICKS: Final = round(10e-6 * TICK_RATE_HZ)
"""Flight times up to 10 µs (3 km) may turn neighbours on the air into an overlap."""


class OnAir:
    """The frames that are, were lately, or will soon be on the air."""

    def __init__(self) -> None:
        self._flights: deque[Flight] = deque()

    def add(self, flight: Flight, now_ticks: int) -> None:
        """Announce a frame; those that ended long ago are forgotten."""
        while self._flights and self._flights[0].end_ticks < now_ticks - _KEPT_TICKS:
            self._flights.popleft()
        self._flights.append(flight)

    def withdraw(self, flight: Flight) -> None:
        """Take back a frame that will not be sent after all."""
        self._flights.remove(flight)

    def others(self, flight: Flight) -> Array:
        """Frames that may overlap this one, shape (n, 3): sending node, begin and end in s from this RMARKER."""
        first, last = flight.begin_ticks - _FARTHEST_TICKS, flight.end_ticks + _FARTHEST_TICKS
        rows = [
            (
                other.sender,
                (other.begin_ticks - flight.marker_ticks) * TICK_S,
                (other.end_ticks - flight.marker_ticks) * TICK_S,
            )
            for other in self._flights
            if other is not flight and other.begin_ticks <= last and other.end_ticks >= first
        ]
        return np.array(rows) if rows else _NO_OTHERS
