"""Where a tag really was: ``t_s,x_m,y_m,z_m`` and, where measured, the attitude ``qx,qy,qz,qw``.

The positions of the listener in a table of MILUV passive ticks (``gt_L_…``) serve as well.
"""

from dataclasses import dataclass
from os import PathLike
from typing import Final

import numpy as np

from skyless.errors import ConfigurationError
from skyless.kernels.arrays import Array
from skyless.recordings.source import finite, read_lines

POSITION_COLUMNS: Final = ("t_s", "x_m", "y_m", "z_m")
LISTENER_COLUMNS: Final = ("t_s", "gt_L_x_m", "gt_L_y_m", "gt_L_z_m")
QUATERNION_COLUMNS: Final = ("qx", "qy", "qz", "qw")

_FARTHEST_M: Final = 1e8
"""Coordinates of any frame on Earth are smaller."""


@dataclass(frozen=True)
class Truth:
    """Positions over time, n of them, times never decreasing."""

    t_s: Array
    """Shape (n,), in the time of the recording."""
    position_m: Array
    """Shape (n, 3)."""
    quaternion: Array | None
    """Shape (n, 4), x, y, z, w, body to site; None where the table has none."""


def read_truth(path: str | PathLike[str], listener: str | None = None) -> Truth:
    """Read a table of truth, gzip or plain; of MILUV ticks the rows of one listener, by default of the first row.

    Raises:
        ConfigurationError: naming file, line, column and value of what cannot be used.
    """
    table = read_lines(path)
    names = [name.strip() for name in table[0].split(",")] if table else []
    columns = _columns(path, names)
    values = _values(path, table, names, columns, listener)
    times = values[:, 0]
    if len(times) == 0 and listener is not None and columns == LISTENER_COLUMNS:
        raise ConfigurationError(path, "listener", listener, "one that the recording names")
    if len(times) == 0:
        raise ConfigurationError(path, "the table", "empty", "at least one row below the header")
    backwards = np.flatnonzero(np.diff(times) < 0.0)
    if len(backwards):
        before_s, after_s = (float(value) for value in times[backwards[0] : backwards[0] + 2])
        raise ConfigurationError(path, "column t_s", after_s, f"at least {before_s}, the time before it")
    return Truth(times, values[:, 1:4], values[:, 4:8] if len(columns) == 8 else None)


def _columns(path: str | PathLike[str], names: list[str]) -> tuple[str, ...]:
    if set(POSITION_COLUMNS) <= set(names):
        attitude = set(QUATERNION_COLUMNS) <= set(names)
        return POSITION_COLUMNS + QUATERNION_COLUMNS if attitude else POSITION_COLUMNS
    if set(LISTENER_COLUMNS) <= set(names):
        return LISTENER_COLUMNS
    raise ConfigurationError(path, "line 1", ",".join(names), "a header with t_s,x_m,y_m,z_m")


def _values(
    path: str | PathLike[str],
    table: list[str],
    names: list[str],
    columns: tuple[str, ...],
    listener: str | None,
) -> Array:
    """Wanted columns, shape (n, len(columns)); blank lines are passed over."""
    positions = [names.index(column) for column in columns]
    chosen = names.index("listener") if columns == LISTENER_COLUMNS and "listener" in names else None
    values: list[list[float]] = []
    for number, line in enumerate(table[1:], start=2):
        if not line.strip():
            continue
        fields = line.split(",")
        if len(fields) != len(names):
            raise ConfigurationError(path, f"line {number}", line, f"{len(names)} columns as in the header")
        if chosen is not None:
            listener = listener or fields[chosen]
            if fields[chosen] != listener:
                continue
        row = [
            finite(fields[position], path, number, column) for position, column in zip(positions, columns, strict=True)
        ]
        for column, value in zip(columns[1:4], row[1:4], strict=True):
            if abs(value) > _FARTHEST_M:
                expected = f"metres, at most {_FARTHEST_M:g}"
                raise ConfigurationError(path, f"line {number}, column {column}", value, expected)
        values.append(row)
    return np.array(values, dtype=np.float64).reshape(-1, len(columns))
