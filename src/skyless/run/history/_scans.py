"""What NumPy counts over all rows, as it takes less processor time than DuckDB: times in cells, and near tags."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from pyarrow import parquet

from skyless.core.errors import SkylessError
from skyless.run.history.answers import GAP_S, THINNED_GAP_S, Heatmap, Span
from skyless.run.history.layout import THINNED

_COLUMNS: Final = ("tag", "t", "x_mm", "y_mm")
_SLICE: Final = 32_768
"""Rows that are computed at a time; their arrays stay in the processor's cache."""
_MAX_CELLS: Final = 4_000_000
_WILD_SHARE: Final = 1e-3
"""Where single wild fixes make the grid too large, this share of the groups of rows is left out at each side."""
_NOWHERE: Final = 2**31 - 1

_Ints = NDArray[np.integer[Any]]
_Grid = tuple[int, int, int, int]
"""First column and row, and how many there are."""


class _Group(Struct, frozen=True):
    """A group of rows of a file, and the least and most of each column."""

    file: parquet.ParquetFile
    number: int
    limits: dict[str, tuple[int, int]]
    gap_ms: int
    """For how long a fix counts at most."""


def time_in_cells(files: Sequence[str], span: Span, cell_mm: int, tags: Collection[int] | None) -> Heatmap:
    """The time of tags in cells; ``tags`` None means all. Raises SkylessError, OSError.

    A fix counts until the tag's next one in the range, for ``GAP_S`` at most, in a thinned file ``THINNED_GAP_S``. The
    tag's last one counts nothing.
    """
    groups = _groups(files, span, tags)
    if not groups:
        return Heatmap(0.0, 0.0, 1e-3 * cell_mm, 0, 0, (), 0)
    (x0, columns), (y0, rows) = _extent(groups, "x_mm", cell_mm), _extent(groups, "y_mm", cell_mm)
    if columns * rows > _MAX_CELLS:
        size = f"{1e-3 * cell_mm * columns:.0f} x {1e-3 * cell_mm * rows:.0f} m"
        raise SkylessError(f"cells of {1e-3 * cell_mm:g} m over {size} are too many; choose larger ones")
    sums_ms = np.zeros(columns * rows)
    edges = [
        _add(sums_ms, arrays, (x0, y0, columns, rows), cell_mm, group.gap_ms)
        for group, arrays in _read(groups, span, tags)
    ]
    seen = _add_between(sums_ms, np.concatenate(edges, axis=1)) if edges else 0
    seconds = tuple((1e-3 * sums_ms).tolist())
    return Heatmap(1e-3 * cell_mm * x0, 1e-3 * cell_mm * y0, 1e-3 * cell_mm, columns, rows, seconds, seen)


