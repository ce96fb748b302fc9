"""Read recordings of a running site, including unfinished and truncated ones.

A recording holds MQTT topics and payloads, with their schemas.
"""

import math
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from io import BufferedReader
from os import PathLike
from pathlib import Path
from typing import Final, Generic, TypeVar, cast

import lz4.frame
import zstandard
from msgspec import Struct

from skyless.core.air.frame import Reception
from skyless.core.errors import ConfigurationError
from skyless.core.ticks import TICK_S, Unwrapper
from skyless.files import Drops
from skyless.run.mqtt.messages import (
    FixMessage,
    ReceptionsMessage,
    SiteMessage,
    TruthMessage,
    WrongMessageError,
    ZonesMessage,
)
from skyless.run.site_feed import Recorded as Recorded  # noqa: PLC0414 - what recordings give
from skyless.run.site_feed import channel_of, message_of

PROFILE: Final = "skyless"
JSON: Final = "json"
JSON_SCHEMA: Final = "jsonschema"

FLOOR_PLAN: Final = "floor_plan"
"""An image, which has no schema and is kept as an attachment."""

# Chunks of an MCAP file (https://mcap.dev/spec), found by walking over its records; neither index nor end is needed.
# A file that was cut off, or is being written, yields all its complete chunks.

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES: Final = 1 << 28
"""Decompressed size limit; larger chunks count as damaged."""

MAX_ATTACHMENT_BYTES: Final = 1 << 26

_CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _ATTACHMENT = 4, 5, 6, 7, 9
_DATA_END: Final = 15
_RECORD: Final = struct.Struct("<BQ")
_CHUNK_HEAD: Final = struct.Struct("<QQQI")
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
_INDEX_HEAD: Final = struct.Struct("<HI")
_INDEX_ENTRY_BYTES: Final = 16


def is_mcap(path: str | PathLike[str]) -> bool:
    """Whether a file is MCAP by its content; False if it cannot be opened, or if reading would consume it."""
    try:
        file = Path(path)
        if file.is_fifo():
            return False
        with file.open("rb") as stream:
            return stream.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


class ChunkIndex(Struct):
    """Position of a chunk in the file, and its index."""

    offset: int
    """Offset of the chunk's content in the file."""
    length: int
    start_ns: int
    end_ns: int
    counts: dict[int, int]
    """Messages per channel, as far as index records were found."""
    indexed: bool = False
    """Whether the counts are complete."""


