"""Passes over all fixes of a range: for how long each fix is valid, times in cells, and contacts.

They need all rows, for which NumPy takes a third of DuckDB's processor time.

A fix is valid until the tag's next one, also where the tag sleeps in between. A silence of more than 10 s is an
absence, and the fix before it is valid for 10 s only, unless the tag sends rarely there: another silence of similar
length is nearer than its own length, or nothing else is known of the tag. More than 15 minutes are always an absence.
"""

import math
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyless.core.errors import SkylessError
from skyless.run.history.answers import Heatmap, Span
from skyless.run.history.layout import FIX_COLUMNS, THINNED
from skyless.run.history.tables import ROW_GROUP, connection, metadata_in, select
from skyless.run.site_table import THRESHOLDS
from skyless.run.web import HISTORY as LIMITS

KNOWN: Final = "tag NOT NULL AND x_mm NOT NULL AND y_mm NOT NULL"

GONE_MS: Final = round(1000 * THRESHOLDS.gone_s)
_THINNED_GONE_MS: Final = 65_000
"""In files that are thinned, where there may be one fix a minute."""
_LONGEST_MS: Final = round(1000 * THRESHOLDS.longest_s)
_SHORT_MS: Final = round(GONE_MS / THRESHOLDS.gone_intervals)
"""Shorter times between fixes are no silence: four of them are shorter than ``GONE_MS``."""
_SIMILAR: Final = 0.4
"""Silences are compared in classes of lengths, each from a bound to twice the bound: one that has this share of the
bound at least is similar to all of the class."""
_KNOWN_SHARE: Final = 0.1
"""If less time than this share of a silence is known besides it, nothing is known of the tag."""

_Ints = NDArray[Any]


def fixes_in(
    files: Sequence[Path], span: Span, tags: Collection[int] | None
) -> Iterator[tuple[tuple[_Ints, ...], _Ints]]:
    """Yield batches of fixes (tags, times in ms, x and y in mm), and for how long in ms each is valid.

    Fixes before a silence come at the end, as the next one may be in any file; a tag's last fix has 0. ``tags`` None
    means all. Raises duckdb.Error.
    """
    edges: list[tuple[_Ints, ...]] = []
    for columns, gone_ms in _rows_in(files, span, tags):
        tag, t = columns[:2]
        valid_ms = np.append(t[1:] - t[:-1], 0)
        is_last = np.append(tag[1:] != tag[:-1], True) | (valid_ms > _SHORT_MS)
        yield tuple(column[~is_last] for column in columns), valid_ms[~is_last]
        is_first = np.append(True, is_last[:-1])
        more = is_first, is_last, np.full(len(tag), gone_ms, np.int32)
        edges.append(tuple(column[is_first | is_last] for column in (*columns, *more)))
    if not edges:
        return
    found = [np.concatenate(parts) for parts in zip(*edges, strict=True)]
    del edges  # of tags that sleep every fix is one
    order = np.lexsort((found[5], found[1], found[0]))
    for nth, column in enumerate(found):
        found[nth] = column[order]
    *places, is_first, is_last, gone = found
    tag, t = places[:2]
    gap_ms = np.append(np.where(is_last[:-1] & is_first[1:] & (tag[1:] == tag[:-1]), np.diff(t), 0), 0)
    valid_ms = _valid_ms(tag, t, gap_ms, gone)
    last = np.flatnonzero(is_last)
    del found, order, is_first, is_last, gone, gap_ms
    for first in range(0, len(last), ROW_GROUP):
        rows = last[first : first + ROW_GROUP]
        yield tuple(column[rows] for column in places), valid_ms[rows]


def _rows_in(
    files: Sequence[Path], span: Span, tags: Collection[int] | None
) -> Iterator[tuple[tuple[_Ints, ...], int]]:
    """Yield batches of fixes, by tag and time, with the time in ms after which a silent tag is gone."""
    begin_ms, end_ms = (math.ceil(round(1000.0 * unix_s, 2)) for unix_s in (span.from_unix_s, span.to_unix_s))
    kinds = {name: FIX_COLUMNS[name] for name in ("tag", "t", "x_mm", "y_mm")}
    wanted = f"t >= make_timestamptz({1000 * begin_ms}) AND t < make_timestamptz({1000 * end_ms})"
    wanted += f" AND {KNOWN}" + ("" if tags is None else f" AND tag IN ({', '.join(map(str, tags))})")
    with connection() as duck:
        for file, metadata in metadata_in(duck, files).items():
            columns = [*select(duck, [file], kinds, wanted).fetchnumpy().values()]
            for first in range(0, len(columns[0]), ROW_GROUP):  # in parts, which needs less memory
                part = tuple(column[first : first + ROW_GROUP] for column in columns)
                yield part, _THINNED_GONE_MS if THINNED in metadata else GONE_MS


