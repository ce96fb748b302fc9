"""Queries on the history of a site: tracks, times in cells and zones, contacts, and SQL.

DuckDB reads the files. Rows that are in no file yet, from the last ten minutes or so, are not included.
"""

import contextlib
import math
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from functools import wraps
from itertools import chain
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar

import duckdb
import msgspec
import numpy as np

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
from skyless.run.history.scans import GONE_MS, KNOWN, check_contacts, fixes_in, joined, near, time_in_cells
from skyless.run.history.tables import (
    check_readable,
    connection,
    database,
    pattern,
    quoted,
    read_rows,
)
from skyless.run.site_table import THRESHOLDS
from skyless.run.web import HISTORY as LIMITS

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
_PART_S: Final = 28.0 * 86_400.0
_MARGIN_S: Final = 3.0 * THRESHOLDS.longest_s
_NAMED: Final = 5
"""How many known names an error lists."""

_FIX_VALUES: Final = f"""
    x_mm / 1000 AS x_m, y_mm / 1000 AS y_m, z_mm / 1000 AS z_m, std_mm / 1000 AS std_m,
    CASE WHEN hpl_cm != {NONE_U16} THEN hpl_cm / 100 END AS hpl_m,
    list_extract({[alert.value for alert in ALERTS]}, flags & {ALERT_BITS}) AS alert,
    flags & {SIMULATED} != 0 AS simulated
"""

_FIXES: Final = f"""
    SELECT tag, epoch_ms(t) AS ms, {_FIX_VALUES}
    FROM read_parquet($files) WHERE t >= to_timestamp($begin) AND t < to_timestamp($end)
        AND z_mm NOT NULL AND std_mm NOT NULL AND {KNOWN}
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
        ((count,),) = _stream(f"SELECT count(*) FROM ({own})", files, span) if files else ((0,),)
        valid: dict[int, int] = {}
        for (_, t, *_), valid_ms in fixes_in(files, span, numbers):
            is_long = valid_ms > GONE_MS
            valid.update(zip(t[is_long].tolist(), valid_ms[is_long].tolist(), strict=True))
        gap_s = 1e-3 * max(valid.values(), default=GONE_MS)
        if not count:
            return Track(tag, (), 0, 0.0, gap_s)
        way = _Way(count, most_points, valid)
        for row in _stream(f"SELECT ms, x_m, y_m, std_m FROM ({own}) ORDER BY ms", files, span):
            way.add(*row)
        kept = way.kept()
        columns = "ms / 1000, x_m, y_m, z_m, std_m, hpl_m, alert"
        sql = f"SELECT DISTINCT ON (ms) {columns} FROM ({own} AND list_contains($kept, epoch_ms(t))) ORDER BY ms"
        points = tuple(TrackPoint(*row) for row in _stream(sql, files, span, kept=kept))
        return Track(tag, points, count, way.length_m, gap_s)

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

        Two tags are in contact while the newest fixes of both are valid, and interruptions of up to 5 s do not end it.
        """
        check_number("the distance", distance_m, least=0.01, most=LIMITS.contact_m)
        ((tag, own),) = self._tags((tag,)).items()
        names, files = self._names(), self._files(span)
        found = []
        for files_of_part, wide, part in _parts(files, span):
            runs = near(files_of_part, wide, own, round(1000.0 * distance_m))
            edges_ms = round(1000.0 * part.from_unix_s), round(1000.0 * part.to_unix_s)
            runs = runs[:, (runs[2] >= edges_ms[0]) & (runs[1] <= edges_ms[1])]
            runs[1:3] = runs[1:3].clip(*edges_ms)
            found.append(runs)
        all_parts = joined(found)
        check_contacts(all_parts)
        contacts = [
            Contact(tag, names.get(number, f"#{number}"), 1e-3 * begin, 1e-3 * end, 1e-3 * math.sqrt(square))
            for number, begin, end, square in all_parts.T.tolist()
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


# The way of a tag


class _Way:
    """A tag's track, built from its fixes in order of time: its length, and which fixes to keep."""

    def __init__(self, count: int, most: int, valid_ms: Mapping[int, int]) -> None:
        """Keep at most ``most`` of ``count`` fixes. ``valid_ms``: by time in ms, those that are valid for long."""
        self.length_m = 0.0
        """Sum of moves beyond the noise, each measured from the end of the last."""
        self._most, self._valid_ms = most, valid_ms
        self._step, self._index = max(1.0, (count - 1) / (most - 1)), -1
        self._evenly, self._at_gaps = array("q"), list[float]()
        self._before_ms, self._x, self._y = -GONE_MS, 0.0, 0.0

    def add(self, now_ms: int, x: float, y: float, std_m: float) -> None:
        moved_m = math.hypot(x - self._x, y - self._y)
        is_new = now_ms - self._before_ms > self._valid_ms.get(self._before_ms, GONE_MS)
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


def _parts(files: Sequence[Path], span: Span) -> Iterator[tuple[list[Path], Span, Span]]:
    """Split a range into parts of four weeks with fixes; of each part its files, with a margin, that range and its own.

    The margin shows whether silences at the edges are absences.
    """
    begin_s = span.from_unix_s // _PART_S * _PART_S
    while begin_s < span.to_unix_s:
        part = Span(max(begin_s, span.from_unix_s), min(begin_s + _PART_S, span.to_unix_s))
        wide = Span(
            max(part.from_unix_s - _MARGIN_S, span.from_unix_s), min(part.to_unix_s + _MARGIN_S, span.to_unix_s)
        )
        if _of_days(files, part):
            yield _of_days(files, wide), wide, part
        begin_s += _PART_S


def _of_days(files: Iterable[Path], span: Span) -> list[Path]:
    """Files that may contain fixes of the range; they are sorted by day of arrival."""
    begin, end = _day(span.from_unix_s, -_EARLY), _day(span.to_unix_s, _LATE)
    return [file for file in files if begin <= day_of(file) <= end]


def _some(known: Iterable[str], kind: str) -> str:
    names = sorted(known)
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"it has {', '.join(name[:40] for name in names[:_NAMED])}{more}" if names else f"it has no {kind} yet"