class McapScan:
    """Index of a file's chunks, attachments and topics. ``walk`` continues where it stopped, for files that grow."""

    def __init__(self, path: str | PathLike[str]) -> None:
        """Open the file. Raises ConfigurationError if it cannot be opened, or is not MCAP."""
        self.path = Path(path)
        self.drops: Drops = Counter()
        self.chunks: list[ChunkIndex] = []
        self.attachments: dict[str, tuple[int, int]] = {}
        """Offset and length of each attachment's record."""
        self.topics: dict[int, str] = {}
        """Topics by channel number."""
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
        """Index what has been written since the last call."""
        size = self._file.seek(0, 2)
        while not self.finished and self._next + _RECORD.size <= size:
            self._file.seek(self._next)
            kind, length = _RECORD.unpack(self._file.read(_RECORD.size))
            content = self._next + _RECORD.size
            if content + length > size:
                return
            self._index_record(kind, content, length)
            self._next = content + length

    @property
    def unread_bytes(self) -> int:
        """Bytes beyond the last complete record."""
        return 0 if self.finished else self._file.seek(0, 2) - self._next

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _index_record(self, kind: int, content: int, length: int) -> None:
        if kind != _MESSAGE_INDEX and self.chunks:
            self._complete_index(self.chunks[-1])
            self._file.seek(content)
        if kind == _CHUNK and length >= _CHUNK_HEAD.size:
            start_ns, end_ns, _, _ = _CHUNK_HEAD.unpack(self._file.read(_CHUNK_HEAD.size))
            self.chunks.append(ChunkIndex(content, length, start_ns, end_ns, {}))
        elif kind == _MESSAGE_INDEX and length >= _INDEX_HEAD.size and self.chunks:
            channel, entries = _INDEX_HEAD.unpack(self._file.read(_INDEX_HEAD.size))
            self.chunks[-1].counts[channel] = entries // _INDEX_ENTRY_BYTES
        elif kind == _ATTACHMENT:
            head = self._file.read(min(length, 1 << 12))
            (name_bytes,) = struct.unpack_from("<I", head.ljust(20, b"\0"), 16)
            self.attachments[head[20 : 20 + name_bytes].decode("utf-8", "replace")] = (content, length)
        elif kind == _MESSAGE:
            self.drops["message-outside-chunks"] += 1
        elif kind == _DATA_END:
            self.finished = True

    def _complete_index(self, chunk: ChunkIndex) -> None:
        """Complete a chunk's index; read the chunk if the index names an unknown channel."""
        if not chunk.indexed and chunk.counts:
            chunk.indexed = True
            if not chunk.counts.keys() <= self.topics.keys():
                for _ in self.messages(chunk):
                    pass

    def attachment(self, name: str) -> bytes | None:
        """Content of the last attachment of that name; None if it is missing or damaged."""
        offset, length = self.attachments.get(name, (0, 0))
        if not 0 < length <= MAX_ATTACHMENT_BYTES:
            return None
        self._file.seek(offset)
        record = self._file.read(length)
        at = 16
        for _ in range(2):  # name and media type
            at += 4 + int.from_bytes(record[at : at + 4], "little")
        size = int.from_bytes(record[at : at + 8], "little")
        data = record[at + 8 : at + 8 + size]
        if len(data) != size:
            self.drops["damaged-attachment"] += 1
            return None
        return data

    def messages(self, chunk: ChunkIndex) -> Iterator[tuple[int, int, bytes]]:
        """Yield channel, log time and payload of each message of a chunk, as written; none of a damaged chunk."""
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
            elif kind == _CHANNEL and length >= 8:
                channel, _, size = struct.unpack_from("<HHI", data, at)
                self.topics[channel] = data[at + 8 : at + min(8 + size, length)].decode("utf-8", "replace")
            at += length

    def _content(self, chunk: ChunkIndex) -> bytes | None:
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
    """Decompress up to the expected size; None if the data are damaged or use another compression."""
    try:
        if name == b"zstd":
            return zstandard.ZstdDecompressor().stream_reader(data).read(size + 1)
        if name == b"lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    except (zstandard.ZstdError, RuntimeError):
        return None
    return None if name else data


# ``McapRecording``: access by kind and time, also while the file is being written.

NS: Final = 1_000_000_000


class RecordingSummary(Struct, frozen=True):
    """Contents of a recording. Times are Unix seconds by the recorder's clock; None while it is empty."""

    path: str
    site: int | None
    name: str | None
    simulated: bool | None
    start_s: float | None
    end_s: float | None
    finished: bool
    """False if it is being written, or was never closed."""
    unread_bytes: int
    """Bytes of an incomplete record at the end."""
    tags: tuple[str, ...]
    """Tags with fixes or receptions."""
    raw_tags: tuple[str, ...]
    """Tags with raw receptions, which can be replayed."""
    messages: dict[str, int]
    """Number of messages by kind."""
    drops: dict[str, int]


def tags_to_replay(summary: RecordingSummary) -> tuple[str, ...]:
    """Tags whose receptions a recording holds. Raises ConfigurationError if there are none."""
    if summary.start_s is None:
        beyond = f", and {summary.unread_bytes} bytes that are not whole" if summary.unread_bytes else ""
        held = f"empty: no message in it{beyond}"
        raise ConfigurationError(summary.path, "the recording", held, "one whose recorder ran for a second or more")
    if not summary.raw_tags:
        raise ConfigurationError(summary.path, "raw receptions", None, "a recording that skyless record made")
    return summary.raw_tags


