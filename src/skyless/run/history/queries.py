"""Queries on the history of a site: tracks, times in cells and zones, contacts, and SQL.

DuckDB reads the files. Rows that are in no file yet, from the last ten minutes or so, are not included.
"""

import contextlib
import math
from array import array
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from functools import wraps
from itertools import chain
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar

import duckdb
import msgspec
import numpy as np
from numpy.typing import NDArray

from skyless.arguments import check_number
from skyless.core.errors import SkylessError
from skyless.files import whole_file
from skyless.run.fix_batch import ALERT_BITS, ALERTS, NONE_U16, SIMULATED
from skyless.run.history.answers import Contact, Dwell, Heatmap, Span, Track, TrackPoint
from skyless.run.history.layout import (
    ASSET_COLUMNS,
    EVENT_COLUMNS,
    FIX_COLUMNS,
    NAME_COLUMNS,
    ZONE_COLUMNS,
    current_events,
    current_files,
    day_of,
    site_folder,
    sites_in,
)
from skyless.run.history.tables import (
    ROW_GROUP,
    check_readable,
    connection,
    database,
    pattern,
    quoted,
    read_rows,
    select,
)
from skyless.run.site_table import RHYTHM_SHARE, SHORT_GAP_S, THRESHOLDS
from skyless.run.web import HISTORY as LIMITS

# Times in cells and contacts need all rows: NumPy takes a third of DuckDB's processor time here.

_SIDE: Final = 2000
"""Cells along each side of the grid, which is centred on the first fixes. Not a power of two: rows would then share few
cache lines."""
_OUTSIDE: Final = _SIDE * _SIDE
_WILD_SHARE: Final = 1e-3
"""Largest share of the time that wild fixes outside the grid may account for."""

_GAP_BITS: Final = 10  # of a gap in whole seconds, beside its tag
_LEAST_GAPS: Final = 3

_ScanInts = NDArray[Any]


