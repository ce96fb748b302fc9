"""Users' CSV tables of anchors, truth, ranges and heights. Other columns are ignored.

Anchors: ``id,x_m,y_m,z_m``, optionally with a calibration. An id is as in ``anchor_names``; in a table in which one is
a MAC address with a letter, so are all of 4 or 16 digits. Truth: ``t_s,x_m,y_m,z_m`` and, if measured, the attitude
``qx,qy,qz,qw``; or the listener's positions in a table of MILUV passive ticks (``gt_L_…``). Ranges of a survey:
``anchor_a,anchor_b,range_m``, one row for each range in either direction. Heights: ``id,z_m``.
All functions raise ConfigurationError, which names file, line, column and value of the fault.
"""

import csv
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from io import StringIO
from math import inf
from os import PathLike
from typing import Final, TypeVar

import numpy as np
from msgspec import Struct

from skyless.core.air.masterless_packets import Point
from skyless.core.air.site_pages import MAX_COORDINATE_M
from skyless.core.arrays import Array
from skyless.core.errors import ConfigurationError
from skyless.files import finite, read_lines
from skyless.site.anchor_names import anchor_name, is_address, read_anchor
from skyless.site.survey.anchor_errors import AnchorCalibration, DifferenceCalibration
from skyless.site.survey.facts import PairRanges
from skyless.site.survey.legs import mean_ranges

ANCHOR_COLUMNS: Final = ("id", "x_m", "y_m", "z_m")
BIAS, SLOPE, NOISE = CALIBRATION_COLUMNS = ("bias_m", "bias_slope_m", "noise_m")
"""Columns added by ``skyless calibrate``. A blank field means unknown."""

POSITION_COLUMNS: Final = ("t_s", "x_m", "y_m", "z_m")
LISTENER_COLUMNS: Final = ("t_s", "gt_L_x_m", "gt_L_y_m", "gt_L_z_m")
QUATERNION_COLUMNS: Final = ("qx", "qy", "qz", "qw")
RANGE_COLUMNS: Final = ("anchor_a", "anchor_b", "range_m")
HEIGHT_COLUMNS: Final = ("id", "z_m")

_MAX_EARTH_M: Final = 1e8
"""Limit of coordinates in any frame on Earth."""

_MAX_RANGE_M: Final = 20_000.0
"""Farther than any radio of this kind reaches. Unconfigured delays can make ranges negative."""


class _Row(Struct, frozen=True, gc=False):
    """A row that is not blank, with its line in the file."""

    path: str | PathLike[str]
    line: int
    fields: dict[str, str]
    """By column."""
    addresses: bool = False
    """Whether identifiers are MAC addresses, without a letter too."""

    def number(self, column: str, limit_m: float = inf) -> float:
        """A finite number, within ± ``limit_m``."""
        value = finite(self.fields[column], self.path, self.line, column)
        if abs(value) > limit_m:
            raise self.wrong(column, f"metres, at most {limit_m:g}")
        return value

    def identifier(self, column: str = "id") -> int:
        """An anchor's identifier."""
        try:
            return read_anchor(self.fields[column], addresses=self.addresses)
        except ValueError:
            raise self.wrong(column, "a whole number, one after 0x, or a MAC address, as C974") from None

    def wrong(self, column: str, expected: str) -> ConfigurationError:
        return ConfigurationError(self.path, f"line {self.line}, column {column}", self.fields[column], expected)


