"""Nodes of the simulated medium as the air of a chip: as the medium is, and so that hand-overs make no difference.

The medium draws a node's clock noise when it reads its counter. A ``SiteAir`` lets that happen at an instant that
follows from the frame's own time alone, so that two runs whose frames are the same have the same noise, however early
each was handed over.
"""

from collections import Counter
from typing import Any, Final

from msgspec import Struct

from skyless.core.air.ieee802154 import preamble_s
from skyless.core.air.reception import Transmission
from skyless.core.ticks import difference, from_seconds, wrap
from skyless.sim.medium import Medium
from skyless.sim.oscillator import clock_rate

SITE_TURNAROUND_S: Final = 4e-6
"""For the medium: a real chip sends what it gets until its preamble begins. Frames in slots never overlap."""
_GRID_TICKS: Final = from_seconds(10e-6)
_COMMIT_TICKS: Final = from_seconds(preamble_s() + SITE_TURNAROUND_S + 1e-6)
"""The medium gets a frame at the last instant of a grid of true time that is so long before its RMARKER.

Which one that is, is decided at these instants, when what is known of the clock no longer depends on the hand-over.
"""
_EARLIER: Final = 2
"""Steps of the grid by which the time may be wrong that is foreseen at the hand-over."""


class NodeAir:
    """A node of the simulated medium as the air of a chip (``skyless.sim.dw1000.transceiver.Air``)."""

    def __init__(self, medium: Medium[Any], node: int) -> None:
        self._medium, self.node = medium, node
        self.counts: Counter[str] = Counter()

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
        return self._medium.transmit(self.node, Transmission(frame, leaves_ticks))

    def withdraw(self) -> None:
        """The medium cancels nothing; counted, as a frame then flies that its sender takes for cancelled."""
        self.counts["not-withdrawn"] += 1


class _Pending(Struct, frozen=True):
    transmission: Transmission
    serial: int
    boot: int


class SiteAir(NodeAir):
    """The same, and it does not matter when a frame is handed over."""

    def __init__(self, medium: Medium[Any], node: int) -> None:
        super().__init__(medium, node)
        self._serial = 0
        """Of the newest frame; one that was withdrawn is no longer the newest."""

    def transmit(self, frame: bytes, leaves_ticks: int) -> bool:
        """Plan the frame's flight, unless it is too late."""
        now = self._medium.timeline.now_ticks
        first = -(-now // _GRID_TICKS)
        last = self._commit_ticks(leaves_ticks) // _GRID_TICKS
        if last < first:
            return False
        self._serial += 1
        pending = _Pending(Transmission(frame, leaves_ticks), self._serial, self._medium.boots[self.node])
        self._plan(pending, max(first, last - _EARLIER))
        return True

    def _commit_ticks(self, leaves_ticks: int) -> int:
        """By when the medium must have a frame, in true time, as far as the clock is known now."""
        return self._medium.timeline.now_ticks + difference(leaves_ticks, self.now_ticks()) - _COMMIT_TICKS

    def _plan(self, pending: "_Pending", step: int) -> None:
        self._medium.timeline.at(step * _GRID_TICKS, lambda: self._check(pending, step))

    def _check(self, pending: "_Pending", step: int) -> None:
        """Hand a frame to the medium at the last instant of the grid that is early enough."""
        if pending.serial != self._serial or pending.boot != self._medium.boots[self.node]:
            return
        if self._commit_ticks(pending.transmission.tx_ticks) >= (step + 1) * _GRID_TICKS:
            self._plan(pending, step + 1)
        elif not self._medium.transmit(self.node, pending.transmission):
            self.counts["refused-by-the-medium"] += 1

    def withdraw(self) -> None:
        """Cancel the newest frame; one that is on the air is cut off."""
        self._serial += 1
        self._medium.boots[self.node] += 1
