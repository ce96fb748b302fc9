"""A node of the simulated medium as the air of a chip."""

from collections import Counter
from typing import Any

from skyless.air.reception import Transmission
from skyless.simulation.medium import Medium
from skyless.simulation.oscillator import clock_rate
from skyless.ticks import wrap


class NodeAir:
    """What a chip's antenna is in (``skyless.simulation.dw1000.transceiver.Air``)."""

    def __init__(self, medium: Medium[Any], node: int) -> None:
        self._medium, self._node = medium, node
        self.counts: Counter[str] = Counter()

    def now_ticks(self) -> int:
        """The node's counter, from its last instant by its present rate: reading it draws no noise."""
        clock = self._medium.clocks[self._node]
        passed = self._medium.timeline.now_ticks - int(clock["true_ticks"]) - float(clock["true_fraction"])
        gain = passed * clock_rate(self._medium.clocks, self._node)
        return wrap(int(clock["local_ticks"]) + round(float(clock["local_fraction"]) + passed + gain))

    def now_s(self) -> float:
        """True time."""
        return self._medium.now_s

    def transmit(self, frame: bytes, leaves_ticks: int) -> bool:
        """Plan the frame's flight, unless it is too late."""
        return self._medium.transmit(self._node, Transmission(frame, leaves_ticks))

    def withdraw(self) -> None:
        """The medium takes nothing back; counted, for then a frame flies of which its sender says that it does not."""
        self.counts["not-withdrawn"] += 1
