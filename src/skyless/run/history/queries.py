"""Questions to the history of a site: ways, times in cells and zones, contacts, alarms; and its fixes as a file.

DuckDB reads the files, and NumPy where a question needs all rows (``_scans.py``). Rows that are in the journal only,
those of the last ten minutes or so, are not known yet.
"""

import contextlib
import math
import secrets
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from functools import wraps
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar

import duckdb
import msgspec
import numpy as np
import pyarrow
from numpy.typing import NDArray
from pyarrow import parquet

from skyless.core.arguments import check_number
from skyless.core.earth import geodetic
from skyless.core.errors import SkylessError
from skyless.core.site import GeoreferenceSite
from skyless.core.whole_files import whole_file
from skyless.run.fix_batch import ALERT_BITS, ALERTS, NONE_U16, SIMULATED
from skyless.run.history._scans import near, time_in_cells
from skyless.run.history.answers import (
    GAP_S,
    THINNED_GAP_S,
    AlarmRow,
    Contact,
    Dwell,
    Heatmap,
    Occupancy,
    Span,
    Track,
    TrackPoint,
)
from skyless.run.history.layout import THINNED, current_events, current_files, site_folder

MEMORY: Final = "800MB"
"""What DuckDB may use, which is most of what a question uses."""

EXPORT_SUFFIXES: Final = (".csv", ".parquet", ".geojsonl")

_EARLY: Final = timedelta(hours=1)
_LATE: Final = timedelta(days=1)
"""How much earlier and later than its time a fix may arrive: clocks differ, and sites keep what a cut line delays."""

_MOVE_MM: Final = 250
_MOVE_SIGMAS: Final = 3.0
"""Moves that are shorter, or within so many standard deviations of the fix, may be noise and do not lengthen a way."""
_CONTACT_MS: Final = {False: (1000, 5), True: (10_000, 6)}
"""By whether days are thinned: fixes within the same so many milliseconds are compared, and a contact goes on after an
interruption of so many such times or less."""
_MAX_DISTANCE_M: Final = 50.0
_MAX_STEPS: Final = 100_000
_NAMED: Final = 5
"""How many known names an error lists."""
_NEWEST: Final = 3
"""Files among which the newest row is."""

_VISITS: Final = """
    WITH crossings AS (
        SELECT tag, zone, kind, greatest(epoch_ms(t), $begin) AS ms FROM read_parquet($files)
        WHERE kind IN ('enter', 'leave') AND t >= to_timestamp($begin / 1000) AND t < to_timestamp($end / 1000)
        UNION ALL
        SELECT tag, zone, arg_max(kind, t), $begin FROM read_parquet($files)
        WHERE kind IN ('enter', 'leave') AND t < to_timestamp($begin / 1000) GROUP BY tag, zone
    ), numbered AS (
        SELECT *, lag(kind, 1, 'leave') OVER (PARTITION BY tag, zone ORDER BY ms, kind DESC) AS before FROM crossings
        WHERE tag IS NOT NULL AND zone IS NOT NULL AND (len($tags) = 0 OR list_contains($tags, tag))
            AND ($zone IS NULL OR zone = $zone)
    ), changes AS (SELECT tag, zone, kind = 'enter' AS enters, ms FROM numbered WHERE kind != before)
"""
"""When tags entered and left zones, in turn. Those that were in a zone at the beginning enter it there. Of two
crossings at one instant the leaving is the first."""

_DWELL: Final = """
    SELECT tag, zone, count(*) FILTER (enters) AS visits, visits > count(*) FILTER (NOT enters) AS is_open,
        sum(CASE WHEN enters THEN -ms ELSE ms END) + CASE WHEN is_open THEN $end ELSE 0 END, min(ms),
        CASE WHEN is_open THEN $end ELSE max(ms) END
    FROM changes GROUP BY tag, zone ORDER BY tag, zone
"""

_FIXES: Final = """
    SELECT epoch_ms(t) AS t, x_mm, y_mm, z_mm, std_mm, hpl_cm, flags FROM read_parquet($files)
    WHERE tag IN ({tags}) AND t >= to_timestamp($begin) AND t < to_timestamp($end) ORDER BY t
"""

