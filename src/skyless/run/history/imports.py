"""Recordings become history, without what it has already, from the same file or from the running site."""

import hashlib
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import pyarrow as pa
from msgspec import Struct
from numpy.typing import NDArray

from skyless.run.fix_batch import MAX_RECORDS, Records, records_of
from skyless.run.history.events import EventLog
from skyless.run.history.layout import EVENT_COLUMNS, current_events, current_files
from skyless.run.history.sink import FILE_ROWS, Event, read_table
from skyless.run.history.writer import Table, Writer, read_rows
from skyless.run.mqtt.messages import FixMessage, ZoneEvent
from skyless.run.recordings.recording import McapRecording

_COLUMNS: Final = {"sha256": "string", "file": "string", "t": "timestamp[ms, tz=UTC]"}
_CHUNK: Final = 100_000
_DAY_S: Final = 86_400.0


class Imported(Struct, frozen=True):
    """What became of a recording."""

    fixes: int
    known_fixes: int
    """Those that the history had."""
    events: int
    drops: dict[str, int]


def import_recording(recording: McapRecording, file: Path, writer: Writer, reach: Callable[[float], None]) -> Imported:
    """Write its fixes, zone events and zones. ``reach`` is called with the time that has been read, Unix time in s.

    Raises:
        SkylessError: the history cannot be read.
        OSError: the disk does not take it; what it took is there, and a repetition adds the rest.
    """
    with file.open("rb") as content:
        digest = hashlib.file_digest(content, "sha256").hexdigest()
    imports = Table(writer.folder / "imports.parquet", _COLUMNS, "sha256")
    if digest in imports.rows:
        return Imported(0, recording.summary().messages.get("fix", 0), 0, {})
    writer.set_zones(() if recording.zones is None else recording.zones.zones)
    simulated = recording.site is not None and recording.site.simulated
    log = EventLog(_known_events(recording, writer))
    chunk: list[tuple[float, int, FixMessage]] = []
    counts = {"fixes": 0, "known_fixes": 0, "events": 0}

    def add() -> None:
        added = _add(chunk, writer, simulated=simulated) if chunk else 0
        counts["fixes"] += added
        counts["known_fixes"] += len(chunk) - added
        chunk.clear()

    for found in recording.messages({"fix", "event"}):
        if isinstance(found.message, ZoneEvent):
            if events := tuple(log.of_zone(found.message)):
                writer.events.add(events, found.time_s)
                counts["events"] += len(events)
            continue
        fix = cast("FixMessage", found.message)
        number = writer.number(fix, found.time_s)
        if number is not None:
            chunk.append((found.time_s, number, fix))
        if len(chunk) >= _CHUNK:
            add()
            reach(found.time_s)
    add()
    writer.write()
    imports.set(digest, file.name, round(1000 * datetime.now(UTC).timestamp()))
    imports.save()
    return Imported(**counts, drops=dict(writer.drops + recording.drops))


def _known_events(recording: McapRecording, writer: Writer) -> Iterator[Event]:
    """The events that the history has of the time of a recording."""
    found = recording.summary()
    if found.start_s is not None and found.end_s is not None:
        span = [("t", ">=", _time(1000 * (found.start_s - _DAY_S))), ("t", "<=", _time(1000 * (found.end_s + _DAY_S)))]
        for path in current_events(writer.root, writer.site):
            yield from (Event(*row.values()) for row in read_rows(path, EVENT_COLUMNS, span))
    yield from chain.from_iterable(writer.events.sink.unwritten)


def _add(chunk: list[tuple[float, int, FixMessage]], writer: Writer, *, simulated: bool) -> int:
    """Add the fixes that the history lacks; how many these are. A tag has one fix in a millisecond."""
    records = records_of([(number, fix) for _, number, fix in chunk], simulated=simulated)
    times_s = np.array([time_s for time_s, _, _ in chunk])
    keys = _keys_of(records)
    known = [_known_keys(records, times_s, writer), *map(_keys_of, writer.fixes.sink.unwritten)]
    is_new = ~np.isin(keys, np.concatenate(known))
    is_new &= np.isin(np.arange(len(keys)), np.unique(keys, return_index=True)[1])
    new, new_s = records[is_new], times_s[is_new]
    for first in range(0, len(new), MAX_RECORDS):
        writer.fixes.add(new[first : first + MAX_RECORDS], float(new_s[first]))
    writer.store()
    if writer.fixes.sink.waiting >= FILE_ROWS:
        writer.write()
    return len(new)


def _known_keys(records: Records, times_s: NDArray[np.float64], writer: Writer) -> NDArray[np.int64]:
    """Keys in files of the days of a recording's piece; a message may have arrived a little earlier or later there."""
    ms, margin_s = _ms(records), np.array([-_DAY_S, _DAY_S])
    days = np.array([times_s.min(), times_s.max()]) + margin_s
    first, last = (f"day={datetime.fromtimestamp(unix_s, UTC).date()}" for unix_s in days)
    span = [("t", ">=", _time(ms.min())), ("t", "<=", _time(ms.max()))]
    files = [file for file in current_files(writer.root, writer.site) if first <= file.parent.name <= last]
    tables = [read_table(file, ["tag", "t"], span) for file in files]
    found = [_keys(table["tag"].to_numpy(), table["t"].cast(pa.int64()).to_numpy()) for table in tables]
    return np.concatenate([np.empty(0, np.int64), *found])


def _keys_of(records: Records) -> NDArray[np.int64]:
    return _keys(records["tag"], _ms(records))


def _ms(records: Records) -> NDArray[np.int64]:
    return (records["unix_us"] // np.uint64(1000)).astype(np.int64)


def _keys(tag: NDArray[Any], ms: NDArray[np.int64]) -> NDArray[np.int64]:
    """A number for each tag and millisecond; times have 43 bits (``MAX_UNIX_S``), tags fewer than 20."""
    return (tag.astype(np.int64) << 43) | ms


def _time(ms: float) -> pa.Scalar:
    return pa.scalar(int(ms), pa.timestamp("ms", tz="UTC"))
