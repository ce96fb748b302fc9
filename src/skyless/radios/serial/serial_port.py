"""A serial port that is opened, and again whenever it was pulled out."""

import asyncio
import contextlib
import errno
import termios
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol

import serialx

from skyless.errors import SkylessError

RETRY_S: Final = 0.2


class Session(Protocol):
    """What talks over an open port. The port calls it."""

    def begin(self, send: Callable[[bytes], None]) -> None:
        """The port is open."""

    def hear(self, data: bytes) -> None:
        """Bytes have come."""

    def end(self) -> None:
        """The port is closed."""


class SerialPort:
    """One port, by its path; ``give_up`` closes it, to be opened anew."""

    def __init__(self, path: str, baud: int, gone: Callable[[str], None]) -> None:
        """``gone`` is told why there is no port, once for each reason in a row."""
        self.path, self.baud = path, baud
        self._gone = gone
        self._told = ""
        self._line: _Line | None = None

    async def keep(self, session: Session) -> None:
        """Stay open until cancelled."""
        while True:
            try:
                transport, line = await self._open(session)
            except (OSError, termios.error, serialx.SerialException, ValueError) as error:
                self.tell(_trouble(self.path, error))
            else:
                self._line = line
                try:
                    self.tell(await line.ended or f"{self.path} was pulled out")
                finally:
                    self._line = None
                    session.end()
                    transport.abort()
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(RETRY_S):
                            await transport.wait_closed()
            await asyncio.sleep(RETRY_S)

    async def _open(self, session: Session) -> "tuple[serialx.BaseSerialTransport, _Line]":
        line = _Line(session)

        def protocol() -> asyncio.Protocol:
            return line

        loop = asyncio.get_running_loop()
        transport, _ = await serialx.create_serial_connection(loop, protocol, self.path, self.baud)
        return transport, line

    def give_up(self, reason: str) -> None:
        """Close the port, if it is open, and open it anew."""
        if self._line is not None:
            self._line.end(reason)

    def tell(self, reason: str) -> None:
        """Say why there is no port, unless that was just said."""
        if reason != self._told:
            self._told = reason
            self._gone(reason)

    def forget_told(self) -> None:
        """All is well: the next trouble is news."""
        self._told = ""


class _Line(asyncio.Protocol):
    """One life of the port; ``ended`` says why it is over, or nothing."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.ended: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)

        def send(data: bytes) -> None:
            if not self.ended.done() and not transport.is_closing():
                transport.write(data)

        self._session.begin(send)

    def data_received(self, data: bytes) -> None:
        if not self.ended.done():
            self._session.hear(data)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - a port that is gone is gone
        self.end("")

    def end(self, reason: str) -> None:
        if not self.ended.done():
            self.ended.set_result(reason)


def line_advice(path: str, baud: int, speaker: str, *, silent: bool) -> str:
    """Where to look when nothing of use comes from ``speaker`` on a port that is open."""
    if silent:
        return f"nothing at all comes from {path} at {baud} baud: nothing on the air, another port, or not {speaker}?"
    return f"what comes from {path} at {baud} baud is not from {speaker}: another rate or other firmware?"


def check_path(spec: str, path: str) -> None:
    """See that a path could be a serial port; one that does not exist yet may come.

    Raises:
        SkylessError: it never will be one.
    """
    if "://" in path:
        raise SkylessError(
            f"--radio is {spec!r}; it should name a serial port of this computer, as /dev/ttyACM0, and {path} is an "
            "address: run the program where the board is"
        )
    place = Path(path)
    try:
        kind = "a port" if not place.exists() or place.is_char_device() else "a folder" if place.is_dir() else "a file"
    except OSError:  # nobody may look there, or no file has such a name; opening it will tell
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
        return f"{path} is no serial port, or has not this baud rate"
    why = error.strerror if isinstance(error, OSError) and error.strerror else error
    return f"{path} cannot be opened ({why})"
