"""Numbered rows on their way into Parquet, safe from the moment at which they are in a file.

A journal is files ``<kind>-<first>.journal``, named after the number of their first row. Each is a run of frames:
CRC-32 of all that follows, length of the payload, number of its first row, payload. Whatever a program that was killed
left unfinished at the end of a file is recognised by length and CRC, and is not read.
"""

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from skyless.run.history.layout import NUMBER_DIGITS

_HEAD: Final = struct.Struct("<IIQ")
_CRC_BYTES: Final = 4


class Journal:
    """The rows of one kind. Every method raises OSError where the disk does not take or give something."""

    def __init__(self, folder: Path, kind: str) -> None:
        self._folder, self._kind = folder, kind
        self._handle: int | None = None
        self._length = 0
        self._is_torn = False

    def read(self) -> Iterator[tuple[int, bytes]]:
        """The whole frames of all files in order: number of the first row, and payload."""
        for file in self._files().values():
            yield from frames_of(file.read_bytes())

    def begin(self, first: int) -> None:
        """Write rows from this number on into a file of their own."""
        handle = os.open(self._file(first), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        self.close()
        self._handle, self._length, self._is_torn = handle, 0, False

    def append(self, first: int, payload: bytes) -> None:
        """Add a frame. One that the disk does not take as a whole leaves nothing behind."""
        assert self._handle is not None, "begin comes first"
        if self._is_torn:
            os.ftruncate(self._handle, self._length)
            self._is_torn = False
        rest = _HEAD.pack(0, len(payload), first)[_CRC_BYTES:] + payload
        view = memoryview(zlib.crc32(rest).to_bytes(_CRC_BYTES, "little") + rest)
        frame_bytes, self._is_torn = len(view), True
        try:
            while view:
                view = view[os.pwrite(self._handle, view, self._length + frame_bytes - len(view)) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._handle, self._length)
            raise
        self._length, self._is_torn = self._length + frame_bytes, False

    def free_bytes(self) -> int:
        """How much the disk has left."""
        found = os.statvfs(self._folder)
        return found.f_bavail * found.f_frsize

    def sync(self) -> None:
        """Wait until all frames are on the disk: they then survive a power cut, too."""
        if self._handle is not None:
            os.fsync(self._handle)

    def drop_through(self, last: int) -> None:
        """Remove the files that have no row beyond this number; the one that is written stays."""
        files = self._files()
        for first, following in zip(files, list(files)[1:], strict=False):
            if following <= last + 1:
                files[first].unlink()

    def close(self) -> None:
        """Close the file that is written."""
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None

    def end(self) -> int:
        """Number of the row that the name of the last file promises, 1 without any."""
        return max(self._files(), default=1)

    def _file(self, first: int) -> Path:
        return self._folder / f"{self._kind}-{first:0{NUMBER_DIGITS}}.journal"

    def _files(self) -> dict[int, Path]:
        """The files by their first row, in order."""
        found = {
            file.stem.removeprefix(f"{self._kind}-"): file for file in self._folder.glob(f"{self._kind}-*.journal")
        }
        return dict(sorted((int(number), file) for number, file in found.items() if number.isdecimal()))


def frames_of(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The whole frames at the beginning of a file's bytes."""
    at = 0
    while at + _HEAD.size <= len(data):
        crc, length, first = _HEAD.unpack_from(data, at)
        end = at + _HEAD.size + length
        if end > len(data) or zlib.crc32(memoryview(data)[at + _CRC_BYTES : end]) != crc:
            return
        yield first, data[at + _HEAD.size : end]
        at = end