def _rows(path: str | PathLike[str], *headers: Sequence[str]) -> Iterator[_Row]:
    """The rows of a table that has all columns of one of the headers; incomplete rows of a recording are skipped."""
    try:
        table = list(csv.reader(read_lines(path)))
    except csv.Error as error:
        raise ConfigurationError(path, "", None, f"a table of comma-separated values ({error})") from None
    names = [name.strip() for name in table[0]] if table else []
    wanted = next((header for header in headers if set(header) <= set(names)), None)
    if wanted is None:
        raise ConfigurationError(path, "line 1", ",".join(names), f"a header with {','.join(headers[0])}")
    if any(names.count(name) > 1 for name in wanted):
        raise ConfigurationError(path, "line 1", ",".join(names), "a header with different names")
    ids = [number for number, name in enumerate(names) if name in ("id", *RANGE_COLUMNS[:2])]
    addresses = any(is_address(row[number].strip()) for row in table[1:] for number in ids if number < len(row))
    for line, row in enumerate(table[1:], start=2):
        if not any(field.strip() for field in row):
            continue
        if len(row) != len(names):
            if wanted is LISTENER_COLUMNS:
                continue
            raise ConfigurationError(path, f"line {line}", ",".join(row), f"{len(names)} columns as in the header")
        yield _Row(path, line, {name: field.strip() for name, field in zip(names, row, strict=True)}, addresses)


def _empty(path: str | PathLike[str], what: str) -> ConfigurationError:
    return ConfigurationError(path, "the table", "empty", f"at least one {what} below the header")


# Truth


class Truth(Struct, frozen=True):
    """``n`` true positions over time."""

    t_s: Array
    """Shape (n,), time of the recording, not decreasing."""
    position_m: Array
    """Shape (n, 3)."""
    quaternion: Array | None
    """Shape (n, 4), x, y, z, w, body to site; None if the table has none."""


def read_truth(path: str | PathLike[str], listener: str | None = None) -> Truth:
    """Read a table of truth. From MILUV ticks it reads the rows of one listener, by default that of the first row.

    Damaged rows of such a recording are left out, as the replay drops and counts them.
    """
    values: list[list[float]] = []
    columns: tuple[str, ...] = ()
    for row in _rows(path, POSITION_COLUMNS, LISTENER_COLUMNS):
        if not columns:
            columns = POSITION_COLUMNS if set(POSITION_COLUMNS) <= row.fields.keys() else LISTENER_COLUMNS
            if columns is POSITION_COLUMNS and set(QUATERNION_COLUMNS) <= row.fields.keys():
                columns += QUATERNION_COLUMNS
        if columns is LISTENER_COLUMNS:
            listener = listener or row.fields.get("listener")
            if row.fields.get("listener", listener) != listener:
                continue
        try:
            values.append([row.number(name, _MAX_EARTH_M if name in columns[1:4] else inf) for name in columns])
        except ConfigurationError:
            if columns is not LISTENER_COLUMNS:
                raise
    if not values and listener is not None and columns is LISTENER_COLUMNS:
        raise ConfigurationError(path, "listener", listener, "one that the recording names")
    if not values:
        raise _empty(path, "row")
    table = np.array(values, dtype=np.float64)
    if columns is LISTENER_COLUMNS:
        table = table[np.argsort(table[:, 0], kind="stable")]
    times = table[:, 0]
    backwards = np.flatnonzero(np.diff(times) < 0.0)
    if len(backwards):
        before_s, after_s = (float(value) for value in times[backwards[0] : backwards[0] + 2])
        raise ConfigurationError(path, "column t_s", after_s, f"at least {before_s}, the time before it")
    return Truth(times, table[:, 1:4], table[:, 4:8] if len(columns) == 8 else None)


HEIGHT_STD_M: Final = 0.05
"""Default standard deviation of a height sensor's reading."""


def read_height_readings(path: str | PathLike[str]) -> Array:
    """Read a height sensor's table: rows of time, height and standard deviation, shape (n, 3)."""
    rows = [
        (row.number("t_s"), row.number("height_m"), row.number("std_m") if row.fields.get("std_m") else HEIGHT_STD_M)
        for row in _rows(path, ("t_s", "height_m"))
    ]
    if not rows:
        raise _empty(path, "row")
    return np.array(rows)


# Anchors and their calibration


Value = TypeVar("Value")


def _by_anchor(
    path: str | PathLike[str], columns: tuple[str, ...], what: str, value: Callable[[_Row], Value]
) -> dict[int, Value]:
    """What a table states of each anchor, by identifier."""
    found: dict[int, Value] = {}
    for row in _rows(path, columns):
        identifier = row.identifier()
        if identifier in found:
            raise row.wrong("id", "an id that occurs only once")
        found[identifier] = value(row)
    if not found:
        raise _empty(path, what)
    return found