def time_in_cells(files: Sequence[Path], span: Span, cell_mm: int, tags: Collection[int] | None) -> Heatmap:
    """Return how long tags were in each cell of a grid; ``tags`` None means all. Raises SkylessError, duckdb.Error.

    A fix counts until the tag's next one in the range, or until the tag would be gone (``run/site_table.py``). The
    tag's last fix does not count.
    """
    sums_ms = np.zeros(_OUTSIDE + 1, np.int64)
    corner: list[int] = []

    def cells() -> Iterator[list[_ScanInts]]:
        for tag, t, x, y in fixes_in(files, span, tags, "x_mm", "y_mm"):
            places = x // cell_mm, y // cell_mm
            corner[:] = corner or [int(np.median(one)) - _SIDE // 2 for one in places]
            column, row = ((one - first).view(np.uint32) for one, first in zip(places, corner, strict=True))
            cell = (row * np.uint32(_SIDE) + column).astype(np.intp)
            if column.max() >= _SIDE or row.max() >= _SIDE:  # negative ones are large as unsigned numbers
                cell[(column >= _SIDE) | (row >= _SIDE)] = _OUTSIDE
            yield [tag, t, cell]

    intervals_s = intervals_in(files, span, tags)
    counts_ms = _by_tag({tag: gone_after_ms(interval_s) for tag, interval_s in intervals_s.items()})
    for (tag, _, cell), gap_ms in with_gaps(cells()):
        np.add.at(sums_ms, cell, np.minimum(gap_ms, counts_ms(tag)))  # fast for these types only
    if sums_ms[_OUTSIDE] > _WILD_SHARE * sums_ms.sum():
        raise SkylessError(f"cells of {1e-3 * cell_mm:g} m are too many; choose larger ones")
    grid, number, cell_m = sums_ms[:_OUTSIDE].reshape(_SIDE, _SIDE), len(intervals_s), 1e-3 * cell_mm
    columns, rows = np.flatnonzero(grid.any(axis=0)), np.flatnonzero(grid.any(axis=1))
    if not len(rows):
        return Heatmap(0.0, 0.0, cell_m, 0, 0, (), number)
    grid = grid[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    if grid.size > LIMITS.cells:
        right = f"choose ones of {1.1 * cell_m * math.sqrt(grid.size / LIMITS.cells):.2g} m"
        raise SkylessError(f"{grid.size} cells of {cell_m:g} m are too many; {right}")
    x0_m, y0_m = (cell_m * (first + int(used[0])) for first, used in zip(corner, (columns, rows), strict=True))
    return Heatmap(x0_m, y0_m, cell_m, grid.shape[1], grid.shape[0], tuple((1e-3 * grid.ravel()).tolist()), number)


def with_gaps(batches: Iterable[list[_ScanInts]]) -> Iterator[tuple[list[_ScanInts], _ScanInts]]:
    """Yield fixes, of which the first columns are tags and times in ms, with the time until the same tag's next one.

    The last fix of a tag in a batch has 0 there, and comes again at the end if the next one is in another batch.
    """
    edges: list[list[_ScanInts]] = []
    for batch in batches:
        tag, t = batch[:2]
        is_last = np.append(tag[1:] != tag[:-1], True)
        gap_ms = np.append(t[1:] - t[:-1], 0)
        gap_ms[is_last] = 0
        yield batch, gap_ms
        for is_edge, is_end in ((np.append(True, is_last[:-1]), False), (is_last, True)):
            edges.append([*(column[is_edge] for column in batch), np.full(np.count_nonzero(is_edge), is_end)])
    if edges:
        columns = [np.concatenate(parts) for parts in zip(*edges, strict=True)]
        order = np.lexsort((columns[-1], columns[1], columns[0]))
        tag, t, *others, ends = (column[order] for column in columns)
        pairs = np.flatnonzero(ends[:-1] & ~ends[1:] & (tag[1:] == tag[:-1]))
        if len(pairs):
            yield [column[pairs] for column in (tag, t, *others)], np.diff(t)[pairs]


def intervals_in(
    files: Sequence[Path], span: Span, tags: Collection[int] | None, share: float = RHYTHM_SHARE
) -> dict[int, int]:
    """Return each tag's own interval in seconds, 0 if it is short. Raises duckdb.Error.

    Nearly as ``run/site_table.py`` learns it: the longest gap such that it and longer ones, three at least, fill a
    share of the tag's time in the range. Gaps in which any tag would be gone are absences.
    """
    heard: list[tuple[_ScanInts, _ScanInts]] = []  # tags, and times in ms without absences
    gaps: list[tuple[_ScanInts, _ScanInts]] = []  # tags with lengths in s, and numbers of such gaps
    for (tag, *_), gap_ms in with_gaps(fixes_in(files, span, tags)):
        gap_ms[gap_ms > 1000.0 * THRESHOLDS.longest_s] = 0
        first = np.flatnonzero(np.append(True, tag[1:] != tag[:-1]))
        heard.append((tag[first], np.add.reduceat(gap_ms, first)))
        is_long = gap_ms > 1000.0 * SHORT_GAP_S
        lengths_s = np.rint(1e-3 * gap_ms[is_long]).astype(np.int64)
        gaps.append(np.unique((tag[is_long].astype(np.int64) << _GAP_BITS) + lengths_s, return_counts=True))
    known_ms = dict(zip(*(column.tolist() for column in _sums(heard)), strict=True))
    found = dict.fromkeys(known_ms, 0)
    keys, counts = _sums(gaps)
    if not len(keys):
        return found
    changes = np.flatnonzero(np.diff(keys >> _GAP_BITS)) + 1
    for key, count in zip(np.split(keys, changes), np.split(counts, changes), strict=True):
        number, length_s = int(key[0]) >> _GAP_BITS, key & ((1 << _GAP_BITS) - 1)
        longer, longer_s = (np.cumsum(one[::-1])[::-1] for one in (count, count * length_s))
        is_usual = (longer >= _LEAST_GAPS) & (1000 * longer_s >= share * known_ms[number])
        found[number] = int(length_s[is_usual].max(initial=0))
    return found


def _sums(parts: Sequence[tuple[_ScanInts, _ScanInts]]) -> tuple[_ScanInts, _ScanInts]:
    """Sorted keys of all parts, each once, with the sum of its values."""
    nothing = np.empty(0, np.int64)
    keys, values = (np.concatenate(columns) for columns in zip((nothing, nothing), *parts, strict=True))
    found, at = np.unique(keys, return_inverse=True)
    return found, np.bincount(at, values, len(found)).astype(np.int64)


def _by_tag(values: Mapping[int, int]) -> Callable[[_ScanInts], _ScanInts]:
    """Return a function that looks up the values of tags."""
    tags, found = (np.array(column) for column in zip((-1, 0), *sorted(values.items()), strict=True))
    if len({*values.values()}) < 2:  # usually; looking up costs as much as the sums
        return lambda _: found[-1]
    return lambda tag: found[np.searchsorted(tags, tag)]


def near(
    files: Sequence[Path], span: Span, own: Collection[int], bucket_s: int, distance_mm: int, others: Collection[int]
) -> NDArray[np.int64]:
    """Find when tags with the numbers ``others`` were near the tag with the numbers ``own``.

    Returns a row each for tags, first and last buckets of time, and least squared distances. Of ``own``, the first fix
    in a bucket is compared. Raises duckdb.Error.
    """
    firsts: list[tuple[_ScanInts, ...]] = []
    bucket_ms = 1000 * bucket_s
    for _, t, x, y in fixes_in(files, span, own, "x_mm", "y_mm"):
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
    for tag, t, x, y in fixes_in(files, span, None, "x_mm", "y_mm"):
        bucket = t // bucket_ms
        at = np.searchsorted(buckets, bucket).clip(max=len(buckets) - 1)
        rows = np.flatnonzero((np.abs(x - x0[at]) <= distance_mm) & (buckets[at] == bucket))
        rows = rows[(np.abs(y[rows] - y0[at[rows]]) <= distance_mm) & np.isin(tag[rows], list(others))]
        square = (x[rows] - x0[at[rows]]) ** 2 + (y[rows] - y0[at[rows]]) ** 2
        found = np.array([tag[rows], bucket[rows], bucket[rows], square], np.int64)
        runs.append(joined([found[:, square <= distance_mm**2]]))
        if sum(one.shape[1] for one in runs) > 2 * LIMITS.contacts:
            runs = [joined(runs)]
    return joined(runs)


def joined(parts: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Join runs of buckets of the same tag with at most ``_PAUSE`` buckets between them.

    Raises SkylessError if there are too many.
    """
    runs = np.concatenate([np.empty((4, 0), np.int64), *parts], axis=1)
    if not runs.size:
        return runs
    tag, first, last, square = runs[:, np.lexsort((runs[1], runs[0]))]
    is_other = np.append(True, tag[1:] != tag[:-1])
    later = np.cumsum(is_other) * (last.max() - first.min() + _PAUSE + 2)  # each tag after the one before
    until = np.maximum.accumulate(last + later)
    begins = np.flatnonzero(np.append(True, (first + later)[1:] > until[:-1] + _PAUSE + 1))
    if len(begins) > LIMITS.contacts:
        raise SkylessError("the contacts are too many; choose a shorter range or a smaller distance")
    return np.array(
        [tag[begins], first[begins], np.maximum.reduceat(last, begins), np.minimum.reduceat(square, begins)]
    )


def fixes_in(
    files: Sequence[Path], span: Span, tags: Collection[int] | None, *places: str
) -> Iterator[list[_ScanInts]]:
    """Yield fixes by tag and time, in batches: columns of tags, of times in ms and of ``places``."""
    begin_ms, end_ms = (math.ceil(round(1000.0 * unix_s, 2)) for unix_s in (span.from_unix_s, span.to_unix_s))
    kinds = {name: FIX_COLUMNS[name] for name in ("tag", "t", *places)}
    wanted = f"t >= make_timestamptz({1000 * begin_ms}) AND t < make_timestamptz({1000 * end_ms})"
    wanted += "".join(f" AND {name} NOT NULL" for name in ("tag", *places))
    wanted += "" if tags is None else f" AND tag IN ({', '.join(map(str, tags))})"
    with connection() as duck:
        for file in files:
            columns = [*select(duck, [file], kinds, wanted).fetchnumpy().values()]
            for first in range(0, len(columns[0]), ROW_GROUP):  # in parts, which needs less memory
                yield [column[first : first + ROW_GROUP] for column in columns]


_EARLY: Final = timedelta(hours=1)
_LATE: Final = timedelta(days=1)
"""How much earlier or later than its own time a fix may arrive: clocks differ, and sites buffer while disconnected."""

_UNREADABLE: Final = (OSError, ValueError, RecursionError, duckdb.Error, msgspec.MsgspecError)
_OF_SQL: Final = (
    *(duckdb.ParserException, duckdb.BinderException, duckdb.CatalogException),
    *(duckdb.PermissionException, duckdb.DataError),
)
"""Errors of a query, whatever is in the files."""
_TRIES: Final = 3
_MOVE_M: Final = 0.25
_MOVE_SIGMAS: Final = 3.0
"""Shorter moves, in standard deviations of the fix, may be noise and do not lengthen a track."""
_BUCKETS_S: Final = (1, 2, 5, 10, 30, 60, 120, 300, 900)
"""Lengths of the intervals in which fixes are compared: the shortest that is no shorter than the tags' own ones."""
_CONTACT_SHARE: Final = 0.5
"""A tag sends rarely, for contacts, if it does so for this share of its time: longer intervals are less exact."""
_PAUSE: Final = 5
"""The longest interruption of a contact, in such intervals."""
_PART_S: Final = 28.0 * 86_400.0
_NAMED: Final = 5
"""How many known names an error lists."""

_FIX_VALUES: Final = f"""
    x_mm / 1000 AS x_m, y_mm / 1000 AS y_m, z_mm / 1000 AS z_m, std_mm / 1000 AS std_m,
    CASE WHEN hpl_cm != {NONE_U16} THEN hpl_cm / 100 END AS hpl_m,
    list_extract({[alert.value for alert in ALERTS]}, flags & {ALERT_BITS}) AS alert,
    flags & {SIMULATED} != 0 AS simulated
"""

_KNOWN: Final = "tag NOT NULL AND x_mm NOT NULL AND y_mm NOT NULL"

_FIXES: Final = f"""
    SELECT tag, epoch_ms(t) AS ms, {_FIX_VALUES}
    FROM read_parquet($files) WHERE t >= to_timestamp($begin) AND t < to_timestamp($end)
        AND z_mm NOT NULL AND std_mm NOT NULL AND {_KNOWN}
"""

_DWELL: Final = """
    WITH crossings AS (
        SELECT tag, zone, kind = 'enter' AS enters, epoch_ms(t) / 1000 AS s FROM read_parquet($files)
        WHERE kind IN ('enter', 'leave') AND t >= to_timestamp($begin) AND t < to_timestamp($end) AND tag NOT NULL
        UNION ALL
        SELECT tag, zone, arg_max(kind, t) = 'enter', $begin FROM read_parquet($files)
        WHERE kind IN ('enter', 'leave') AND t < to_timestamp($begin) AND tag NOT NULL GROUP BY tag, zone
    ), stays AS (
        SELECT tag, zone, enters, s AS since, lead(s, 1, $end) OVER of_tag AS until,
            lag(enters, 1, false) OVER of_tag AS was_inside
        FROM crossings WHERE (len($tags) = 0 OR list_contains($tags, tag)) AND zone = coalesce($zone, zone)
        WINDOW of_tag AS (PARTITION BY hash(tag, zone) ORDER BY s, enters)
    )
    SELECT tag, zone, count(*) FILTER (NOT was_inside), sum(until - since), min(since), max(until)
    FROM stays WHERE enters GROUP BY tag, zone ORDER BY tag, zone
"""
"""Stays are the time from each crossing of a zone's border to the tag's next one. Tags in a zone at the beginning enter
it then. Of two simultaneous crossings the leaving comes first. Sorting by a 64-bit hash costs two thirds of sorting by
two texts."""

VIEWS: Final = f"""
    CREATE VIEW fixes AS
        SELECT coalesce(name, '#' || tag) AS tag, epoch_ms(t) / 1000 AS unix_s, make_timestamp(epoch_us(t)) AS time_utc,
            {_FIX_VALUES}
        FROM fix_rows LEFT JOIN names ON number = tag WHERE t >= to_timestamp({{begin}}) AND t < to_timestamp({{end}});
    CREATE VIEW events AS
        SELECT epoch_ms(t) / 1000 AS unix_s, make_timestamp(epoch_us(t)) AS time_utc, * EXCLUDE t
        FROM event_rows WHERE t >= to_timestamp({{begin}}) AND t < to_timestamp({{end}});
"""
"""What SQL may ask, besides the tables ``zones`` and ``assets``."""

_P = ParamSpec("_P")
_R = TypeVar("_R")


def _asked(question: Callable[_P, _R]) -> Callable[_P, _R]:
    """Wrap a query: repeat it if a file was replaced by a larger one meanwhile; raise SkylessError if unreadable."""

    @wraps(question)
    def ask(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        try:
            for _ in range(_TRIES - 1):
                with contextlib.suppress(FileNotFoundError, duckdb.IOException):
                    return question(*args, **kwargs)
            return question(*args, **kwargs)
        except _UNREADABLE as error:
            reason = str(error).partition("\n")[0]
            raise SkylessError(f"{_damaged(args[0]) or 'the history'} cannot be read: {reason}") from None

    return ask


def _damaged(history: object) -> Path | None:
    """Return the first unreadable file of a history: not every error names it."""
    if isinstance(history, History):
        kinds = dict.fromkeys(current_files(history.folder, history.site), FIX_COLUMNS)
        kinds |= dict.fromkeys(current_events(history.folder, history.site), EVENT_COLUMNS)
        for file, columns in kinds.items():
            try:
                check_readable(file, columns)
            except SkylessError:
                return file
    return None


class History:
    """The history of one site; thread-safe."""

    def __init__(self, folder: Path, site: int) -> None:
        """Raises SkylessError if there is no history of the site."""
        self.folder, self.site = folder, site
        self._site_folder = site_folder(folder, site)
        if not self._site_folder.is_dir():
            sites = ", ".join(map(str, sites_in(folder)))
            held = f"it holds site {sites}" if sites else "skyless history run writes one"
            raise SkylessError(f"{folder} holds no history of site {site}; {held}")

    # Contents

    def tags(self) -> tuple[str, ...]:
        """Return the names of all tags."""
        return tuple(sorted(set(self._names().values())))

    def assets(self) -> dict[str, str]:
        """Return asset names by tag name, from the newest list that the history has received."""
        return {row["tag"]: row["name"] for row in self._table("assets.parquet", ASSET_COLUMNS) if row["name"]}

    @_asked
    def zones(self) -> dict[str, tuple[str, tuple[tuple[float, float], ...]]]:
        """Return names and corners of all zones by identifier."""
        kind = tuple[tuple[float, float], ...]
        return {
            row["zone"]: (row["name"] or row["zone"], msgspec.json.decode(row["corners_m"] or "[]", type=kind))
            for row in self._table("zones.parquet", ZONE_COLUMNS)
        }

    @_asked
    def known_until_unix_s(self) -> float | None:
        """Return the time of the newest row in a file; None if there is none."""
        files = (*current_files(self.folder, self.site), *current_events(self.folder, self.site))
        last_day = max(map(day_of, files), default="")
        newest = [file for file in files if day_of(file) == last_day]
        sql = "SELECT epoch_ms(max(t)) FROM read_parquet($file)"  # answered from the files' statistics
        with connection() as duck:
            found = [row for file in newest for row in duck.execute(sql, {"file": pattern(file)}).fetchall()]
        return max((ms / 1000 for (ms,) in found if ms is not None), default=None)

    # Queries

    @_asked
    def track(self, tag: str, span: Span, most_points: int = 2000) -> Track:
        """Return the track of a tag, thinned to ``most_points``; points next to gaps are kept if possible.

        Raises SkylessError if there is no such tag.
        """
        ((tag, numbers),) = self._tags((tag,)).items()
        check_number("the number of points", most_points, least=2, most=LIMITS.points)
        files, own = self._files(span), f"{_FIXES} AND tag IN ({', '.join(map(str, numbers))})"
        if not files:
            return Track(tag, (), 0, 0.0, 0.0)
        ((count,),) = _stream(f"SELECT count(*) FROM ({own})", files, span)
        gap_ms = gone_after_ms(max(intervals_in(files, span, numbers).values(), default=0))
        if not count:
            return Track(tag, (), 0, 0.0, 1e-3 * gap_ms)
        way = _Way(count, most_points, gap_ms)
        for row in _stream(f"SELECT ms, x_m, y_m, std_m FROM ({own}) ORDER BY ms", files, span):
            way.add(*row)
        kept = way.kept()
        columns = "ms / 1000, x_m, y_m, z_m, std_m, hpl_m, alert"
        sql = f"SELECT DISTINCT ON (ms) {columns} FROM ({own} AND list_contains($kept, epoch_ms(t))) ORDER BY ms"
        points = tuple(TrackPoint(*row) for row in _stream(sql, files, span, kept=kept))
        return Track(tag, points, count, way.length_m, 1e-3 * gap_ms)

    @_asked
    def heatmap(self, span: Span, cell_m: float = 0.25, tags: Sequence[str] = ()) -> Heatmap:
        """Return how long the tags (default: all) were in the cells of a grid. Raises SkylessError."""
        check_number("the cells' side", cell_m, least=0.01, most=1000.0)
        numbers = [*chain(*self._tags(tags).values())] if tags else None
        return time_in_cells(self._files(span), span, round(1000.0 * cell_m), numbers)

    @_asked
    def dwell(self, span: Span, tags: Sequence[str] = (), zone: str | None = None) -> tuple[Dwell, ...]:
        """Return how long the tags (default: all) were in the zones (default: all). Raises SkylessError.

        A visit across an end of the range counts with its part inside. An unfinished one lasts until the end of the
        range, or of the known data.
        """
        names = {one: name for one, (name, _) in self.zones().items()}
        if zone is not None and zone not in names:
            raise SkylessError(f"the history of site {self.site} has no zone {zone!r}; {_some(names, 'zones')}")
        asked, until = [*self._tags(tags)], self.known_until_unix_s()
        if until is None or until <= span.from_unix_s:
            return ()
        known = Span(span.from_unix_s, min(until, span.to_unix_s))
        rows = list(_stream(_DWELL, current_events(self.folder, self.site), known, tags=asked, zone=zone))
        if len(rows) > LIMITS.rows:
            raise SkylessError(f"the answer has more than {LIMITS.rows} rows; choose a shorter range, a tag or a zone")
        return tuple(
            Dwell(tag, one, names.get(one, one), visits, *map(float, figures)) for tag, one, visits, *figures in rows
        )

    @_asked
    def contacts(self, tag: str, span: Span, distance_m: float = 2.0) -> tuple[Contact, ...]:
        """Return when other tags were within a horizontal distance of this tag. Raises SkylessError.

        The others' fixes in each second are compared with this tag's first fix in it; where one of the two sends less
        often, those in an interval as long as its own.
        """
        check_number("the distance", distance_m, least=0.01, most=LIMITS.contact_m)
        ((tag, own),) = self._tags((tag,)).items()
        names, files = self._names(), self._files(span)
        intervals_s = intervals_in(files, span, None, _CONTACT_SHARE)
        own_s = max(intervals_s.get(number, 0) for number in own)
        others = defaultdict[int, list[int]](list)
        for number in intervals_s.keys() - set(own):
            others[_BUCKETS_S[bisect_left(_BUCKETS_S, max(own_s, intervals_s[number]))]].append(number)
        contacts = [
            Contact(
                tag,
                names.get(number, f"#{number}"),
                max(float(length_s * begin), span.from_unix_s),
                min(float(length_s * (end + 1)), span.to_unix_s),
                1e-3 * math.sqrt(square),
            )
            for length_s, numbers in others.items()
            for number, begin, end, square in joined(
                [near(*part, own, length_s, round(1000.0 * distance_m), numbers) for part in _parts(files, span)]
            ).T.tolist()
        ]
        return tuple(sorted(contacts, key=lambda one: (one.begin_unix_s, one.other)))

    @_asked
    def sql(self, query: str, span: Span) -> list[dict[str, Any]]:
        """Answer an SQL query over ``VIEWS``, of which fixes and events are those of the range. Raises SkylessError."""
        with self._views(query, span) as (duck, select):
            found = duck.execute(select)
            names = [column[0] for column in found.description]
            rows = found.fetchmany(LIMITS.rows + 1)
        if len(rows) > LIMITS.rows:
            raise SkylessError(f"the answer has more than {LIMITS.rows} rows; --write takes all, and LIMIT some")
        return [dict(zip(names, row, strict=True)) for row in rows]

    @_asked
    def write(self, query: str, span: Span, file: Path) -> int:
        """Write the answer of an SQL query to a .csv or .parquet file. Returns the number of rows.

        Raises SkylessError, OSError.
        """
        if file.suffix not in {".csv", ".parquet"}:
            raise SkylessError(f"{file} ends with {file.suffix!r}; it should end with .csv or .parquet")
        with whole_file(file) as scratch, self._views(query, span, scratch) as (duck, select):
            copy = f"COPY (\n{select}\n) TO {quoted(scratch)} (FORMAT {file.suffix[1:]})"
            return int(duck.execute(copy).fetchall()[0][0])

    @contextlib.contextmanager
    def _views(self, query: str, span: Span, *written: Path) -> Iterator[tuple[duckdb.DuckDBPyConnection, str]]:
        """Open DuckDB with the views, and check that a query reads only. It can open no other files than theirs."""
        events = current_events(self.folder, self.site)
        tables = {"fix_rows": (FIX_COLUMNS, self._files(span)), "event_rows": (EVENT_COLUMNS, events)}
        for name, columns in (("zones", ZONE_COLUMNS), ("assets", ASSET_COLUMNS)):
            file = self._site_folder / f"{name}.parquet"
            tables[name] = columns, [file] if file.exists() else []
        readable = [file.resolve() for _, files in tables.values() for file in files]
        with database() as duck:
            for name, (columns, files) in tables.items():
                if files:
                    listed = ", ".join(quoted(pattern(file.resolve())) for file in files)
                    duck.execute(f"CREATE VIEW {name} AS SELECT {', '.join(columns)} FROM read_parquet([{listed}])")
                else:
                    nothing = ", ".join(f"CAST(NULL AS {kind}) AS {column}" for column, kind in columns.items())
                    duck.execute(f"CREATE VIEW {name} AS SELECT {nothing} LIMIT 0")
            names = self._names()
            duck.execute(
                "CREATE TABLE names AS SELECT unnest($1::BIGINT[]) AS number, unnest($2::VARCHAR[]) AS name",
                [list(names), list(names.values())],
            )
            duck.execute(VIEWS.format(begin=span.from_unix_s, end=span.to_unix_s))
            allowed = ", ".join(map(quoted, (*readable, *written)))
            duck.execute(f"SET allowed_paths = [{allowed}]; SET enable_external_access = false")
            duck.execute("SET lock_configuration = true")
            try:
                statements = duck.extract_statements(query)
                if [one.type for one in statements] != [duckdb.StatementType.SELECT]:
                    raise SkylessError(f"the SQL is {query[:60]!r}; it should be one SELECT")
                yield duck, statements[0].query.rstrip().removesuffix(";")
            except duckdb.Error as error:
                if isinstance(error, duckdb.IOException) or (not isinstance(error, _OF_SQL) and _damaged(self)):
                    raise
                raise SkylessError(f"the SQL cannot be answered: {str(error).partition(chr(10))[0]}") from None

    # Helpers

    def _files(self, span: Span) -> list[Path]:
        return _of_days(current_files(self.folder, self.site), span)

    def _table(self, name: str, columns: dict[str, str]) -> list[dict[str, Any]]:
        file = self._site_folder / name
        rows = read_rows(file, columns) if file.exists() else []
        return [row for row in rows if row[next(iter(columns))] is not None]

    def _names(self) -> dict[int, str]:
        """Newest name of each number."""
        rows = self._table("names.parquet", NAME_COLUMNS)
        return {row["tag"]: row["name"] for row in sorted(rows, key=lambda row: row["since"] or 0) if row["name"]}

    def _tags(self, asked: Iterable[str]) -> dict[str, list[int]]:
        """Resolve names of tags or assets to tags and their numbers. Raises SkylessError."""
        numbers = defaultdict(list)
        for number, name in self._names().items():
            numbers[name].append(number)
        found, assets = {}, self.assets()
        for one in asked:
            tags = [tag for tag, name in assets.items() if tag in numbers and name.casefold() == one.casefold()]
            tags = [one] if one in numbers else tags
            if len(tags) > 1:
                raise SkylessError(f"{one!r} is the name of {' and '.join(sorted(tags))}; it should be one of these")
            if not tags:
                raise SkylessError(f"the history of site {self.site} has no tag {one!r}; {_some(numbers, 'tags')}")
            found[tags[0]] = numbers[tags[0]]
        return found


def gone_after_ms(interval_s: int) -> int:
    """How long a position counts if no other follows."""
    return round(1000.0 * THRESHOLDS.gone_after_s(interval_s, THRESHOLDS.longest_s))


# The way of a tag


class _Way:
    """A tag's track, built from its fixes in order of time: its length, and which fixes to keep."""

    def __init__(self, count: int, most: int, gap_ms: int) -> None:
        """Keep at most ``most`` of ``count`` fixes."""
        self.length_m = 0.0
        """Sum of moves beyond the noise, each measured from the end of the last."""
        self._most, self._gap_ms = most, gap_ms
        self._step, self._index = max(1.0, (count - 1) / (most - 1)), -1
        self._evenly, self._at_gaps = array("q"), list[float]()
        self._before_ms, self._x, self._y = -math.inf, 0.0, 0.0

    def add(self, now_ms: int, x: float, y: float, std_m: float) -> None:
        moved_m = math.hypot(x - self._x, y - self._y)
        is_new = now_ms - self._before_ms > self._gap_ms
        if is_new or moved_m >= max(_MOVE_M, _MOVE_SIGMAS * std_m):
            self.length_m += 0.0 if is_new else moved_m
            self._x, self._y = x, y
        if is_new and self._index >= 0 and len(self._at_gaps) <= self._most // 2:
            self._at_gaps += [self._before_ms, now_ms]
        self._index += 1
        if self._index >= round(len(self._evenly) * self._step):
            self._evenly.append(now_ms)
        self._before_ms = now_ms

    def kept(self) -> list[int]:
        """Times of the fixes to keep, evenly spaced; those at gaps are kept if they are at most half of ``most``."""
        at_gaps = np.unique(np.array(self._at_gaps, np.int64))
        if len(at_gaps) > self._most // 2:
            at_gaps = at_gaps[:0]
        evenly = np.array(self._evenly)
        if len(evenly) + len(at_gaps) > self._most:
            evenly = evenly[np.linspace(0, len(evenly) - 1, self._most - len(at_gaps)).round().astype(int)]
        return [int(ms) for ms in np.union1d(evenly, at_gaps)]


# Files and DuckDB


def _stream(sql: str, files: Iterable[Path], span: Span, **more: object) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a result, with few of them in memory at once."""
    parameters = {"files": list(map(pattern, files)), "begin": span.from_unix_s, "end": span.to_unix_s} | more
    if parameters["files"]:
        with connection() as duck:
            found = duck.execute(sql, parameters)
            while rows := found.fetchmany(10_000):
                yield from rows


def _day(unix_s: float, later: timedelta) -> str:
    return (datetime.fromtimestamp(unix_s, UTC) + later).date().isoformat()


def _parts(files: Sequence[Path], span: Span) -> Iterator[tuple[list[Path], Span]]:
    """Split a range into parts of four weeks, leaving out those without files."""
    begin_s = span.from_unix_s // _PART_S * _PART_S
    while begin_s < span.to_unix_s:
        part = Span(max(begin_s, span.from_unix_s), min(begin_s + _PART_S, span.to_unix_s))
        if of_part := _of_days(files, part):
            yield of_part, part
        begin_s += _PART_S


def _of_days(files: Iterable[Path], span: Span) -> list[Path]:
    """Files that may contain fixes of the range; they are sorted by day of arrival."""
    begin, end = _day(span.from_unix_s, -_EARLY), _day(span.to_unix_s, _LATE)
    return [file for file in files if begin <= day_of(file) <= end]


def _some(known: Iterable[str], kind: str) -> str:
    names = sorted(known)
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"it has {', '.join(name[:40] for name in names[:_NAMED])}{more}" if names else f"it has no {kind} yet"
