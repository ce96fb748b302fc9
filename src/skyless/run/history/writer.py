"""Write one site's history: rows wait in memory, then in a journal (SQLite), and end in Parquet.

Rows are numbered. A row whose number is within a file's name is in Parquet, whatever the journal says, so no row is
lost or written twice if a program is killed. Only one process at a time writes a site.
"""

import contextlib
import errno
import math
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC, date, datetime
from itertools import chain, groupby
from pathlib import Path
from threading import Lock
from typing import Any, Final

import msgspec
import numpy as np
import pyarrow as pa
from msgspec import Struct
from numpy.typing import NDArray
from pyarrow import parquet

from skyless.core.errors import SkylessError
from skyless.run.fix_batch import RECORD, Records
from skyless.run.history.layout import (
    ASSET_COLUMNS,
    EVENT_COLUMNS,
    FIX_COLUMNS,
    NAME_COLUMNS,
    THINNED,
    ZONE_COLUMNS,
    day_of,
    file_name,
    largest_files,
    rows_of,
    site_folder,
)
from skyless.run.history.tables import Event, event_table, fix_table, read_table, schema_of, write_table
from skyless.run.mqtt.messages import Asset, FixMessage, Zone
from skyless.run.process import locked
from skyless.run.web import HISTORY as LIMITS

FILE_ROWS: Final = 1_000_000
"""Approximate number of rows in a file, which ends before the batch that would exceed it."""


class Intake:
    """Rows of one kind. ``write`` may be called from another thread than the other methods."""

    def __init__(
        self,
        journal: "Journal",
        kind: str,
        folder: Path,
        encode: Callable[[Any], bytes],
        table: Callable[[Sequence[bytes]], pa.Table],
        source: str,
    ) -> None:
        self.lost = 0
        """Rows dropped because the disk was too slow."""
        self.taken = 0
        """Rows taken since the start."""
        self._journal, self._kind, self._folder, self._place = journal, kind, folder, source + kind
        self._encode, self._table = encode, table
        self._batches: list[tuple[Records | Sequence[Event], float]] = []
        self.position = 0
        """Place of the newest rows in the source, if it has places."""
        files = [rows for file in largest_files(folder) if (rows := rows_of(file))]
        self.last = max((last for _, last in files), default=0)
        """Number of the last row in a file."""
        with journal.transaction() as sql:
            sql.execute(f"CREATE TABLE IF NOT EXISTS {kind} (first INTEGER PRIMARY KEY, rows, unix_s, data)")
            (end,) = sql.execute(f"SELECT max(first + rows) FROM {kind}").fetchone()
            sql.execute("CREATE TABLE IF NOT EXISTS positions (kind PRIMARY KEY, position)")
            for (position,) in sql.execute("SELECT position FROM positions WHERE kind = ?", (self._place,)):
                self.position = position
        self.next = max(self.last + 1, end or 1)
        """Number of the next row to enter the journal."""

    def add(self, rows: Records | Sequence[Event], arrived_unix_s: float, position: int = 0) -> None:
        """Take rows. ``store`` moves them to the journal, together with their place in the source."""
        if len(rows):
            self._batches.append((rows, arrived_unix_s))
        self.taken += len(rows)
        self.position = position

    @property
    def waiting(self) -> int:
        """Rows not in the journal yet."""
        return sum(len(rows) for rows, _ in self._batches)

    def store(self) -> None:
        """Move all waiting rows to the journal.

        Raises OSError: none is stored, and the oldest beyond the limit are dropped.
        """
        number, values = self.next, []
        for rows, unix_s in self._batches:
            values.append((number, len(rows), unix_s, self._encode(rows)))
            number += len(rows)
        if not values:
            return
        try:
            with self._journal.transaction() as sql:
                sql.executemany(f"INSERT INTO {self._kind} VALUES (?, ?, ?, ?)", values)
                sql.execute("INSERT OR REPLACE INTO positions VALUES (?, ?)", (self._place, self.position))
        except OSError:
            while self.waiting > LIMITS.waiting_rows:
                self.lost += len(self._batches.pop(0)[0])
            raise
        self._batches.clear()
        self.next = number

    def write(self) -> None:
        """Move the rows now in the journal to files. Raises OSError: the rest stays."""
        end = self.next
        while self.last + 1 < end:
            day, last, batches = self._next_file(end)
            if batches:
                write_table(self._table(batches), self._folder / f"day={day}" / file_name(self.last + 1, last))
            self.last = last
            with self._journal.transaction() as sql:
                sql.execute(f"DELETE FROM {self._kind} WHERE first <= ?", (last,))

    def _next_file(self, end: int) -> tuple[str, int, list[bytes]]:
        """Return day, last row and rows of the next file; its rows arrived on one day."""
        day, last, batches = "", self.last, list[bytes]()
        query = f"SELECT first, rows, unix_s, data FROM {self._kind} WHERE first > ? AND first < ? ORDER BY first"
        with self._journal.transaction() as sql:
            for first, rows, unix_s, data in sql.execute(query, (self.last, end)):
                of_day = datetime.fromtimestamp(unix_s, UTC).date().isoformat()
                if batches and (of_day != day or first + rows - self.last - 1 > FILE_ROWS):
                    break
                day, last = of_day, first + rows - 1
                batches.append(data)
        return day, last if batches else end - 1, batches


