"""Recordings for the page: the list of a folder, and the states that a live page would have got."""

import logging
import math
import os
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import BinaryIO, Final

from msgspec import Struct
from starlette.exceptions import HTTPException

from skyless.core.errors import SkylessError
from skyless.page.events import Event, EventLog
from skyless.page.state import SiteState
from skyless.run.mqtt.messages import (
    AnchorHealth,
    EtherHealth,
    FixMessage,
    SiteMessage,
    StatusMessage,
    TagHealth,
    TruthMessage,
    WatchMessage,
    Zone,
)
from skyless.run.recordings.recording import McapRecording, Recorded
from skyless.run.site_feed import Channel, SiteFeed
from skyless.run.site_table import Health, SiteTable
from skyless.run.zones import zones_of

_SUFFIX: Final = ".mcap"
_MAX_OPEN: Final = 8
_GAP_S: Final = 2.5  # shorter gaps without fixes are not shown, as the recorder closes a chunk once a second

MAX_RECORDED_EVENTS: Final = 2000
_TICK_S: Final = 0.5
_LEAD_S: Final = 12.0  # how much earlier than its first state a recording is read
_PIECE_BYTES: Final = 1 << 18
_Version = tuple[int, int, int]  # a file's inode, size and time of change

_log = logging.getLogger("skyless.page")


class ListedRecording(Struct, frozen=True):
    """A recording in the list."""

    name: str
    bytes: int
    start_unix_s: float | None
    duration_s: float
    complete: bool
    """False while the recording is being written, or if it was cut off."""
    site: str | None
    tags: int
    fixes: int


class PlaybackSummary(Struct, frozen=True):
    """Information that a page needs before it plays a recording."""

    name: str
    site: SiteMessage | None
    start_unix_s: float
    end_unix_s: float
    tags: tuple[str, ...]
    zones: tuple[Zone, ...]
    fix_spans_unix_s: tuple[tuple[float, float], ...]
    """Periods with fixes, from the first one on, to about a second. Empty without any."""


class RecordedEvents(Struct, frozen=True):
    """The events of a recording, the oldest first."""

    events: tuple[Event, ...]
    complete: bool
    """False if there are more than ``MAX_RECORDED_EVENTS``."""


class RecordingFile(Struct, frozen=True):
    """An open recording, to be read up to its current size, as it may be growing."""

    name: str
    size_bytes: int
    file: BinaryIO

    def pieces(self) -> Iterator[bytes]:
        """The content, piece by piece. The file is closed at the end."""
        with self.file:
            left = self.size_bytes
            while left > 0 and (piece := self.file.read(min(left, _PIECE_BYTES))):
                left -= len(piece)
                yield piece


