"""The firmware's portable files on this computer: ``make -C firmware host`` builds them, and ctypes calls them.

The same C as on a board, with the undefined-behaviour sanitizer; bus, clock and line are functions of Python.
"""

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Protocol

from emulator.build import build

CHIP_NUMBERS = (
    "received", "errors", "sent", "late", "rx_ticks", "tx_ticks", "frame_bytes",
    "rx_power_cdbm", "first_path_cdbm", "offset_ppb", "temperature_cc", "millivolts",
)  # fmt: skip
"""What ``host_chip_number`` of firmware/host/exports.c returns, in its order."""
STATES = ("OFF", "IDLE", "LISTENING", "SENDING")
STAGES = ("NO_FRAME", "FRAME_HELD", "FRAME_HANDED_OVER")

_BYTES = ctypes.POINTER(ctypes.c_uint8)


class _Hardware(ctypes.Structure):
    """``struct hardware`` of firmware/source/hardware.h."""

    _fields_ = (
        ("transfer", ctypes.CFUNCTYPE(None, _BYTES, _BYTES, ctypes.c_uint32)),
        ("set_spi_fast", ctypes.CFUNCTYPE(None, ctypes.c_bool)),
        ("reset_chip", ctypes.CFUNCTYPE(None)),
        ("pause_us", ctypes.CFUNCTYPE(None, ctypes.c_uint32)),
        ("now_us", ctypes.CFUNCTYPE(ctypes.c_uint32)),
        ("interrupt_line", ctypes.CFUNCTYPE(ctypes.c_bool)),
        ("read_line", ctypes.CFUNCTYPE(ctypes.c_uint32, _BYTES, ctypes.c_uint32)),
        ("write_line", ctypes.CFUNCTYPE(ctypes.c_bool, _BYTES, ctypes.c_uint32)),
        ("restart_line", ctypes.CFUNCTYPE(None)),
        ("show", ctypes.CFUNCTYPE(None, ctypes.c_uint32)),
    )


class Hardware(Protocol):
    """What a board needs of its processor, as in firmware/source/hardware.h; nothing may raise."""

    def transfer(self, out: bytes) -> bytes:
        """One SPI transaction; as many bytes come back."""

    def set_spi_fast(self, fast: bool) -> None:
        """Clock the SPI slowly or fast."""

    def reset_chip(self) -> None:
        """Pull RSTn low for a moment."""

    def pause_us(self, microseconds: int) -> None:
        """Wait."""

    def now_us(self) -> int:
        """A clock, modulo 2**32."""

    def interrupt_line(self) -> bool:
        """Whether the chip's interrupt line is high."""

    def read_line(self, size: int) -> bytes:
        """Bytes from the host, at most ``size``."""

    def write_line(self, line: bytes) -> bool:
        """Queue a line for the host; False where it does not fit."""

    def restart_line(self) -> None:
        """Start the line's receiver again."""

    def show(self, lights: int) -> None:
        """Switch the lights."""


@cache
def library() -> ctypes.CDLL:
    """Build and load the library.

    Raises:
        RuntimeError: it cannot be built; the message has the compiler's.
    """
    loaded = ctypes.CDLL(str(build("host")))
    loaded.host_board_chip.restype = ctypes.c_void_p
    loaded.host_chip_number.restype = ctypes.c_int64
    for name in ("host_chip_frame", "host_writer_line", "host_reader_record"):
        getattr(loaded, name).restype = ctypes.c_void_p
    for name in ("log10", "accumulated", "power_cdbm", "first_path_cdbm", "carrier_offset_ppb", "micros_until"):
        getattr(loaded, f"dw1000_{name}").restype = ctypes.c_int32
    for name in ("check", "cancel", "measure", "start"):
        getattr(loaded, f"dw1000_{name}").restype = ctypes.c_bool
    loaded.dw1000_now.restype = loaded.link_number.restype = ctypes.c_uint64
    loaded.dw1000_micros_until.argtypes = (ctypes.c_uint64, ctypes.c_uint64)
    loaded.dw1000_transmit_at.argtypes = (ctypes.c_void_p, ctypes.c_uint64, ctypes.c_char_p, ctypes.c_uint32)
    return loaded


