"""A node of the simulated medium as the air of a chip, where it does not matter when a frame is handed over.

The medium draws a node's clock noise when it reads its counter. Here that happens at an instant that follows from the
frame's own time alone, so that two runs whose frames are the same have the same noise, however early each was handed
over.
"""

from collections import Counter
from typing import Any, Final

from skyless.air.ieee802154 import preamble_s
from skyless.air.reception import Transmission
from skyless.simulation.medium import Medium
from skyless.simulation.oscillator import clock_rate
from skyless.ticks import difference, from_seconds, wrap

SITE_TURNAROUND_S: Final = 4e-6
"""For a medium with such air: a real chip sends what it gets until its preamble begins. Frames in slots never overlap."""
_GRID_TICKS: Final = from_seconds(10e-6)
_COMMIT_TICKS: Final = from_seconds(preamble_s() + SITE_TURNAROUND_S + 1e-6)
"""The medium gets a frame at the last multiple of the grid of true time that is so long before its RMARKER."""


class SiteAir:
    """One node's (``skyless.simulation.dw1000.transceiver.Air``)."""

    def __init__(self, medium: Medium[Any], node: int) -> None:
        self._medium, self.node = medium, node
        self.counts: Counter[str] = Counter()
        self._serial = 0
        """Of the newest frame; one that was withdrawn is no longer the newest."""

    def now_ticks(self) -> int:
        """The node's counter, from its last instant by its present rate: reading it draws no noise."""
        clock = self._medium.clocks[self.node]
        passed = self._medium.timeline.now_ticks - int(clock["true_ticks"]) - float(clock["true_fraction"])
        gain = passed * clock_rate(self._medium.clocks, self.node)
        return wrap(int(clock["local_ticks"]) + round(float(clock["local_fraction"]) + passed + gain))

    def now_s(self) -> float:
        """True time."""
        return self._medium.now_s

    def transmit(self, frame: bytes, leaves_ticks: int) -> bool:
        """Plan the frame's flight, unless it is too late."""
        now = self._medium.timeline.now_ticks
        marker = now + difference(leaves_ticks, self.now_ticks())
        commit = (marker - _COMMIT_TICKS) // _GRID_TICKS * _GRID_TICKS
        if commit < now:
            return False
        self._serial += 1
        serial, boot = self._serial, self._medium.boots[self.node]
        self._medium.timeline.at(commit, lambda: self._commit(Transmission(frame, leaves_ticks), serial, boot))
        return True

    def _commit(self, transmission: Transmission, serial: int, boot: int) -> None:
        if serial != self._serial or boot != self._medium.boots[self.node]:
            return
        if not self._medium.transmit(self.node, transmission):
            self.counts["refused-by-the-medium"] += 1

    def withdraw(self) -> None:
        """Cancel the newest frame; one that is on the air is cut off."""
        self._serial += 1
        self._medium.boots[self.node] += 1
