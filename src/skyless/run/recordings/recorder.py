"""Write recordings of a running site: the file, and which MQTT messages go into it."""

import contextlib
import os
from collections import Counter
from io import IOBase
from os import PathLike
from pathlib import Path
from typing import IO, Final, cast

from mcap.writer import CompressionType, Writer
from msgspec import Struct

from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.site import GeoreferenceSite
from skyless.core.version import installed_version
from skyless.files import Drops
from skyless.run.foxglove import SCENE_TOPIC, ellipse, foxglove_schema, location_fix, pose_in_frame, scene, schema_of
from skyless.run.mqtt.messages import FixMessage, SiteMessage, WrongMessageError
from skyless.run.recordings.recording import FLOOR_PLAN, JSON, JSON_SCHEMA, NS, PROFILE
from skyless.run.site_feed import channel_of, message_of

# An MCAP file being written, valid after every flush. Chunks are compressed (zstd); a killed program loses what came
# after the last flush. A full disk ends the recording: the file is cut back to its last complete chunk.

_CHUNK_BYTES: Final = 1 << 22
"""Chunks are closed by time; no second is expected to need more."""


class _Unwritten(IOBase):
    """A file object that collects the MCAP writer's output since the last flush."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def write(self, data: bytes, /) -> int:
        self._parts.append(bytes(data))
        self._length += len(data)
        return len(data)

    def seek(self, _offset: int, _whence: int = 0, /) -> int:
        """Return the file's length so far; the writer seeks only to learn it."""
        return self._length

    def drain(self) -> bytes:
        """Return what was written since the last call."""
        written = b"".join(self._parts)
        self._parts.clear()
        return written


class McapFile:
    """A recording on disk. After a failure every method does nothing."""

    def __init__(self, path: str | PathLike[str], limit_bytes: int | None = None) -> None:
        """Create the file. Raises SkylessError if it exists already, or cannot be created."""
        self.path = Path(path)
        self.limit_bytes = limit_bytes
        self.written_bytes = 0
        self.messages = 0
        self.lost = 0
        """Messages not written because the recording had ended."""
        self.ended: str | None = None
        """Why nothing more is written; None while all is well."""
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
        self._tail = _Unwritten()
        self._writer = Writer(cast("IO[bytes]", self._tail), _CHUNK_BYTES, CompressionType.ZSTD)
        self._writer.start(PROFILE, f"skyless {installed_version()}")
        self.flush()

    def add(self, topic: str, schema: tuple[str, bytes], payload: bytes, log_ns: int) -> None:
        """Write a JSON message with a Unix time; times never decrease in the file."""
        if self.ended is not None:
            self.lost += 1
            return
        self._newest_ns = log_ns = max(log_ns, self._newest_ns)
        channel = self._channels.get(topic) or self._new_channel(topic, schema)
        self._writer.add_message(channel, log_ns, payload, log_ns)
        self._unflushed += 1
        self.messages += 1

    def attach(self, name: str, media_type: str, data: bytes, log_ns: int) -> None:
        """Write a file, such as the floor plan's image."""
        if self.ended is None:
            self._writer.add_attachment(log_ns, log_ns, name, media_type, data)

    def flush(self) -> None:
        """Close the chunk and write it to the file."""
        if self.ended is not None:
            return
        self._writer.flush()  # type: ignore[no-untyped-call]
        if self._write(self._tail.drain()):
            self._unflushed = 0
            if self.limit_bytes is not None and self.written_bytes >= self.limit_bytes:
                self._finish()
                self.ended = f"its limit of {self.limit_bytes / 1e6:g} MB is reached"

    def sync(self) -> None:
        """Wait until flushed data are on the disk."""
        handle = self._handle
        try:
            if handle >= 0:
                os.fsync(handle)
        except OSError as error:
            if handle == self._handle:  # else it was closed in the meantime, by another thread
                self._fail(error)

    def close(self) -> None:
        """Write the remaining data and the index, and close the file."""
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
        self._write(self._tail.drain())

    def _new_channel(self, topic: str, schema: tuple[str, bytes]) -> int:
        name, data = schema
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, JSON_SCHEMA, data)
        channel = self._channels[topic] = self._writer.register_channel(topic, JSON, self._schemas[name])
        return channel

    def _write(self, data: bytes) -> bool:
        """Write all of the data. If the disk fails, undo what was written if possible, and return False."""
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