class McapRecording:
    """A recording; ``refresh`` reads what has been written since it was opened."""

    def __init__(self, path: str | PathLike[str]) -> None:
        """Open a recording and index its chunks. Raises ConfigurationError if it cannot be opened, or is not MCAP."""
        self._scan = McapScan(path)
        self._lasting: dict[str, Struct] = {}
        self._lasting_chunks = 0
        self.drops: Drops = Counter()

    def __enter__(self) -> "McapRecording":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._scan.close()

    def refresh(self) -> None:
        """Read what has been written since the last call."""
        self._scan.walk()

    @property
    def site(self) -> SiteMessage | None:
        """The site as last recorded."""
        return cast("SiteMessage | None", self._last("site"))

    @property
    def zones(self) -> ZonesMessage | None:
        """The site's zones as last recorded."""
        return cast("ZonesMessage | None", self._last("zones"))

    @property
    def floor_plan(self) -> bytes | None:
        """The image of the floor."""
        return self._scan.attachment(FLOOR_PLAN)

    def summary(self) -> RecordingSummary:
        """Summarise the contents; quick, as only indexes are read."""
        counts: Counter[str] = Counter()
        tags: set[str] = set()
        raw_tags: set[str] = set()
        site = self.site
        for topic, count in self._counts().items():
            channel = channel_of(topic)
            if channel is None:
                continue
            counts[channel.kind] += count
            if channel.kind in ("fix", "receptions"):
                tags.add(channel.name)
            if channel.kind == "receptions":
                raw_tags.add(channel.name)
        chunks = self._scan.chunks
        return RecordingSummary(
            path=str(self._scan.path),
            site=None if site is None else site.site.id,
            name=None if site is None else site.site.name,
            simulated=None if site is None else site.simulated,
            start_s=min(chunk.start_ns for chunk in chunks) / NS if chunks else None,
            end_s=max(chunk.end_ns for chunk in chunks) / NS if chunks else None,
            finished=self._scan.finished,
            unread_bytes=self._scan.unread_bytes,
            tags=tuple(sorted(tags)),
            raw_tags=tuple(sorted(raw_tags)),
            messages=dict(sorted(counts.items())),
            drops=dict(self._scan.drops + self.drops),
        )

    def fixes(
        self, from_s: float = -math.inf, to_s: float = math.inf, tags: Iterable[str] | None = None
    ) -> Iterator[FixMessage]:
        """Yield fixes recorded from ``from_s`` to before ``to_s`` (Unix time), in the order of recording."""
        wanted = None if tags is None else frozenset(tags)
        for found in self.messages({"fix"}, from_s, to_s):
            if wanted is None or found.channel.name in wanted:
                yield cast("FixMessage", found.message)

    def truth(self, from_s: float = -math.inf, to_s: float = math.inf) -> Iterator[TruthMessage]:
        """Yield the true positions of the tags."""
        return (cast("TruthMessage", found.message) for found in self.messages({"truth"}, from_s, to_s))

    def receptions(self, tag: str | None = None) -> Iterator[ReceptionsMessage]:
        """Yield the raw receptions of one tag, or of all."""
        for found in self.messages({"receptions"}):
            if tag is None or found.channel.name == tag:
                yield cast("ReceptionsMessage", found.message)

    def messages(self, kinds: set[str], from_s: float = -math.inf, to_s: float = math.inf) -> Iterator[Recorded]:
        """Yield messages of these kinds by time of recording; chunks without any are not read."""
        for chunk in list(self._scan.chunks):
            if chunk.end_ns / NS >= from_s and chunk.start_ns / NS < to_s and self._may_hold(chunk, kinds):
                yield from self._of(chunk, kinds, from_s, to_s)

    def spans(self, kinds: set[str], gap_s: float) -> list[tuple[float, float]]:
        """Return the periods with messages of these kinds: sorted pairs of begin and end in Unix time.

        Gaps of up to ``gap_s`` are bridged. Only indexes are read, so a period may be a chunk too long at each end.
        """
        found: list[tuple[float, float]] = []
        for chunk in self._scan.chunks:
            if self._holds(chunk, kinds):
                begin_s, end_s = chunk.start_ns / NS, chunk.end_ns / NS
                if found and begin_s - found[-1][1] <= gap_s:
                    found[-1] = (found[-1][0], max(end_s, found[-1][1]))
                else:
                    found.append((begin_s, end_s))
        return found

    def _holds(self, chunk: ChunkIndex, kinds: set[str]) -> bool:
        """Whether a chunk holds messages of these kinds; one without a complete index is read."""
        if chunk.indexed:
            return self._may_hold(chunk, kinds)
        return any(True for _ in self._of(chunk, kinds, -math.inf, math.inf))

    def _of(self, chunk: ChunkIndex, kinds: set[str], from_s: float, to_s: float) -> Iterator[Recorded]:
        for channel_id, log_ns, payload in self._scan.messages(chunk):
            topic = self._scan.topics.get(channel_id, "")
            channel = channel_of(topic)
            time_s = log_ns / NS
            if (
                channel is None
                or channel.of.payload is None
                or channel.kind not in kinds
                or not from_s <= time_s < to_s
            ):
                continue
            try:
                message = message_of(channel, payload)
            except WrongMessageError:
                self.drops["malformed-message"] += 1
                continue
            if message is not None:
                yield Recorded(time_s, channel, topic, message)

    def _may_hold(self, chunk: ChunkIndex, kinds: set[str]) -> bool:
        """Whether a chunk may hold messages of these kinds: its index does not rule them out."""
        if not chunk.indexed:
            return True
        channels = (channel_of(self._scan.topics.get(number, "")) for number in chunk.counts)
        return any(channel is not None and channel.kind in kinds for channel in channels)

    def _last(self, kind: str) -> Struct | None:
        """Newest message of kind ``site`` or ``zones``; reads the chunks added since the last call."""
        chunks = self._scan.chunks
        kinds = {"site", "zones"}
        for chunk in chunks[self._lasting_chunks :]:
            if self._may_hold(chunk, kinds):
                for found in self._of(chunk, kinds, -math.inf, math.inf):
                    self._lasting[found.channel.kind] = found.message
        self._lasting_chunks = len(chunks)
        return self._lasting.get(kind)

    def _counts(self) -> Counter[str]:
        """Messages by topic; a chunk without a complete index is read."""
        counts: Counter[str] = Counter()
        for chunk in self._scan.chunks:
            found = chunk.counts if chunk.indexed else Counter(channel for channel, _, _ in self._scan.messages(chunk))
            counts.update({self._scan.topics.get(channel, ""): count for channel, count in found.items()})
        return counts


