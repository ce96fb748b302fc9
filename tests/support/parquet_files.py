"""Parquet files as another program writes them: by PyArrow, with times in milliseconds, as before version 0.3."""

import pyarrow as pa

from skyless.run.history.layout import TIME

ARROW_TYPES = {
    "INTEGER": pa.int32(),
    "UINTEGER": pa.uint32(),
    "USMALLINT": pa.uint16(),
    "VARCHAR": pa.string(),
    TIME: pa.timestamp("ms", tz="UTC"),
}


def arrow_table(kinds, columns):
    """A table of columns by name, of the kinds of ``layout.py``; times are in ms."""
    return pa.table(
        {
            name: pa.array(columns[name], pa.int64() if kind == TIME else ARROW_TYPES[kind]).cast(ARROW_TYPES[kind])
            for name, kind in kinds.items()
        }
    )