class Playback:
    """The recordings of one folder. Its methods read files, and may be called by threads."""

    def __init__(self, folder: Path | None) -> None:
        """``folder``: None if there are no recordings."""
        self._folder = folder
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._open: OrderedDict[tuple[str, int], McapRecording] = OrderedDict()
        self._listed: dict[str, tuple[_Version, ListedRecording]] = {}

    def stop(self) -> None:
        """End running reads soon. Their results are incomplete."""
        self._stopped.set()

    def recordings(self) -> list[ListedRecording]:
        """List all readable recordings, newest first."""
        if self._folder is None:
            return []
        with self._lock:
            known, self._listed = self._listed, {}
            for file in self._folder.glob(f"*{_SUFFIX}"):
                if self._stopped.is_set():
                    break
                try:
                    self._list(file, known)
                except (HTTPException, OSError) as error:
                    _log.debug("%s is not listed: %s", file, error)
            found = [listed for _, listed in self._listed.values()]
        return sorted(found, key=lambda listed: listed.start_unix_s or 0.0, reverse=True)

    def summary(self, name: str) -> PlaybackSummary:
        """Site, times, tags and zones of a recording. Raises HTTPException."""
        with self._lock:
            recording = self._recording(name)
            found = recording.summary()
            if found.start_s is None or found.end_s is None:
                raise HTTPException(404, f"{name!r} holds no messages yet")
            zones = _zones(recording)
            spans = _fix_spans(recording)
            return PlaybackSummary(name, recording.site, found.start_s, found.end_s, found.tags, zones, spans)

    def events(self, name: str) -> RecordedEvents:
        """Events of a recording, read as a whole without blocking other reads. Raises HTTPException."""
        path = self._path(name)
        try:
            return _events(path, _version(path), self._stopped)
        except (SkylessError, OSError) as error:
            raise HTTPException(404, f"{name!r} cannot be read: {error}") from None

    def open_file(self, name: str) -> RecordingFile:
        """Open a recording for download. Raises HTTPException."""
        try:
            file = self._path(name).open("rb")
        except OSError as error:
            raise HTTPException(404, f"{name!r} cannot be read: {error.strerror}") from None
        return RecordingFile(name, os.fstat(file.fileno()).st_size, file)

    def path_and_start(self, name: str) -> tuple[str, float]:
        """Path of a recording, and Unix time of its first message. Raises HTTPException."""
        return str(self._path(name)), self.summary(name).start_unix_s

    def floor_plan(self, name: str) -> bytes | None:
        """The floor plan's image. Raises HTTPException."""
        with self._lock:
            return self._recording(name).floor_plan

    def states(self, name: str, begin_s: float, end_s: float, rate_hz: float) -> list[bytes]:
        """The ``state`` messages from ``begin_s`` until before ``end_s``, in seconds since the recording's start.

        Raises HTTPException.
        """
        start_s = self.summary(name).start_unix_s
        with self._lock:
            return _states(self._recording(name), start_s + begin_s, start_s + end_s, 1.0 / rate_hz, self._stopped)

    def _list(self, file: Path, known: dict[str, tuple[_Version, ListedRecording]]) -> None:
        """Add a file to the list, reading it only if it has changed since the last list."""
        version = _version(file)
        old = known.get(file.name)
        if old is None or old[0] != version:
            found = self._recording(file.name).summary()
            duration_s = 0.0 if found.start_s is None or found.end_s is None else found.end_s - found.start_s
            tags, fixes = len(found.tags), found.messages.get("fix", 0)
            listed = (file.name, version[1], found.start_s, duration_s, found.finished, found.name, tags, fixes)
            old = version, ListedRecording(*listed)
        self._listed[file.name] = old

    def _recording(self, name: str) -> McapRecording:
        """Open or refresh a recording. Raises HTTPException."""
        path = self._path(name)
        try:
            key = name, path.stat().st_ino
            recording = self._open.pop(key, None)
            if recording is None:
                recording = McapRecording(path)
            else:
                recording.refresh()
        except (SkylessError, OSError) as error:
            raise HTTPException(404, f"{name!r} cannot be read: {error}") from None
        self._open[key] = recording
        while len(self._open) > _MAX_OPEN:
            self._open.popitem(last=False)[1].close()
        return recording

    def _path(self, name: str) -> Path:
        """Path of a recording directly in the folder. Raises HTTPException."""
        plain = name.endswith(_SUFFIX) and not name.startswith(".") and not {"/", "\\", "\0", os.sep} & set(name)
        if self._folder is not None and plain:
            path = self._folder / name
            if path.is_file() and path.resolve().parent == self._folder.resolve():
                return path
        raise HTTPException(404, f"there is no recording {name[:100]!r}")


def _version(file: Path) -> _Version:
    stat = file.stat()
    return stat.st_ino, stat.st_size, stat.st_mtime_ns


