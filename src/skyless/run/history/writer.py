"""The history of one site as it is written: numbers of tags, journals, files. One process at a time writes it."""

import errno
import os
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from threading import Lock
from typing import Any, Final, Generic, cast

import msgspec
import pyarrow as pa

from skyless.core.errors import SkylessError
from skyless.run.fix_batch import Batch, Records, decode_batch, encode_batch
from skyless.run.history.events import MAX_UNIX_S, REMEMBERED_KINDS
from skyless.run.history.journal import Journal
from skyless.run.history.layout import EVENT_COLUMNS, NAME_COLUMNS, ZONE_COLUMNS, current_events, site_folder
from skyless.run.history.sink import (
    MAX_ROWS,
    Event,
    R,
    Sink,
    event_sink,
    fix_sink,
    read_table,
    schema_of,
    scratch_of,
    write_table,
)
from skyless.run.mqtt.messages import FixMessage, Zone
from skyless.run.process import locked

MAX_WAITING: Final = 500_000
"""How many rows wait in memory while the disk does not take them."""

MAX_TAGS: Final = 200_000

_FILE_BYTES: Final = 16
_SPARE_BYTES: Final = 1 << 20
"""The journal leaves so much of the disk free, for each of its rows and besides: its rows must find room in files."""


class Intake(Generic[R]):
    """Rows of one kind on their way: first into the journal, then into files."""

    def __init__(
        self,
        journal: Journal,
        sink: Sink[R],
        encode: Callable[[R, float], bytes],
        decode: Callable[[bytes], tuple[R, float]],
    ) -> None:
        """Take over what an earlier run has left in the journal. Raises OSError or ValueError."""
        self.sink: Sink[R] = sink
        self.dropped = 0
        """Rows that the disk did not take in time."""
        self._journal = journal
        self._encode: Callable[[R, float], bytes] = encode
        self._waiting: deque[tuple[R, float]] = deque()
        self._waiting_rows = 0
        self._lock = Lock()  # a thread may still be at work when the program ends
        for first, payload in journal.read():
            rows, arrived_unix_s = decode(payload)
            sink.put(rows, first, arrived_unix_s)
        sink.next = max(sink.next, journal.end())
        journal.begin(sink.next)

    @property
    def waiting(self) -> int:
        """How many rows are not in the journal yet."""
        return self._waiting_rows

    def add(self, rows: R, arrived_unix_s: float) -> None:
        """Take rows, at most ``MAX_RECORDS`` of ``run/fix_batch.py``. They are in the journal after ``store``."""
        self._waiting.append((rows, arrived_unix_s))
        self._waiting_rows += len(rows)
        while self._waiting_rows > MAX_WAITING:
            lost = len(self._waiting.popleft()[0])
            self._waiting_rows -= lost
            self.dropped += lost

    def store(self) -> None:
        """Bring everything into the journal. Raises OSError: what is not there waits."""
        while self._waiting and self.sink.waiting < MAX_ROWS:
            rows, arrived_unix_s = self._waiting[0]
            payload = self._encode(rows, arrived_unix_s)
            if self._journal.free_bytes() < len(payload) + _SPARE_BYTES + _FILE_BYTES * self.sink.waiting:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._journal.append(self.sink.next, payload)
            self._waiting.popleft()
            self._waiting_rows -= len(rows)
            self.sink.put(rows, self.sink.next, arrived_unix_s)

    def begin(self) -> None:
        """Let the journal go on in another file, so that ``write`` can remove the one so far. Raises OSError."""
        with self._lock:
            self._journal.begin(self.sink.next)

    def write(self) -> None:
        """Turn the rows of the journal into files. Raises OSError. Another thread may call it."""
        with self._lock:
            self.sink.write()
            self._journal.drop_through(self.sink.last)

    def sync(self) -> None:
        """Wait until the journal is on the disk. Raises OSError. Another thread may call it."""
        with self._lock:
            self._journal.sync()


class Table:
    """A small table that is kept as a whole, such as the names of tags; a row that has been there stays."""

    def __init__(self, file: Path, columns: dict[str, str], key: str) -> None:
        """Raises SkylessError: the file is damaged."""
        self.rows: dict[str, dict[str, Any]] = {}
        """By the value of the column ``key``."""
        self._file, self._columns, self._key = file, columns, key
        self._is_saved = True
        scratch_of(file).unlink(missing_ok=True)
        if file.exists():
            self.rows = {row[key]: row for row in read_rows(file, columns)}

    def set(self, *values: object) -> None:
        """Add or replace a row; its values are in the order of the columns."""
        row: dict[str, Any] = dict(zip(self._columns, values, strict=True))
        self._is_saved = self._is_saved and self.rows.get(row[self._key]) == row
        self.rows[row[self._key]] = row

    def save(self) -> None:
        """Write the table if it is not on the disk as it is now. Raises OSError."""
        if not self._is_saved:
            write_table(pa.Table.from_pylist([*self.rows.values()], schema_of(self._columns)), self._file)
            self._is_saved = True