# From MQTT messages to a recording: which ones are kept, and what is added for Foxglove to show.

SHOWN_HZ: Final = 20.0
"""Largest rate of poses of a tag added for Foxglove; the fixes themselves are all kept."""

MAX_TOPICS: Final = 10_000


class McapRecorder:
    """Writes messages into a recording."""

    def __init__(self, file: McapFile) -> None:
        self.file = file
        self.drops: Drops = Counter()
        self.kinds: Counter[str] = Counter()
        """Messages kept, by kind."""
        self._last: dict[str, bytes] = {}
        self._topics: set[str] = set()
        self._shown_s: dict[str, float] = {}
        self._georeference: GeoreferenceSite | None = None

    def add(self, topic: str, payload: bytes, unix_s: float) -> Struct | None:
        """Add a message that arrived at ``unix_s`` and return it decoded.

        Returns None for an image, for a repetition, and for a message that is dropped and counted.
        """
        channel = channel_of(topic)
        if channel is None:
            self.drops["unknown-topic"] += 1
            return None
        if not payload or self._last.get(topic) == payload:
            return None
        if topic not in self._topics and len(self._topics) >= MAX_TOPICS:
            self.drops["too-many-topics"] += 1
            return None
        self._topics.add(topic)
        if channel.of.retained:
            self._last[topic] = payload
        log_ns = round(unix_s * NS)
        if channel.of.payload is None:
            media_type = "image/png" if payload.startswith(b"\x89PNG") else "image/jpeg"
            self.file.attach(
                f"{FLOOR_PLAN}/{channel.name}" if channel.name else FLOOR_PLAN, media_type, payload, log_ns
            )
            return None
        try:
            message = message_of(channel, payload)
        except WrongMessageError:
            self.drops["malformed-message"] += 1
            return None
        assert message is not None  # empty ones are left out above
        self.kinds[channel.kind] += 1
        self.file.add(topic, schema_of(channel.of.payload), payload, log_ns)
        self._add_views(message, unix_s, log_ns)
        return message

    def _add_views(self, message: Struct, unix_s: float, log_ns: int) -> None:
        if isinstance(message, FixMessage):
            try:
                self._show(message, log_ns)
            except (ValueError, ArithmeticError):  # figures that no tag publishes
                self.drops["impossible-fix"] += 1
        elif isinstance(message, SiteMessage):
            self._georeference = message.site.georeference
            site = message.site
            anchors_m = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}
            self._add(SCENE_TOPIC, "foxglove.SceneUpdate", scene(unix_s, anchors_m, site.master, site.walls), log_ns)

    def _show(self, fix: FixMessage, log_ns: int) -> None:
        """Add Foxglove's messages for a fix, at most ``SHOWN_HZ`` a second for each tag."""
        if abs(fix.unix_s - self._shown_s.get(fix.tag, -1.0)) < 1.0 / SHOWN_HZ:
            return
        self._shown_s[fix.tag] = fix.unix_s
        self._add(f"/tag/{fix.tag}/pose", "foxglove.PoseInFrame", pose_in_frame(fix, facing=True), log_ns)
        self._add(f"/tag/{fix.tag}/ellipse", "foxglove.SceneUpdate", ellipse(fix), log_ns)
        if self._georeference is not None:
            location = location_fix(fix, self._georeference)
            self._add(f"/tag/{fix.tag}/location", "foxglove.LocationFix", location, log_ns)

    def _add(self, topic: str, schema: str, payload: bytes, log_ns: int) -> None:
        self.file.add(topic, foxglove_schema(schema), payload, log_ns)