@lru_cache(_MAX_OPEN)
def _events(path: Path, _of: _Version, stopped: threading.Event) -> RecordedEvents:
    """Events of a recording from the live page's log, by the recording's times."""
    events: list[Event] = []
    table, feed = SiteTable(0.0), SiteFeed()
    log = EventLog(table, add=events.append)

    def on_status(status: StatusMessage | None) -> None:
        if status is not None and (node := table.add(status.kind, status.name, sends=True)) is not None:
            log.on_status(status, node.status, feed.now_s)
            table.add_status(status, feed.now_s)

    def on_health(health: Health, channel: Channel) -> None:
        log.on_health(channel.who, channel.name, health, feed.now_s)
        table.add_health(channel.who, channel.name, health, feed.now_s)

    feed.on(FixMessage, lambda fix, _: log.on_fix(fix, feed.now_s))
    feed.on(StatusMessage, lambda status, _: on_status(status))
    feed.on(WatchMessage, lambda watch, _: log.on_watch(watch, feed.now_s))
    for kind in (TagHealth, AnchorHealth, EtherHealth):
        feed.on(kind, on_health)

    def watched(recorded: Iterable[Recorded]) -> Iterator[Recorded]:
        """The messages, with the log's own work between them."""
        due_s, last_s = 0.0, float("-inf")
        for found in recorded:
            if stopped.is_set() or len(events) >= MAX_RECORDED_EVENTS:
                return
            if found.time_s - last_s > _GAP_S:
                log.pause(found.time_s)  # the recorder was cut off
            elif found.time_s >= due_s:
                log.tick(found.time_s)
                due_s = found.time_s + _TICK_S
            last_s = found.time_s
            yield found

    with McapRecording(path) as recording:
        feed.play(watched(recording.messages({"status", "health", "fix", "watch"})))
    return RecordedEvents(tuple(events[:MAX_RECORDED_EVENTS]), len(events) < MAX_RECORDED_EVENTS)


def _zones(recording: McapRecording) -> tuple[Zone, ...]:
    """Zones of the recorded site, without those of other sites with its number."""
    if recording.zones is None:
        return ()
    return zones_of(recording.zones, "" if recording.site is None else recording.site.site.name).zones


def _fix_spans(recording: McapRecording) -> tuple[tuple[float, float], ...]:
    spans = recording.spans({"fix"}, _GAP_S)
    if not spans:
        return ()
    first_s = min((found.time_s for found in islice(recording.messages({"fix"}), 1)), default=spans[0][0])
    return (max(first_s, spans[0][0]), spans[0][1]), *spans[1:]


def _states(
    recording: McapRecording, begin_s: float, end_s: float, step_s: float, stopped: threading.Event
) -> list[bytes]:
    """A ``state`` message every ``step_s``, if there is anything new. Unix times.

    Reading begins some time before, as the tags' intervals must be learnt.
    """
    table = SiteTable(begin_s)
    site = SiteState(table)
    states: list[bytes] = []
    sent, due_s, feed = 0, begin_s + step_s, SiteFeed()

    def take_fix(fix: FixMessage) -> None:
        node = table.add_fix(fix, feed.now_s)
        if node is not None:
            node.ended_unix_s = feed.now_s

    feed.on(FixMessage, lambda fix, _: take_fix(fix))
    feed.on(TruthMessage, lambda truth, _: site.add_truth(truth))
    feed.on(TagHealth, lambda health, channel: table.add_health("tag", channel.name, health, feed.now_s))

    def sampled(recorded: Iterable[Recorded]) -> Iterator[Recorded]:
        """The messages, with the states between them."""
        nonlocal sent, due_s
        for found in recorded:
            if stopped.is_set():
                return
            if found.time_s >= due_s:
                sent = _append_state(site, sent, due_s, states)
                due_s += step_s * (1 + math.floor((found.time_s - due_s) / step_s))
            yield found

    kinds = {"fix", "truth", "health"}
    feed.play(recording.messages(kinds, begin_s - _LEAD_S, begin_s))
    sent = table.fixes_serial
    feed.play(sampled(recording.messages(kinds, begin_s, end_s)))
    _append_state(site, sent, min(due_s, end_s), states)
    return states


def _append_state(site: SiteState, sent: int, unix_s: float, states: list[bytes]) -> int:
    """Append a state if there is anything new. Returns the state's serial."""
    if site.table.fixes_serial > sent:
        site.unix_s = unix_s
        states.append(site.state_since(sent))
    return site.table.fixes_serial
