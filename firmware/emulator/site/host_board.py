"""The firmware's C, compiled for this computer, as a board."""

from collections.abc import Callable
from typing import Any, Final, TypeVar

from emulator.board_library import CBoard
from emulator.site.program_board import ProgramBoard
from skyless.simulation.dw1000.chip import Chip
from skyless.simulation.medium import Timeline

Value = TypeVar("Value")

_TURN_S: Final = 5e-6
"""What a turn takes besides its transfers (assumed; the emulated processor counts it)."""


class HostBoard(ProgramBoard):
    """One board."""

    def __init__(
        self,
        timeline: Timeline[Any],
        chip: Chip,
        send: Callable[[bytes], None],
        *,
        can_transmit: bool,
        identity: bytes,
    ) -> None:
        self._can_transmit, self._identity = can_transmit, identity
        super().__init__(timeline, chip, send)

    def program(self) -> None:
        """Run the board's loop, as the image's ``main`` does."""
        hardware = _Guarded(self)
        board = CBoard(hardware, can_transmit=self._can_transmit, device_id=self._identity)
        board.begin()
        while True:
            wait_us = board.turn()
            if hardware.failed is not None:
                raise hardware.failed
            self.pause_s(_TURN_S)
            if wait_us:
                self.wait_s(1e-6 * wait_us)


class _Guarded:
    """The board's hardware for C, which knows no exceptions.

    One that is raised, as the end of the program, is kept until the C has returned, which until then reads zeros.
    """

    def __init__(self, board: HostBoard) -> None:
        self.failed: BaseException | None = None
        self._board = board

    def _call(self, call: Callable[..., Value], *values: object) -> Value | None:
        if self.failed is None:
            try:
                return call(*values)
            except BaseException as error:  # noqa: BLE001 - raised by HostBoard.program
                self.failed = error
        return None

    def transfer(self, out: bytes) -> bytes:
        return self._call(self._board.transfer, out) or bytes(len(out))

    def set_spi_fast(self, fast: bool) -> None:
        self._call(self._board.set_spi_fast, fast)

    def reset_chip(self) -> None:
        self._call(self._board.reset_chip)

    def pause_us(self, microseconds: int) -> None:
        self._call(self._board.pause_s, 1e-6 * microseconds)

    def now_us(self) -> int:
        return self._call(self._board.now_us) or 0

    def interrupt_line(self) -> bool:
        return self._call(lambda: self._board.chip.irq) or False

    def read_line(self, size: int) -> bytes:
        return self._call(self._board.read_line, size) or b""

    def write_line(self, line: bytes) -> bool:
        return self._call(self._board.write_line, line) or False

    def restart_line(self) -> None:
        self._call(self._board.restart_line)

    def show(self, lights: int) -> None:
        self._board.lights = lights
