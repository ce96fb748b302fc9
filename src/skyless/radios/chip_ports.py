"""Where a DW1000 is: on the SPI of this computer, or a model of one on the emulated air."""

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import Final, Protocol

from skyless.air.reception import Diagnostics, Reception, Transmission
from skyless.errors import SkylessError
from skyless.firmware.dw1000 import Bus, ChipError
from skyless.radios.emulated import EmulatedRadio
from skyless.radios.radio import AntennaDelays, Gone, RadioEvent, Restarted, Sent
from skyless.radios.spi_bus import SpiBus
from skyless.simulation.dw1000.bus import ModelBus
from skyless.simulation.dw1000.chip import Chip
from skyless.simulation.dw1000.transceiver import PREAMBLE_TICKS
from skyless.ticks import difference, from_seconds

RETRY_S: Final = 1.0
ASK_S: Final = 0.5e-3
"""How often a chip without an interrupt line is asked."""
LOOK_S: Final = 0.02
"""And one with a line, should an edge have been missed."""

ETHER_LEAD_TICKS: Final = PREAMBLE_TICKS + from_seconds(0.3e-3)
"""How long before its RMARKER the emulated air, and the way there, want a frame."""

_SLEPT_S: Final = 100e-6


class Port(Protocol):
    """A chip's place."""

    async def keep(self, served: "Served") -> None:
        """Keep the chip within reach until cancelled, and tell what happens to it."""


class Served(Protocol):
    """Who wants the chip."""

    def begin(self, bus: Bus) -> None:
        """There is a chip, which is to be started; raises OSError and ChipError."""

    def wake(self) -> None:
        """Its interrupt line is high; raises OSError."""

    def end(self, reason: str) -> None:
        """It is out of reach."""


class SpiPort:
    """A chip on SPI; ``open_bus`` opens it anew each time."""

    def __init__(self, place: str, open_bus: Callable[[], SpiBus]) -> None:
        self._place, self._open_bus = place, open_bus

    async def keep(self, served: Served) -> None:
        """Look for the chip again when it does not answer any more."""
        while True:
            try:
                bus = self._open_bus()
            except SkylessError as error:
                served.end(str(error))
            else:
                try:
                    await self._serve(bus, served)
                except (OSError, ChipError) as error:
                    served.end(f"{self._place}: {error}")
                finally:
                    bus.close()
            await asyncio.sleep(RETRY_S)

    async def _serve(self, bus: SpiBus, served: Served) -> None:
        """Follow the interrupt line; without one the chip is asked again and again."""
        served.begin(bus)
        loop, line = asyncio.get_running_loop(), bus.fileno()
        risen = asyncio.Event()
        if line is not None:
            loop.add_reader(line, risen.set)
        try:
            while True:
                if line is None:
                    await asyncio.sleep(ASK_S)
                else:
                    await _wait(risen, LOOK_S)
                    bus.forget_edges()
                    risen.clear()
                served.wake()
                while line is not None and bus.is_raised():
                    served.wake()
                    await asyncio.sleep(0)
        finally:
            if line is not None:
                loop.remove_reader(line)


async def _wait(event: asyncio.Event, seconds: float) -> None:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await event.wait()


class ModelPort:
    """A model of the chip at one node of ``skyless ether``."""

    def __init__(self, radio: EmulatedRadio, delays: AntennaDelays) -> None:
        self._radio = radio
        self.chip = Chip(self, delays.tx_ticks, delays.rx_ticks, time.monotonic)
        self._served: Served | None = None

    async def keep(self, served: Served) -> None:
        """Have a chip as long as there is an ether."""
        self._served = served
        await self._radio.run(self._hear)

    def _hear(self, event: RadioEvent) -> None:
        served, chip = self._served, self.chip
        assert served is not None
        if isinstance(event, Restarted):
            chip.pull_reset()
            try:
                served.begin(ModelBus(chip, _sleep))
            except ChipError as error:
                served.end(str(error))
        elif isinstance(event, Gone):
            served.end(event.reason)
        elif isinstance(event, Reception):
            chip.hear(event.frame, event.rx_ticks, event.diagnostics or Diagnostics())
        elif isinstance(event, Sent):
            chip.transceiver.finish()
        else:
            chip.transceiver.fail()
        if not isinstance(event, Gone) and chip.irq:
            try:
                served.wake()
            except ChipError as error:
                served.end(str(error))

    # The chip's air

    def now_ticks(self) -> int:
        """The node's counter."""
        return self._radio.now_ticks() or 0

    def transmit(self, frame: bytes, leaves_ticks: int) -> bool:
        """Hand a frame to the ether, unless it would come too late there."""
        if difference(leaves_ticks, self.now_ticks()) < ETHER_LEAD_TICKS:
            return False
        self._radio.transmit(Transmission(frame, leaves_ticks))
        return True

    def withdraw(self) -> None:
        """The ether takes nothing back: the frame flies at its time."""


def _sleep(seconds: float) -> None:
    """Pauses that the driver asks for; those of transfers are too short to be slept."""
    if seconds >= _SLEPT_S:
        time.sleep(seconds)
