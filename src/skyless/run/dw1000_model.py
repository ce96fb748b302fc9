"""A model of a DW1000 on the emulated air, behind the same radio class as a real chip on SPI."""

import time
from typing import Final

from skyless.core.air.frame import Diagnostics, Reception, Transmission
from skyless.core.ticks import difference, from_seconds
from skyless.radio.dw1000.radio import ChipError, Dw1000Radio
from skyless.radio.emulated import EmulatedRadio
from skyless.radio.interface import AntennaDelays, Gone, Late, RadioEvent, Restarted, Sent
from skyless.sim.dw1000.chip import Chip, ModelBus
from skyless.sim.dw1000.transceiver import PREAMBLE_TICKS

ETHER_LEAD_TICKS: Final = PREAMBLE_TICKS + from_seconds(0.3e-3)
"""How long before its RMARKER a frame must be handed over, to reach the emulated air in time."""
_SHORTEST_SLEEP_S: Final = 100e-6


class ModelPort:
    """A model of the chip at one node of ``skyless ether`` (``skyless.radio.dw1000.radio.Port``)."""

    def __init__(self, node: EmulatedRadio, delays: AntennaDelays) -> None:
        self._node = node
        self.chip = Chip(self, delays.tx_ticks, delays.rx_ticks, time.monotonic)
        self._radio: Dw1000Radio | None = None

    async def run(self, radio: Dw1000Radio) -> None:
        """Provide a chip while there is an ether, until cancelled."""
        self._radio = radio
        await self._node.run(self._on_event)

    def _on_event(self, event: RadioEvent) -> None:
        radio, chip = self._radio, self.chip
        assert radio is not None
        if isinstance(event, Restarted):
            chip.pull_reset()
            try:
                radio.begin(ModelBus(chip, _sleep))
            except ChipError as error:
                radio.end(str(error))
        elif isinstance(event, Gone):
            radio.end(event.reason)
        elif isinstance(event, Reception):
            measured, phase_cycles = event.diagnostics or Diagnostics(), event.carrier_phase_cycles
            chip.receive(event.frame, event.rx_ticks, measured, carrier_phase_cycles=phase_cycles)
        elif isinstance(event, Sent):
            chip.transceiver.finish()
        elif isinstance(event, Late):
            chip.transceiver.fail()
        if not isinstance(event, Gone) and chip.irq:
            try:
                radio.serve()
            except ChipError as error:
                radio.end(str(error))

    # The chip's air

    def now_ticks(self) -> int:
        """The node's counter."""
        return self._node.now_ticks() or 0

    def transmit(self, frame: bytes, leaves_ticks: int) -> bool:
        """Hand a frame to the ether; return False if it would arrive too late."""
        if difference(leaves_ticks, self.now_ticks()) < ETHER_LEAD_TICKS:
            return False
        self._node.transmit(Transmission(frame, leaves_ticks))
        return True

    def withdraw(self) -> None:
        """Do nothing: the ether cannot cancel a frame, which is sent at its time."""


def _sleep(seconds: float) -> None:
    """Sleep for the driver's pauses, except those of transfers, which are too short."""
    if seconds >= _SHORTEST_SLEEP_S:
        time.sleep(seconds)