_ALARMS: Final = """
    SELECT alarm, max(subject), max(text) FILTER (kind = 'alarm-raised'),
        epoch_ms(min(t) FILTER (kind = 'alarm-raised')) AS raised,
        epoch_ms(max(t) FILTER (kind = 'alarm-ended')) AS ended,
        epoch_ms(min(t) FILTER (kind = 'alarm-acknowledged')),
        arg_min(text, t) FILTER (kind = 'alarm-acknowledged')
    FROM read_parquet($files) WHERE kind LIKE 'alarm-%' AND alarm IS NOT NULL GROUP BY alarm
    HAVING raised < $end AND (ended IS NULL OR ended >= $begin) ORDER BY raised, alarm
"""

_EXPORT: Final = f"""
    SELECT coalesce(name, '#' || tag) AS tag, make_timestamp(epoch_ms(t) * 1000) AS time_utc,
        x_mm / 1000 AS x_m, y_mm / 1000 AS y_m, z_mm / 1000 AS z_m, std_mm / 1000 AS std_m,
        CASE WHEN hpl_cm != {NONE_U16} THEN hpl_cm / 100 END AS hpl_m, alert, flags & {SIMULATED} != 0 AS simulated
    FROM read_parquet($files)
        LEFT JOIN (SELECT unnest($numbers) AS tag, unnest($names) AS name) USING (tag)
        LEFT JOIN (SELECT unnest($codes) AS code, unnest($alerts) AS alert) ON code = flags & {ALERT_BITS}
    WHERE t >= to_timestamp($begin) AND t < to_timestamp($end) {{of_tags}} ORDER BY 1, 2
"""

_P = ParamSpec("_P")
_R = TypeVar("_R")
_Ints = NDArray[np.int64]
_Floats = NDArray[np.float64]


def sites_in(folder: Path) -> tuple[int, ...]:
    """Numbers of the sites whose history a folder holds."""
    found = (one.name.removeprefix("site=") for one in folder.glob("site=*"))
    return tuple(sorted(int(number) for number in found if number.isdecimal()))


