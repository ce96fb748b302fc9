"""Slow hosts of ``host_latency``: programs on a Raspberry Pi with a DW1000, in the simulated world's time."""

import random
import sys
from collections import Counter
from pathlib import Path
from typing import Any, Final

sys.path.insert(0, str(Path(__file__).parents[1] / "firmware"))

import numpy as np
from emulator.site.host_programs import HostLatency, Process
from emulator.site.site_air import NodeAir
from numpy.typing import NDArray

from skyless.core.air.frame import Diagnostics, Reception
from skyless.core.any_receiver import AnyReceiver
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.protocol1.anchor import Anchor
from skyless.core.site import Site
from skyless.core.ticks import TICK_S, difference
from skyless.radio.dw1000.radio import SPI_LEAD_S, ChipSession
from skyless.radio.interface import AntennaDelays, Late, RadioEvent, Sent
from skyless.run.anchor import ASK_AGAIN_S, LEAD_GAIN, LEAD_LOSS, MAX_LEAD_S
from skyless.sim.dw1000.chip import Chip, ModelBus
from skyless.sim.medium import Medium

_POLL_S: Final = 20e-3
_COMING: Final = 64
"""Frames that a host may still be about to fetch."""


class Host:
    """A computer with a chip on its SPI."""

    def __init__(self, medium: Medium[Any], node: int, latency: HostLatency, generator: random.Random) -> None:
        self.medium, self.latency, self.generator = medium, latency, generator
        self.air = NodeAir(medium, node)
        delays = AntennaDelays()
        self.chip = Chip(self.air, delays.tx_ticks, delays.rx_ticks, self.air.now_s)
        self.counters: Counter[str] = Counter()
        self.heard: set[int] = set()
        """Slots whose frames the program received."""
        self._coming: dict[bytes, tuple[int, NDArray[np.float64]]] = {}
        bus = ModelBus(self.chip, self._spend, lambda: latency.draw(generator))
        self.session = ChipSession(bus, delays, self.hear, self.counters)
        self.process = Process(medium.timeline, self.program)

    @property
    def misused(self) -> int:
        """Events that should never happen."""
        return self.chip.misuse.total() + self.air.counts.total() + self.counters["sent-at-another-time"]

    def _spend(self, seconds: float) -> None:
        self.process.sleep(seconds)

    # The air

    def arrive(self, reception: Reception, slot: int, position_m: NDArray[np.float64]) -> None:
        """A frame has ended at the antenna."""
        self._coming[reception.frame] = (slot, position_m)
        if len(self._coming) > _COMING:
            del self._coming[next(iter(self._coming))]
        self.chip.receive(reception.frame, reception.rx_ticks, reception.diagnostics or Diagnostics())
        if self.chip.irq:
            self.process.notify()

    def finish(self) -> None:
        """The own frame has ended."""
        self.chip.transceiver.finish()
        if self.chip.irq:
            self.process.notify()

    # The program

    def program(self) -> None:
        """The host's program; never returns."""
        raise NotImplementedError

    def serve(self, seconds: float) -> None:
        """Wait for the interrupt line for some seconds, and serve it."""
        self.process.wait(seconds)
        while self.chip.irq:
            self.process.sleep(self.latency.draw(self.generator))  # until the program runs
            self.session.serve(self.medium.now_s)

    def work(self, reception: Reception) -> tuple[int, NDArray[np.float64]]:
        """Spend the time that a frame costs to be processed; its slot, and the tag's position."""
        self.process.sleep(self.latency.work_s)
        slot, position_m = self._coming[reception.frame]
        self.heard.add(slot)
        return slot, position_m

    def hear(self, event: RadioEvent) -> None:
        """An event of the session."""
        raise NotImplementedError


class AnchorHost(Host):
    """An anchor's, which does what ``run/anchor.py`` does: hands frames over earlier after a late one."""

    def __init__(
        self,
        medium: Medium[Any],
        site: Site,
        node: int,
        latency: HostLatency,
        generator: random.Random,
        lead_s: float | None,
    ) -> None:
        """``lead_s``: the lead that it keeps to; None for one that adapts."""
        self.lead_s = SPI_LEAD_S if lead_s is None else lead_s
        self.machine = Anchor(site, site.anchors[node].id, lead_s=self.lead_s)
        self._adapts = lead_s is None
        self.late = 0
        self._answered = True
        self._wait_s = 0.0
        super().__init__(medium, node, latency, generator)

    def program(self) -> None:
        """Receive others, and send in its slots."""
        self.session.start()
        while True:
            now_ticks = self.session.read_ticks()
            tx_ticks = None if now_ticks is None else self.machine.next_transmission_ticks(now_ticks)
            if tx_ticks is None:
                self.serve(ASK_AGAIN_S)
                continue
            self._serve_until(tx_ticks)
            self.process.sleep(self.latency.work_s)
            self._answered = False
            self.session.transmit(self.machine.transmission(tx_ticks), self.medium.now_s)
            self._await_answer()
            if self._wait_s:
                self.serve(self._wait_s)
                self._wait_s = 0.0

    def _serve_until(self, tx_ticks: int) -> None:
        """Receive others until the frame is to be handed over."""
        while (ahead_s := difference(tx_ticks, self.air.now_ticks()) * TICK_S - self.lead_s) > 0.0:
            self.serve(ahead_s + 1e-6)

    def _await_answer(self) -> None:
        while not self._answered:
            overdue = self.session.overdue_ticks
            ahead_s = _POLL_S if overdue is None else difference(overdue, self.air.now_ticks()) * TICK_S
            if ahead_s <= 0.0:
                self.session.cancel_overdue()
            self.serve(max(ahead_s, 0.0) + 1e-6)

    def hear(self, event: RadioEvent) -> None:
        """A frame of another anchor, or the result of its own."""
        if isinstance(event, Reception):
            self.work(event)
            self.machine.hear(event)
        elif isinstance(event, Sent):
            self._answered = True
            if self._adapts:
                self.lead_s = max(self.lead_s * LEAD_LOSS, SPI_LEAD_S)
        elif isinstance(event, Late):
            self._answered = True
            self.late += 1
            if self._adapts:
                self.lead_s = min(self.lead_s * LEAD_GAIN, MAX_LEAD_S)
            self._wait_s = ASK_AGAIN_S


class TagHost(Host):
    """A tag's."""

    def __init__(
        self, medium: Medium[Any], node: int, latency: HostLatency, generator: random.Random, qa: float
    ) -> None:
        self.receiver = AnyReceiver(DEFAULT_METHOD, qa=qa)
        self.errors_m2: list[tuple[int, float]] = []
        """Slot and squared error of every fix."""
        super().__init__(medium, node, latency, generator)

    def program(self) -> None:
        """Listen."""
        self.session.start()
        while True:
            self.serve(_POLL_S)

    def hear(self, event: RadioEvent) -> None:
        """A frame."""
        if isinstance(event, Reception):
            slot, position_m = self.work(event)
            fix = self.receiver.hear(event)
            if fix is not None:
                self.errors_m2.append((slot, float(np.sum((fix.position_m - position_m)[:2] ** 2))))