class Journal:
    """An SQLite file. Committed data survive the program, and after ``sync`` a power cut."""

    def __init__(self, file: Path) -> None:
        """Raises OSError."""
        self._file, self._lock = file, Lock()
        with self._errors():
            self._sql = sqlite3.connect(file, check_same_thread=False)
            self._sql.execute("PRAGMA locking_mode = EXCLUSIVE")  # no shared memory, which network disks lack
            self._sql.execute("PRAGMA journal_mode = WAL")
            self._sql.execute("PRAGMA synchronous = NORMAL")

    @contextlib.contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Commit a block, or roll it back if it fails. Raises OSError."""
        with self._lock, self._errors(), self._sql:
            yield self._sql

    def sync(self) -> None:
        """Wait until all committed data are on the disk. Raises OSError."""
        with self._lock, self._errors():
            self._sql.execute("PRAGMA wal_checkpoint").fetchall()

    def close(self) -> None:
        """Close the file, so that other programs can open it."""
        with self._lock:
            self._sql.close()

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise OSError(errno.EIO, str(error), str(self._file)) from None


class Table:
    """A small table written as a whole, such as the names of tags; rows are never removed."""

    def __init__(self, file: Path, columns: dict[str, str], key: str) -> None:
        """Raises SkylessError if the file is damaged."""
        self.rows: dict[str, dict[str, Any]] = {}
        """Rows by the value of the column ``key``."""
        self._file, self._columns, self._key, self._is_saved = file, columns, key, True
        if file.exists():
            self.rows = {row[key]: row for row in read_table(file, columns).to_pylist()}

    def set(self, *values: object) -> None:
        """Add or replace a row; the values are in the order of the columns."""
        row: dict[str, Any] = dict(zip(self._columns, values, strict=True))
        self._is_saved = self._is_saved and self.rows.get(row[self._key]) == row
        self.rows[row[self._key]] = row

    def save(self) -> None:
        """Write the table if it has changed. Raises OSError."""
        if not self._is_saved:
            write_table(pa.Table.from_pylist([*self.rows.values()], schema_of(self._columns)), self._file)
            self._is_saved = True


class Writer:
    """Writes the history of one site."""

    def __init__(self, folder: Path, site: int, source: str = "") -> None:
        """``source`` names streams whose places are stored; a history of another source is refused.

        Raises SkylessError: the history cannot be written, is being written by another program, is damaged, or has rows
        from elsewhere.
        """
        self.root, self.site, self.folder = folder, site, site_folder(folder, site)
        self.drops: Counter[str] = Counter()
        """Messages that were not kept, by reason."""
        self._writing = Lock()  # a thread may still be at work when the program ends
        names = self.folder / "names.parquet"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = locked(self.folder / "lock")
            for scratch in self.folder.rglob("*.tmp"):
                scratch.unlink()
            self.names = Table(names, NAME_COLUMNS, "name")
            self.assets = Table(self.folder / "assets.parquet", ASSET_COLUMNS, "tag")
            self.zones = Table(self.folder / "zones.parquet", ZONE_COLUMNS, "zone")
            self.journal = Journal(self.folder / "journal.sqlite")
            self.fixes = Intake(self.journal, "fixes", self.folder, np.ndarray.tobytes, _fixes_in, source)
            events = self.folder / "events"
            self.events = Intake(self.journal, "events", events, msgspec.json.encode, _events_in, source)
        except BlockingIOError:
            raise SkylessError(f"{self.folder} is written by another program; each needs a folder of its own") from None
        except OSError as error:
            raise SkylessError(f"{error.filename or folder} cannot be written: {error.strerror}") from None
        fault = ""
        if not self.names.rows:
            fault = f"{names} is missing; it should be the table that tells whose the fixes are"
        elif source and not self.fixes.position:
            fault = f"{self.folder} has fixes that are not from the site's stream at a hub; it should be another folder"
        if fault and self.fixes.next > 1:
            self.journal.close()
            raise SkylessError(fault)

    @property
    def unwritten(self) -> int:
        """Rows in the journal that are not in a file yet."""
        return sum(intake.next - 1 - intake.last for intake in (self.fixes, self.events))

    def number(self, fix: FixMessage, unix_s: float) -> int | None:
        """Return the number of a fix's tag; None for a fix not to be kept, which is counted in ``drops``."""
        if not LIMITS.first_unix_s <= fix.unix_s <= LIMITS.last_unix_s:
            self.drops["wrong-time"] += 1
            return None
        return self.tag_number(fix.tag, unix_s)

    def tag_number(self, name: str, unix_s: float) -> int | None:
        """Return the unique number of a tag; None if there are too many tags, which is counted in ``drops``."""
        if name not in self.names.rows:
            if len(self.names.rows) >= LIMITS.tags:
                self.drops["too-many-tags"] += 1
                return None
            newest = next(reversed(self.names.rows.values()), {"tag": 0})
            self.names.set(newest["tag"] + 1, name, datetime.fromtimestamp(unix_s, UTC))
        return int(self.names.rows[name]["tag"])

    def set_zones(self, zones: Iterable[Zone]) -> None:
        """Keep zones; removed ones stay, because events refer to them."""
        for zone in zones:
            self.zones.set(zone.id, zone.name, msgspec.json.encode(zone.polygon_m).decode())

    def set_assets(self, assets: Iterable[Asset]) -> None:
        """Keep the asset names of tags; a tag that no longer has an asset gets an empty name."""
        for tag, name in (dict.fromkeys(self.assets.rows, "") | {one.tag: one.name for one in assets}).items():
            self.assets.set(tag, name)

    def store(self) -> None:
        """Move everything added to the journal. Raises OSError: the rest waits."""
        for table in (self.names, self.assets, self.zones):  # first: the journal refers to the tags' numbers
            table.save()
        self.fixes.store()
        self.events.store()

    def write(self) -> None:
        """Write all rows of the journal to files. Raises OSError: the rest stays in the journal."""
        with self._writing:
            self.fixes.write()
            self.events.write()

    def close(self) -> None:
        """Write all rows to files, and unlock the history. Raises OSError."""
        with contextlib.ExitStack() as stack:  # in reverse order, each even if another fails
            stack.callback(self._lock.close)
            stack.callback(self.journal.close)
            stack.callback(self.write)
            self.store()


