"""A radio between a program and its real one, which writes down what passes and when."""

import time
from collections import Counter

from msgspec import Struct

from emulator.site.site_air import SiteAir
from skyless.core.air.reception import Reception, Transmission
from skyless.core.constants import TICK_S
from skyless.core.ticks import difference
from skyless.radio.interface import Late, Listener, Radio, RadioEvent, Sent, ignore


class Instants(Struct):
    """When the program of a node heard of what, and how far its radio's clock was off."""

    events: list[tuple[float, RadioEvent]]
    lags: list[tuple[float, int | None]]
    """When the program asked for the counter, and by how many ticks the true one was ahead of the answer."""


class WatchedRadio:
    """One node's (``skyless.radio.interface.Radio``)."""

    def __init__(self, radio: Radio, air: SiteAir, lead_s: float | None = None) -> None:
        """``lead_s``: another one than the radio asks for."""
        self._radio, self._air = radio, air
        self.lead_s = radio.lead_s if lead_s is None else lead_s
        self._listener: Listener = ignore
        self.instants = Instants([], [])
        self.heard: set[tuple[bytes, int]] = set()
        """Frames and stamps that reached the program."""
        self.present: tuple[bytes, int] | None = None
        """The newest of them."""
        self.made: set[tuple[bytes, int]] = set()
        """Frames of the program and their times."""
        self.handed_over: dict[int, float] = {}
        """How long before its time each frame was handed over, in s of true time."""
        self.late: list[float] = []
        """When the program heard of each frame that came too late."""
        self.sent = 0

    @property
    def name(self) -> str:
        """The real radio's."""
        return self._radio.name

    @property
    def counters(self) -> Counter[str]:
        """The real radio's."""
        return self._radio.counters

    async def run(self, listener: Listener) -> None:
        """Run the real radio."""
        self._listener = listener
        await self._radio.run(self._on_event)

    def advice(self) -> str:
        """The real radio's."""
        return self._radio.advice()

    def now_ticks(self) -> int | None:
        """The real radio's."""
        ticks = self._radio.now_ticks()
        lag = None if ticks is None else difference(self._air.now_ticks(), ticks)
        self.instants.lags.append((time.monotonic(), lag))
        return ticks

    def transmit(self, transmission: Transmission) -> None:
        """Hand over a frame."""
        self.made.add((transmission.frame, transmission.tx_ticks))
        self.handed_over[transmission.tx_ticks] = difference(transmission.tx_ticks, self._air.now_ticks()) * TICK_S
        self._radio.transmit(transmission)

    def _on_event(self, event: RadioEvent) -> None:
        now_s = time.monotonic()
        self.instants.events.append((now_s, event))
        if isinstance(event, Reception):
            self.present = event.frame, event.rx_ticks
            self.heard.add(self.present)
        elif isinstance(event, Late):
            self.late.append(now_s)
        elif isinstance(event, Sent):
            self.sent += 1
        self._listener(event)
