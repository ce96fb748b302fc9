"""Recordings become history, without what it has already, from the same file or from the running site."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any, Final, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct
from numpy.typing import NDArray

from skyless.run.fix_batch import records_of
from skyless.run.history.events import EventLog
from skyless.run.history.layout import FIX_COLUMNS, current_events, current_files, day_of
from skyless.run.history.tables import Event, read_events, read_table, unix_ms
from skyless.run.history.writer import FILE_ROWS, Writer
from skyless.run.mqtt.messages import FixMessage, ZoneEvent
from skyless.run.recordings.recording import McapRecording

_CHUNK: Final = 100_000
_MARGIN: Final = timedelta(days=1)
"""A message may have arrived a little earlier or later at the running history."""


class Imported(Struct, frozen=True):
    """What became of a recording."""

    fixes: int
    known_fixes: int
    """Those that the history had."""
    events: int
    drops: dict[str, int]


def import_recording(recording: McapRecording, writer: Writer, reach: Callable[[float], None]) -> Imported:
    """Write its fixes, zone events and zones. ``reach`` is called with the time that has been read, Unix time in s.

    A tag has one fix in a millisecond.

    Raises:
        SkylessError: the history cannot be read.
        OSError: the disk does not take it; what it took is there, and a repetition adds the rest.
    """
    writer.write()  # what an earlier import, or a run, has left in the journal
    writer.set_zones(() if recording.zones is None else recording.zones.zones)
    simulated = recording.site is not None and recording.site.simulated
    known, known_events = _known(recording, writer)
    log = EventLog()
    chunk: list[tuple[int, FixMessage]] = []
    counts = {"fixes": 0, "known_fixes": 0, "events": 0}
    day, arrived_s = None, 0.0

    def add() -> None:
        records = records_of(chunk, simulated=simulated)
        keys, rows = np.unique(_keys(records["tag"], unix_ms(records)), return_index=True)
        new = records[rows[~np.isin(keys, known)]]
        writer.fixes.add(new, arrived_s)
        writer.store()
        if writer.unwritten >= FILE_ROWS:
            writer.write()
        counts["fixes"] += len(new)
        counts["known_fixes"] += len(chunk) - len(new)
        chunk.clear()

    for found in recording.messages({"fix", "event"}):
        if isinstance(found.message, ZoneEvent):
            events = [event for event in log.of(found.message, found.time_s) if event not in known_events]
            writer.events.add(events, found.time_s)
            counts["events"] += len(events)
            continue
        of_day = datetime.fromtimestamp(found.time_s, UTC).date()
        if chunk and (of_day != day or len(chunk) >= _CHUNK):
            add()
            reach(found.time_s)
        day, arrived_s = of_day, found.time_s
        fix = cast("FixMessage", found.message)
        number = writer.number(fix, found.time_s)
        if number is not None:
            chunk.append((number, fix))
    add()
    writer.write()
    return Imported(**counts, drops=dict(writer.drops + recording.drops))


def _known(recording: McapRecording, writer: Writer) -> tuple[NDArray[np.int64], set[Event]]:
    """Keys of the fixes, and the events, that the history has of the time of a recording."""
    summary = recording.summary()
    if summary.start_s is None or summary.end_s is None:
        return np.empty(0, np.int64), set()
    begin = datetime.fromtimestamp(summary.start_s, UTC) - _MARGIN
    end = datetime.fromtimestamp(summary.end_s, UTC) + _MARGIN
    span = (pc.field("t") >= begin) & (pc.field("t") <= end)
    files, events = (
        [file for file in current(writer.root, writer.site) if str(begin.date()) <= day_of(file) <= str(end.date())]
        for current in (current_files, current_events)
    )
    columns = {name: FIX_COLUMNS[name] for name in ("tag", "t")}
    tables = [read_table(file, columns, span) for file in files]
    keys = [_keys(table["tag"].to_numpy(), table["t"].cast(pa.int64()).to_numpy()) for table in tables]
    return np.concatenate([np.empty(0, np.int64), *keys]), set(read_events(events, span))


def _keys(tag: NDArray[Any], ms: NDArray[np.int64]) -> NDArray[np.int64]:
    """A number for each tag and millisecond; times have 43 bits (``LIMITS.last_unix_s``), tags fewer than 20."""
    return (tag.astype(np.int64) << 43) | ms
