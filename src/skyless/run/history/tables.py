"""Tables of a history's rows, and reading and writing of whole Parquet files by DuckDB.

In memory a table is its columns by name. Times are whole milliseconds since 1970, and None among texts is null.
"""

import contextlib
import errno
import os
import re
import secrets
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any, Final

import duckdb
import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.core.errors import SkylessError
from skyless.run.fix_batch import NONE_U16, Records
from skyless.run.history.layout import EVENT_COLUMNS, PLACE, THINNED, TIME, EventKind, Place
from skyless.run.mqtt.messages import AlarmMessage, StatusMessage, ZoneEvent
from skyless.run.web import HISTORY as LIMITS

ROW_GROUP: Final = 131_072

Columns = dict[str, NDArray[Any]]


class Event(Struct, frozen=True):
    """One event; the fields are ``EVENT_COLUMNS``."""

    t: datetime
    kind: EventKind
    tag: str | None = None
    zone: str | None = None
    subject: str | None = None
    alarm: str | None = None
    text: str = ""


def fix_columns(records: Records) -> Columns:
    """Convert records (``run/fix_batch.py``) to columns sorted by tag and time.

    ``std_mm`` is the root of the covariance's trace, as ``FixMessage.std_m``; the correlation of x and y is dropped.
    """
    rows = records[np.lexsort((records["unix_us"], records["tag"]))]
    up_mm = np.where(rows["std_z_mm"] == NONE_U16, 0, rows["std_z_mm"]).astype(np.float64)
    plane_m2 = rows["covariance_m2"][:, [0, 2]].astype(np.float64).clip(0.0).sum(axis=1)
    std_mm = np.nan_to_num(np.rint(np.sqrt(1e6 * plane_m2 + up_mm**2)), nan=NONE_U16)
    columns: Columns = {"tag": rows["tag"], "t": unix_ms(rows)}
    columns |= dict(zip(("x_mm", "y_mm", "z_mm"), rows["position_mm"].T, strict=True))
    columns |= {"std_mm": std_mm.clip(0, NONE_U16).astype(np.uint16), "hpl_cm": rows["hpl_cm"], "flags": rows["flags"]}
    return {name: np.ascontiguousarray(column) for name, column in columns.items()}