def _fixes_in(batches: Sequence[bytes]) -> pa.Table:
    return fix_table(np.frombuffer(b"".join(batches), RECORD))


def _events_in(batches: Sequence[bytes]) -> pa.Table:
    found = (msgspec.json.decode(data, type=list[Event]) for data in batches)
    return event_table(tuple(chain.from_iterable(found)))


# Daily maintenance: join small files, thin old ones, remove those that are too old. It is safe against kills: a joined
# file's name covers the files that it replaces (``layout.py``), and a thinned file replaces the original atomically.

_JOINED_ROWS: Final = 2_000_000
"""Rows of a joined file: it must fit into memory several times."""

_MOVING_MS: Final = 10_000
_REST_MS: Final = 60_000
_REST_MM: Final = 500
"""A tag is at rest in a minute in which no coordinate changes by more than this."""


class Keep(Struct, frozen=True):
    """For how many days fixes and events are kept."""

    days: float = 400.0
    full_days: float = 7.0
    """Fixes older than this are thinned."""
    event_days: float = 365.0


def tidy(root: Path, site: int, keep: Keep, unix_s: float) -> None:
    """Do the maintenance that is due in a site's folder. Raises OSError or SkylessError; completed steps stay."""
    folder = site_folder(root, site)
    _tidy(folder, FIX_COLUMNS, ("tag", "t"), keep.days, keep.full_days, unix_s)
    _tidy(folder / "events", EVENT_COLUMNS, ("t",), keep.event_days, math.inf, unix_s)


