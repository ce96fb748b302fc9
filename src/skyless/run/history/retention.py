"""What a history does once a day: join small files, thin what is old, remove what is too old.

Readers take no row twice and miss none, whenever the program is killed: a joined file has a name that covers those of
the files that it replaces, so that these are no longer current (``layout.py``), and they are removed later; a thinned
file takes the place of the whole one in one step.
"""

import contextlib
import os
from collections.abc import Sequence
from datetime import UTC, date, datetime
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from msgspec import Struct
from numpy.typing import NDArray
from pyarrow import compute, parquet

from skyless.run.history.layout import THINNED, current_events, current_files, file_name, rows_of, site_folder
from skyless.run.history.sink import read_table, write_table

GRACE_S: Final = 60.0
"""A file that was replaced is kept for so long, for readers that have it in their lists."""

_JOINED_ROWS: Final = 2_000_000
"""Rows of a joined file: what fits into memory several times."""

_DAY_MS: Final = 86_400_000
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
    remove_replaced(root, site, unix_s)
    today = datetime.fromtimestamp(unix_s, UTC).date()
    for day, found in groupby(current_files(root, site), lambda file: file.parent.name.removeprefix("day=")):
        files, age_days = list(found), (today - date.fromisoformat(day)).days
        if age_days > keep.days:
            _remove(files)
        elif age_days > 0:
            for file in _joined(files, ("tag", "t")):
                if age_days > keep.full_days and not _is_thinned(file):
                    write_table(thinned(read_table(file)), file)
    ends_ms = {file: _newest_ms(file) for file in current_events(root, site)}
    now_ms = 1000.0 * unix_s
    _remove([file for file, end_ms in ends_ms.items() if now_ms - end_ms > _DAY_MS * keep.event_days])
    whole = [file for file, end_ms in ends_ms.items() if _DAY_MS < now_ms - end_ms <= _DAY_MS * keep.event_days]
    for _, found in groupby(whole, lambda file: datetime.fromtimestamp(ends_ms[file] / 1000.0, UTC).timetuple()[:2]):
        _joined(list(found), ("t",))


def remove_replaced(root: Path, site: int, unix_s: float) -> None:
    """Remove the files that another one has replaced for a while. Raises OSError."""
    current = {*current_files(root, site), *current_events(root, site)}
    for file in site_folder(root, site).glob("*/*.parquet"):
        if file not in current and rows_of(file) is not None and unix_s - file.stat().st_mtime > GRACE_S:
            file.unlink()


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


def _joined(files: Sequence[Path], order: Sequence[str]) -> list[Path]:
    """Join files with consecutive numbers as far as they are alike; the files that there are then."""
    groups: list[list[Path]] = []
    for file in files:
        first, last = rows_of(file) or (0, 0)
        if groups:
            begin, end = (rows_of(groups[-1][0]) or (0, 0))[0], (rows_of(groups[-1][-1]) or (0, 0))[1]
            fits = first == end + 1 and last - begin < _JOINED_ROWS
            if fits and _is_thinned(file) == _is_thinned(groups[-1][0]):
                groups[-1].append(file)
                continue
        groups.append([file])
    return [_join(group, order) if len(group) > 1 else group[0] for group in groups]


def _join(files: Sequence[Path], order: Sequence[str]) -> Path:
    numbers = [number for file in files for number in rows_of(file) or ()]
    joined = files[0].with_name(file_name(numbers[0], numbers[-1]))
    table = pa.concat_tables([read_table(file) for file in files])
    write_table(table.sort_by([(name, "ascending") for name in order]), joined)
    for file in files:
        os.utime(file)  # the time from which on it is replaced
    return joined


def _remove(files: Sequence[Path]) -> None:
    for file in files:
        file.unlink()
        with contextlib.suppress(OSError):  # other files are there
            file.parent.rmdir()


def _is_thinned(file: Path) -> bool:
    return THINNED in (parquet.read_schema(file).metadata or {})


def _newest_ms(file: Path) -> int:
    return int(compute.max(read_table(file, ["t"])["t"].cast(pa.int64())).as_py())
