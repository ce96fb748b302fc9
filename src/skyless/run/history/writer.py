"""Write one site's history: rows wait in memory until they are a Parquet file, with their place in the site's stream.

The stream still has what is in no file, so no row is lost or written twice if a program is killed: a file appears
whole, and its metadata say where the next start goes on. Rows are numbered. Only one process at a time writes a site.
"""

import contextlib
import errno
import math
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, date, datetime
from itertools import chain, groupby
from pathlib import Path
from threading import Lock
from typing import Any, Final, Literal

import duckdb
import msgspec
import numpy as np
from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.run.fix_batch import Records
from skyless.run.history.layout import (
    ASSET_COLUMNS,
    EVENT_COLUMNS,
    FIX_COLUMNS,
    NAME_COLUMNS,
    PLACE,
    THINNED,
    ZONE_COLUMNS,
    Place,
    day_of,
    file_name,
    largest_files,
    rows_of,
    site_folder,
)
from skyless.run.history.tables import (
    Columns,
    Event,
    check_readable,
    columns_of,
    event_columns,
    first_line,
    fix_columns,
    metadata_of,
    pattern,
    place_in,
    quoted,
    read_rows,
    write_answer,
    write_table,
)
from skyless.run.mqtt.messages import Asset, FixMessage, Zone
from skyless.run.process import locked
from skyless.run.web import HISTORY as LIMITS

FILE_ROWS: Final = 500_000
"""Approximate number of rows in a file, which ends before the batch that would exceed it."""
_ROW_BYTES: Final = 32
"""More than a row takes in a file."""
_ROOM_BYTES: Final = 1_000_000
"""What the disk should have free besides the rows that wait."""


class Intake:
    """Rows of one kind, waiting for a file. ``write`` may be called from another thread than ``add``."""

    def __init__(self, folder: Path, kinds: Mapping[str, str], table: Callable[[Sequence[Any]], Columns]) -> None:
        """``table`` makes columns of ``kinds`` of batches of rows.

        Raises SkylessError if the newest file cannot be read.
        """
        self.taken = 0
        """Rows taken since the start."""
        self._folder, self._kinds, self._table = folder, kinds, table
        self._batches: list[tuple[Records | Sequence[Event], float, Place]] = []
        files = largest_files(folder)
        first = self.last = (rows_of(files[-1]) or (0, 0))[1] if files else 0
        """Number of the last row in a file."""
        self.place = place_in(files[-1]) if files else Place()
        """Place in the stream up to which everything was taken. It is set before the rows of a message are added."""
        self._first = first

    def add(self, rows: Records | Sequence[Event], arrived_unix_s: float) -> None:
        """Take the rows of the message at ``place``."""
        if len(rows):
            self.taken += len(rows)
            self._batches.append((rows, arrived_unix_s, self.place))

    @property
    def waiting(self) -> int:
        """Rows not in a file yet."""
        return self._first + self.taken - self.last

    @property
    def batches(self) -> int:
        """Number of batches that wait."""
        return len(self._batches)

    def write(self, batches: int) -> None:
        """Write the first ``batches`` that wait to files. Raises OSError: the rest waits."""
        while batches > 0:
            day, rows, place = self._next_file(batches)
            last = self.last + sum(map(len, rows))
            file = self._folder / f"day={day}" / file_name(self.last + 1, last)
            write_table(self._table(rows), self._kinds, file, {PLACE: msgspec.json.encode(place).decode()})
            self.last = last
            del self._batches[: len(rows)]
            batches -= len(rows)

    def _next_file(self, most: int) -> tuple[str, list[Records | Sequence[Event]], Place]:
        """Return day, batches (at most ``most``) and place of the next file; its rows arrived on one day."""
        day, found, count, place = "", list[Records | Sequence[Event]](), 0, Place()
        for rows, unix_s, at in self._batches[:most]:
            of_day = datetime.fromtimestamp(unix_s, UTC).date().isoformat()
            if found and (of_day != day or count + len(rows) > FILE_ROWS):
                break
            day, place, count = of_day, at, count + len(rows)
            found.append(rows)
        return day, found, place


