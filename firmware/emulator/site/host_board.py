"""The firmware's C, compiled for this computer, as a board in the timeline's time: its clock, line, bus and chip's pin.

What the program computes takes no time; transfers, pauses and bytes on the line take theirs.
"""

from functools import partial
from typing import Final

from emulator.board_library import CBoard, Processor
from emulator.seat import Seat
from emulator.site.host_programs import Process
from skyless.core.ticks import TICK_S, from_seconds

LINE_BYTES: Final = 1024
"""Bytes that wait to be sent, or to be read."""
SLOW_HZ: Final = 2_000_000
FAST_HZ: Final = 8_000_000
_TRANSFER_S: Final = 5e-6
"""Of a transfer besides its bits: chip select and the start of the DMA (assumed)."""
_TURN_S: Final = 5e-6
"""What a turn takes besides its transfers (assumed; the emulated processor counts it)."""


class HostBoard(Processor):
    """One board; its program is run again after the supply failed."""

    reset_cause = 0
    byte_s = 10e-6
    """On the UART: ten bits at 1 Mbaud."""

    def __init__(self, seat: Seat) -> None:
        self._seat, self._timeline, self.chip = seat, seat.timeline, seat.chip
        self._start()

    def program(self) -> None:
        """Run the board's loop, as the image's ``main`` does."""
        board = CBoard(
            self, can_transmit=self._seat.can_transmit, device_id=self._seat.identity, reset_cause=self.reset_cause
        )
        board.begin()
        while True:
            wait_us = board.turn()
            self.process.sleep(_TURN_S)
            if wait_us and not self._came:  # at most until the interrupt line rises or bytes come
                self.process.wait(1e-6 * wait_us)

    def _start(self) -> None:
        self._came = bytearray()
        self._line_was_high = False
        self._hz = SLOW_HZ
        self._unsent_ticks = self._timeline.now_ticks
        self._starts_ticks = self._timeline.now_ticks
        self.process = Process(self._timeline, self.program)

    # What the site calls

    def notify(self) -> None:
        """The chip's interrupt line may have changed; a rise wakes the program, and a line that stays high does not."""
        is_high = self.chip.irq
        if is_high and not self._line_was_high:
            self.process.notify()
        self._line_was_high = is_high

    def receive(self, data: bytes) -> None:
        """These bytes have come on the UART."""
        if len(self._came) + len(data) <= LINE_BYTES:
            self._came += data
        self.process.notify()

    def power_cycle(self) -> None:
        """The supply failed and is back."""
        self.process.close()
        self._start()

    def close(self) -> None:
        """End the program."""
        self.process.close()

    # What the program calls

    def now_us(self) -> int:
        """Microseconds since the start."""
        return int((self._timeline.now_ticks - self._starts_ticks) * TICK_S * 1e6)

    def transfer(self, out: bytes) -> bytes:
        """One SPI transaction; it reaches the chip when its time is over."""
        self.process.sleep(_TRANSFER_S + 8 * len(out) / self._hz)
        answer = self.chip.transfer(out, self._hz)
        self.notify()
        left_ticks = self.chip.transceiver.window_left_ticks
        if left_ticks is not None:
            self._timeline.at(self._timeline.now_ticks + left_ticks + (left_ticks >> 13), self.notify)
        return answer

    def set_spi_fast(self, fast: bool) -> None:
        """Clock the SPI fast from now on, or slowly."""
        self._hz = FAST_HZ if fast else SLOW_HZ

    def reset_chip(self) -> None:
        """Pull RSTn low for a moment."""
        self.chip.pull_reset()

    def pause_us(self, microseconds: int) -> None:
        """Wait."""
        self.process.sleep(1e-6 * microseconds)

    def interrupt_line(self) -> bool:
        """Whether the chip's line is high."""
        return self.chip.irq

    def sleep_for(self, milliseconds: int) -> None:
        """Sleep; what comes on the UART is lost."""
        self.process.sleep(1e-3 * milliseconds)
        self._came.clear()

    def read_line(self, size: int) -> bytes:
        """What has come on the UART, at most ``size`` bytes."""
        data = bytes(self._came[:size])
        del self._came[:size]
        return data

    def write_line(self, data: bytes) -> bool:
        """Send, now or when what waits is sent; False where it does not fit."""
        now = self._timeline.now_ticks
        begins = max(now, self._unsent_ticks)
        if (begins - now) * TICK_S / self.byte_s + len(data) > LINE_BYTES:
            return False
        self._unsent_ticks = begins + from_seconds(len(data) * self.byte_s)
        self._timeline.at(self._unsent_ticks, partial(self._deliver, data, self.process))
        return True

    def _deliver(self, data: bytes, sender: Process) -> None:
        """The bytes have left the pin, unless the supply failed meanwhile."""
        if sender is self.process:
            self._seat.send(data)

    def restart_line(self) -> None:
        """Discard all that has come."""
        self._came.clear()
