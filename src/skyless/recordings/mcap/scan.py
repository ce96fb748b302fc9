"""The chunks of an MCAP file, found by walking over its records: it need not have an index, nor an end.

Reading goes as far as whole records reach, so a file that was cut off, or is being written now, gives all its whole
chunks (https://mcap.dev/spec).
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BufferedReader
from os import PathLike
from pathlib import Path
from typing import Final

import zstandard
from msgspec import Struct

from skyless.errors import ConfigurationError
from skyless.recordings.source import Drops

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES: Final = 1 << 28
"""Decompressed; more is not believed."""

MAX_ATTACHMENT_BYTES: Final = 1 << 26

_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _ATTACHMENT = 3, 4, 5, 6, 7, 9
_DATA_END: Final = 15
_RECORD: Final = struct.Struct("<BQ")
_CHUNK_HEAD: Final = struct.Struct("<QQQI")
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
_INDEX_HEAD: Final = struct.Struct("<HI")
_INDEX_ENTRY_BYTES: Final = 16


class ChunkPlace(Struct):
    """Where a chunk lies and what its index says of it."""

    offset: int
    """Of its content in the file."""
    length: int
    start_ns: int
    end_ns: int
    counts: dict[int, int]
    """Messages of each channel, as far as its index was found."""
    indexed: bool = False
    """Whether that is all of it."""


class McapScan:
    """Walks over a file; ``walk`` goes on where it stopped, for files that grow."""

    def __init__(self, path: str | PathLike[str]) -> None:
        """Open the file.

        Raises:
            ConfigurationError: it cannot be opened, or is no MCAP.
        """
        self.path = Path(path)
        self.drops: Drops = Counter()
        self.chunks: list[ChunkPlace] = []
        self.attachments: dict[str, tuple[int, int]] = {}
        """Where each one's record lies: offset and length."""
        self.topics: dict[int, str] = {}
        """Of channels."""
        self.finished = False
        self._next = len(MAGIC)
        try:
            self._file: BufferedReader = self.path.open("rb")
        except OSError as error:
            raise ConfigurationError(path, "", None, f"a file that can be read ({error.strerror})") from error
        start = self._file.read(len(MAGIC))
        if start != MAGIC:
            self._file.close()
            raise ConfigurationError(
                path, "the beginning", start.decode("ascii", "backslashreplace"), "that of an MCAP"
            )
        self.walk()

    def walk(self) -> None:
        """Take what has been written since."""
        size = self._file.seek(0, 2)
        while not self.finished and self._next + _RECORD.size <= size:
            self._file.seek(self._next)
            kind, length = _RECORD.unpack(self._file.read(_RECORD.size))
            content = self._next + _RECORD.size
            if content + length > size:
                return
            self._enter(kind, content, length)
            self._next = content + length

    @property
    def unread_bytes(self) -> int:
        """What the file has beyond the last whole record."""
        return 0 if self.finished else self._file.seek(0, 2) - self._next

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _enter(self, kind: int, content: int, length: int) -> None:
        if kind != _MESSAGE_INDEX and self.chunks:
            self._settle(self.chunks[-1])
            self._file.seek(content)
        if kind == _CHUNK and length >= _CHUNK_HEAD.size:
            start_ns, end_ns, _, _ = _CHUNK_HEAD.unpack(self._file.read(_CHUNK_HEAD.size))
            self.chunks.append(ChunkPlace(content, length, start_ns, end_ns, {}))
        elif kind == _MESSAGE_INDEX and length >= _INDEX_HEAD.size and self.chunks:
            channel, entries = _INDEX_HEAD.unpack(self._file.read(_INDEX_HEAD.size))
            self.chunks[-1].counts[channel] = entries // _INDEX_ENTRY_BYTES
        elif kind == _ATTACHMENT:
            self._enter_attachment(content, length)
        elif kind == _MESSAGE:
            self.drops["message-outside-chunks"] += 1
        elif kind == _DATA_END:
            self.finished = True

    def _settle(self, chunk: ChunkPlace) -> None:
        """Its index is complete; look into it if that names a channel that is not known yet."""
        if not chunk.indexed and chunk.counts:
            chunk.indexed = True
            if not chunk.counts.keys() <= self.topics.keys():
                for _ in self.messages(chunk):
                    pass

    def _enter_attachment(self, content: int, length: int) -> None:
        head = self._file.read(min(length, 1 << 12))
        (name_bytes,) = struct.unpack_from("<I", head.ljust(20, b"\0"), 16)
        self.attachments[head[20 : 20 + name_bytes].decode("utf-8", "replace")] = (content, length)

    def attachment(self, name: str) -> bytes | None:
        """Content of the last attachment of that name."""
        offset, length = self.attachments.get(name, (0, 0))
        if not 0 < length <= MAX_ATTACHMENT_BYTES:
            return None
        self._file.seek(offset)
        record = self._file.read(length)
        try:
            at = 16
            for _ in range(2):  # name and media type
                at += 4 + int.from_bytes(record[at : at + 4], "little")
            size = int.from_bytes(record[at : at + 8], "little")
        except IndexError:
            size, at = -1, 0
        data = record[at + 8 : at + 8 + size]
        if size < 0 or len(data) != size:
            self.drops["damaged-attachment"] += 1
            return None
        return data

    def messages(self, chunk: ChunkPlace) -> Iterator[tuple[int, int, bytes]]:
        """Channel, log time and payload of each message of a chunk, as written; none of a damaged chunk."""
        data = self._content(chunk)
        if data is None:
            self.drops["damaged-chunk"] += 1
            return
        at, end = 0, len(data)
        while at + _RECORD.size <= end:
            kind, length = _RECORD.unpack_from(data, at)
            at += _RECORD.size
            if at + length > end:
                self.drops["damaged-chunk"] += 1
                return
            if kind == _MESSAGE and length >= _MESSAGE_HEAD.size:
                channel, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(data, at)
                yield channel, log_ns, data[at + _MESSAGE_HEAD.size : at + length]
            elif kind == _CHANNEL:
                self._enter_channel(data[at : at + length])
            at += length

    def _enter_channel(self, record: bytes) -> None:
        if len(record) >= 8:
            channel, _, size = struct.unpack_from("<HHI", record)
            self.topics[channel] = record[8 : 8 + size].decode("utf-8", "replace")

    def _content(self, chunk: ChunkPlace) -> bytes | None:
        self._file.seek(chunk.offset)
        record = self._file.read(chunk.length)
        _, _, size, crc = _CHUNK_HEAD.unpack_from(record)
        at = _CHUNK_HEAD.size + 4
        name_bytes = int.from_bytes(record[at - 4 : at], "little")
        name, data = record[at : at + name_bytes], record[at + name_bytes + 8 :]
        if size > MAX_CHUNK_BYTES:
            return None
        content = _decompressed(name, data, size)
        if content is None or len(content) != size or (crc and zlib.crc32(content) != crc):
            return None
        return content


def _decompressed(name: bytes, data: bytes, size: int) -> bytes | None:
    """The content, of which no more is made than it should have; None if it is damaged or of another compression."""
    if name != b"zstd":
        return data if not name else None
    try:
        return zstandard.ZstdDecompressor().stream_reader(data).read(size + 1)
    except zstandard.ZstdError:
        return None