class Table:
    """A small table written as a whole, such as the names of tags; rows are never removed."""

    def __init__(self, file: Path, columns: dict[str, str], key: str) -> None:
        """Raises SkylessError if the file is damaged."""
        self.rows: dict[str, dict[str, Any]] = {}
        """Rows by the value of the column ``key``."""
        self._file, self._columns, self._key, self._is_saved = file, columns, key, True
        if file.exists():
            self.rows = {row[key]: row for row in read_rows(file, columns)}

    def set(self, *values: object) -> None:
        """Add or replace a row; the values are in the order of the columns."""
        row: dict[str, Any] = dict(zip(self._columns, values, strict=True))
        is_known = self.rows.get(row[self._key]) == row
        self.rows[row[self._key]] = row
        self._is_saved = self._is_saved and is_known

    def save(self) -> None:
        """Write the table if it has changed, perhaps in another thread than that of ``set``. Raises OSError."""
        if not self._is_saved:
            self._is_saved = True  # before the rows are read: one that is set meanwhile is written the next time
            try:
                write_table(columns_of([*self.rows.values()], self._columns), self._columns, self._file)
            except BaseException:
                self._is_saved = False
                raise


class Writer:
    """Writes the history of one site."""

    def __init__(self, folder: Path, site: int, source: Literal["site", "hub"] = "site") -> None:
        """``source`` says at whose server the streams are; a history from the other's is refused.

        Raises SkylessError: the history cannot be written, is being written by another program, is damaged, or has rows
        from elsewhere.
        """
        self.root, self.site, self.folder, self.source = folder, site, site_folder(folder, site), source
        self.drops: Counter[str] = Counter()
        """Messages that were not kept, by reason."""
        self._writing = Lock()  # a thread may still be at work when the program ends
        names, journal = self.folder / "names.parquet", self.folder / "journal.sqlite"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = locked(self.folder / "lock")
            for scratch in chain(self.folder.glob("*.tmp"), self.folder.glob("**/day=*/*.tmp")):
                scratch.unlink()
            self.names = Table(names, NAME_COLUMNS, "name")
            self.assets = Table(self.folder / "assets.parquet", ASSET_COLUMNS, "tag")
            self.zones = Table(self.folder / "zones.parquet", ZONE_COLUMNS, "zone")
            self.fixes = Intake(self.folder, FIX_COLUMNS, lambda batches: fix_columns(np.concatenate(batches)))
            self.events = Intake(
                self.folder / "events", EVENT_COLUMNS, lambda batches: event_columns([*chain.from_iterable(batches)])
            )
        except BlockingIOError:
            raise SkylessError(f"{self.folder} is written by another program; each needs a folder of its own") from None
        except OSError as error:
            raise SkylessError(f"{error.filename or folder} cannot be written: {error.strerror}") from None
        fault, kept = "", self.fixes.place.stream.partition(" ")[0] or "site"
        if journal.exists():
            fault = (
                f"{journal} may have rows that are in no Parquet file; end skyless history run of the version that "
                "wrote it with Ctrl-C, which writes them, and remove the file"
            )
        elif self.fixes.last and not self.names.rows:
            fault = f"{names} is missing; it should be the table that tells whose the fixes are"
        elif self.fixes.last and kept != source:
            fault = (
                f"{self.folder} was kept from the streams of a {kept}, not of a {source}; it should be another folder"
            )
        if fault:
            self._lock.close()
            raise SkylessError(fault)

    @property
    def waiting(self) -> int:
        """Rows that are not in a file yet."""
        return self.fixes.waiting + self.events.waiting

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
            self.names.set(newest["tag"] + 1, name, round(1000 * unix_s))
        return int(self.names.rows[name]["tag"])

    def set_zones(self, zones: Iterable[Zone]) -> None:
        """Keep zones; removed ones stay, because events refer to them."""
        for zone in zones:
            self.zones.set(zone.id, zone.name, msgspec.json.encode(zone.polygon_m).decode())

    def set_assets(self, assets: Iterable[Asset]) -> None:
        """Keep the asset names of tags; a tag that no longer has an asset gets an empty name."""
        for tag, name in (dict.fromkeys(self.assets.rows, "") | {one.tag: one.name for one in assets}).items():
            self.assets.set(tag, name)

    def check(self) -> None:
        """Try whether the rows that wait could be written now. Raises OSError."""
        if shutil.disk_usage(self.folder).free < _ROOM_BYTES + _ROW_BYTES * self.waiting:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.folder))
        scratch = self.folder / "check.tmp"
        scratch.write_bytes(b"skyless")
        scratch.unlink()

    def write(self) -> None:
        """Write all rows to files. Raises OSError: the rest waits."""
        with self._writing:
            fixes, events = self.fixes.batches, self.events.batches
            for table in (self.names, self.assets, self.zones):  # first: the fixes refer to the tags' numbers
                table.save()
            self.fixes.write(fixes)
            self.events.write(events)

    def close(self) -> None:
        """Write all rows to files, and unlock the history. Raises OSError."""
        try:
            self.write()
        finally:
            self._lock.close()