def _valid_ms(tag: _Ints, t: _Ints, gap_ms: _Ints, gone_ms: _Ints) -> _Ints:
    """For how long fixes are valid, by tag and time, before gaps in ms, which are 0 where there is no silence."""
    silent_ms = np.where(gap_ms > _LONGEST_MS, 0, gap_ms)
    first = np.flatnonzero(np.append(True, tag[1:] != tag[:-1]))
    number = np.diff(np.append(first, len(tag)))
    known_ms = t[first + number - 1] - t[first] - np.add.reduceat(gap_ms - silent_ms, first)
    is_usual = (1.0 + _KNOWN_SHARE) * silent_ms > np.repeat(known_ms, number)
    for bound_ms in GONE_MS * 2 ** np.arange(math.ceil(math.log2(_LONGEST_MS / GONE_MS))):
        rows = np.flatnonzero(silent_ms >= _SIMILAR * bound_ms)
        length = silent_ms[rows]
        between = np.where(tag[rows][1:] == tag[rows][:-1], t[rows][1:] - t[rows][:-1] - length[:-1], _LONGEST_MS)
        is_near = (np.append(between, _LONGEST_MS) < length) | (np.append(_LONGEST_MS, between) < length)
        is_usual[rows[is_near & (length > bound_ms) & (length <= 2 * bound_ms)]] = True
    return np.where(is_usual, silent_ms, np.minimum(gap_ms, gone_ms))


# Times in cells

_SIDE: Final = 2000
"""Cells along each side of the grid, which is centred on the first fixes. Not a power of two: rows would then share few
cache lines."""
_OUTSIDE: Final = _SIDE * _SIDE
_WILD_SHARE: Final = 1e-3
"""Largest share of the time that wild fixes outside the grid may account for."""


