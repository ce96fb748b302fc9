"""Where a DW1000 is: on the SPI of this computer, or a model of one on the emulated air."""

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import Final, Protocol

from skyless.air.reception import Diagnostics, Reception, Transmission
from skyless.errors import SkylessError
from skyless.firmware.dw1000 import Bus, ChipError
from skyless.radios.dw1000.spi_bus import SpiBus
from skyless.radios.emulated.radio import EmulatedRadio
from skyless.radios.interface import AntennaDelays, Gone, Late, RadioEvent, Restarted, Sent
from skyless.simulation.dw1000.chip import Chip, ModelBus
from skyless.simulation.dw1000.transceiver import PREAMBLE_TICKS
from skyless.ticks import difference, from_seconds

RETRY_S: Final = 1.0
ASK_S: Final = 0.5e-3
"""How often a chip without an interrupt line is asked."""
LOOK_S: Final = 0.02
"""And one with a line, should an edge have been missed."""

ETHER_LEAD_TICKS: Final = PREAMBLE_TICKS + from_seconds(0.3e-3)
"""How long before its RMARKER the emulated air, and the way there, want a frame."""

VAIN_WAKES: Final = 8
"""After so many interrupts in a row for nothing the line does not tell the truth."""

_SLEPT_S: Final = 100e-6


_IN_VAIN: Final = (
    "calls though the chip has nothing to tell: is irq= the right pin, the wire sound? "
    "It is asked every 0.5 ms meanwhile"
)


class Port(Protocol):
    """A chip's place."""

    async def keep(self, served: "Served") -> None:
        """Keep the chip within reach until cancelled, and tell what happens to it."""


class Served(Protocol):
    """Who wants the chip."""

    def begin(self, bus: Bus) -> None:
        """There is a chip, which is to be started; raises OSError and ChipError."""

    def wake(self) -> bool:
        """Its interrupt line is high; False when there was nothing for which it should be. Raises OSError."""

    def remark(self, counter: str, text: str) -> None:
        """Something is wrong with its wires: one more for this counter, and in words what to look at."""

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
        if line is None:
            while True:
                await asyncio.sleep(ASK_S)
                served.wake()
        risen = asyncio.Event()
        loop.add_reader(line, risen.set)
        try:
            await self._follow(bus, served, risen)
        finally:
            loop.remove_reader(line)

    async def _follow(self, bus: SpiBus, served: Served, risen: asyncio.Event) -> None:
        """Serve the chip when its line has risen and until it is low; one that calls for nothing is as good as none."""
        vain = 0
        while True:
            called = await _is_set(risen, LOOK_S)
            bus.forget_edges()
            risen.clear()
            while True:
                vain = 0 if served.wake() or not called else vain + 1
                if vain == VAIN_WAKES:
                    served.remark("irq-in-vain", f"the interrupt line of {self._place} {_IN_VAIN}")
                if vain >= VAIN_WAKES:
                    await asyncio.sleep(ASK_S)
                called = bus.is_raised()
                if not called:
                    break
                await asyncio.sleep(0)


async def _is_set(event: asyncio.Event, seconds: float) -> bool:
    """Whether it was set within that time."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await event.wait()
    return event.is_set()


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
            chip.receive(event.frame, event.rx_ticks, event.diagnostics or Diagnostics())
        elif isinstance(event, Sent):
            chip.transceiver.finish()
        elif isinstance(event, Late):
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
