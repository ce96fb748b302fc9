"""A serial port that is reopened whenever it was unplugged, and the clock of the board behind it."""

import asyncio
import contextlib
import errno
import os
import termios
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol

import serialx

from skyless.core.errors import SkylessError
from skyless.core.ticks import TICK_RATE_HZ, difference, wrap

_REOPEN_S: Final = 0.2

MAX_BOARD_DRIFT: Final = 100e-6
"""Bound on the relative drift of two crystals; the estimate decays by it between stamps with a short delay."""

JUMP_TICKS: Final = round(TICK_RATE_HZ)
"""A stamp off by more than a second means that the counter has restarted."""


class PortUser(Protocol):
    """Callbacks of the port."""

    def on_open(self, send: Callable[[bytes], None]) -> None:
        """The port is open."""

    def on_data(self, data: bytes) -> None:
        """Bytes have come."""

    def on_close(self) -> None:
        """The port is closed."""


class SerialPort:
    """One port, by its path."""

    def __init__(self, path: str, baud: int, gone: Callable[[str], None]) -> None:
        """``gone`` is called with the reason why there is no port, once for equal consecutive reasons."""
        self.path, self.baud = path, baud
        self._gone = gone
        self._reported = ""
        self._connection: _Connection | None = None

    async def run(self, user: PortUser) -> None:
        """Stay open until cancelled."""
        while True:
            try:
                transport, connection = await self._open(user)
            except (OSError, termios.error, serialx.SerialException, ValueError) as error:
                self._report(_trouble(self.path, error))
            else:
                self._connection = connection
                try:
                    ended = await connection.ended
                    if ended is not None:
                        self._report(ended or f"{self.path} was unplugged")
                finally:
                    self._connection = None
                    user.on_close()
                    transport.abort()
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(_REOPEN_S):
                            await transport.wait_closed()
            await asyncio.sleep(_REOPEN_S)

    async def _open(self, user: PortUser) -> "tuple[serialx.BaseSerialTransport, _Connection]":
        connection = _Connection(user)

        def protocol() -> asyncio.Protocol:
            return connection

        loop = asyncio.get_running_loop()
        transport, _ = await serialx.create_serial_connection(loop, protocol, self.path, self.baud)
        return transport, connection

    def waiting_bytes(self) -> int:
        """Bytes not accepted by the port yet; 0 while it is closed."""
        return 0 if self._connection is None else self._connection.waiting_bytes()

    def reopen(self, reason: str | None) -> None:
        """Close the port, if open, and open it again; None: there is nothing to report."""
        if self._connection is not None:
            self._connection.end(reason)

    def _report(self, reason: str) -> None:
        """Report why there is no port, unless that was the last report."""
        if reason != self._reported:
            self._reported = reason
            self._gone(reason)

    def clear_report(self) -> None:
        """The board works: report the next reason in any case."""
        self._reported = ""


class _Connection(asyncio.Protocol):
    """The port from opening to closing; ``ended`` gives the reason: empty if unknown, None if not to be reported."""

    def __init__(self, user: PortUser) -> None:
        self._user = user
        self.waiting_bytes: Callable[[], int] = int
        self.ended: asyncio.Future[str | None] = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)
        self.waiting_bytes = transport.get_write_buffer_size

        def send(data: bytes) -> None:
            if not self.ended.done() and not transport.is_closing():
                transport.write(data)

        self._user.on_open(send)

    def data_received(self, data: bytes) -> None:
        if not self.ended.done():
            self._user.on_data(data)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - the reason makes no difference
        self.end("")

    def end(self, reason: str | None) -> None:
        if not self.ended.done():
            self.ended.set_result(reason)


def line_advice(path: str, baud: int, sender: str, *, silent: bool) -> str:
    """Where to look if nothing usable comes from ``sender`` on an open port."""
    if silent:
        return f"nothing at all comes from {path} at {baud} baud: nothing on the air, another port, or not {sender}?"
    return f"what comes from {path} at {baud} baud is not from {sender}: another rate or other firmware?"


def check_path(spec: str, path: str) -> None:
    """Check that a path could be a serial port; a missing one may appear later.

    Raises:
        SkylessError: it can never be one.
    """
    if "://" in path:
        raise SkylessError(
            f"--radio is {spec!r}; it should name a serial port of this computer, as /dev/ttyACM0, and {path} is an "
            "address: run the program where the board is"
        )
    file = Path(path)
    try:
        kind = "a port" if not file.exists() or file.is_char_device() else "a folder" if file.is_dir() else "a file"
    except OSError:  # not readable, or no valid name; opening it will fail with the reason
        return
    if kind != "a port":
        raise SkylessError(f"--radio is {spec!r}; it should name a serial port, as /dev/ttyACM0, and {path} is {kind}")