class Writer:
    """Writes the history of one site."""

    def __init__(self, folder: Path, site: int) -> None:
        """Raises SkylessError: it cannot be written, another program does so, or it is damaged."""
        self.root, self.site = folder, site
        self.drops: Counter[str] = Counter()
        """Messages that are not kept, by reason."""
        self.folder = site_folder(folder, site)
        journals, names = self.folder / "journal", self.folder / "names.parquet"
        try:
            journals.mkdir(parents=True, exist_ok=True)
            self._lock = locked(self.folder / "lock")
            self.names = Table(names, NAME_COLUMNS, "name")
            self.zones = Table(self.folder / "zones.parquet", ZONE_COLUMNS, "zone")
            self.fixes = Intake(Journal(journals, "fixes"), fix_sink(self.folder), _fix_bytes, _fixes_in)
            self.events = Intake(Journal(journals, "events"), event_sink(self.folder), _event_bytes, _events_in)
        except BlockingIOError:
            raise SkylessError(f"{self.folder} is written by another program; each needs a folder of its own") from None
        except OSError as error:
            raise SkylessError(f"{error.filename or folder} cannot be written: {error.strerror}") from None
        except ValueError as error:
            raise SkylessError(f"{journals} is damaged, or of another version of Skyless: {error}") from None
        if self.fixes.sink.next > 1 and not self.names.rows:
            raise SkylessError(f"{names} is missing; it should be the table that tells whose the fixes are")

    def number(self, fix: FixMessage, unix_s: float) -> int | None:
        """The number of a fix's tag, which no other ever gets; None for a fix that is not kept, which is counted."""
        row = self.names.rows.get(fix.tag)
        if not 0.0 <= fix.unix_s <= MAX_UNIX_S:
            self.drops["wrong-time"] += 1
            return None
        if row is None and len(self.names.rows) >= MAX_TAGS:
            self.drops["too-many-tags"] += 1
            return None
        if row is None:
            newest = next(reversed(self.names.rows.values()), {"tag": 0})
            self.names.set(newest["tag"] + 1, fix.tag, round(1000 * unix_s))
            row = self.names.rows[fix.tag]
        return int(row["tag"])

    def set_zones(self, zones: Iterable[Zone]) -> None:
        """Keep zones; those that were removed stay, as events name them."""
        for zone in zones:
            self.zones.set(zone.id, zone.name, msgspec.json.encode(zone.polygon_m).decode())

    def past_events(self) -> Iterator[Event]:
        """The events of ``REMEMBERED_KINDS``, in order."""
        for file in current_events(self.root, self.site):
            for row in read_rows(file, EVENT_COLUMNS, [("kind", "in", REMEMBERED_KINDS)]):
                yield Event(*row.values())
        yield from chain.from_iterable(self.events.sink.unwritten)

    def store(self) -> None:
        """Bring all that was added into the journal. Raises OSError: what is not there waits."""
        for table in (self.names, self.zones):  # the journal uses the numbers
            table.save()
        for intake in (self.fixes, self.events):
            intake.store()

    def write(self) -> None:
        """Turn all rows of the journal into files. Raises OSError: the others stay in the journal."""
        for intake in (self.fixes, self.events):
            intake.begin()
            intake.write()

    def close(self) -> None:
        """Turn all rows into files, and let other programs write. Raises OSError."""
        try:
            self.store()
            self.write()
        finally:
            self._lock.close()


def read_rows(file: Path, columns: dict[str, str], filters: object = None) -> list[dict[str, Any]]:
    """The rows of a file, times in ms. Raises SkylessError: it cannot be read, or lacks a column."""
    table = read_table(file, filters=filters)
    if not set(columns) <= set(table.column_names):
        raise SkylessError(f"{file} has columns {', '.join(table.column_names)}; it should have {', '.join(columns)}")
    for name, kind in columns.items():
        if kind.startswith("timestamp"):
            table = table.set_column(table.column_names.index(name), name, table[name].cast(pa.int64()))
    return cast("list[dict[str, Any]]", table.select(list(columns)).to_pylist())


def _fix_bytes(records: Records, arrived_unix_s: float) -> bytes:
    return encode_batch(Batch(0, 0, round(1e6 * arrived_unix_s), 0, records))


def _fixes_in(payload: bytes) -> tuple[Records, float]:
    batch = decode_batch(payload)
    return batch.records, 1e-6 * batch.sent_unix_us


def _event_bytes(events: tuple[Event, ...], arrived_unix_s: float) -> bytes:
    return msgspec.json.encode((arrived_unix_s, events))


def _events_in(payload: bytes) -> tuple[tuple[Event, ...], float]:
    arrived_unix_s, events = msgspec.json.decode(payload, type=tuple[float, tuple[Event, ...]])
    return events, arrived_unix_s
