"""The way between a board's UART and the programs of its host: pins, an adapter, a pseudo-terminal, a busy computer."""

import random
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from msgspec import Struct

from emulator.site.host_programs import HostLatency
from emulator.site.virtual_time import wake
from skyless.core.ticks import from_seconds
from skyless.radio.serial.serial_port import Pty
from skyless.sim.medium import Timeline

BITS_A_BYTE: Final = 10

_USB_BYTES: Final = 64
_USB_S: Final = 1e-3
"""A debugger's probe passes on at most so much at most so often, as a packet of full-speed USB (assumed)."""
_FIFO_BYTES: Final = 32
"""A computer's UART wakes its program at most once for this number of bytes (assumed)."""


class WireSettings(Struct, frozen=True):
    """What lies between a board and its host."""

    baud: int = 1_000_000
    usb: bool = False
    """Through a probe's USB port, else through a UART of the computer itself."""
    host: HostLatency | None = None
    """A pause before it reads or writes, and work for each line. None: it takes no time."""
    piece_bytes: int = 1
    """The board gets this number of bytes at once, when the last of them has come."""


Change = Callable[[bytes], bytes]


class SerialWire:
    """One board's. ``path`` is the port that its programs open."""

    def __init__(self, timeline: Timeline[Any], settings: WireSettings, generator: random.Random) -> None:
        self._timeline, self._settings, self._generator = timeline, settings, generator
        self._pty = Pty(held_bytes=0)
        self.path, self.close = self._pty.path, self._pty.close
        self.noise_to_board: Change = bytes
        self.noise_to_host: Change = bytes
        self._receive: Callable[[bytes], None] | None = None
        self._byte_ticks = from_seconds(BITS_A_BYTE / settings.baud)
        self._line_free = self._host_free = self._read_ticks = 0
        self._unread = bytearray()
        self._packets = {True: _Packets(timeline, self._to_pins), False: _Packets(timeline, self._to_computer)}

    def start(self, receive: Callable[[bytes], None]) -> None:
        """Pass on what programs write, from the running loop on; ``receive`` gets what arrives at the board."""
        self._receive = receive
        self._pty.start(self._on_written)

    # To the host

    def send(self, data: bytes) -> None:
        """These bytes have just left the board's pin."""
        if self._settings.usb:
            self._packets[False].add(data)
        else:
            self._to_computer(data)

    def _to_computer(self, data: bytes) -> None:
        data = self.noise_to_host(data)
        if self._settings.host is None:
            self._write(data)
            return
        if not self._unread:
            earliest = max(self._timeline.now_ticks, self._host_free, self._read_ticks + _FIFO_BYTES * self._byte_ticks)
            self._timeline.at(earliest + self._pause_ticks(self._settings.host), self._wake_host)
        self._unread += data

    def _wake_host(self) -> None:
        """The program gets to read all that has come."""
        assert self._settings.host is not None
        data = bytes(self._unread)
        self._unread.clear()
        self._read_ticks = self._timeline.now_ticks
        self._host_free = self._read_ticks + data.count(0) * from_seconds(self._settings.host.work_s)
        self._write(data)

    def _pause_ticks(self, host: HostLatency) -> int:
        return from_seconds(host.draw(self._generator))

    def _write(self, data: bytes) -> None:
        self._pty.send(data)
        wake(self._timeline)

    # To the board

    def _on_written(self, data: bytes) -> None:
        host = self._settings.host
        if host is None:
            self._to_adapter(data)
            return
        begins = max(self._timeline.now_ticks, self._host_free) + self._pause_ticks(host)
        self._host_free = begins + from_seconds(host.work_s)
        self._timeline.at(self._host_free, partial(self._to_adapter, data))

    def _to_adapter(self, data: bytes) -> None:
        if self._settings.usb:
            self._packets[True].add(data)
        else:
            self._to_pins(data)

    def _to_pins(self, data: bytes) -> None:
        """Let the bytes arrive at the board one after the other."""
        assert self._receive is not None
        data, most = self.noise_to_board(data), self._settings.piece_bytes
        at = max(self._timeline.now_ticks, self._line_free)
        for first in range(0, len(data), most):
            piece = data[first : first + most]
            at += len(piece) * self._byte_ticks
            self._timeline.at(at, partial(self._receive, piece))
        self._line_free = at


class _Packets:
    """One direction of the USB: at most a packet at once, and at most one in a frame."""

    def __init__(self, timeline: Timeline[Any], deliver: Callable[[bytes], None]) -> None:
        self._timeline, self._deliver = timeline, deliver
        self._waiting = bytearray()
        self._planned = False

    def add(self, data: bytes) -> None:
        self._waiting += data
        if not self._planned:
            self._plan()

    def _plan(self) -> None:
        frame = from_seconds(_USB_S)
        self._planned = True
        self._timeline.at((self._timeline.now_ticks // frame + 1) * frame, self._pass_on)

    def _pass_on(self) -> None:
        piece = bytes(self._waiting[:_USB_BYTES])
        del self._waiting[:_USB_BYTES]
        self._planned = False
        if self._waiting:
            self._plan()
        self._deliver(piece)
