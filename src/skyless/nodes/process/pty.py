"""A pseudo-terminal that stands in for the serial port of a board."""

import asyncio
import contextlib
import os
import termios
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Final

from skyless.errors import SkylessError

HELD_BYTES: Final = 1 << 15
"""What nobody fetches is held up to here, and then dropped, with what the system holds: a UART keeps nothing either."""


class Pty:
    """The board's end; programs open ``path``, or the symbolic link to it."""

    def __init__(self, link: Path | None = None) -> None:
        """Open a pseudo-terminal.

        Raises:
            SkylessError: there is none to be had, or something else stands where the link should be.
        """
        try:
            self._board, self._port = os.openpty()  # its own hold of the port keeps it alive while no program has it
        except OSError as error:
            raise SkylessError(f"no pseudo-terminal can be opened: {error.strerror}") from None
        tty.setraw(self._port)
        os.set_blocking(self._board, False)
        self.path = os.ttyname(self._port)
        self.link = link
        self.overruns = 0
        """How often what nobody fetched was dropped."""
        self._waiting = bytearray()
        if link is not None:
            _point(link, self.path)

    @property
    def place(self) -> str:
        """What to call it."""
        return self.path if self.link is None else str(self.link)

    def start(self, hear: Callable[[bytes], None]) -> None:
        """Give what programs write to ``hear``, from the running event loop."""
        asyncio.get_running_loop().add_reader(self._board, self._read, hear)

    def _read(self, hear: Callable[[bytes], None]) -> None:
        with contextlib.suppress(BlockingIOError):
            hear(os.read(self._board, 4096))

    def send(self, data: bytes) -> bool:
        """Write, now or soon; False if this and all that waited was dropped because nobody reads."""
        if self._waiting:
            if len(self._waiting) + len(data) > HELD_BYTES:
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
        """Pull it out."""
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._board)
        loop.remove_writer(self._board)
        if self.link is not None and self.link.is_symlink() and str(self.link.readlink()) == self.path:
            self.link.unlink()
        os.close(self._board)
        os.close(self._port)


def _point(link: Path, path: str) -> None:
    """Make the link, in the place of an older one at once."""
    if link.exists() and not link.is_symlink():
        raise SkylessError(f"--link is {str(link)!r}; it should be a name that is free, and something stands there")
    scratch = link.with_name(f".{link.name}.{os.getpid()}")
    try:
        scratch.symlink_to(path)
        scratch.replace(link)
    except OSError as error:
        raise SkylessError(f"--link is {str(link)!r}, which cannot be made: {error.strerror}") from None
