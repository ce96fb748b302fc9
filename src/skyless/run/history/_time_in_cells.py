"""Seconds of tags in the cells of a grid, read from the columns of files, one group of rows after the other."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from pyarrow import parquet

from skyless.core.errors import SkylessError
from skyless.run.history.answers import GAP_S, THINNED_GAP_S, Heatmap, Span
from skyless.run.history.layout import THINNED

_COLUMNS: Final = ["tag", "t", "x_mm", "y_mm"]
_SLICE: Final = 32_768
"""Rows that are computed at a time; their arrays stay in the processor's cache."""
_MAX_CELLS: Final = 4_000_000
_KNOWN_SHARE: Final = 1e-3
"""Where single wild fixes make the grid too large, this share of the groups of rows is left out at each side."""

_Ints = NDArray[np.integer[Any]]


class _Group(Struct, frozen=True):
    """A group of rows of a file, and the least and most of each column."""

    file: parquet.ParquetFile
    number: int
    limits: dict[str, tuple[int, int]]
    gap_ms: int
    """For how long a fix counts at most."""


def time_in_cells(files: Sequence[Path], span: Span, cell_mm: int, tags: Collection[int] | None) -> Heatmap:
    """The time of tags in cells; ``tags`` None means all. Raises SkylessError, OSError.

    A fix counts until the tag's next one in the range, for ``GAP_S`` at most, in a thinned file ``THINNED_GAP_S``. The
    tag's last one counts nothing.
    """
    begin_ms, end_ms = round(1000.0 * span.from_unix_s), round(1000.0 * span.to_unix_s)
    groups = [
        group
        for file in files
        for group in _groups(file)
        if group.limits["t"][0] < end_ms
        and group.limits["t"][1] >= begin_ms
        and (tags is None or any(group.limits["tag"][0] <= tag <= group.limits["tag"][1] for tag in tags))
    ]
    if not groups:
        return Heatmap(0.0, 0.0, 1e-3 * cell_mm, 0, 0, (), 0)
    (x0, columns), (y0, rows) = _extent(groups, "x_mm", cell_mm), _extent(groups, "y_mm", cell_mm)
    if columns * rows > _MAX_CELLS:
        size = f"{1e-3 * cell_mm * columns:.0f} x {1e-3 * cell_mm * rows:.0f} m"
        raise SkylessError(f"cells of {1e-3 * cell_mm:g} m over {size} are too many; choose larger ones")
    sums = np.zeros(columns * rows)
    edges: list[_Ints] = []
    for group in groups:
        read = group.file.read_row_group(group.number, _COLUMNS, use_threads=False).combine_chunks()
        tag, t, x, y = (read.column(name).chunk(0) for name in _COLUMNS)
        arrays = [tag.to_numpy(), t.view("int64").to_numpy(), x.to_numpy(), y.to_numpy()]
        if not (begin_ms <= group.limits["t"][0] and group.limits["t"][1] < end_ms and tags is None):
            keep = (arrays[1] >= begin_ms) & (arrays[1] < end_ms)
            keep &= True if tags is None else np.isin(arrays[0], list(tags))
            arrays = [array[keep] for array in arrays]
        if len(arrays[0]):
            edges.append(_add(sums, arrays, (x0, y0, columns, rows), cell_mm, group.gap_ms))
    seen = _add_between(sums, np.concatenate(edges, axis=1)) if edges else 0
    return Heatmap(1e-3 * cell_mm * x0, 1e-3 * cell_mm * y0, 1e-3 * cell_mm, columns, rows, tuple(sums.tolist()), seen)


def _groups(path: Path) -> list[_Group]:
    file = parquet.ParquetFile(path)
    gap_s = THINNED_GAP_S if THINNED in (file.schema_arrow.metadata or {}) else GAP_S
    found = []
    for number in range(file.num_row_groups):
        group = file.metadata.row_group(number)
        columns = {group.column(k).path_in_schema: group.column(k).statistics for k in range(group.num_columns)}
        if group.num_rows:
            limits = {name: (columns[name].min_raw, columns[name].max_raw) for name in _COLUMNS}
            found.append(_Group(file, number, limits, round(1000.0 * gap_s)))
    return found


def _extent(groups: Sequence[_Group], column: str, cell_mm: int) -> tuple[int, int]:
    """The first cell along an axis, and how many there are."""
    lows = np.array([group.limits[column][0] for group in groups]) // cell_mm
    highs = np.array([group.limits[column][1] for group in groups]) // cell_mm
    first, last = int(lows.min()), int(highs.max())
    if last - first >= _MAX_CELLS**0.5 and len(groups) > 2:
        left_out = max(1, int(_KNOWN_SHARE * len(groups)))
        first, last = int(np.sort(lows)[left_out]), int(np.sort(highs)[-1 - left_out])
    return first, last - first + 1


def _add(
    sums: NDArray[np.float64], arrays: Sequence[_Ints], grid: tuple[int, int, int, int], cell_mm: int, gap_ms: int
) -> _Ints:
    """Add the times of rows that are sorted by tag and time; return the first and last row of each tag.

    As columns of tag, time, the most that the row counts (0 for a first row), and cell (-1 outside the grid).
    """
    tag, t, x, y = arrays
    _, _, columns, rows = grid
    changes = np.flatnonzero(tag[1:] != tag[:-1])
    for begin in range(0, len(t) - 1, _SLICE):
        end = min(begin + _SLICE, len(t) - 1)
        ms = np.clip(t[begin + 1 : end + 1] - t[begin:end], 0, gap_ms)
        first, last = np.searchsorted(changes, (begin, end))
        ms[changes[first:last] - begin] = 0
        cells, inside = _cell(x[begin:end], y[begin:end], grid, cell_mm)
        if not inside.all():
            cells, ms = cells[inside], ms[inside]
        sums += np.bincount(cells, 1e-3 * ms, columns * rows)
    begins, ends = np.append(0, changes + 1), np.append(changes, len(t) - 1)
    cells, inside = _cell(x[ends], y[ends], grid, cell_mm)
    lasts = (tag[ends], t[ends], np.full(len(ends), gap_ms), np.where(inside, cells, -1))
    firsts = (tag[begins], t[begins], np.zeros(len(begins), np.int64), np.full(len(begins), -1))
    return np.concatenate([np.array(firsts, np.int64), np.array(lasts, np.int64)], axis=1)


def _cell(x: _Ints, y: _Ints, grid: tuple[int, int, int, int], cell_mm: int) -> tuple[_Ints, NDArray[np.bool_]]:
    x0, y0, columns, rows = grid
    column, row = x // cell_mm - x0, y // cell_mm - y0
    return row * columns + column, (column >= 0) & (column < columns) & (row >= 0) & (row < rows)


def _add_between(sums: NDArray[np.float64], edges: _Ints) -> int:
    """Add the times from a tag's last row of one group to its first of the next; return how many tags there are."""
    tag, t, most_ms, cell = edges[:, np.lexsort((edges[2], edges[1], edges[0]))]
    joined = (most_ms[:-1] > 0) & (most_ms[1:] == 0) & (tag[1:] == tag[:-1]) & (cell[:-1] >= 0)
    ms = np.minimum(t[1:] - t[:-1], most_ms[:-1])[joined]
    np.add.at(sums, cell[:-1][joined], 1e-3 * ms)
    return len(np.unique(tag))
