"""A radio between a program and its real one, which writes down what passes."""

import time

from skyless.core.air.frame import Reception, Transmission
from skyless.radio.interface import Late, Listener, Radio, RadioEvent, ignore


class WatchedRadio:
    """One node's (``skyless.radio.interface.Radio``)."""

    def __init__(self, radio: Radio, lead_s: float | None = None) -> None:
        """``lead_s``: another one than the radio asks for."""
        self._radio = radio
        self.name, self.counters, self.advice, self.now_ticks = (
            radio.name,
            radio.counters,
            radio.advice,
            radio.now_ticks,
        )
        self.lead_s = radio.lead_s if lead_s is None else lead_s
        self._listener: Listener = ignore
        self.heard: dict[tuple[bytes, int], float] = {}
        """Frames and stamps that reached the program, and when; the newest last."""
        self.made: set[tuple[bytes, int]] = set()
        """Frames of the program and their times."""
        self.late: list[float] = []
        """When the program heard of each frame that came too late."""

    async def run(self, listener: Listener) -> None:
        """Run the real radio."""
        self._listener = listener
        await self._radio.run(self._on_event)

    def transmit(self, transmission: Transmission) -> None:
        """Hand over a frame."""
        self.made.add((transmission.frame, transmission.tx_ticks))
        self._radio.transmit(transmission)

    def _on_event(self, event: RadioEvent) -> None:
        if isinstance(event, Reception):
            self.heard[event.frame, event.rx_ticks] = time.monotonic()
        elif isinstance(event, Late):
            self.late.append(time.monotonic())
        self._listener(event)