def read_anchors(path: str | PathLike[str]) -> dict[int, Point]:
    """Read anchor positions by identifier, in metres."""
    return _by_anchor(
        path, ANCHOR_COLUMNS, "anchor", lambda row: (row.number("x_m"), row.number("y_m"), row.number("z_m"))
    )


def read_calibration(path: str | PathLike[str]) -> DifferenceCalibration | None:
    """Read the calibration in a table of anchors; None for a table without ``bias_m``."""
    anchors: dict[int, AnchorCalibration] = {}
    for row in _rows(path, ANCHOR_COLUMNS):
        known = {column: row.number(column) for column in CALIBRATION_COLUMNS if row.fields.get(column)}
        if known.get(NOISE, 0.0) < 0.0:
            raise row.wrong(NOISE, "a number that is not negative")
        if BIAS in known:
            anchors[row.identifier()] = AnchorCalibration(known[BIAS], known.get(SLOPE, 0.0), known.get(NOISE))
    return DifferenceCalibration(anchors) if anchors else None


def calibrated_table(path: str | PathLike[str], calibration: DifferenceCalibration) -> str:
    """The table with its calibration replaced and everything else unchanged."""
    lines = read_lines(path)
    names = [name.strip() for name in next(csv.reader(lines))]
    identifiers = {row.line: row.identifier() for row in _rows(path, ANCHOR_COLUMNS)}
    out = StringIO()
    writer = csv.writer(out, lineterminator="\n")
    for number, row in enumerate(csv.reader(lines), start=1):
        kept = [field for name, field in zip(names, row, strict=False) if name not in CALIBRATION_COLUMNS]
        if number == 1:
            writer.writerow([*kept, *CALIBRATION_COLUMNS])
        elif number in identifiers:
            writer.writerow([*kept, *_fields(calibration.anchors.get(identifiers[number]))])
        else:
            writer.writerow([])
    return out.getvalue()


def new_table(anchors_m: Mapping[int, Point], calibration: DifferenceCalibration, *, addresses: bool = False) -> str:
    """A new table of anchors with their calibration; ``addresses``: identifiers are MAC addresses."""
    names = {anchor: anchor_name(anchor, addresses=addresses) for anchor in anchors_m}
    if addresses and not any(map(is_address, names.values())):  # they would be read as numbers
        names = {anchor: f"0x{name}" for anchor, name in names.items()}
    rows = [",".join((*ANCHOR_COLUMNS, *CALIBRATION_COLUMNS))]
    for anchor, position_m in sorted(anchors_m.items()):
        rows.append(",".join((names[anchor], *map(str, position_m), *_fields(calibration.anchors.get(anchor)))))
    return "\n".join(rows) + "\n"


def _fields(known: AnchorCalibration | None) -> tuple[str, str, str]:
    if known is None:
        return "", "", ""
    return f"{known.bias_m:.4f}", f"{known.slope_m:.4f}", "" if known.noise_m is None else f"{known.noise_m:.4f}"


# Input of a survey


def read_ranges(path: str | PathLike[str]) -> PairRanges:
    """Read ranges, reduced to one per pair of anchors."""
    ranges_m: dict[tuple[int, int], list[float]] = defaultdict(list)
    for row in _rows(path, RANGE_COLUMNS):
        a, b = row.identifier("anchor_a"), row.identifier("anchor_b")
        if a == b:
            raise row.wrong("anchor_b", "another anchor than a")
        ranges_m[min(a, b), max(a, b)].append(row.number("range_m", _MAX_RANGE_M))
    if not ranges_m:
        raise _empty(path, "range")
    return mean_ranges(ranges_m)


def read_heights(path: str | PathLike[str]) -> dict[int, float]:
    """Read anchor heights by identifier, in metres."""
    return _by_anchor(path, HEIGHT_COLUMNS, "height", lambda row: row.number("z_m", MAX_COORDINATE_M))