def pass_to_c(hardware: Hardware) -> _Hardware:
    """The functions as C calls them. The result must be kept as long as C may call them.

    An exception in one of them is shown by ctypes and lost: what must not be missed has to be noted by the hardware.
    """

    def transfer(out: "ctypes._Pointer[ctypes.c_uint8]", into: "ctypes._Pointer[ctypes.c_uint8]", size: int) -> None:
        ctypes.memmove(into, hardware.transfer(ctypes.string_at(out, size)), size)

    def read_line(into: "ctypes._Pointer[ctypes.c_uint8]", size: int) -> int:
        data = hardware.read_line(size)
        ctypes.memmove(into, data, len(data))
        return len(data)

    def write_line(line: "ctypes._Pointer[ctypes.c_uint8]", size: int) -> bool:
        return hardware.write_line(ctypes.string_at(line, size))

    functions: dict[str, Callable[..., object]] = {
        "transfer": transfer, "read_line": read_line, "write_line": write_line,
        "now_us": lambda: hardware.now_us() & 0xFFFF_FFFF,
    }  # fmt: skip
    kinds = dict(_Hardware._fields_)
    made = {name: kind(functions.get(name) or getattr(hardware, name)) for name, kind in kinds.items()}
    return _Hardware(**made)


class CChip:
    """``struct dw1000``, alone or a board's."""

    def __init__(self, hardware: Hardware | None = None, *, address: int | None = None) -> None:
        self._library = library()
        self._memory = ctypes.create_string_buffer(self._library.host_chip_bytes())
        self.address = ctypes.c_void_p(ctypes.addressof(self._memory) if address is None else address)
        if hardware is not None:
            self._hardware = pass_to_c(hardware)
            self._library.dw1000_init(self.address, ctypes.byref(self._hardware))

    def __getattr__(self, name: str) -> int:
        if name not in CHIP_NUMBERS:
            raise AttributeError(name)
        value: int = self._library.host_chip_number(self.address, CHIP_NUMBERS.index(name))
        return value

    @property
    def state(self) -> str:
        """OFF, IDLE, LISTENING or SENDING."""
        return STATES[self._library.host_chip_state(self.address)]

    @property
    def frame(self) -> bytes:
        """The frame that was received last."""
        return ctypes.string_at(self._library.host_chip_frame(self.address), self.frame_bytes)

    def start(self, tx_antenna_delay: int, rx_antenna_delay: int) -> bool:
        """``dw1000_start``."""
        return bool(self._library.dw1000_start(self.address, tx_antenna_delay, rx_antenna_delay))

    def receive(self) -> None:
        """``dw1000_receive``."""
        self._library.dw1000_receive(self.address)

    def transmit_at(self, dx_ticks: int, frame: bytes) -> int:
        """``dw1000_transmit_at``."""
        return int(self._library.dw1000_transmit_at(self.address, dx_ticks, frame, len(frame)))

    def cancel(self) -> bool:
        """``dw1000_cancel``."""
        return bool(self._library.dw1000_cancel(self.address))

    def poll(self) -> int:
        """``dw1000_poll``."""
        return int(self._library.dw1000_poll(self.address))

    def check(self) -> bool:
        """``dw1000_check``."""
        return bool(self._library.dw1000_check(self.address))

    def now(self) -> int:
        """``dw1000_now``."""
        return int(self._library.dw1000_now(self.address))

    def measure(self) -> bool:
        """``dw1000_measure``."""
        return bool(self._library.dw1000_measure(self.address))


class CBoard:
    """``struct board``: the firmware's loop."""

    def __init__(
        self, hardware: Hardware, *, can_transmit: bool, device_id: bytes = bytes(8), reset_cause: int = 0
    ) -> None:
        self._library = library()
        self._memory = ctypes.create_string_buffer(self._library.host_board_bytes())
        self._board = ctypes.c_void_p(ctypes.addressof(self._memory))
        self._hardware = pass_to_c(hardware)
        self._library.host_board_init(
            self._board,
            ctypes.byref(self._hardware),
            device_id,
            ctypes.c_bool(can_transmit),
            ctypes.c_uint8(reset_cause),
        )
        self.chip = CChip(address=self._library.host_board_chip(self._board))

    @property
    def stage(self) -> str:
        """What became of the frame that the host wants to be sent."""
        return STAGES[self._library.host_board_stage(self._board)]

    def begin(self) -> None:
        """``board_begin``: send HELLO."""
        self._library.board_begin(self._board)

    def turn(self) -> int:
        """``board_turn``: for how many µs nothing is to be done without an event; 0: turn again."""
        return ctypes.c_uint32(self._library.board_turn(self._board)).value
