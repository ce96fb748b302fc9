"""An MCAP file that is being written: whole after every flush, whatever happens then.

Chunks are compressed (zstd) and handed to the system at once; a program that is killed loses what came after the last
flush. A full disk ends the recording and is told once; the file is cut back to its last whole chunk.
"""

import contextlib
import os
from os import PathLike
from pathlib import Path
from typing import IO, Final, cast

from mcap.writer import CompressionType, Writer

import skyless
from skyless.errors import ConfigurationError, SkylessError
from skyless.recordings.mcap.channels import JSON, JSON_SCHEMA, PROFILE

CHUNK_BYTES: Final = 1 << 22
"""Chunks are closed by time; no second is expected to be longer."""


class _Tail:
    """Gathers what the MCAP writer writes since the last flush; as much of a file as that writer uses."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def write(self, data: bytes) -> int:
        """Keep a piece."""
        self._parts.append(bytes(data))
        self._length += len(data)
        return len(data)

    def tell(self) -> int:
        """Length of the file so far."""
        return self._length

    def flush(self) -> None:
        """Nothing to do: what was written waits to be taken."""

    def take(self) -> bytes:
        """What was written since the last call."""
        taken = b"".join(self._parts)
        self._parts.clear()
        return taken


class McapFile:
    """One recording on disk. Every method may be called after a failure, and then does nothing."""

    def __init__(self, path: str | PathLike[str], limit_bytes: int | None = None) -> None:
        """Make the file.

        Raises:
            SkylessError: it exists already, or cannot be made.
        """
        self.path = Path(path)
        self.limit_bytes = limit_bytes
        self.written_bytes = 0
        self.messages = 0
        self.lost = 0
        """Messages that came after the recording had to end, or were not written any more."""
        self.ended: str | None = None
        """Why nothing is written any more; None while all is well."""
        self.failed = False
        """Whether it ended because the disk is full or gone."""
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._newest_ns = 0
        self._unflushed = 0
        try:
            self._handle = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            raise ConfigurationError(path, "", None, "a new file; this one exists and is not overwritten") from None
        except OSError as error:
            raise SkylessError(f"{path} cannot be written: {error.strerror}") from None
        self._tail = _Tail()
        self._writer = Writer(cast("IO[bytes]", self._tail), CHUNK_BYTES, CompressionType.ZSTD)
        self._writer.start(PROFILE, f"skyless {skyless.__version__}")
        self.flush()

    def add(
        self, topic: str, schema: tuple[str, bytes], payload: bytes, log_ns: int, publish_ns: int | None = None
    ) -> None:
        """Write a JSON message at a Unix time; times never go back in the file."""
        if self.ended is not None:
            self.lost += 1
            return
        self._newest_ns = log_ns = max(log_ns, self._newest_ns)
        channel = self._channels.get(topic) or self._new_channel(topic, schema)
        self._writer.add_message(channel, log_ns, payload, log_ns if publish_ns is None else publish_ns)
        self._unflushed += 1
        self.messages += 1

    def attach(self, name: str, media_type: str, data: bytes, log_ns: int) -> None:
        """Write a file, such as the floor plan's image."""
        if self.ended is None:
            self._writer.add_attachment(log_ns, log_ns, name, media_type, data)

    def flush(self) -> None:
        """Close the chunk and hand it to the system."""
        if self.ended is not None:
            return
        self._writer.flush()  # type: ignore[no-untyped-call]
        if self._write(self._tail.take()):
            self._unflushed = 0
            if self.limit_bytes is not None and self.written_bytes >= self.limit_bytes:
                self._finish()
                self.ended = f"its limit of {self.limit_bytes / 1e6:g} MB is reached"

    def sync(self) -> None:
        """See that what was flushed stands on the disk; takes as long as the disk does."""
        handle = self._handle
        try:
            if handle >= 0:
                os.fsync(handle)
        except OSError as error:
            if handle == self._handle:  # else it was closed in the meantime, by another thread
                self._fail(error)

    def close(self) -> None:
        """Write what is left and the index, and close the file."""
        self.flush()
        if self.ended is None:
            self._finish()
            self.sync()
            self.ended = self.ended or "closed"
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def _finish(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._write(self._tail.take())

    def _new_channel(self, topic: str, schema: tuple[str, bytes]) -> int:
        name, data = schema
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, JSON_SCHEMA, data)
        channel = self._channels[topic] = self._writer.register_channel(topic, JSON, self._schemas[name])
        return channel

    def _write(self, data: bytes) -> bool:
        """Write all of it or, as far as the disk allows, nothing."""
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self._handle, view) :]
        except OSError as error:
            self._fail(error)
            return False
        self.written_bytes += len(data)
        return True

    def _fail(self, error: OSError) -> None:
        self.failed = True
        self.ended = f"{self.path} cannot be written any more: {error.strerror}"
        self.lost += self._unflushed
        self.messages -= self._unflushed
        with contextlib.suppress(OSError):
            os.ftruncate(self._handle, self.written_bytes)