def unix_ms(records: Records) -> NDArray[np.int64]:
    """Times of records in ms."""
    return (records["unix_us"] // np.uint64(1000)).astype(np.int64)


def event_columns(events: Sequence[Event]) -> Columns:
    """Convert events to columns sorted by time."""
    rows = [msgspec.structs.asdict(event) for event in sorted(events, key=lambda event: event.t)]
    return columns_of([row | {"t": round(1000 * row["t"].timestamp())} for row in rows], EVENT_COLUMNS)


def columns_of(rows: Sequence[Mapping[str, object]], kinds: Mapping[str, str]) -> Columns:
    """Convert rows to columns of the kinds of ``layout.py``."""
    return {
        name: np.array(
            [row[name] if kind == "VARCHAR" else row[name] or 0 for row in rows],
            object if kind == "VARCHAR" else np.int64,
        )
        for name, kind in kinds.items()
    }


def database(memory_mb: int = LIMITS.memory_mb) -> duckdb.DuckDBPyConnection:
    """Open DuckDB with temporary files only, and without the network."""
    spill = str(Path(tempfile.gettempdir()) / f"skyless-history-{secrets.token_hex(8)}")  # created only if needed
    options: dict[str, Any] = {"memory_limit": f"{memory_mb}MB", "temp_directory": spill}
    # One thread takes less processor time in total, and leaves the other cores to the site.
    options |= {"autoinstall_known_extensions": "false", "python_enable_replacements": "false", "threads": 1}
    return duckdb.connect(config=options)


_shared_database = cache(database)
"""One to read and one to write for the process, as opening one takes 15 ms."""
_WRITING_MB: Final = 512
"""For the largest day of events with long texts that is joined."""
_writing: Final = Lock()
"""A hub's sites write one after the other, within that memory."""


def connection() -> duckdb.DuckDBPyConnection:
    """Connect to this process's database, for one thread; it should be closed."""
    return _shared_database().cursor()


def pattern(file: Path) -> str:
    """A file's path where DuckDB takes a pattern."""
    return re.sub(r"([*?\[])", r"[\1]", str(file))


def select(
    duck: duckdb.DuckDBPyConnection, files: Iterable[Path], kinds: Mapping[str, str], wanted: str = "true"
) -> duckdb.DuckDBPyConnection:
    """Ask for columns of the rows of files for which the SQL ``wanted`` is true. Raises duckdb.Error."""
    values = ", ".join(
        f"epoch_us({name}) // 1000 AS {name}" if kind == TIME else f"CAST({name} AS {kind}) AS {name}"
        for name, kind in kinds.items()
    )
    sql = f"SELECT {values} FROM read_parquet($files, hive_partitioning = false) WHERE {wanted}"
    return duck.execute(sql, {"files": list(map(pattern, files))})


def metadata_in(duck: duckdb.DuckDBPyConnection, files: Iterable[Path]) -> dict[Path, dict[str, str]]:
    """Return the metadata of files that a history has written there. Raises duckdb.Error."""
    found: dict[Path, dict[str, str]] = {file: {} for file in files}
    sql = f"""SELECT file_name, decode(key), decode(value) FROM parquet_kv_metadata($files)
        WHERE key IN ('{PLACE}'::BLOB, '{THINNED}'::BLOB)"""
    for file, key, value in duck.execute(sql, {"files": list(map(pattern, found))}).fetchall() if found else ():
        found[Path(file)][key] = value
    return found


@contextlib.contextmanager
def _reading(file: Path, what: str = "") -> Iterator[duckdb.DuckDBPyConnection]:
    """Open DuckDB for reading a file. Raises SkylessError if it cannot be read."""
    try:
        with connection() as duck:
            yield duck
    except duckdb.Error as error:
        right = f"it should be a Parquet file{what}"
        raise SkylessError(f"{file} cannot be read; {right}: {first_line(error)}") from None


def first_line(error: duckdb.Error) -> str:
    """What an error says, without the part of the query to which it points."""
    return str(error).partition("\n")[0]


def read_columns(file: Path, kinds: Mapping[str, str], wanted: str = "true") -> Columns:
    """Read columns of the wanted rows of a file. Raises SkylessError if it cannot be read or lacks a column."""
    with _reading(file, f" with {', '.join(kinds)}") as duck:
        return select(duck, [file], kinds, wanted).fetchnumpy()


def read_rows(file: Path, kinds: Mapping[str, str], wanted: str = "true") -> list[dict[str, Any]]:
    """Read the wanted rows of a file. Raises SkylessError if it cannot be read or lacks a column."""
    with _reading(file, f" with {', '.join(kinds)}") as duck:
        return [dict(zip(kinds, row, strict=True)) for row in select(duck, [file], kinds, wanted).fetchall()]


def check_readable(file: Path, kinds: Mapping[str, str]) -> None:
    """Read a whole file. Raises SkylessError if it cannot be read or lacks a column."""
    with _reading(file, f" with {', '.join(kinds)}") as duck:
        found = select(duck, [file], kinds)
        while found.fetchmany(10_000):
            pass


def metadata_of(file: Path) -> dict[str, str]:
    """Return the metadata of a file. Raises SkylessError if it cannot be read."""
    with _reading(file) as duck:
        return metadata_in(duck, [file])[file]


def place_in(file: Path) -> Place:
    """Return the place in the stream up to which a history is complete with this file. Raises SkylessError."""
    try:
        return msgspec.json.decode(metadata_of(file).get(PLACE, "{}"), type=Place)
    except msgspec.MsgspecError as error:
        raise SkylessError(f"{file} has wrong metadata {PLACE}: {error}") from None


def read_events(files: Iterable[Path], wanted: str) -> Iterator[Event]:
    """Yield the wanted events in files, in order. Raises SkylessError."""
    written = f"t BETWEEN to_timestamp(0) AND to_timestamp({LIMITS.last_unix_s})"  # no other times are kept
    for file in files:
        for row in read_rows(file, EVENT_COLUMNS, f"{written} AND ({wanted})"):
            yield Event(**row | {"t": datetime.fromtimestamp(row["t"] / 1000, UTC)})


def quoted(text: Path | str) -> str:
    """A path or a text in SQL."""
    return "'" + str(text).replace("'", "''") + "'"


def write_table(
    table: Columns, kinds: Mapping[str, str], file: Path, metadata: Mapping[str, str] | None = None
) -> None:
    """Write columns of the kinds of ``layout.py`` to a file, atomically and durably. Raises OSError."""
    values = ", ".join(
        f"make_timestamptz(1000 * {name}) AS {name}" if kind == TIME else f"CAST({name} AS {kind}) AS {name}"
        for name, kind in kinds.items()
    )
    try:
        write_answer(f"SELECT {values} FROM rows", file, metadata, rows=table)
    except duckdb.Error as error:
        raise OSError(errno.EIO, first_line(error), str(file)) from None


def write_answer(query: str, file: Path, metadata: Mapping[str, str] | None = None, **tables: Columns) -> None:
    """Write the answer of a query to a file, atomically and durably; it may name ``tables``.

    A program that is killed meanwhile leaves a file of the same name with ``.tmp``.

    Raises:
        OSError: the file cannot be written.
        duckdb.Error: the query cannot be answered.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    scratch = file.with_name(f"{file.name}.tmp")
    options = f"FORMAT parquet, COMPRESSION zstd, PARQUET_VERSION V2, ROW_GROUP_SIZE {ROW_GROUP}"
    if metadata:
        options += f", KV_METADATA {{{', '.join(f'{key}: {quoted(text)}' for key, text in metadata.items())}}}"
    try:
        with _writing, _shared_database(_WRITING_MB).cursor() as duck:
            for name, table in tables.items():
                duck.register(name, table)
            duck.execute(f"COPY ({query}) TO {quoted(scratch)} ({options})")
        _sync(scratch)
        scratch.replace(file)
    except BaseException as error:
        with contextlib.suppress(OSError):
            scratch.unlink()
        if isinstance(error, duckdb.IOException) and str(scratch) in str(error):
            stated = re.search(r'"errno":"(\d+)"', str(error))
            why = (int(stated[1]), os.strerror(int(stated[1]))) if stated else (errno.EIO, first_line(error))
            raise OSError(*why, str(file)) from None
        raise
    _sync(file.parent)  # makes the file's name durable, too


def _sync(path: Path) -> None:
    """Make a file or a folder durable."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


REMEMBERED: Final = "kind IN ('alarm-raised', 'alarm-ended', 'alarm-acknowledged', 'offline', 'online')"
"""Events derived from retained messages, for which the past ones must be known, in SQL."""


class EventLog:
    """Distinguishes new events from known ones."""

    def __init__(self, past: Iterable[Event] = ()) -> None:
        """``past``: the events in the history, in order."""
        self._alarms: set[tuple[EventKind, str]] = set()
        self._last: dict[tuple[str | None, ...], tuple[EventKind, datetime | None]] = {}
        """Last event of each node, or of a tag in a zone, and its time; of an offline node, when it came online."""
        for event in past:
            self._remember(event)

    def of(self, message: ZoneEvent | AlarmMessage | StatusMessage, now_unix_s: float) -> list[Event]:
        """Return the new events in a message: zone crossings, alarms, and nodes that went online or offline."""
        if isinstance(message, ZoneEvent):
            text = f"{message.tag} {'entered' if message.kind == 'enter' else 'left'} {message.name}"
            return self._new(message.unix_s, message.kind, tag=message.tag, zone=message.zone, text=text)
        if isinstance(message, AlarmMessage):
            about = {"zone": message.zone, "subject": message.subject, "alarm": message.id}
            about["tag"] = message.tags[0] if message.tags else None
            return [
                *self._new(message.unix_s, "alarm-raised", text=message.sentence, **about),
                *self._new(message.ended_unix_s, "alarm-ended", text=message.sentence, **about),
                *self._new(message.acknowledged_unix_s, "alarm-acknowledged", text=message.acknowledged_by, **about),
            ]
        kind: EventKind = "online" if message.online else "offline"
        who = {"tag": message.name} if message.kind == "tag" else {"subject": f"{message.kind}-{message.name}"}
        unix_s = message.unix_s if message.online and message.unix_s else now_unix_s
        return self._new(unix_s, kind, text=f"{message.kind} {message.name} is {kind}", **who)

    def _new(self, unix_s: float | None, kind: EventKind, **about: Any) -> list[Event]:  # noqa: ANN401 - Event's fields
        if unix_s is None or not 0.0 <= unix_s <= LIMITS.last_unix_s:
            return []
        event = Event(datetime.fromtimestamp(round(1000 * unix_s) / 1000, UTC), kind, **about)
        return [event] if self._is_new(event) else []

    def _is_new(self, event: Event) -> bool:
        """Remember an event. Return False for a copy, or one that states what is already known."""
        if event.alarm:
            is_new = (event.kind, event.alarm) not in self._alarms
        else:
            before, since = self._last.get(_about(event), (None, None))
            if event.kind != "offline" and event.t == since and event.kind in ("online", before):
                return False  # "online" may be a late copy, sent before the node went offline
            is_new = not (event.kind == before and event.kind in ("online", "offline"))
        self._remember(event)
        return is_new

    def _remember(self, event: Event) -> None:
        if event.alarm:
            self._alarms.add((event.kind, event.alarm))
        elif event.kind == "offline":
            self._last[_about(event)] = ("offline", self._last.get(_about(event), (None, None))[1])
        else:
            self._last[_about(event)] = (event.kind, event.t)


def _about(event: Event) -> tuple[str | None, ...]:
    return event.tag, event.zone, event.subject
