"""From numbered rows to Parquet files, wherever the rows come from: a journal, or a stream that numbers them.

A sink keeps in memory what it has been given since its last file. Its files tell where to go on: nothing up to ``last``
is to be given again, and everything after it is.
"""

import contextlib
import os
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import numpy as np
import pyarrow as pa
from msgspec import Struct
from pyarrow import parquet

from skyless.core.errors import SkylessError
from skyless.run.fix_batch import NONE_U16, Records
from skyless.run.history.layout import EVENT_COLUMNS, FIX_COLUMNS, EventKind, file_name, rows_of

FILE_S: Final = 600.0
FILE_ROWS: Final = 1_000_000
"""A file is written when its oldest row has waited for so long, or so many rows have come."""

_FIRST_FILE_S: Final = 30.0
"""The first file comes sooner, each later one after twice the time, so that a new history can soon be asked."""

MAX_ROWS: Final = 2 * FILE_ROWS
"""How many rows a sink takes while none can be written."""

ROW_GROUP: Final = 131_072
_TYPES: Final = {"timestamp[ms, tz=UTC]": pa.timestamp("ms", tz="UTC")}


class Event(Struct, frozen=True, array_like=True):
    """One row of the events, as ``EVENT_COLUMNS``."""

    unix_ms: int
    kind: EventKind
    tag: str | None
    zone: str | None
    subject: str | None
    alarm: str | None
    text: str


def schema_of(columns: dict[str, str]) -> pa.Schema:
    """The schema of columns as ``layout.py`` states them."""
    return pa.schema(
        [(name, _TYPES[kind] if kind in _TYPES else pa.type_for_alias(kind)) for name, kind in columns.items()]
    )


