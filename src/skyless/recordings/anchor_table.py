"""Anchors from a table: ``id,x_m,y_m,z_m``, perhaps with a calibration (``bias_m``), other columns ignored."""

import csv
from collections.abc import Iterator, Mapping
from io import StringIO
from os import PathLike
from typing import Final

from skyless.air.masterless_packets import Point
from skyless.errors import ConfigurationError
from skyless.positioning.masterless.anchor_errors import AnchorCalibration, DifferenceCalibration
from skyless.recordings.source import finite, read_lines

ANCHOR_COLUMNS: Final = ("id", "x_m", "y_m", "z_m")
BIAS, SLOPE, NOISE = CALIBRATION_COLUMNS = ("bias_m", "bias_slope_m", "noise_m")
"""What ``skyless calibrate`` adds; a blank field means that nothing is known."""


def read_anchors(path: str | PathLike[str]) -> dict[int, Point]:
    """Positions by identifier (decimal; hexadecimal after ``0x``), in metres.

    Raises:
        ConfigurationError: naming file, line, column and value of what cannot be used.
    """
    anchors: dict[int, Point] = {}
    for number, identifier, row in _rows(path):
        if identifier in anchors:
            raise ConfigurationError(path, f"line {number}, column id", identifier, "an id that occurs only once")
        x_m, y_m, z_m = (finite(row[column], path, number, column) for column in ANCHOR_COLUMNS[1:])
        anchors[identifier] = (x_m, y_m, z_m)
    if not anchors:
        raise ConfigurationError(path, "the table", "empty", "at least one anchor below the header")
    return anchors


def read_calibration(path: str | PathLike[str]) -> DifferenceCalibration | None:
    """Calibration that a table of anchors holds; None for a table without ``bias_m``.

    Raises:
        ConfigurationError: naming file, line, column and value of what cannot be used.
    """
    anchors: dict[int, AnchorCalibration] = {}
    for number, identifier, row in _rows(path):
        known = {column: finite(row[column], path, number, column) for column in CALIBRATION_COLUMNS if row.get(column)}
        if known.get(NOISE, 0.0) < 0.0:
            column = f"line {number}, column {NOISE}"
            raise ConfigurationError(path, column, known[NOISE], "a number that is not negative")
        if BIAS in known:
            anchors[identifier] = AnchorCalibration(known[BIAS], known.get(SLOPE, 0.0), known.get(NOISE))
    return DifferenceCalibration(anchors) if anchors else None


def calibrated_table(path: str | PathLike[str], calibration: DifferenceCalibration) -> str:
    """The table with another calibration; everything else stays as it is.

    Raises:
        ConfigurationError: the table cannot be used.
    """
    lines = read_lines(path)
    names = [name.strip() for name in next(csv.reader(lines))]
    identifiers = {number: identifier for number, identifier, _ in _rows(path)}
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


def new_table(anchors_m: Mapping[int, Point], calibration: DifferenceCalibration) -> str:
    """A table of anchors that stood in none."""
    rows = [",".join((*ANCHOR_COLUMNS, *CALIBRATION_COLUMNS))]
    for anchor, position_m in sorted(anchors_m.items()):
        rows.append(",".join((str(anchor), *map(str, position_m), *_fields(calibration.anchors.get(anchor)))))
    return "\n".join(rows) + "\n"


def _fields(known: AnchorCalibration | None) -> tuple[str, str, str]:
    if known is None:
        return "", "", ""
    return f"{known.bias_m:.4f}", f"{known.slope_m:.4f}", "" if known.noise_m is None else f"{known.noise_m:.4f}"


def _rows(path: str | PathLike[str]) -> Iterator[tuple[int, int, dict[str, str]]]:
    """Line number, identifier and fields by column of every anchor."""
    table = list(csv.reader(read_lines(path)))
    names = [name.strip() for name in table[0]] if table else []
    if not set(ANCHOR_COLUMNS) <= set(names):
        raise ConfigurationError(path, "line 1", ",".join(names), "a header with id,x_m,y_m,z_m")
    for number, row in enumerate(table[1:], start=2):
        if not any(field.strip() for field in row):
            continue
        if len(row) != len(names):
            raise ConfigurationError(path, f"line {number}", ",".join(row), f"{len(names)} columns as in the header")
        fields = {name: field.strip() for name, field in zip(names, row, strict=True)}
        yield number, anchor_identifier(fields["id"], path, number), fields


def anchor_identifier(field: str, path: str | PathLike[str], line: int, column: str = "id") -> int:
    """The identifier in one field of a table.

    Raises:
        ConfigurationError: it is none.
    """
    try:
        identifier = int(field, 0) if field.lower().startswith("0x") else int(field)
    except ValueError:
        identifier = -1
    if identifier < 0:
        expected = "a whole number, or a hexadecimal one after 0x"
        raise ConfigurationError(path, f"line {line}, column {column}", field, expected)
    return identifier
