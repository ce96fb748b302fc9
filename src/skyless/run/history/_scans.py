"""Times in cells and near tags, which need all rows: PyArrow and NumPy take a third of DuckDB's processor time here."""

import math
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pyarrow import parquet

from skyless.core.errors import SkylessError
from skyless.run.history.answers import GAP_S, THINNED_GAP_S, Heatmap, Span
from skyless.run.history.layout import THINNED
from skyless.run.history.tables import ROW_GROUP

_SIDE: Final = 2000
"""Cells along each side of the grid, which lies around the first fixes; with a power of two, rows of the grid would
share few lines of the processor's cache."""
_OUTSIDE: Final = _SIDE * _SIDE
_WILD_SHARE: Final = 1e-3
"""Of the time, this share may be outside the grid, which then are wild fixes."""
_NOWHERE: Final = 2**30

_Ints = NDArray[Any]


def time_in_cells(files: Sequence[Path], span: Span, cell_mm: int, tags: Collection[int] | None) -> Heatmap:
    """The time of tags in cells; ``tags`` None means all. Raises SkylessError, OSError.

    A fix counts until the tag's next one in the range, for ``GAP_S`` at most, in a thinned file ``THINNED_GAP_S``. The
    tag's last one counts nothing.
    """
    sums_ms = np.zeros(_OUTSIDE + 1, np.int64)
    edges = [np.empty((4, 0), np.int64)]
    """Tag, time, the most that a row counts, which is 0 for a tag's first row of a batch, else its last, and cell."""
    corner: list[int] = []
    for (tag, t, x, y), gap_ms in read_rows(files, span, tags):
        places = x // cell_mm, y // cell_mm
        corner = corner or [int(np.median(one)) - _SIDE // 2 for one in places]
        column, row = ((one - first).view(np.uint32) for one, first in zip(places, corner, strict=True))
        cell = (row * np.uint32(_SIDE) + column).astype(np.intp)
        if column.max() >= _SIDE or row.max() >= _SIDE:  # a negative one is large, too
            cell[(column >= _SIDE) | (row >= _SIDE)] = _OUTSIDE
        changes = np.flatnonzero(tag[1:] != tag[:-1])
        ms = np.minimum(t[1:] - t[:-1], gap_ms)
        ms[changes] = 0
        np.add.at(sums_ms, cell[:-1], ms)  # fast for these types only
        at = np.concatenate([[0], changes + 1, changes, [len(tag) - 1]])
        edges.append(np.array([tag[at], t[at], np.repeat([0, gap_ms], len(at) // 2), cell[at]]))
    ends = np.concatenate(edges, axis=1)
    tag, t, most_ms, cell = ends[:, np.lexsort((ends[2], ends[1], ends[0]))]
    joined = np.flatnonzero((most_ms[:-1] > 0) & (most_ms[1:] == 0) & (tag[1:] == tag[:-1]))
    np.add.at(sums_ms, cell[joined], np.minimum(np.diff(t), most_ms[:-1])[joined])
    if sums_ms[_OUTSIDE] > _WILD_SHARE * sums_ms.sum():
        raise SkylessError(f"cells of {1e-3 * cell_mm:g} m are too many; choose larger ones")
    grid, number, cell_m = sums_ms[:_OUTSIDE].reshape(_SIDE, _SIDE), len(np.unique(tag)), 1e-3 * cell_mm
    columns, rows = np.flatnonzero(grid.any(axis=0)), np.flatnonzero(grid.any(axis=1))
    if not len(rows):
        return Heatmap(0.0, 0.0, cell_m, 0, 0, (), number)
    grid = grid[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    x0_m, y0_m = (cell_m * (first + int(used[0])) for first, used in zip(corner, (columns, rows), strict=True))
    return Heatmap(x0_m, y0_m, cell_m, grid.shape[1], grid.shape[0], tuple((1e-3 * grid.ravel()).tolist()), number)


def near(
    files: Sequence[Path], span: Span, own: Sequence[_Ints], bucket_ms: int, distance_mm: int
) -> NDArray[np.int64]:
    """Tag, number of the bucket of time, and squared distance of fixes near those of ``own`` in the same bucket.

    ``own`` are times and coordinates, of which the first in each bucket counts. Raises OSError.
    """
    buckets, nth = np.unique(own[0] // bucket_ms, return_index=True)
    first, count = int(buckets[0]), int(buckets[-1] - buckets[0]) + 1
    places = np.full((2, count + 1), _NOWHERE, np.int32)  # the last one is for all other times
    places[:, buckets - first] = own[1][nth], own[2][nth]
    found = [np.empty((3, 0), np.int64)]
    for (tag, t, x, y), _ in read_rows(files, span, None):
        index = np.minimum((t // bucket_ms - first).view(np.uint64), np.uint64(count)).view(np.int64)
        rows = np.flatnonzero(np.abs(x - places[0][index]) <= distance_mm)
        place = places[:, index[rows]].astype(np.int64)
        square = (x[rows] - place[0]) ** 2 + (y[rows] - place[1]) ** 2
        found.append(np.array([tag[rows], index[rows] + first, square])[:, square <= distance_mm**2])
    return np.concatenate(found, axis=1)


def read_rows(files: Sequence[Path], span: Span, tags: Collection[int] | None) -> Iterator[tuple[list[_Ints], int]]:
    """Tags, times in ms and coordinates of batches of rows, and for how many ms a fix counts there at most."""
    begin_ms, end_ms = (math.ceil(round(1000.0 * unix_s, 2)) for unix_s in (span.from_unix_s, span.to_unix_s))
    for file in files:
        try:
            whole = parquet.ParquetFile(file, memory_map=True, pre_buffer=False)
        except ValueError as error:  # ArrowInvalid is one
            raise SkylessError(f"{file} cannot be read; it should be a Parquet file of fixes: {error}") from None
        gap_ms = round(1000.0 * (THINNED_GAP_S if THINNED in (whole.schema_arrow.metadata or {}) else GAP_S))
        for group in range(whole.num_row_groups):
            (tag0, tag1), (first_ms, last_ms) = (limits(whole.metadata, group, name) for name in ("tag", "t"))
            if last_ms < begin_ms or first_ms >= end_ms or not (tags is None or any(tag0 <= n <= tag1 for n in tags)):
                continue
            for batch in whole.iter_batches(ROW_GROUP, [group], ["tag", "t", "x_mm", "y_mm"], use_threads=False):
                tag, t, x, y = batch.columns
                rows = [np.from_dlpack(column) for column in (tag, t.view("int64"), x, y)]
                if tags is not None:
                    rows = [column[np.isin(rows[0], list(tags))] for column in rows]
                if first_ms < begin_ms or last_ms >= end_ms:
                    rows = [column[(rows[1] >= begin_ms) & (rows[1] < end_ms)] for column in rows]
                if len(rows[0]):
                    yield rows, gap_ms


def limits(metadata: parquet.FileMetaData, group: int, column: str) -> tuple[int, int]:
    """The least and the largest value of a column in a row group; times are in ms."""
    known = metadata.row_group(group).column(metadata.schema.names.index(column)).statistics
    return known.min_raw, known.max_raw  # others make dates, for which Pandas would be imported
