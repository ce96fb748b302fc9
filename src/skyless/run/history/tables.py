"""Tables of a history's rows, and reading and writing of whole files."""

import contextlib
import os
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct
from numpy.typing import NDArray
from pyarrow import parquet

from skyless.core.errors import SkylessError
from skyless.run.fix_batch import NONE_U16, Records
from skyless.run.history.layout import EVENT_COLUMNS, FIX_COLUMNS, PLACE, EventKind, Place
from skyless.run.mqtt.messages import AlarmMessage, StatusMessage, ZoneEvent
from skyless.run.web import HISTORY as LIMITS

ROW_GROUP: Final = 131_072
_TIME: Final = pa.timestamp("ms", tz="UTC")


class Event(Struct, frozen=True):
    """One event; the fields are ``EVENT_COLUMNS``."""

    t: datetime
    kind: EventKind
    tag: str | None = None
    zone: str | None = None
    subject: str | None = None
    alarm: str | None = None
    text: str = ""


def schema_of(columns: dict[str, str]) -> pa.Schema:
    """Arrow schema of columns that ``layout.py`` defines."""
    return pa.schema(
        [(name, _TIME if kind.startswith("timestamp") else pa.type_for_alias(kind)) for name, kind in columns.items()]
    )


def fix_table(records: Records) -> pa.Table:
    """Convert records (``run/fix_batch.py``) to a table sorted by tag and time.

    ``std_mm`` is the root of the covariance's trace, as ``FixMessage.std_m``; the correlation of x and y is dropped.
    """
    rows = records[np.lexsort((records["unix_us"], records["tag"]))]
    up_mm = np.where(rows["std_z_mm"] == NONE_U16, 0, rows["std_z_mm"]).astype(np.float64)
    plane_m2 = rows["covariance_m2"][:, [0, 2]].astype(np.float64).clip(0.0).sum(axis=1)
    std_mm = np.nan_to_num(np.rint(np.sqrt(1e6 * plane_m2 + up_mm**2)), nan=NONE_U16)
    columns: dict[str, NDArray[Any]] = {name: rows[name] for name in ("tag", "hpl_cm", "flags")}
    columns |= {"t": unix_ms(rows), "std_mm": std_mm.clip(0, NONE_U16).astype(np.uint16)}
    columns |= dict(zip(("x_mm", "y_mm", "z_mm"), rows["position_mm"].T, strict=True))
    schema = schema_of(FIX_COLUMNS)
    arrays = [pa.array(np.ascontiguousarray(columns[field.name])).cast(field.type) for field in schema]
    return pa.Table.from_arrays(arrays, schema=schema)


def unix_ms(records: Records) -> NDArray[np.int64]:
    """Times of records in ms."""
    return (records["unix_us"] // np.uint64(1000)).astype(np.int64)


def event_table(events: Sequence[Event]) -> pa.Table:
    """Convert events to a table sorted by time."""
    rows = [msgspec.structs.asdict(event) for event in sorted(events, key=lambda event: event.t)]
    return pa.Table.from_pylist(rows, schema_of(EVENT_COLUMNS))


def read_table(file: Path, columns: dict[str, str], wanted: pc.Expression | None = None) -> pa.Table:
    """Read columns of the wanted rows of a file. Raises SkylessError if it cannot be read or lacks a column."""
    try:
        table = parquet.ParquetFile(file).read(columns=list(columns)).cast(schema_of(columns))
        table.validate(full=True)  # among others, that texts are UTF-8
    except (OSError, ValueError, pa.ArrowException) as error:
        should = f"it should be a Parquet file with {', '.join(columns)}"
        raise SkylessError(f"{file} cannot be read; {should}: {error}") from None
    return table if wanted is None else table.filter(wanted)


def metadata_of(file: Path) -> dict[bytes, bytes]:
    """Return the metadata of a file. Raises SkylessError if it cannot be read."""
    try:
        return dict(parquet.read_schema(file).metadata or {})
    except (OSError, ValueError, pa.ArrowException) as error:
        raise SkylessError(f"{file} cannot be read; it should be a Parquet file: {error}") from None


def place_in(file: Path) -> Place:
    """Return the place in the stream up to which a history is complete with this file. Raises SkylessError."""
    try:
        return msgspec.json.decode(metadata_of(file).get(PLACE, b"{}"), type=Place)
    except msgspec.MsgspecError as error:
        raise SkylessError(f"{file} has wrong metadata {PLACE.decode()}: {error}") from None


def read_events(files: Iterable[Path], wanted: pc.Expression) -> Iterator[Event]:
    """Yield the wanted events in files, in order. Raises SkylessError."""
    for file in files:
        yield from (Event(**row) for row in read_table(file, EVENT_COLUMNS, wanted).to_pylist())


def write_table(table: pa.Table, file: Path) -> None:
    """Write a file atomically and durably. Raises OSError.

    A program that is killed meanwhile leaves a file of the same name with ``.tmp``.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    scratch = file.with_name(f"{file.name}.tmp")
    texts = [field.name for field in table.schema if pa.types.is_string(field.type)]
    numbers = [name for name in table.column_names if name not in texts]
    options: dict[str, Any] = {"use_dictionary": texts, "compression": "lz4", "row_group_size": ROW_GROUP}
    options["column_encoding"] = dict.fromkeys(numbers, "DELTA_BINARY_PACKED")
    try:
        with scratch.open("wb") as out:
            parquet.write_table(table, out, **options)
            out.flush()
            os.fsync(out.fileno())
        scratch.replace(file)
    except BaseException:
        with contextlib.suppress(OSError):
            scratch.unlink()
        raise
    handle = os.open(file.parent, os.O_RDONLY)  # make the file's name durable, too
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


REMEMBERED_KINDS: Final = ("alarm-raised", "alarm-ended", "alarm-acknowledged", "offline", "online")
"""Events derived from retained messages, for which the past ones must be known."""


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
