"""The firmware as a program: on a model of the chip at a node of the ether, behind a pseudo-terminal."""

import asyncio
import contextlib
import time

from skyless.air.reception import Diagnostics, Reception, Transmission
from skyless.firmware import board, dw1000
from skyless.nodes.open_radio import open_radios
from skyless.radios.dw1000.model import ETHER_LEAD_TICKS
from skyless.radios.interface import AntennaDelays, Gone, Restarted, Sent
from skyless.radios.serial.pseudo_terminal import Pty
from skyless.simulation.dw1000.chip import Chip, ModelBus
from skyless.ticks import difference

TURN_S = 0.3e-3
LEAD_US = 2500
"""What a board that sleeps between its turns needs on a busy machine."""


class FirmwareBoard:
    """Board, chip and UART in one; starts anew whenever the ether does."""

    def __init__(self, air, kind, name, link):
        (self.radio,) = open_radios(air, kind, (name,))
        self.pty = Pty(link)
        self.chip = Chip(self, AntennaDelays().tx_ticks, AntennaDelays().rx_ticks, time.monotonic)
        self.came = bytearray()
        self.restarts = self.collections = 0
        driver = dw1000.DW1000(ModelBus(self.chip))
        self.board = board.Board(driver, self, self, self, kind == "anchor", bytearray(8), self, LEAD_US)

    async def run(self):
        self.pty.start(self.came.extend)
        air = asyncio.ensure_future(self.radio.run(self.hear))
        self.board.begin()
        try:
            while True:
                self.board.turn()
                await asyncio.sleep(TURN_S)
        finally:
            air.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await air
            self.pty.close()

    def hear(self, event):
        if isinstance(event, Restarted | Gone):
            self.chip.pull_reset()
        elif isinstance(event, Reception):
            self.chip.receive(event.frame, event.rx_ticks, event.diagnostics or Diagnostics())
            self.board.turn()
        elif isinstance(event, Sent):
            self.chip.transceiver.finish()
        else:
            self.chip.transceiver.fail()

    # The chip's air

    def now_ticks(self):
        return self.radio.now_ticks() or 0

    def transmit(self, frame, leaves_ticks):
        if difference(leaves_ticks, self.now_ticks()) < ETHER_LEAD_TICKS:
            return False
        self.radio.transmit(Transmission(frame, leaves_ticks))
        return True

    def withdraw(self):
        pass

    # What the board stands on

    def value(self):
        return int(self.chip.irq)

    def read(self, into):
        size = min(len(into), len(self.came))
        into[:size] = self.came[:size]
        del self.came[:size]
        return size

    def write(self, line, end):
        return self.pty.send(bytes(line[:end]))

    def restart(self):
        self.restarts += 1
        self.came.clear()

    def ticks_us(self):
        return time.monotonic_ns() // 1000

    def ticks_add(self, ticks, change):
        return ticks + change

    def ticks_diff(self, later, earlier):
        return later - earlier

    def collect(self):
        self.collections += 1
