"""Nodes of the simulated medium as the air of a chip."""

from collections import Counter
from typing import Any, Final

from skyless.core.air.frame import Transmission, preamble_s
from skyless.core.ticks import difference, from_seconds, wrap
from skyless.sim.medium import Medium
from skyless.sim.oscillator import clock_rate

SITE_TURNAROUND_S: Final = 4e-6
"""For the medium: a real chip sends what it gets until its preamble begins. Frames in slots never overlap."""
_COMMIT_TICKS: Final = from_seconds(preamble_s() + SITE_TURNAROUND_S + 1e-6)
"""How long before its RMARKER the medium gets a frame, which nobody can withdraw from it."""


class NodeAir:
    """A node of the simulated medium as the air of a chip (``skyless.sim.dw1000.transceiver.Air``)."""

    def __init__(self, medium: Medium[Any], node: int) -> None:
        self._medium, self.node = medium, node
        self.counts: Counter[str] = Counter()

    def now_ticks(self) -> int:
        """The node's counter, from its last instant by its present rate: reading it draws no noise."""
        clock = self._medium.clocks[self.node]
        passed = self._medium.timeline.now_ticks - clock.true_ticks - clock.true_fraction
        gain = passed * clock_rate(clock)
        return wrap(clock.local_ticks + round(clock.local_fraction + passed + gain))

    def now_s(self) -> float:
        """True time."""
        return self._medium.now_s

    def transmit(self, frame: bytes, leaves_ticks: int) -> bool:
        """Plan the frame's flight, unless it is too late."""
        return self._medium.transmit(self.node, Transmission(frame, leaves_ticks))

    def withdraw(self) -> None:
        """The medium cancels nothing; counted, as a frame then flies that its sender takes for cancelled."""
        self.counts["not-withdrawn"] += 1


class SiteAir(NodeAir):
    """The same, with frames that can be withdrawn."""

    def __init__(self, medium: Medium[Any], node: int) -> None:
        super().__init__(medium, node)
        self._serial = 0
        """Of the newest frame; one that was withdrawn is no longer the newest."""

    def transmit(self, frame: bytes, leaves_ticks: int) -> bool:
        """Plan the frame's flight, unless it is too late."""
        medium, now = self._medium, self._medium.timeline.now_ticks
        commit = now + difference(leaves_ticks, self.now_ticks()) - _COMMIT_TICKS
        if commit < now:
            return False
        self._serial += 1
        waiting, fly = (self._serial, medium.boots[self.node]), super().transmit

        def hand_over() -> None:
            if waiting == (self._serial, medium.boots[self.node]) and not fly(frame, leaves_ticks):
                self.counts["refused-by-the-medium"] += 1

        medium.timeline.at(commit, hand_over)
        return True

    def withdraw(self) -> None:
        """Cancel the newest frame; one that is on the air is cut off."""
        self._serial += 1
        self._medium.boots[self.node] += 1