def fix_table(records: Records) -> pa.Table:
    """Columns of records (``run/fix_batch.py``), by tag and time.

    ``std_mm`` is the root of the covariance's trace, as ``FixMessage.std_m``; the correlation of x and y is not kept.
    """
    ms = (records["unix_us"] // np.uint64(1000)).astype(np.int64)
    order = np.lexsort((ms, records["tag"]))
    rows = records[order]
    up_mm = np.where(rows["std_z_mm"] == NONE_U16, 0, rows["std_z_mm"]).astype(np.float64)
    covariance = rows["covariance_m2"].astype(np.float64)
    std_mm = np.sqrt(np.maximum(covariance[:, 0], 0.0) * 1e6 + np.maximum(covariance[:, 2], 0.0) * 1e6 + up_mm**2)
    position = rows["position_mm"]
    columns = {
        "tag": rows["tag"],
        "t": ms[order],
        "x_mm": position[:, 0],
        "y_mm": position[:, 1],
        "z_mm": position[:, 2],
        "std_mm": np.nan_to_num(np.rint(std_mm), nan=NONE_U16).clip(0, NONE_U16).astype(np.uint16),
        "hpl_cm": rows["hpl_cm"],
        "flags": rows["flags"],
    }
    schema = schema_of(FIX_COLUMNS)
    arrays = [pa.array(np.ascontiguousarray(columns[field.name])).cast(field.type) for field in schema]
    return pa.Table.from_arrays(arrays, schema=schema)


def event_table(events: Sequence[Event]) -> pa.Table:
    """Columns of events, by time."""
    ordered = sorted(events, key=lambda event: event.unix_ms)
    values = [[getattr(event, name) for event in ordered] for name in Event.__struct_fields__]
    schema = schema_of(EVENT_COLUMNS)
    return pa.Table.from_arrays(
        [pa.array(column, field.type) for column, field in zip(values, schema, strict=True)], schema=schema
    )


def read_table(file: Path, columns: Sequence[str] | None = None, filters: object = None) -> pa.Table:
    """Rows of a file. Raises SkylessError: it cannot be read."""
    try:
        return parquet.read_table(file, columns=columns, filters=filters, partitioning=None)
    except (OSError, pa.ArrowException) as error:
        raise SkylessError(f"{file} cannot be read; it should be a Parquet file of the history: {error}") from None


def write_table(table: pa.Table, file: Path) -> None:
    """Write a file that readers find whole, on the disk and under its name, or not at all. Raises OSError."""
    scratch = scratch_of(file)
    numbers = [field.name for field in table.schema if not pa.types.is_string(field.type)]
    options: dict[str, Any] = {"use_dictionary": [field.name for field in table.schema if field.name not in numbers]}
    try:
        with scratch.open("wb") as out:
            parquet.write_table(
                table,
                out,
                row_group_size=ROW_GROUP,
                compression="zstd",
                compression_level=3,
                column_encoding=dict.fromkeys(numbers, "DELTA_BINARY_PACKED"),
                **options,
            )
            out.flush()
            os.fsync(out.fileno())
        scratch.replace(file)
    except BaseException:
        with contextlib.suppress(OSError):
            scratch.unlink()
        raise
    sync_folder(file.parent)


def scratch_of(file: Path) -> Path:
    """The name of a file while it is written; a program that was killed leaves it behind."""
    return file.with_name(f"{file.name}.tmp")


def sync_folder(folder: Path) -> None:
    """Wait until the names of its files are on the disk. Raises OSError."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


R = TypeVar("R", Records, tuple[Event, ...])


class _Batch(Struct, Generic[R]):
    first: int
    day: str
    arrived_unix_s: float
    rows: R


class Sink(Generic[R]):
    """Writes the rows of one kind. ``put`` and ``write`` may be called from two threads."""

    def __init__(self, site: Path, folder: str, table: Callable[[Sequence[R]], pa.Table]) -> None:
        """``folder`` is that of a file below the site's, in which ``{day}`` is the day of arrival. Raises OSError."""
        self._site, self._folder = site, folder
        self._table: Callable[[Sequence[R]], pa.Table] = table
        self._batches: list[_Batch[R]] = []
        self._taken = self._written = 0
        self._file_s = _FIRST_FILE_S
        pattern = f"{folder.format(day='*')}/*.parquet"
        for scratch in site.glob(f"{pattern}.tmp"):
            scratch.unlink()
        #: Number of the last row that is in a file.
        self.last = max((rows[1] for file in site.glob(pattern) if (rows := rows_of(file)) is not None), default=0)
        #: Number of the next row: rows before it are not taken again.
        self.next = self.last + 1

    @property
    def waiting(self) -> int:
        """How many rows are not in a file yet."""
        return self._taken - self._written

    @property
    def unwritten(self) -> list[R]:
        """The batches that are not in a file yet."""
        return [batch.rows for batch in self._batches]

    def is_due(self, unix_s: float) -> bool:
        """Whether a file should be written now."""
        age_s = abs(unix_s - self._batches[0].arrived_unix_s) if self._batches else 0.0  # a clock may be set back
        return age_s >= self._file_s or self.waiting >= FILE_ROWS

    def put(self, rows: R, first: int, arrived_unix_s: float) -> None:
        """Take a batch; ``first`` is the number of its first row."""
        rows, first = rows[max(0, self.next - first) :], max(first, self.next)
        if len(rows):
            day = datetime.fromtimestamp(arrived_unix_s, UTC).date().isoformat()
            self.next = first + len(rows)
            self._taken += len(rows)
            self._batches.append(_Batch(first, day, arrived_unix_s, rows))

    def write(self) -> None:
        """Write what waits at the beginning of this call. Raises OSError: what is not in a file still waits."""
        left = len(self._batches)
        self._file_s = min(2.0 * self._file_s, FILE_S)
        while left:
            group = self._group(left)
            last = group[-1].first + len(group[-1].rows) - 1
            folder = self._site / self._folder.format(day=group[0].day)
            folder.mkdir(parents=True, exist_ok=True)
            write_table(self._table([batch.rows for batch in group]), folder / file_name(group[0].first, last))
            del self._batches[: len(group)]
            self.last, left = last, left - len(group)
            self._written += sum(len(batch.rows) for batch in group)

    def _group(self, most: int) -> list[_Batch[R]]:
        """The batches of the next file: they came on one day."""
        rows, end = 0, 0
        for batch in self._batches[:most]:
            rows += len(batch.rows)
            if end and (rows > FILE_ROWS or batch.day != self._batches[0].day):
                break
            end += 1
        return self._batches[:end]


def fix_sink(site: Path) -> Sink[Records]:
    """The sink of a site's fixes. Raises OSError."""
    return Sink(site, "day={day}", lambda batches: fix_table(np.concatenate(batches)))


def event_sink(site: Path) -> Sink[tuple[Event, ...]]:
    """The sink of a site's events. Raises OSError."""
    return Sink(site, "events", lambda batches: event_table(tuple(chain.from_iterable(batches))))
