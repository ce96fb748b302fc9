"""Tables for a survey: ranges between anchors (``anchor_a,anchor_b,range_m``) and heights (``id,z_m``).

Every range of a pair is one row, in either direction; other columns are ignored.
"""

import csv
from collections import defaultdict
from collections.abc import Iterator
from os import PathLike
from typing import Final

from skyless.air.page_codec import MAX_COORDINATE_M
from skyless.errors import ConfigurationError
from skyless.recordings.anchor_table import anchor_identifier
from skyless.recordings.source import finite, read_lines
from skyless.survey.ranges import PairRanges
from skyless.survey.stamps.repeats import mean_ranges

RANGE_COLUMNS: Final = ("anchor_a", "anchor_b", "range_m")
HEIGHT_COLUMNS: Final = ("id", "z_m")

_FARTHEST_M: Final = 20_000.0
"""Farther than any radio of this kind reaches; delays that are not configured can make ranges negative."""


def read_ranges(path: str | PathLike[str]) -> PairRanges:
    """One range of each pair of anchors, from all of its rows.

    Raises:
        ConfigurationError: naming file, line, column and value of what cannot be used.
    """
    ranges_m: dict[tuple[int, int], list[float]] = defaultdict(list)
    for line, row in _rows(path, RANGE_COLUMNS):
        a, b = (anchor_identifier(row[column], path, line, column) for column in RANGE_COLUMNS[:2])
        if a == b:
            raise ConfigurationError(path, f"line {line}, column anchor_b", row["anchor_b"], "another anchor than a")
        range_m = finite(row["range_m"], path, line, "range_m")
        if abs(range_m) > _FARTHEST_M:
            expected = f"metres, at most {_FARTHEST_M:g}"
            raise ConfigurationError(path, f"line {line}, column range_m", row["range_m"], expected)
        ranges_m[min(a, b), max(a, b)].append(range_m)
    if not ranges_m:
        raise ConfigurationError(path, "the table", "empty", "at least one range below the header")
    return mean_ranges(ranges_m)


def read_heights(path: str | PathLike[str]) -> dict[int, float]:
    """Heights by anchor, metres.

    Raises:
        ConfigurationError: naming file, line, column and value of what cannot be used.
    """
    heights_m: dict[int, float] = {}
    for line, row in _rows(path, HEIGHT_COLUMNS):
        anchor = anchor_identifier(row["id"], path, line, "id")
        if anchor in heights_m:
            raise ConfigurationError(path, f"line {line}, column id", row["id"], "an id that occurs only once")
        z_m = heights_m[anchor] = finite(row["z_m"], path, line, "z_m")
        if abs(z_m) > MAX_COORDINATE_M:
            expected = f"metres, at most {MAX_COORDINATE_M:g}"
            raise ConfigurationError(path, f"line {line}, column z_m", row["z_m"], expected)
    if not heights_m:
        raise ConfigurationError(path, "the table", "empty", "at least one height below the header")
    return heights_m


def _rows(path: str | PathLike[str], columns: tuple[str, ...]) -> Iterator[tuple[int, dict[str, str]]]:
    """Line number and fields by column of every row that is not blank."""
    try:
        header, *table = list(csv.reader(read_lines(path))) or [[]]
    except csv.Error as error:
        raise ConfigurationError(path, "", None, f"a table of comma-separated values ({error})") from None
    names = [name.strip() for name in header]
    if not set(columns) <= set(names):
        raise ConfigurationError(path, "line 1", ",".join(names), f"a header with {','.join(columns)}")
    if len(set(names)) < len(names):
        raise ConfigurationError(path, "line 1", ",".join(names), "a header with different names")
    for line, row in enumerate(table, start=2):
        if not any(field.strip() for field in row):
            continue
        if len(row) != len(names):
            raise ConfigurationError(path, f"line {line}", ",".join(row), f"{len(names)} columns as in the header")
        yield line, {name: field.strip() for name, field in zip(names, row, strict=True)}
