"""The firmware's C, compiled for this computer, as a board (``make -C firmware host``)."""

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Final

from program_board import ProgramBoard

from skyless.simulation.dw1000.chip import Chip
from skyless.simulation.medium import Timeline

LIBRARY: Final = Path(__file__).parents[1] / "build" / "libskyless-board.so"
_TURN_S: Final = 5e-6
"""What a turn takes besides its transfers (assumed; the emulated processor counts it)."""

_Bytes = ctypes.POINTER(ctypes.c_uint8)


class _Hardware(ctypes.Structure):
    """``struct hardware`` of hardware.h."""

    _fields_: ClassVar = [
        ("transfer", ctypes.CFUNCTYPE(None, _Bytes, _Bytes, ctypes.c_uint32)),
        ("set_spi_fast", ctypes.CFUNCTYPE(None, ctypes.c_bool)),
        ("reset_chip", ctypes.CFUNCTYPE(None)),
        ("pause_us", ctypes.CFUNCTYPE(None, ctypes.c_uint32)),
        ("now_us", ctypes.CFUNCTYPE(ctypes.c_uint32)),
        ("interrupt_line", ctypes.CFUNCTYPE(ctypes.c_bool)),
        ("read_line", ctypes.CFUNCTYPE(ctypes.c_uint32, _Bytes, ctypes.c_uint32)),
        ("write_line", ctypes.CFUNCTYPE(ctypes.c_bool, _Bytes, ctypes.c_uint32)),
        ("restart_line", ctypes.CFUNCTYPE(None)),
        ("show", ctypes.CFUNCTYPE(None, ctypes.c_uint32)),
    ]


class HostBoard(ProgramBoard):
    """One board; the library keeps no state, so one serves any number."""

    def __init__(
        self,
        timeline: Timeline[Any],
        chip: Chip,
        send: Callable[[bytes], None],
        *,
        can_transmit: bool,
        identity: bytes,
        library: Path = LIBRARY,
    ) -> None:
        self.lights = 0
        self._failed: BaseException | None = None
        self._library = ctypes.CDLL(str(library))
        self._library.board_turn.restype = ctypes.c_uint32
        self._can_transmit, self._identity = can_transmit, identity
        types = dict(_Hardware._fields_)
        calls: dict[str, Callable[..., Any]] = {
            "transfer": self._on_transfer,
            "set_spi_fast": self.set_spi_fast,
            "reset_chip": self.reset_chip,
            "pause_us": lambda microseconds: self.pause_s(1e-6 * microseconds),
            "now_us": lambda: self.now_us() & 0xFFFFFFFF,
            "interrupt_line": lambda: self.chip.irq,
            "read_line": self._on_read,
            "write_line": lambda line, size: self.write_line(ctypes.string_at(line, size)),
            "restart_line": self.restart_line,
            "show": self._on_show,
        }
        self._hardware = _Hardware(*(types[name](self._guarded(call)) for name, call in calls.items()))
        super().__init__(timeline, chip, send)

    def program(self) -> None:
        """Run the board's loop, as the image's ``main`` does."""
        self._failed = None
        board = ctypes.create_string_buffer(self._library.host_board_bytes())
        hardware, can_transmit = ctypes.byref(self._hardware), ctypes.c_bool(self._can_transmit)
        self._library.host_board_init(board, hardware, self._identity, can_transmit, ctypes.c_uint8(0))
        self._call(self._library.board_begin, board)
        while True:
            wait_us = self._call(self._library.board_turn, board)
            self.pause_s(_TURN_S)
            if wait_us:
                self.wait_s(1e-6 * wait_us)

    def _call(self, function: Callable[[Any], int], board: Any) -> int:
        """Call the C; what a callback raised, as the end of the world, is raised here."""
        result = function(board)
        if self._failed is not None:
            raise self._failed
        return result

    def _guarded(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """C knows no exceptions: keep one until the C has returned, and let it call nothing more."""

        def guarded(*values: Any) -> Any:
            if self._failed is None:
                try:
                    return call(*values) or 0
                except BaseException as error:  # noqa: BLE001 - raised by _call
                    self._failed = error
            return 0

        return guarded

    def _on_transfer(self, out: Any, into: Any, size: int) -> None:
        ctypes.memmove(into, self.transfer(ctypes.string_at(out, size)), size)

    def _on_read(self, into: Any, size: int) -> int:
        data = self.read_line(size)
        ctypes.memmove(into, data, len(data))
        return len(data)

    def _on_show(self, lights: int) -> None:
        self.lights = lights