# Daily maintenance: join small files, thin old ones, remove those that are too old. It is safe against kills: a joined
# file's name covers the files that it replaces (``layout.py``), and a thinned file replaces the original atomically.

JOINED_ROWS: Final = 2_000_000
"""Rows of a joined file: its columns fit into memory."""

THINNING: Final = """
    SELECT {columns} FROM ({rows})
    WINDOW minute AS (PARTITION BY tag, epoch_ms(t) // 60000),
        step AS (PARTITION BY tag, epoch_ms(t) // 10000 ORDER BY t)
    QUALIFY row_number() OVER step = 1 AND (t = min(t) OVER minute OR greatest(
        max(x_mm::BIGINT) OVER minute - min(x_mm) OVER minute, max(y_mm::BIGINT) OVER minute - min(y_mm) OVER minute,
        max(z_mm::BIGINT) OVER minute - min(z_mm) OVER minute) > 500)
"""
"""A tag is at rest in a minute in which no coordinate changes by more than 0.5 m. Of such a minute one fix is kept,
otherwise one of every ten seconds."""


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
    names, order_by = ", ".join(columns), ", ".join(order)
    current = largest_files(folder)
    newest = current[-1] if current else None
    _remove(file for file in folder.glob("day=*/*.parquet") if rows_of(file) and file not in current)
    for day, of_day in groupby(current, day_of):
        age_days = (datetime.fromtimestamp(unix_s, UTC).date() - date.fromisoformat(day)).days
        if age_days > days:
            _remove(file for file in of_day if file != newest)
            if newest and day == day_of(newest):  # it has the place
                _rewrite([newest], newest, columns, f"SELECT {names} FROM {_rows_in([newest])} LIMIT 0", {})
            continue
        for files, first, last in _groups(of_day) if age_days > 0 else ():
            is_thinned = age_days <= full_days or all(THINNED in metadata_of(file) for file in files)
            if is_thinned and len(files) == 1:
                continue
            select, more = f"SELECT {names} FROM {_rows_in(files)}", dict[str, str]()
            if age_days > full_days:
                select, more = THINNING.format(columns=names, rows=select), {THINNED: "yes"}
            joined = files[0].with_name(file_name(first, last))
            _rewrite(files, joined, columns, f"{select} ORDER BY {order_by}", more)
            _remove(file for file in files if file != joined)


def _rewrite(files: Sequence[Path], to: Path, kinds: Mapping[str, str], query: str, more: Mapping[str, str]) -> None:
    """Write what a query makes of files, with the metadata of the last one and ``more``.

    Raises OSError; SkylessError, which names the file that cannot be read.
    """
    try:
        write_answer(query, to, metadata_of(files[-1]) | dict(more))
    except duckdb.Error as error:
        for file in files:
            check_readable(file, kinds)
        raise SkylessError(f"{to} cannot be made of {files[0]} and others: {first_line(error)}") from None


def _rows_in(files: Iterable[Path]) -> str:
    return f"read_parquet([{', '.join(quoted(pattern(file)) for file in files)}], hive_partitioning = false)"


def _groups(files: Iterable[Path]) -> Iterator[tuple[list[Path], int, int]]:
    """Group files with consecutive numbers that are to be joined, with their first and last number."""
    group, first, last = list[Path](), 0, 0
    for file in files:
        begin, end = rows_of(file) or (0, 0)
        if group and (begin != last + 1 or end - first >= JOINED_ROWS):
            yield group, first, last
            group = []
        group, first, last = [*group, file], first if group else begin, end
    yield group, first, last


def _remove(files: Iterable[Path]) -> None:
    for file in files:
        file.unlink()
        with contextlib.suppress(OSError):  # not empty
            file.parent.rmdir()
