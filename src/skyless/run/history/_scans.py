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
from skyless.run.history.layout import FIX_COLUMNS, THINNED
from skyless.run.history.tables import ROW_GROUP, schema_of
from skyless.run.limits import HISTORY as LIMITS

_SIDE: Final = 2000
"""Cells along each side of the grid, which lies around the first fixes; with a power of two, rows of the grid would
share few lines of the processor's cache."""
_OUTSIDE: Final = _SIDE * _SIDE
_WILD_SHARE: Final = 1e-3
"""Of the time, this share may be outside the grid, which then are wild fixes."""

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
    if grid.size > LIMITS.cells:
        right = f"choose ones of {1.1 * cell_m * math.sqrt(grid.size / LIMITS.cells):.2g} m"
        raise SkylessError(f"{grid.size} cells of {cell_m:g} m are too many; {right}")
    x0_m, y0_m = (cell_m * (first + int(used[0])) for first, used in zip(corner, (columns, rows), strict=True))
    return Heatmap(x0_m, y0_m, cell_m, grid.shape[1], grid.shape[0], tuple((1e-3 * grid.ravel()).tolist()), number)


def near(
    files: Sequence[Path], span: Span, own: Collection[int], bucket_ms: int, distance_mm: int, gap: int
) -> NDArray[np.int64]:
    """When tags were near one with the numbers ``own``: tag, first and last bucket of time, least squared distance.

    The first fix of ``own`` in a bucket counts. ``gap`` is how many buckets may lie between those of one contact.
    Raises OSError.
    """
    firsts: list[tuple[_Ints, ...]] = []
    for (_, t, x, y), _ in read_rows(files, span, own):
        nth = np.unique(t // bucket_ms, return_index=True)[1]
        firsts.append((t[nth], x[nth], y[nth]))
    if not firsts:
        return np.empty((4, 0), np.int64)
    times, *places = (np.concatenate(columns) for columns in zip(*firsts, strict=True))
    del firsts
    order = np.argsort(times)
    buckets, nth = np.unique(times[order] // bucket_ms, return_index=True)
    x0, y0 = (column[order[nth]].astype(np.int64) for column in places)
    runs: list[NDArray[np.int64]] = []
    for (tag, t, x, y), _ in read_rows(files, span, None):
        bucket = t // bucket_ms
        at = np.searchsorted(buckets, bucket).clip(max=len(buckets) - 1)
        rows = np.flatnonzero((np.abs(x - x0[at]) <= distance_mm) & (buckets[at] == bucket))
        rows = rows[(np.abs(y[rows] - y0[at[rows]]) <= distance_mm) & ~np.isin(tag[rows], list(own))]
        square = (x[rows] - x0[at[rows]]) ** 2 + (y[rows] - y0[at[rows]]) ** 2
        found = np.array([tag[rows], bucket[rows], bucket[rows], square], np.int64)
        runs.append(joined([found[:, square <= distance_mm**2]], gap))
        if sum(one.shape[1] for one in runs) > 2 * LIMITS.contacts:
            runs = [joined(runs, gap)]
    return joined(runs, gap)


def joined(parts: Sequence[NDArray[np.int64]], gap: int) -> NDArray[np.int64]:
    """Runs of buckets of tags, with the runs of a tag joined that have ``gap`` buckets or less between them.

    Raises SkylessError: they are too many.
    """
    runs = np.concatenate([np.empty((4, 0), np.int64), *parts], axis=1)
    if not runs.size:
        return runs
    tag, first, last, square = runs[:, np.lexsort((runs[1], runs[0]))]
    is_other = np.append(True, tag[1:] != tag[:-1])
    later = np.cumsum(is_other) * (last.max() - first.min() + gap + 2)  # each tag after the one before
    until = np.maximum.accumulate(last + later)
    begins = np.flatnonzero(np.append(True, (first + later)[1:] > until[:-1] + gap + 1))
    if len(begins) > LIMITS.contacts:
        raise SkylessError("the contacts are too many; choose a shorter range or a smaller distance")
    return np.array(
        [tag[begins], first[begins], np.maximum.reduceat(last, begins), np.minimum.reduceat(square, begins)]
    )


def read_rows(files: Sequence[Path], span: Span, tags: Collection[int] | None) -> Iterator[tuple[list[_Ints], int]]:
    """Tags, times in ms and coordinates of batches of rows, and for how many ms a fix counts there at most."""
    begin_ms, end_ms = (math.ceil(round(1000.0 * unix_s, 2)) for unix_s in (span.from_unix_s, span.to_unix_s))
    wanted = schema_of({name: FIX_COLUMNS[name] for name in ("tag", "t", "x_mm", "y_mm")})
    for file in files:
        try:
            whole = parquet.ParquetFile(file, memory_map=True, pre_buffer=False)
            if not {*wanted} <= {*whole.schema_arrow} or len({*whole.schema_arrow.names}) < len(whole.schema_arrow):
                raise ValueError(f"its columns are {', '.join(whole.schema_arrow.names)}")
        except ValueError as error:  # ArrowInvalid is one
            raise SkylessError(f"{file} cannot be read; it should be a Parquet file of fixes: {error}") from None
        gap_ms = round(1000.0 * (THINNED_GAP_S if THINNED in (whole.schema_arrow.metadata or {}) else GAP_S))
        for group in range(whole.num_row_groups):
            (tag0, tag1), (first_ms, last_ms) = (limits(whole.metadata, group, name) for name in ("tag", "t"))
            if last_ms < begin_ms or first_ms >= end_ms or not (tags is None or any(tag0 <= n <= tag1 for n in tags)):
                continue
            for batch in whole.iter_batches(ROW_GROUP, [group], wanted.names, use_threads=False):
                tag, t, x, y = (batch[name] for name in wanted.names)
                rows = [np.from_dlpack(column) for column in (tag, t.view("int64"), x, y)]
                if tags is not None:
                    rows = [column[np.isin(rows[0], list(tags))] for column in rows]
                if first_ms < begin_ms or last_ms >= end_ms:
                    rows = [column[(rows[1] >= begin_ms) & (rows[1] < end_ms)] for column in rows]
                if len(rows[0]):
                    yield rows, gap_ms


def limits(metadata: parquet.FileMetaData, group: int, column: str) -> tuple[int, int]:
    """The least and the largest value of a column in a row group; times are in ms. Raises ValueError."""
    known = metadata.row_group(group).column(metadata.schema.names.index(column)).statistics
    if known is None or not isinstance(known.max_raw, int):
        raise ValueError(f"its column {column} has no whole numbers, or no statistics of them")
    return known.min_raw, known.max_raw  # others make dates, for which Pandas would be imported
