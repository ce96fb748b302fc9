"""What a history does once a day: join small files, thin what is old, remove what is too old.

Readers take no row twice and miss none, whenever the program is killed: a joined file has a name that covers those of
the files that it replaces, so that these are no longer current (``layout.py``); a thinned file takes the place of the
whole one in one step.
"""

import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, date, datetime
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from msgspec import Struct
from numpy.typing import NDArray
from pyarrow import parquet

from skyless.run.history.layout import (
    EVENT_COLUMNS,
    FIX_COLUMNS,
    THINNED,
    day_of,
    file_name,
    largest_files,
    rows_of,
    site_folder,
)
from skyless.run.history.tables import read_table, write_table

_JOINED_ROWS: Final = 2_000_000
"""Rows of a joined file: what fits into memory several times."""

_MOVING_MS: Final = 10_000
_REST_MS: Final = 60_000
_REST_MM: Final = 500
"""A tag is at rest in a minute in which no coordinate changes by more."""


class Keep(Struct, frozen=True):
    """For how many days what is kept."""

    days: float = 400.0
    full_days: float = 7.0
    """From then on, fixes are thinned."""
    event_days: float = 365.0


def tidy(root: Path, site: int, keep: Keep, unix_s: float) -> None:
    """Do what is due in a site's folder. Raises OSError or SkylessError; what has been done by then stays so."""
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
    """Files with consecutive numbers, and their first and last number: those of one group are to be joined."""
    group, first, last = list[Path](), 0, 0
    for file in files:
        begin, end = rows_of(file) or (0, 0)
        if group and (begin != last + 1 or end - first >= _JOINED_ROWS):
            yield group, first, last
            group = []
        group, first, last = [*group, file], first if group else begin, end
    yield group, first, last


def thinned(table: pa.Table) -> pa.Table:
    """Of a moving tag one fix in ten seconds, of one at rest one in a minute. The table is sorted by tag and time."""
    tag, ms = table["tag"].to_numpy(), table["t"].cast(pa.int64()).to_numpy()
    is_minute, is_step = (_begins(tag, ms // length_ms) for length_ms in (_REST_MS, _MOVING_MS))
    first = np.flatnonzero(is_minute)
    places = [table[name].to_numpy().astype(np.int64) for name in ("x_mm", "y_mm", "z_mm")]
    extents = [np.maximum.reduceat(place, first) - np.minimum.reduceat(place, first) for place in places]
    moves = np.repeat(np.max(extents, axis=0) > _REST_MM, np.diff(np.append(first, len(tag))))
    kept = table.filter(pa.array(is_minute | (moves & is_step)))
    return kept.replace_schema_metadata({THINNED: b"yes"})


def _begins(tag: NDArray[Any], part: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether another tag or another part of its time begins at a row."""
    return np.append(True, (np.diff(tag) != 0) | (np.diff(part) != 0))


def _remove(files: Iterable[Path]) -> None:
    for file in files:
        file.unlink()
        with contextlib.suppress(OSError):  # other files are there
            file.parent.rmdir()
