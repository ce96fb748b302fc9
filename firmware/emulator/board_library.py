"""The firmware's portable files on this computer: ``make -C firmware host`` builds them, and ctypes calls them.

The same C as on a board, with the undefined-behaviour sanitizer; bus, clock and line are functions of Python.
"""

import ctypes
from functools import cache, partial
from typing import Protocol

from emulator.build import build
from skyless.radio.dw1000 import radio
from skyless.radio.serial.link import SETTINGS_BYTES, BoardSettings, unpack

KEPT_BYTES = 80
PLACES = ("board_bytes", "chip_bytes", "chip", "settings", "stage", "unix_us")
"""What ``host_places`` of firmware/host/exports.c states: sizes, and where in a board its parts are."""
STAGES = ("NO_FRAME", "FRAME_HELD", "FRAME_HANDED_OVER")


class Processor(radio.Bus, Protocol):
    """What a board needs of its processor, as in ``struct hardware``; what most tests do not look at is done here."""

    lights: int = 0
    settings: bytes | None = None
    """The ``KEPT_BYTES`` that were written last, if there are any."""

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

    def set_rate(self, baud: int) -> None:
        """Go on at another rate; here all are alike."""

    def show(self, lights: int) -> None:
        """Switch the lights."""
        self.lights = lights

    def sleep_for(self, milliseconds: int) -> None:
        """Sleep with everything off; the clock goes on."""

    def write_settings(self, settings: bytes) -> None:
        """Keep settings."""
        self.settings = settings

    def probe(self, item: int) -> int:  # noqa: ARG002
        """A fact of the processor."""
        return 0

    def advertise(self, data: bytes) -> bool:  # noqa: ARG002
        """Begin to send a Bluetooth advertisement; False while the last is on its way."""
        return True


@cache
def library() -> ctypes.CDLL:
    """Build and load the library.

    Raises:
        RuntimeError: it cannot be built; the message has the compiler's.
    """
    loaded = ctypes.CDLL(str(build("host")))
    radio.declare(loaded)
    loaded.link_number.restype = ctypes.c_uint64
    for name in ("settings_check", "settings_unpack", "fix_is_due"):
        getattr(loaded, name).restype = ctypes.c_bool
    return loaded


@cache
def places() -> dict[str, int]:
    """The numbers of ``PLACES``."""
    found = (ctypes.c_uint32 * len(PLACES)).in_dll(library(), "host_places")
    return dict(zip(PLACES, found, strict=True))


class Hardware(radio.Hardware):
    """``struct hardware``."""

    _fields_ = (
        ("now_us", ctypes.CFUNCTYPE(ctypes.c_uint32)),
        ("interrupt_line", ctypes.CFUNCTYPE(ctypes.c_bool)),
        ("read_line", ctypes.CFUNCTYPE(ctypes.c_uint32, ctypes.c_void_p, ctypes.c_uint32)),
        ("write_line", ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, ctypes.c_uint32)),
        ("restart_line", ctypes.CFUNCTYPE(None)),
        ("set_rate", ctypes.CFUNCTYPE(None, ctypes.c_uint32)),
        ("show", ctypes.CFUNCTYPE(None, ctypes.c_uint32)),
        ("sleep_for", ctypes.CFUNCTYPE(None, ctypes.c_uint32)),
        ("read_settings", ctypes.CFUNCTYPE(None, ctypes.c_void_p)),
        ("write_settings", ctypes.CFUNCTYPE(None, ctypes.c_void_p)),
        ("probe", ctypes.CFUNCTYPE(ctypes.c_uint32, ctypes.c_int)),
        ("advertise", ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, ctypes.c_uint32)),
    )

    def __init__(self, processor: Processor) -> None:
        super().__init__(processor)

        def read_line(into: int, size: int) -> int:
            data = self.call(processor.read_line, size) or b""
            ctypes.memmove(into, data, len(data))
            return len(data)

        def read_settings(into: int) -> None:
            if processor.settings is not None:
                ctypes.memmove(into, processor.settings, len(processor.settings))

        self.connect(
            now_us=lambda: self.call(processor.now_us) & 0xFFFF_FFFF,
            read_line=read_line,
            write_line=lambda line, size: self.call(processor.write_line, ctypes.string_at(line, size)),
            read_settings=read_settings,
            write_settings=lambda at: self.call(processor.write_settings, ctypes.string_at(at, KEPT_BYTES)),
            probe=partial(self.call, processor.probe),
            advertise=lambda at, size: self.call(processor.advertise, ctypes.string_at(at, size)),
            **{
                name: partial(self.call, getattr(processor, name))
                for name in ("interrupt_line", "restart_line", "set_rate", "show", "sleep_for")
            },
        )


class CBoard:
    """``struct board``: the firmware's loop."""

    def __init__(
        self, processor: Processor, *, can_transmit: bool, device_id: bytes = bytes(8), reset_cause: int = 0
    ) -> None:
        self._library = library()
        self._memory = ctypes.create_string_buffer(places()["board_bytes"])
        self._board = ctypes.c_void_p(ctypes.addressof(self._memory))
        self._hardware = Hardware(processor)
        identity = bytes((can_transmit, *device_id, reset_cause))
        self._library.board_init(self._board, ctypes.byref(self._hardware), identity)
        self.chip = radio.DW1000.from_buffer(self._memory, places()["chip"])
        """Its fields; the board alone calls the driver."""

    @property
    def stage(self) -> str:
        """What became of the frame that the host wants to be sent."""
        return STAGES[ctypes.c_int.from_buffer(self._memory, places()["stage"]).value]

    @property
    def settings(self) -> BoardSettings | None:
        """What it works with as a tag."""
        packed = ctypes.create_string_buffer(SETTINGS_BYTES)
        self._library.settings_pack(ctypes.byref(self._memory, places()["settings"]), packed)
        return unpack(packed.raw)

    @property
    def unix_us(self) -> int:
        """The time of the last turn as a tag, by what its host has given."""
        return ctypes.c_int64.from_buffer(self._memory, places()["unix_us"]).value

    def begin(self) -> None:
        """``board_begin``: send HELLO."""
        self._library.board_begin(self._board)
        self._hardware.raise_failure()

    def turn(self) -> int:
        """``board_turn``: for how many µs nothing is to be done without an event; 0: turn again."""
        wait_us = ctypes.c_uint32(self._library.board_turn(self._board)).value
        self._hardware.raise_failure()
        return wait_us