def _asked(question: Callable[_P, _R]) -> Callable[_P, _R]:
    """A question that is asked again where a file has gone, as a larger one has replaced it meanwhile."""

    @wraps(question)
    def ask(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with contextlib.suppress(FileNotFoundError, duckdb.IOException):
            return question(*args, **kwargs)
        try:
            return question(*args, **kwargs)
        except (OSError, duckdb.Error, pyarrow.ArrowException) as error:
            reason = str(error).partition("\n")[0]
            raise SkylessError(f"the history cannot be read: {reason}") from None

    return ask


class History:
    """The history of one site. May be asked from several threads."""

    def __init__(self, folder: Path, site: int) -> None:
        """Raises SkylessError: there is no history of the site."""
        self.folder, self.site = folder, site
        if not site_folder(folder, site).is_dir():
            sites = ", ".join(map(str, sites_in(folder)))
            held = f"it holds site {sites}" if sites else "skyless history run writes one"
            raise SkylessError(f"{folder} holds no history of site {site}; {held}")

    # What there is

    def tags(self) -> tuple[str, ...]:
        """Names of all tags."""
        return tuple(sorted(set(self._names().values())))

    def zones(self) -> dict[str, tuple[str, tuple[tuple[float, float], ...]]]:
        """Names and corners of all zones by their identifiers."""
        file = site_folder(self.folder, self.site) / "zones.parquet"
        rows = _rows("SELECT zone, name, corners_m FROM read_parquet($1)", file)
        kind = tuple[tuple[float, float], ...]
        return {zone: (name or zone, msgspec.json.decode(corners or "[]", type=kind)) for zone, name, corners in rows}

    def known_until_unix_s(self) -> float | None:
        """The time of the newest row that is in a file; None without any."""
        newest = [*current_files(self.folder, self.site)[-_NEWEST:], *current_events(self.folder, self.site)[-_NEWEST:]]
        if not newest:
            return None
        with _connection() as duck:
            files = list(map(str, newest))
            (row,) = duck.execute(
                "SELECT max(epoch_ms(t)) FROM read_parquet($files, union_by_name=true)", {"files": files}
            ).fetchall()
        return None if row[0] is None else 1e-3 * row[0]

    # Questions

    @_asked
    def track(self, tag: str, span: Span, most_points: int = 2000) -> Track:
        """The way of a tag, thinned to a number of points; what lies next to a gap stays, as long as that is possible.

        Raises SkylessError: there is no such tag.
        """
        found = self._fixes(self._numbers((tag,)), span, self._files(span))
        if not found:
            return Track(tag, (), 0, 0.0)
        ms, x_mm, y_mm, std_mm = (np.asarray(found[name], np.int64) for name in ("t", "x_mm", "y_mm", "std_mm"))
        gap_ms = 1000.0 * (THINNED_GAP_S if True in self._files_by_kind(span) else GAP_S)
        kept = _thinned(ms, max(most_points, 2), gap_ms)
        columns = (
            1e-3 * ms,
            1e-3 * x_mm,
            1e-3 * y_mm,
            1e-3 * found["z_mm"],
            1e-3 * std_mm,
            found["hpl_cm"],
            found["flags"],
        )
        points = tuple(
            TrackPoint(unix_s, x, y, z, std_m, None if hpl_cm == NONE_U16 else hpl_cm / 100.0, _alert(flags))
            for unix_s, x, y, z, std_m, hpl_cm, flags in zip(
                *(np.asarray(column)[kept].tolist() for column in columns), strict=True
            )
        )
        return Track(
            tag, points, len(ms), 1e-3 * _length_mm(ms, x_mm, y_mm, np.maximum(_MOVE_MM, _MOVE_SIGMAS * std_mm), gap_ms)
        )

    @_asked
    def heatmap(self, span: Span, cell_m: float = 0.25, tags: Sequence[str] = ()) -> Heatmap:
        """How long tags, by default all, were in the cells of a grid. Raises SkylessError."""
        check_number("the cells' side", cell_m, least=0.01, most=1000.0)
        numbers = self._numbers(tags) if tags else None
        return time_in_cells(self._files(span), span, round(1000.0 * cell_m), numbers)

    @_asked
    def dwell(self, span: Span, tags: Sequence[str] = (), zone: str | None = None) -> tuple[Dwell, ...]:
        """How long tags, by default all, were in zones, by default all. Raises SkylessError.

        A visit at an edge of the range counts with its part in it. One that has not ended goes on until the end of the
        range, or of what is known.
        """
        names = self._zone_names(zone)
        return tuple(
            Dwell(tag, one, names.get(one, one), visits, 1e-3 * float(ms), 1e-3 * first, 1e-3 * last)
            for tag, one, visits, _, ms, first, last in self._of_changes(_DWELL, span, tags, zone)
        )

    @_asked
    def occupancy(self, span: Span, zone: str | None = None, step_s: float = 300.0) -> tuple[Occupancy, ...]:
        """How many tags were in zones, by default all, in each step of time; the last step may be shorter.

        Raises SkylessError.
        """
        check_number("the step", step_s, least=1.0)
        length_s = span.to_unix_s - span.from_unix_s
        if length_s / step_s > _MAX_STEPS:
            raise SkylessError(f"steps of {step_s:g} s in a range of {length_s:.0f} s are too many; choose longer ones")
        times: dict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
        for one, enters, ms in self._of_changes("SELECT zone, enters, ms FROM changes", span, (), zone):
            times[one][0 if enters else 1].append(1e-3 * ms - span.from_unix_s)
        until_s = (self.known_until_unix_s() or span.from_unix_s) - span.from_unix_s
        names = self._zone_names(zone)
        edges = np.append(np.arange(0.0, length_s, step_s), length_s)
        return tuple(
            Occupancy(one, names.get(one, one), span.from_unix_s + begin, mean, most)
            for one in ([zone] if zone is not None else sorted({*names, *times}))
            for begin, mean, most in zip(edges[:-1].tolist(), *counts(*times[one], until_s, edges), strict=True)
        )

    @_asked
    def contacts(self, tag: str, span: Span, distance_m: float = 2.0) -> tuple[Contact, ...]:
        """When other tags were within a distance in the plane of each other, by fixes within the same second.

        In days that are thinned by fixes within the same ten seconds. Raises SkylessError.
        """
        check_number("the distance", distance_m, least=0.01, most=_MAX_DISTANCE_M)
        own, names, limit_mm = self._numbers((tag,)), self._names(), round(1000.0 * distance_m)
        found: list[Contact] = []
        for is_thinned, files in self._files_by_kind(span).items():
            length_ms, gap = _CONTACT_MS[is_thinned]
            fixes = self._fixes(own, span, files)
            if not fixes:
                continue
            places = [np.asarray(fixes[name], np.int64) for name in ("t", "x_mm", "y_mm")]
            least: dict[str, dict[int, float]] = defaultdict(dict)
            for number, bucket, square in zip(*near(files, span, places, own, length_ms, limit_mm), strict=True):
                of_other = least[names.get(number, f"#{number}")]
                of_other[bucket] = min(square, of_other.get(bucket, math.inf))
            for other, squares in least.items():
                for begin, end in merged(sorted(squares), gap):
                    least_mm = math.sqrt(min(square for bucket, square in squares.items() if begin <= bucket < end))
                    begin_s = max(1e-3 * length_ms * begin, span.from_unix_s)
                    end_s = min(1e-3 * length_ms * end, span.to_unix_s)
                    found.append(Contact(tag, other, begin_s, end_s, 1e-3 * least_mm))
        return tuple(sorted(found, key=lambda one: (one.begin_unix_s, one.other)))

    @_asked
    def alarms(self, span: Span) -> tuple[AlarmRow, ...]:
        """Alarms that were raised before the range's end and had not ended at its beginning. Raises SkylessError."""
        files = list(map(str, current_events(self.folder, self.site)))
        if not files:
            return ()
        with _connection() as duck:
            limits = {"begin": round(1000.0 * span.from_unix_s), "end": round(1000.0 * span.to_unix_s)}
            rows = duck.execute(_ALARMS, {"files": files} | limits).fetchall()
        return tuple(
            AlarmRow(
                *(alarm, alarm.partition("/")[0], subject or "", text or ""),
                *(1e-3 * raised, _seconds(ended), _seconds(seen), by or ""),
            )
            for alarm, subject, text, raised, ended, seen, by in rows
        )

    @_asked
    def export(self, file: Path, span: Span, tags: Sequence[str] = (), origin: GeoreferenceSite | None = None) -> int:
        """Write the fixes of tags, by default all, by name and time; return how many. The suffix is the format.

        GeoJSON, one feature a line, needs the site's georeference. Raises SkylessError, OSError.
        """
        numbers, files = self._numbers(tags) if tags else None, self._files(span)
        if file.suffix not in EXPORT_SUFFIXES:
            raise SkylessError(f"{file} ends with {file.suffix!r}; it should end with {' or '.join(EXPORT_SUFFIXES)}")
        if file.suffix == ".geojsonl" and origin is None:
            raise SkylessError("GeoJSON has degrees: it needs a site with [georeference] (latitude_deg, longitude_deg)")
        names, is_parquet = self._names(), file.suffix == ".parquet"
        parameters = _parameters(files, span) | {
            "numbers": list(names) or [0],
            "names": list(names.values()) or [""],
            "codes": list(range(1, len(ALERTS) + 1)),
            "alerts": [str(alert.value) for alert in ALERTS],
        }
        sql = _EXPORT.format(of_tags="" if numbers is None else f"AND tag IN ({_listed(numbers)})")
        if not files:
            raise SkylessError("there are no fixes in this range: nothing is written")
        with _connection() as duck, whole_file(file) as scratch:
            if origin is not None and file.suffix == ".geojsonl":
                return _write_features(scratch, duck.execute(sql, parameters), origin)
            found = duck.sql(sql, params=parameters)
            (found.write_parquet if is_parquet else found.write_csv)(str(scratch))
            written = f"SELECT count(*) FROM read_{'parquet' if is_parquet else 'csv'}($1)"
            return int(duck.execute(written, [str(scratch)]).fetchall()[0][0])

    # What they share

    def _files(self, span: Span) -> list[str]:
        """Files in which fixes of the range may be: they lie by the day of arrival."""
        begin = (_utc(span.from_unix_s) - _EARLY).date().isoformat()
        end = (_utc(span.to_unix_s) + _LATE).date().isoformat()
        files = current_files(self.folder, self.site)
        return [str(file) for file in files if begin <= file.parent.name.removeprefix("day=") <= end]

    def _fixes(self, numbers: Iterable[int], span: Span, files: list[str]) -> dict[str, NDArray[Any]]:
        """The fixes of tags in order of time, as columns; empty without any."""
        if not files:
            return {}
        with _connection() as duck:
            found = duck.execute(_FIXES.format(tags=_listed(numbers)), _parameters(files, span)).fetchnumpy()
        return found if len(found["t"]) else {}

    def _files_by_kind(self, span: Span) -> dict[bool, list[str]]:
        """The same files, by whether those of their day are thinned."""
        found: dict[bool, list[str]] = {}
        for _, files in groupby(self._files(span), lambda file: Path(file).parent):
            of_day = list(files)
            found.setdefault(THINNED in (parquet.read_schema(of_day[0]).metadata or {}), []).extend(of_day)
        return found

    def _names(self) -> dict[int, str]:
        """The newest name of each number."""
        file = site_folder(self.folder, self.site) / "names.parquet"
        return dict(_rows("SELECT tag, name FROM read_parquet($1) ORDER BY since", file))

    def _numbers(self, tags: Iterable[str]) -> tuple[int, ...]:
        """The numbers of tags. Raises SkylessError for a name that no tag has."""
        numbers = defaultdict(list)
        for number, name in self._names().items():
            numbers[name].append(number)
        for tag in tags:
            if tag not in numbers:
                raise SkylessError(f"the history of site {self.site} has no tag {tag!r}; {_some(numbers, 'tags')}")
        return tuple(number for tag in tags for number in numbers[tag])

    def _zone_names(self, zone: str | None) -> dict[str, str]:
        """Names by identifier. Raises SkylessError where ``zone`` is not among them."""
        names = {one: name for one, (name, _) in self.zones().items()}
        if zone is not None and zone not in names:
            raise SkylessError(f"the history of site {self.site} has no zone {zone!r}; {_some(names, 'zones')}")
        return names

    def _of_changes(self, sql: str, span: Span, tags: Sequence[str], zone: str | None) -> list[tuple[Any, ...]]:
        if tags:
            self._numbers(tags)
        until, files = self.known_until_unix_s(), list(map(str, current_events(self.folder, self.site)))
        if not files or until is None or until <= span.from_unix_s:
            return []
        begin, end = round(1000.0 * span.from_unix_s), round(1000.0 * min(until, span.to_unix_s))
        parameters = {"files": files, "begin": begin, "end": end, "tags": list(tags), "zone": zone}
        with _connection() as duck:
            return duck.execute(_VISITS + sql, parameters).fetchall()


# Plain computations


def merged(numbers: Sequence[int], gap: int) -> list[tuple[int, int]]:
    """Intervals of sorted numbers, their ends excluded; a pause of ``gap`` numbers or less is within an interval."""
    if not numbers:
        return []
    breaks = [(before, after) for before, after in pairwise(numbers) if after - before - 1 > gap]
    begins, ends = (
        [numbers[0], *(after for _, after in breaks)],
        [*(before + 1 for before, _ in breaks), numbers[-1] + 1],
    )
    return list(zip(begins, ends, strict=True))


def counts(
    entered: Sequence[float], left: Sequence[float], until: float, edges: _Floats
) -> tuple[list[float], list[int]]:
    """How many are inside in each interval between edges: their mean and most. Who has not left does so at last."""
    begins, ends = np.sort(entered), np.sort([*left, *(until for _ in range(len(entered) - len(left)))])
    mean = np.diff(_ramp(begins, edges) - _ramp(ends, edges)) / np.diff(edges)
    most = np.searchsorted(begins, edges[:-1], "right") - np.searchsorted(ends, edges[:-1], "right")
    after = np.arange(1, len(begins) + 1) - np.searchsorted(ends, begins, "right")
    step = np.searchsorted(edges, begins, "right") - 1
    inside = (step >= 0) & (step < len(most))
    np.maximum.at(most, step[inside], after[inside])
    return np.maximum(mean, 0.0).tolist(), most.tolist()


def _ramp(times: _Floats, at: _Floats) -> _Floats:
    """The sum of how long each of the sorted times has passed at ``at``."""
    passed = np.searchsorted(times, at)
    ramp: _Floats = passed * at - np.append(0.0, np.cumsum(times))[passed]
    return ramp


def _thinned(ms: _Ints, most: int, gap_ms: float) -> NDArray[np.intp]:
    """Indices of at most so many rows, evenly among them; the rows at gaps are kept if they are half of it at most."""
    if len(ms) <= most:
        return np.arange(len(ms))
    gaps = np.flatnonzero(np.diff(ms) > gap_ms)
    fixed = np.union1d(gaps, gaps + 1)
    if len(fixed) > most // 2:
        fixed = fixed[:0]
    evenly = np.linspace(0, len(ms) - 1, most - len(fixed)).round().astype(np.intp)
    return np.union1d(evenly, fixed).astype(np.intp)


def _length_mm(ms: _Ints, x_mm: _Ints, y_mm: _Ints, least_mm: _Floats, gap_ms: float) -> float:
    """Length of a way of moves that are not shorter than the least ones, each from the end of the last."""
    total_mm = x0 = y0 = 0.0
    before_ms = -math.inf
    for now_ms, x, y, least in zip(*(column.tolist() for column in (ms, x_mm, y_mm, least_mm)), strict=True):
        moved_mm = math.hypot(x - x0, y - y0)
        if now_ms - before_ms > gap_ms:
            x0, y0 = x, y
        elif moved_mm >= least:
            total_mm += moved_mm
            x0, y0 = x, y
        before_ms = now_ms
    return total_mm


def _alert(flags: int) -> str | None:
    number = flags & ALERT_BITS
    return str(ALERTS[number - 1].value) if 1 <= number <= len(ALERTS) else None


# Files and DuckDB


@contextlib.contextmanager
def _connection() -> Iterator[duckdb.DuckDBPyConnection]:
    """DuckDB without files of its own but temporary ones, and without the network."""
    spill = str(Path(tempfile.gettempdir()) / f"skyless-history-{secrets.token_hex(8)}")  # made where it is needed
    options: dict[str, Any] = {"memory_limit": MEMORY, "temp_directory": spill, "autoinstall_known_extensions": "false"}
    duck = duckdb.connect(config=options)
    try:
        yield duck
    finally:
        duck.close()


def _rows(sql: str, file: Path) -> list[tuple[Any, ...]]:
    """The rows of a small file; none where it does not exist yet."""
    if not file.exists():
        return []
    with _connection() as duck:
        return duck.execute(sql, [str(file)]).fetchall()


def _parameters(files: list[str], span: Span) -> dict[str, object]:
    return {"files": files, "begin": span.from_unix_s, "end": span.to_unix_s}


def _listed(numbers: Iterable[int]) -> str:
    return ", ".join(map(str, map(int, numbers)))


def _some(known: Iterable[str], kind: str) -> str:
    names = sorted(known)
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"it has {', '.join(names[:_NAMED])}{more}" if names else f"it has no {kind} yet"


def _seconds(ms: int | None) -> float | None:
    return None if ms is None else 1e-3 * ms


def _utc(unix_s: float) -> datetime:
    return datetime.fromtimestamp(min(max(unix_s, 86_400.0), 2.5e11), UTC)


def _write_features(file: Path, found: duckdb.DuckDBPyConnection, origin: GeoreferenceSite) -> int:
    count = 0
    with file.open("wb") as out:
        while rows := found.fetchmany(10_000):
            for tag, time_utc, x, y, z, std_m, hpl_m, alert, simulated in rows:
                latitude, longitude, height_m = geodetic((x, y, z), origin)
                place = [round(longitude, 9), round(latitude, 9), round(height_m, 4)]
                stamp = f"{time_utc.isoformat(timespec='milliseconds')}Z"
                facts = {"tag": tag, "time_utc": stamp, "std_m": std_m, "hpl_m": hpl_m, "alert": alert}
                geometry = {"type": "Point", "coordinates": place}
                feature = {"type": "Feature", "geometry": geometry, "properties": facts | {"simulated": simulated}}
                out.write(msgspec.json.encode(feature) + b"\n")
            count += len(rows)
    return count
