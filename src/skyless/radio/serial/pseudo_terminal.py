"""A pseudo-terminal in place of a device on a serial port."""

import asyncio
import contextlib
import os
import termios
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Final

from skyless.core.errors import SkylessError

HELD_BYTES: Final = 1 << 15
"""Bytes that nobody reads are held up to here, then dropped with those in the system: a UART keeps nothing either."""


class Pty:
    """A pseudo-terminal in place of a board's serial port; programs open ``path``, or the symbolic link to it."""

    def __init__(self, link: Path | None = None, held_bytes: int = HELD_BYTES, asked: str = "--link is") -> None:
        """Open a pseudo-terminal. ``asked`` begins the message about a link that cannot be made.

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
        """How often bytes that nobody read were dropped."""
        self._waiting = bytearray()
        if link is not None:
            _make_link(link, self.path, asked)

    @property
    def name(self) -> str:
        """The path that programs open: the link's, where there is one."""
        return self.path if self.link is None else str(self.link)

    def start(self, on_data: Callable[[bytes], None]) -> None:
        """Call ``on_data`` with what programs write, from the running event loop."""
        asyncio.get_running_loop().add_reader(self._board, self._read, on_data)

    def _read(self, on_data: Callable[[bytes], None]) -> None:
        with contextlib.suppress(BlockingIOError):
            on_data(os.read(self._board, 4096))

    def send(self, data: bytes) -> bool:
        """Write, at once or soon; False if this and all that waited was dropped because nobody reads."""
        if self._waiting:
            if len(self._waiting) + len(data) > self._held_bytes:
                self._drop()
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

    def _drop(self) -> None:
        self.overruns += 1
        self._waiting.clear()
        termios.tcflush(self._port, termios.TCIFLUSH)
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
    """Make the link, replacing an older one in one step."""
    if link.exists() and not link.is_symlink():
        raise SkylessError(f"{asked} {str(link)!r}; it should be a free name, and this path exists")
    scratch = link.with_name(f".{link.name}.{os.getpid()}")
    try:
        scratch.symlink_to(path)
        scratch.replace(link)
    except OSError as error:
        raise SkylessError(f"{asked} {str(link)!r}, which cannot be made: {error.strerror}") from None