# Unix times of receptions: the tag's counter, tied to its host's clock by the least delayed receptions, as hosts see
# frames with varying delays. The clocks jump against each other when the emulated air stalls, a clock is set or a radio
# restarts. Receptions that are suddenly late are held back for a second, until it is clear whether the host was merely
# busy.

_HOST_DRIFT: Final = 1e-4
"""Largest relative rate difference between a host's clock and a tag's."""

_SUDDEN_S: Final = 0.1
"""Receptions that are later than this are held back until it is clear why."""

_STEADY_S: Final = 1.0
"""If a host is late continuously for this long, its clock was changed or the tag's counter stood still."""

_MAX_HELD: Final = 10_000
"""Limit against forged recordings, which could hold back any number."""

_T = TypeVar("_T")


class HostClock(Generic[_T]):
    """Computes the Unix times of one tag's receptions; each carries an object of the caller."""

    def __init__(self) -> None:
        self._ticks = Unwrapper()
        self._less_counter_s = math.inf
        """Unix time minus counter, by the least delayed reception."""
        self._last_s = 0.0
        self._held: list[tuple[_T, float, float, float]] = []
        """Carried object, counter, host time minus counter, and host time."""

    def add(self, reception: Reception, unix_less_host_s: float, carried: _T) -> list[tuple[_T, float]]:
        """Add a reception. Returns the objects of receptions whose Unix time is now known, in order, with that time."""
        counter_s = self._ticks.unwrap(reception.rx_ticks, reception.host_s) * TICK_S
        least_s = self._less_counter_s + _HOST_DRIFT * max(counter_s - self._last_s, 0.0)
        self._last_s = counter_s
        if reception.host_s is None:
            return [*self.rest(), (carried, counter_s + (0.0 if math.isinf(least_s) else least_s))]
        unix_s = reception.host_s + unix_less_host_s
        self._less_counter_s = least_s
        self._held.append((carried, counter_s, unix_s - counter_s, unix_s))
        if unix_s - counter_s <= least_s + _SUDDEN_S:
            self._less_counter_s = min(least_s, unix_s - counter_s)
        elif unix_s - self._held[0][3] >= _STEADY_S or len(self._held) > _MAX_HELD:
            self._tie_again()
        else:
            return []
        return self._released()

    def rest(self) -> list[tuple[_T, float]]:
        """Return the objects of receptions still held back, with their times; call this at the end."""
        if len(self._held) > 1:
            (_, first_s, _, begun_s), (_, last_s, _, ended_s) = self._held[0], self._held[-1]
            if ended_s - begun_s >= 0.5 * (last_s - first_s):  # not a backlog, which would be processed at once
                self._tie_again()
        return self._released()

    def _tie_again(self) -> None:
        self._less_counter_s = min(less_counter_s for _, _, less_counter_s, _ in self._held)

    def _released(self) -> list[tuple[_T, float]]:
        released = [(carried, counter_s + self._less_counter_s) for carried, counter_s, _, _ in self._held]
        self._held.clear()
        return released