def _tidy(
    folder: Path, columns: dict[str, str], order: Sequence[str], days: float, full_days: float, unix_s: float
) -> None:
    current = largest_files(folder)
    _remove(file for file in folder.glob("day=*/*.parquet") if rows_of(file) and file not in current)
    for day, of_day in groupby(current, day_of):
        age_days = (datetime.fromtimestamp(unix_s, UTC).date() - date.fromisoformat(day)).days
        if age_days > days:
            _remove(of_day)
            continue
        for files, first, last in _groups(of_day) if age_days > 0 else ():
            is_thinned = age_days <= full_days or all(
                THINNED in (parquet.read_schema(file).metadata or {}) for file in files
            )
            if is_thinned and len(files) == 1:
                continue
            table = pa.concat_tables([read_table(file, columns) for file in files])
            table = table.sort_by([(name, "ascending") for name in order])
            joined = files[0].with_name(file_name(first, last))
            write_table(thinned(table) if age_days > full_days else table, joined)
            _remove(file for file in files if file != joined)


def _groups(files: Iterable[Path]) -> Iterator[tuple[list[Path], int, int]]:
    """Group files with consecutive numbers that are to be joined, with their first and last number."""
    group, first, last = list[Path](), 0, 0
    for file in files:
        begin, end = rows_of(file) or (0, 0)
        if group and (begin != last + 1 or end - first >= _JOINED_ROWS):
            yield group, first, last
            group = []
        group, first, last = [*group, file], first if group else begin, end
    yield group, first, last


def thinned(table: pa.Table) -> pa.Table:
    """Keep one fix per ten seconds of a moving tag, one per minute of one at rest.

    The table is sorted by tag and time.
    """
    tag, ms = table["tag"].to_numpy(), table["t"].cast(pa.int64()).to_numpy()
    is_minute, is_step = (_begins(tag, ms // length_ms) for length_ms in (_REST_MS, _MOVING_MS))
    first = np.flatnonzero(is_minute)
    places = [table[name].to_numpy().astype(np.int64) for name in ("x_mm", "y_mm", "z_mm")]
    extents = [np.maximum.reduceat(place, first) - np.minimum.reduceat(place, first) for place in places]
    moves = np.repeat(np.max(extents, axis=0) > _REST_MM, np.diff(np.append(first, len(tag))))
    kept = table.filter(pa.array(is_minute | (moves & is_step)))
    return kept.replace_schema_metadata({THINNED: b"yes"})


def _begins(tag: NDArray[Any], part: NDArray[Any]) -> NDArray[np.bool_]:
    """Mark the rows where the tag, or the part of its time, differs from the row before."""
    return np.append(True, (np.diff(tag) != 0) | (np.diff(part) != 0))


def _remove(files: Iterable[Path]) -> None:
    for file in files:
        file.unlink()
        with contextlib.suppress(OSError):  # not empty
            file.parent.rmdir()