def near(
    files: Sequence[str], span: Span, own: Sequence[_Ints], not_of: Collection[int], bucket_ms: int, distance_mm: int
) -> tuple[list[int], list[int], list[float]]:
    """Tags, numbers of buckets of time, and squared distances of fixes near those of ``own`` in the same bucket.

    ``own`` are times, sorted, and coordinates; tags of ``not_of`` are left out. Raises OSError.
    """
    bucket = own[0] // bucket_ms
    nth = np.arange(len(bucket)) - np.searchsorted(bucket, bucket)  # of the fixes in the bucket
    first, count = int(bucket[0]), int(bucket[-1] - bucket[0]) + 1
    places = np.full((int(nth.max()) + 1, 2, count + 1), _NOWHERE, np.int32)  # the last one is for all other times
    places[nth, 0, bucket - first], places[nth, 1, bucket - first] = own[1], own[2]
    found: list[tuple[_Ints, ...]] = []
    for group, arrays in _read(_groups(files, span, None), span, None):
        low, high = group.limits["t"]
        base = low // bucket_ms
        for begin in range(0, len(arrays[0]), _SLICE):
            tag, t, x, y = (array[begin : begin + _SLICE] for array in arrays)
            since = (t - base * bucket_ms).astype(np.int32 if high - low < 2**30 else np.int64)
            index = np.clip(since // bucket_ms + (base - first), -1, count)
            for x_mm, y_mm in places:
                # In 32 bits the difference may overflow; the squares of those that seem near are exact.
                close = np.flatnonzero(np.abs(x - x_mm[index]) <= distance_mm)
                dx, dy = x[close] - x_mm[index[close]].astype(np.int64), y[close] - y_mm[index[close]].astype(np.int64)
                is_near = (np.abs(dx) <= distance_mm) & (np.abs(dy) <= distance_mm)
                rows, square = close[is_near], dx[is_near] ** 2 + dy[is_near] ** 2
                kept = (square <= distance_mm**2) & ~np.isin(tag[rows], list(not_of))
                found.append((tag[rows[kept]], index[rows[kept]] + first, square[kept]))
    tags, buckets, squares = (np.concatenate(columns).tolist() for columns in zip(*found, strict=True))
    return tags, buckets, squares


def _groups(files: Sequence[str], span: Span, tags: Collection[int] | None) -> list[_Group]:
    """The groups of rows that may have such rows."""
    begin_ms, end_ms = 1000.0 * span.from_unix_s, 1000.0 * span.to_unix_s
    found = []
    for path in files:
        file = parquet.ParquetFile(Path(path))
        gap_s = THINNED_GAP_S if THINNED in (file.schema_arrow.metadata or {}) else GAP_S
        for number in range(file.num_row_groups):
            group = file.metadata.row_group(number)
            columns = {group.column(k).path_in_schema: group.column(k).statistics for k in range(group.num_columns)}
            limits = {name: (columns[name].min_raw, columns[name].max_raw) for name in _COLUMNS}
            (low_tag, high_tag), (low_ms, high_ms) = limits["tag"], limits["t"]
            is_asked = tags is None or any(low_tag <= tag <= high_tag for tag in tags)
            if is_asked and low_ms < end_ms and high_ms >= begin_ms:
                found.append(_Group(file, number, limits, round(1000.0 * gap_s)))
    return found


def _read(
    groups: Sequence[_Group], span: Span, tags: Collection[int] | None
) -> Iterator[tuple[_Group, tuple[_Ints, ...]]]:
    """The rows of groups that are asked for, as columns; groups without any are left out."""
    begin_ms, end_ms = 1000.0 * span.from_unix_s, 1000.0 * span.to_unix_s
    for group in groups:
        read = group.file.read_row_group(group.number, list(_COLUMNS), use_threads=False).combine_chunks()
        tag, t, x, y = (read.column(name).chunk(0) for name in _COLUMNS)
        arrays = (tag.to_numpy(), t.view("int64").to_numpy(), x.to_numpy(), y.to_numpy())
        low_ms, high_ms = group.limits["t"]
        if tags is not None or low_ms < begin_ms or high_ms >= end_ms:
            keep = (arrays[1] >= begin_ms) & (arrays[1] < end_ms)
            keep &= True if tags is None else np.isin(arrays[0], list(tags))
            arrays = tuple(array[keep] for array in arrays)
        if len(arrays[0]):
            yield group, arrays


def _extent(groups: Sequence[_Group], column: str, cell_mm: int) -> tuple[int, int]:
    """The first cell along an axis, and how many there are."""
    lows = np.array([group.limits[column][0] for group in groups]) // cell_mm
    highs = np.array([group.limits[column][1] for group in groups]) // cell_mm
    first, last = int(lows.min()), int(highs.max())
    if last - first >= _MAX_CELLS**0.5 and len(groups) > 2:
        left_out = max(1, int(_WILD_SHARE * len(groups)))
        first, last = int(np.sort(lows)[left_out]), int(np.sort(highs)[-1 - left_out])
    return first, last - first + 1


def _add(sums_ms: NDArray[np.float64], arrays: Sequence[_Ints], grid: _Grid, cell_mm: int, gap_ms: int) -> _Ints:
    """Add the times of rows that are sorted by tag and time; return the first and last row of each tag.

    As columns of tag, time, the most that the row counts (0 for a first row), and cell (-1 outside the grid).
    """
    tag, t, x, y = arrays
    changes = np.flatnonzero(tag[1:] != tag[:-1])
    all_cells, all_ms = np.empty(len(t) - 1, np.intp), np.empty(len(t) - 1)
    for begin in range(0, len(t) - 1, _SLICE):
        end = min(begin + _SLICE, len(t) - 1)
        cells, inside = _cell(x[begin:end], y[begin:end], grid, cell_mm)
        all_cells[begin:end] = cells if inside is None else np.where(inside, cells, 0)
        all_ms[begin:end] = np.clip(t[begin + 1 : end + 1] - t[begin:end], 0, gap_ms)
        if inside is not None:
            all_ms[begin:end][~inside] = 0.0
    all_ms[changes] = 0.0
    sums_ms += np.bincount(all_cells, all_ms, len(sums_ms))
    begins, ends = np.append(0, changes + 1), np.append(changes, len(t) - 1)
    cells, inside = _cell(x[ends], y[ends], grid, cell_mm)
    lasts = (tag[ends], t[ends], np.full(len(ends), gap_ms), cells if inside is None else np.where(inside, cells, -1))
    firsts = (tag[begins], t[begins], np.zeros(len(begins), np.int64), np.full(len(begins), -1))
    return np.concatenate([np.array(firsts, np.int64), np.array(lasts, np.int64)], axis=1)


def _cell(x: _Ints, y: _Ints, grid: _Grid, cell_mm: int) -> tuple[_Ints, NDArray[np.bool_] | None]:
    """Numbers of cells, and which are in the grid; None if all are."""
    x0, y0, columns, rows = grid
    column, row = x // cell_mm - x0, y // cell_mm - y0
    cells = row * columns + column
    if column.min() >= 0 and column.max() < columns and row.min() >= 0 and row.max() < rows:
        return cells, None
    return cells, (column >= 0) & (column < columns) & (row >= 0) & (row < rows)


def _add_between(sums_ms: NDArray[np.float64], edges: _Ints) -> int:
    """Add the times from a tag's last row of one group to its first of the next; return how many tags there are."""
    tag, t, most_ms, cell = edges[:, np.lexsort((edges[2], edges[1], edges[0]))]
    joined = (most_ms[:-1] > 0) & (most_ms[1:] == 0) & (tag[1:] == tag[:-1]) & (cell[:-1] >= 0)
    ms = np.minimum(t[1:] - t[:-1], most_ms[:-1])[joined]
    np.add.at(sums_ms, cell[:-1][joined], ms)
    return len(np.unique(tag))