def time_in_cells(files: Sequence[Path], span: Span, cell_mm: int, tags: Collection[int] | None) -> Heatmap:
    """Return how long tags were in each cell of a grid; ``tags`` None means all. Raises SkylessError, duckdb.Error.

    The tag's last fix in the range does not count.
    """
    sums_ms = np.zeros(_OUTSIDE + 1, np.int64)
    corner: list[int] = []
    seen = set[int]()
    for (tag, _, x, y), valid_ms in fixes_in(files, span, tags):
        if not len(tag):
            continue
        places = x // cell_mm, y // cell_mm
        corner = corner or [int(np.median(one)) - _SIDE // 2 for one in places]
        column, row = ((one - first).view(np.uint32) for one, first in zip(places, corner, strict=True))
        cell = (row * np.uint32(_SIDE) + column).astype(np.intp)
        if column.max() >= _SIDE or row.max() >= _SIDE:  # negative ones are large as unsigned numbers
            cell[(column >= _SIDE) | (row >= _SIDE)] = _OUTSIDE
        np.add.at(sums_ms, cell, valid_ms)  # fast for these types only
        seen.update(tag[valid_ms == 0].tolist())
    if sums_ms[_OUTSIDE] > _WILD_SHARE * sums_ms.sum():
        raise SkylessError(f"cells of {1e-3 * cell_mm:g} m are too many; choose larger ones")
    grid, cell_m = sums_ms[:_OUTSIDE].reshape(_SIDE, _SIDE), 1e-3 * cell_mm
    columns, rows = np.flatnonzero(grid.any(axis=0)), np.flatnonzero(grid.any(axis=1))
    if not len(rows):
        return Heatmap(0.0, 0.0, cell_m, 0, 0, (), len(seen))
    grid = grid[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    if grid.size > LIMITS.cells:
        right = f"choose ones of {1.1 * cell_m * math.sqrt(grid.size / LIMITS.cells):.2g} m"
        raise SkylessError(f"{grid.size} cells of {cell_m:g} m are too many; {right}")
    x0_m, y0_m = (cell_m * (first + int(used[0])) for first, used in zip(corner, (columns, rows), strict=True))
    return Heatmap(x0_m, y0_m, cell_m, grid.shape[1], grid.shape[0], tuple((1e-3 * grid.ravel()).tolist()), len(seen))


# Contacts

_PAUSE_MS: Final = 5000
"""The longest interruption of a contact."""
_RARE_MS: Final = 1500
"""A fix that is valid for longer is compared with all of the other tag's meanwhile, others with the newest."""


def near(files: Sequence[Path], span: Span, own: Collection[int], distance_mm: int) -> NDArray[np.int64]:
    """Find when other tags were near the tag with the numbers ``own``: while the newest fixes of both are valid.

    Returns a row each for tags, begins and ends in ms, and least squared distances in mm². Of ``own``, the first fix in
    a second is used. Raises duckdb.Error; SkylessError if there are too many contacts.
    """
    fixes = [np.array([t, x, y, t + valid_ms], np.int64) for (_, t, x, y), valid_ms in fixes_in(files, span, own)]
    if not fixes:
        return np.empty((4, 0), np.int64)
    whole = np.concatenate(fixes, axis=1)
    whole = whole[:, np.argsort(whole[0])]
    nth = np.unique(whole[0] // 1000, return_index=True)[1]
    own_t, own_x, own_y = whole[:3, nth]
    own_end = np.minimum(np.maximum.reduceat(whole[3], nth), np.append(own_t[1:], whole[3].max()))

    def compared(fixes: tuple[_Ints, ...], ends: _Ints, at: _Ints) -> NDArray[np.int64]:
        """Compare fixes with those of ``own`` at the places ``at``, if both are valid at a time."""
        rows = np.flatnonzero(np.abs(fixes[2] - own_x[at]) <= distance_mm)
        rows = rows[np.abs(fixes[3][rows] - own_y[at[rows]]) <= distance_mm]
        (tag, t, x, y), at = (column[rows] for column in fixes), at[rows]
        begin, end = np.maximum(t, own_t[at]), np.minimum(ends[rows], own_end[at])
        found = np.array([tag, begin, end, (x - own_x[at]) ** 2 + (y - own_y[at]) ** 2], np.int64)
        return found[:, (begin <= end) & (found[3] <= distance_mm**2) & ~np.isin(tag, list(own))]

    runs: list[NDArray[np.int64]] = []
    for columns, valid_ms in fixes_in(files, span, None):
        t, ends = columns[1], columns[1] + valid_ms
        runs.append(compared(columns, ends, np.searchsorted(own_t, t, side="right") - 1))
        rare = np.flatnonzero(valid_ms > _RARE_MS)
        first, end = np.searchsorted(own_t, t[rare], side="right"), np.searchsorted(own_t, ends[rare])
        for part in np.array_split(np.arange(len(rare)), 1 + (end - first).sum() // ROW_GROUP):
            number = (end - first)[part]
            rows = np.repeat(rare[part], number)
            at = np.arange(len(rows)) + np.repeat(first[part] - np.cumsum(number) + number, number)
            runs.append(compared(tuple(column[rows] for column in columns), ends[rows], at))
        if sum(one.shape[1] for one in runs) > 10 * LIMITS.contacts:
            runs = [joined(runs)]
            check_contacts(runs[0])
    return joined(runs)


def joined(parts: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Join contacts with the same tag that have at most ``_PAUSE_MS`` between them."""
    runs = np.concatenate([np.empty((4, 0), np.int64), *parts], axis=1)
    if not runs.size:
        return runs
    tag, begin, end, square = runs[:, np.lexsort((runs[1], runs[0]))]
    is_other = np.append(True, tag[1:] != tag[:-1])
    later = np.cumsum(is_other) * (end.max() - begin.min() + _PAUSE_MS + 1)  # each tag after the one before
    until = np.maximum.accumulate(end + later)
    first = np.flatnonzero(np.append(True, (begin + later)[1:] > until[:-1] + _PAUSE_MS))
    return np.array([tag[first], begin[first], np.maximum.reduceat(end, first), np.minimum.reduceat(square, first)])


def check_contacts(found: NDArray[np.int64]) -> None:
    """Raise SkylessError if there are too many."""
    if found.shape[1] > LIMITS.contacts:
        raise SkylessError("the contacts are too many; choose a shorter range or a smaller distance")