def _trouble(path: str, error: Exception) -> str:
    """Why a port cannot be opened, and what to do."""
    number = error.errno if isinstance(error, OSError) else error.args[0] if error.args else None
    if number == errno.ENOENT:
        there = ", ".join(
            str(port) for pattern in ("ttyACM*", "ttyUSB*") for port in sorted(Path("/dev").glob(pattern))
        )
        return f"there is no {path} (serial ports here: {there or 'none'})"
    if number in (errno.EACCES, errno.EPERM):
        return f"{path} may not be opened: its group, usually dialout, must be one of yours (sudo usermod -aG ...)"
    if number == errno.EBUSY:
        return f"{path} is used by another program"
    if number in (errno.ENOTTY, errno.EINVAL):
        return f"{path} is no serial port, or does not have this baud rate"
    why = error.strerror if isinstance(error, OSError) and error.strerror else error
    return f"{path} cannot be opened ({why})"


class BoardClock:
    """A board's 40-bit counter, estimated from stamps that arrive with unknown delays.

    It uses the stamp with the shortest delay, so it lags by the shortest transfer.
    """

    def __init__(self) -> None:
        self._ticks: int | None = None
        self._host_s = 0.0

    def update(self, ticks: int, host_s: float) -> None:
        """Add a stamp of the counter that arrived at ``host_s`` of the host's monotonic clock."""
        known = self.read(host_s, MAX_BOARD_DRIFT)
        if known is None or difference(ticks, known) >= 0 or difference(ticks, known) < -JUMP_TICKS:
            self._ticks, self._host_s = ticks, host_s

    def read(self, host_s: float, drift: float = 0.0) -> int | None:
        """The 40-bit counter at a time of the host's clock; None before the first stamp."""
        if self._ticks is None:
            return None
        return wrap(self._ticks + round((host_s - self._host_s) * (1.0 - drift) * TICK_RATE_HZ))

    def reset(self) -> None:
        """Forget all stamps: the board has gone."""
        self._ticks = None


# A pseudo-terminal in place of a device on a serial port.

HELD_BYTES: Final = 1 << 15
"""Unread bytes kept; beyond it they are dropped with those in the system: a UART keeps nothing either."""


class Pty:
    """A pseudo-terminal in place of a board's serial port; programs open ``path`` or the symbolic link to it."""

    def __init__(self, link: Path | None = None, held_bytes: int = HELD_BYTES, asked: str = "--link is") -> None:
        """Open a pseudo-terminal. ``asked`` begins the message about a link that cannot be created.

        Raises:
            SkylessError: the system has none, or another file is in the way of the link.
        """
        try:
            self._board, self._port = os.openpty()  # held open, so that it exists while no program has it open
        except OSError as error:
            raise SkylessError(f"no pseudo-terminal can be opened: {error.strerror}") from None
        tty.setraw(self._port)
        os.set_blocking(self._board, False)
        self.path = os.ttyname(self._port)
        self.link = link
        self._held_bytes = held_bytes
        self.overruns = 0
        """Number of times unread bytes were dropped."""
        self._waiting = bytearray()
        if link is not None:
            _make_link(link, self.path, asked)

    @property
    def name(self) -> str:
        """The path that programs open: the link's, if there is one."""
        return self.path if self.link is None else str(self.link)

    def start(self, on_data: Callable[[bytes], None]) -> None:
        """Call ``on_data`` with programs' output, from the running event loop."""
        asyncio.get_running_loop().add_reader(self._board, self._read, on_data)

    def _read(self, on_data: Callable[[bytes], None]) -> None:
        with contextlib.suppress(BlockingIOError):
            on_data(os.read(self._board, 4096))

    def send(self, data: bytes) -> bool:
        """Write, at once or soon. Returns False if this and all waiting bytes were dropped because nobody reads."""
        if self._waiting:
            if len(self._waiting) + len(data) > self._held_bytes:
                self.overruns += 1
                self._waiting.clear()
                termios.tcflush(self._port, termios.TCIFLUSH)
                asyncio.get_running_loop().remove_writer(self._board)
                return False
            self._waiting += data
            return True
        self._waiting += data
        self._write()
        if self._waiting:
            asyncio.get_running_loop().add_writer(self._board, self._write)
        return True

    def _write(self) -> None:
        with contextlib.suppress(BlockingIOError):
            del self._waiting[: os.write(self._board, self._waiting)]
        if not self._waiting:
            asyncio.get_running_loop().remove_writer(self._board)

    def close(self) -> None:
        """Remove the port, as when a board is unplugged."""
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._board)
        loop.remove_writer(self._board)
        if self.link is not None and self.link.is_symlink() and str(self.link.readlink()) == self.path:
            self.link.unlink()
        os.close(self._board)
        os.close(self._port)


def _make_link(link: Path, path: str, asked: str) -> None:
    """Create the link, replacing an older one atomically."""
    if link.exists() and not link.is_symlink():
        raise SkylessError(f"{asked} {str(link)!r}; it should be a free name, and this path exists")
    scratch = link.with_name(f".{link.name}.{os.getpid()}")
    try:
        scratch.symlink_to(path)
        scratch.replace(link)
    except OSError as error:
        raise SkylessError(f"{asked} {str(link)!r}, which cannot be made: {error.strerror}") from None
