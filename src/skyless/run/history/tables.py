"""The history's rows as tables, and its files, which are read and written as a whole."""

import contextlib
import os
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
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
from skyless.run.history.layout import EVENT_COLUMNS, FIX_COLUMNS, EventKind

ROW_GROUP: Final = 131_072
_TIME: Final = pa.timestamp("ms", tz="UTC")


class Event(Struct, frozen=True):
    """One row of the events, as ``EVENT_COLUMNS``."""

    t: datetime
    kind: EventKind
    tag: str | None = None
    zone: str | None = None
    subject: str | None = None
    alarm: str | None = None
    text: str = ""


def schema_of(columns: dict[str, str]) -> pa.Schema:
    """The schema of columns as ``layout.py`` states them."""
    return pa.schema(
        [(name, _TIME if kind.startswith("timestamp") else pa.type_for_alias(kind)) for name, kind in columns.items()]
    )


def fix_table(records: Records) -> pa.Table:
    """Columns of records (``run/fix_batch.py``), by tag and time.

    ``std_mm`` is the root of the covariance's trace, as ``FixMessage.std_m``; the correlation of x and y is not kept.
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
    """Columns of events, by time."""
    rows = [msgspec.structs.asdict(event) for event in sorted(events, key=lambda event: event.t)]
    return pa.Table.from_pylist(rows, schema_of(EVENT_COLUMNS))


def read_table(file: Path, columns: dict[str, str], wanted: pc.Expression | None = None) -> pa.Table:
    """Columns of the wanted rows of a file. Raises SkylessError: it cannot be read, or lacks one."""
    try:
        table = parquet.ParquetFile(file).read(columns=list(columns)).cast(schema_of(columns))
        table.validate(full=True)  # texts are UTF-8
    except (OSError, ValueError, pa.ArrowException) as error:
        should = f"it should be a Parquet file with {', '.join(columns)}"
        raise SkylessError(f"{file} cannot be read; {should}: {error}") from None
    return table if wanted is None else table.filter(wanted)


def read_events(files: Iterable[Path], wanted: pc.Expression) -> Iterator[Event]:
    """The wanted events in files, in order. Raises SkylessError."""
    for file in files:
        yield from (Event(**row) for row in read_table(file, EVENT_COLUMNS, wanted).to_pylist())


def write_table(table: pa.Table, file: Path) -> None:
    """Write a file that readers find whole, on the disk and under its name, or not at all. Raises OSError.

    A program that was killed meanwhile leaves a file of the same name with ``.tmp``.
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
    handle = os.open(file.parent, os.O_RDONLY)  # its name, too, is to be on the disk
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
