"""Anchor positions from a table: ``id,x_m,y_m,z_m``, other columns ignored."""

import csv
from os import PathLike
from typing import Final

from skyless.air.packet import Point
from skyless.errors import ConfigurationError
from skyless.recordings.source import read_lines
from skyless.recordings.table import finite

COLUMNS: Final = ("id", "x_m", "y_m", "z_m")


def read_anchors(path: str | PathLike[str]) -> dict[int, Point]:
    """Positions by identifier (decimal; hexadecimal after ``0x``), in metres.

    Raises:
        ConfigurationError: naming file, line, column and value of what cannot be used.
    """
    table = list(csv.reader(read_lines(path)))
    names = [name.strip() for name in table[0]] if table else []
    if not set(COLUMNS) <= set(names):
        raise ConfigurationError(path, "line 1", ",".join(names), "a header with id,x_m,y_m,z_m")
    places = [names.index(column) for column in COLUMNS]
    anchors: dict[int, Point] = {}
    for number, row in enumerate(table[1:], start=2):
        if not any(field.strip() for field in row):
            continue
        if len(row) != len(names):
            raise ConfigurationError(path, f"line {number}", ",".join(row), f"{len(names)} columns as in the header")
        anchor, *point = (row[place].strip() for place in places)
        identifier = _identifier(anchor, path, number)
        if identifier in anchors:
            raise ConfigurationError(path, f"line {number}, column id", identifier, "an id that occurs only once")
        x_m, y_m, z_m = (finite(field, path, number, column) for field, column in zip(point, COLUMNS[1:], strict=True))
        anchors[identifier] = (x_m, y_m, z_m)
    if not anchors:
        raise ConfigurationError(path, "the table", "empty", "at least one anchor below the header")
    return anchors


def _identifier(field: str, path: str | PathLike[str], line: int) -> int:
    try:
        identifier = int(field, 0) if field.lower().startswith("0x") else int(field)
    except ValueError:
        identifier = -1
    if identifier < 0:
        expected = "a whole number, or a hexadecimal one after 0x"
        raise ConfigurationError(path, f"line {line}, column id", field, expected)
    return identifier
