"""Times in cells and near tags, which need all rows: PyArrow and NumPy take a third of DuckDB's processor time here."""

from collections.abc import Collection, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pyarrow import dataset, parquet

from skyless.core.errors import SkylessError
from skyless.run.history.answers import GAP_S, THINNED_GAP_S, Heatmap, Span
from skyless.run.history.layout import THINNED
from skyless.run.history.tables import ROW_GROUP

_SIDE: Final = 2048
"""Cells along each side of the grid, which lies around the first fixes."""
_OUTSIDE: Final = _SIDE * _SIDE
_WILD_SHARE: Final = 1e-3
"""Of the time, this share may be outside the grid, which then are wild fixes."""
_NOWHERE: Final = 2**30
_MAX_UNIX_S: Final = 2.5e11

_Ints = NDArray[np.integer[Any]]


def time_in_cells(files: Sequence[Path], span: Span, cell_mm: int, tags: Collection[int] | None) -> Heatmap:
    """The time of tags in cells; ``tags`` None means all. Raises SkylessError, OSError.

    A fix counts until the tag's next one in the range, for ``GAP_S`` at most, in a thinned file ``THINNED_GAP_S``. The
    tag's last one counts nothing.
    """
    sums_ms = np.zeros(_OUTSIDE + 1)
    edges: list[_Ints] = []
    column0: int | None = None
    row0 = 0
    for (tag, t, x, y), gap_ms in read_rows(files, span, tags):
        column, row = x // cell_mm, y // cell_mm
        if column0 is None:
            column0, row0 = int(np.median(column)) - _SIDE // 2, int(np.median(row)) - _SIDE // 2
        column, row = (column - column0).view(np.uint32), (row - row0).view(np.uint32)  # a negative one is large there
        cell = row * np.uint32(_SIDE) + column
        if column.max() >= _SIDE or row.max() >= _SIDE:
            cell[(column >= _SIDE) | (row >= _SIDE)] = _OUTSIDE
        changes = np.flatnonzero(tag[1:] != tag[:-1])
        ms = np.minimum(t[1:] - t[:-1], gap_ms).astype(np.float64)
        ms[changes] = 0.0
        np.add.at(sums_ms, cell[:-1].astype(np.intp), ms)  # fast for these types only
        begins, ends = np.append(0, changes + 1), np.append(changes, len(tag) - 1)
        edges += [np.array([tag[begins], t[begins], 0 * begins, 0 * begins])]
        edges += [np.array([tag[ends], t[ends], 0 * ends + gap_ms, cell[ends]])]
    if column0 is None:
        return Heatmap(0.0, 0.0, 1e-3 * cell_mm, 0, 0, (), 0)
    number = _add_between(sums_ms, np.concatenate(edges, axis=1))
    if sums_ms[_OUTSIDE] > _WILD_SHARE * sums_ms.sum():
        raise SkylessError(f"cells of {1e-3 * cell_mm:g} m are too many; choose larger ones")
    grid = sums_ms[:_OUTSIDE].reshape(_SIDE, _SIDE)
    rows, columns = np.flatnonzero(grid.any(axis=1)), np.flatnonzero(grid.any(axis=0))
    if not len(rows):
        return Heatmap(0.0, 0.0, 1e-3 * cell_mm, 0, 0, (), number)
    grid = grid[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    x0_m, y0_m = 1e-3 * cell_mm * (column0 + int(columns[0])), 1e-3 * cell_mm * (row0 + int(rows[0]))
    seconds = tuple((1e-3 * grid.ravel()).tolist())
    return Heatmap(x0_m, y0_m, 1e-3 * cell_mm, grid.shape[1], grid.shape[0], seconds, number)


def _add_between(sums_ms: NDArray[np.float64], edges: _Ints) -> int:
    """Add the times from a tag's last row of one batch to its first of the next; return how many tags there are.

    ``edges`` are tag, time, the most that the row counts, which is 0 for a first row, and cell.
    """
    tag, t, most_ms, cell = edges[:, np.lexsort((edges[2], edges[1], edges[0]))]
    joined = (most_ms[:-1] > 0) & (most_ms[1:] == 0) & (tag[1:] == tag[:-1])
    np.add.at(sums_ms, cell[:-1][joined], np.minimum(np.diff(t), most_ms[:-1])[joined])
    return len(np.unique(tag))


def near(
    files: Sequence[Path], span: Span, own: Sequence[_Ints], bucket_ms: int, distance_mm: int
) -> NDArray[np.int64]:
    """Tag, number of the bucket of time, and squared distance of fixes near those of ``own`` in the same bucket.

    ``own`` are times and coordinates, of which the first in each bucket counts. Raises OSError.
    """
    buckets, nth = np.unique(own[0] // bucket_ms, return_index=True)
    first = int(buckets[0])
    count = int(buckets[-1]) - first + 1
    places = np.full((2, count + 1), _NOWHERE, np.int32)  # the last one is for all other times
    places[:, buckets - first] = own[1][nth], own[2][nth]
    found = [np.empty((3, 0), np.int64)]
    for (tag, t, x, y), _ in read_rows(files, span, None):
        index = np.minimum((t // bucket_ms - first).view(np.uint64), np.uint64(count)).view(np.int64)
        rows = np.flatnonzero(np.abs(x - places[0][index]) <= distance_mm)
        dx, dy = (
            column[rows] - own_mm[index[rows]].astype(np.int64) for column, own_mm in zip((x, y), places, strict=True)
        )
        square = dx**2 + dy**2
        found.append(np.array([tag[rows], index[rows] + first, square])[:, square <= distance_mm**2])
    return np.concatenate(found, axis=1)


def read_rows(
    files: Sequence[Path], span: Span, tags: Collection[int] | None
) -> Iterator[tuple[tuple[_Ints, _Ints, _Ints, _Ints], int]]:
    """Tags, times in ms and coordinates of batches of rows, and for how many ms a fix counts there at most."""
    begin, end = utc(span.from_unix_s), utc(span.to_unix_s)
    t, names = dataset.field("t"), ["tag", "t", "x_mm", "y_mm"]
    wanted = (t >= begin) & (t < end)
    if tags is not None:
        wanted &= dataset.field("tag").isin(list(tags))
    for file in files:
        try:
            whole = parquet.ParquetFile(file, memory_map=True, pre_buffer=False)
            first, last = time_limits(whole.metadata)
        except ValueError as error:  # ArrowInvalid is one
            raise SkylessError(f"{file} cannot be read; it should be a Parquet file of fixes: {error}") from None
        if last < begin or first >= end:
            continue
        gap_s = THINNED_GAP_S if THINNED in (whole.schema_arrow.metadata or {}) else GAP_S
        if tags is None and begin <= first and last < end:  # a filter would cost more than all of the rest
            batches = whole.iter_batches(columns=names, batch_size=ROW_GROUP, use_threads=False)
        else:
            batches = dataset.dataset(file).to_batches(columns=names, filter=wanted, use_threads=False)
        for batch in batches:
            if len(batch):
                tag, time, x, y = batch.columns
                columns = (tag.to_numpy(), time.view("int64").to_numpy(), x.to_numpy(), y.to_numpy())
                yield columns, round(1000.0 * gap_s)


def time_limits(metadata: parquet.FileMetaData) -> tuple[datetime, datetime]:
    """The first and the last time in a file."""
    column = metadata.schema.names.index("t")
    found = [metadata.row_group(number).column(column).statistics for number in range(metadata.num_row_groups)]
    return min(one.min for one in found), max(one.max for one in found)


def utc(unix_s: float) -> datetime:
    """A time, or the first or last one that files may have."""
    return datetime.fromtimestamp(min(max(unix_s, 0.0), _MAX_UNIX_S), UTC)
