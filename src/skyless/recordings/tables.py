"""Tables of comma-separated values: the header, and what the readers of the streams share."""

from collections.abc import Iterator, Sequence
from io import BufferedIOBase
from math import isfinite
from os import PathLike

from skyless.errors import ConfigurationError
from skyless.recordings.source import Drops, lines


def header_of(head: bytes) -> tuple[str, ...]:
    """Column names in the first line of a table."""
    first = head.lstrip(b"\xef\xbb\xbf").partition(b"\n")[0]
    return tuple(name.strip() for name in first.decode("utf-8", "replace").split(","))


def rows(stream: BufferedIOBase, drops: Drops, columns: Sequence[str]) -> Iterator[list[bytes]]:
    """Yield the wanted columns of each row, in the wanted order; rows of another width are counted.

    A stream whose first line lacks one of the columns yields nothing, and that is counted too.
    """
    source = lines(stream, drops)
    names = header_of(next(source, b""))
    if not set(columns) <= set(names):
        drops["header-without-the-columns"] += 1
        return
    places = [names.index(column) for column in columns]
    width = len(names)
    as_it_stands = places == list(range(width))
    first = names[0].encode()
    for line in source:
        fields = line.split(b",")
        if len(fields) != width:
            drops["blank-line" if not line.strip() else "wrong-number-of-columns"] += 1
        elif fields[0] == first:
            drops["repeated-header"] += 1
        else:
            yield fields if as_it_stands else [fields[place] for place in places]


def finite(field: str, file: str | PathLike[str], line: int, column: str) -> float:
    """Number in one field of a file that the user names.

    Raises:
        ConfigurationError: it is not a finite number.
    """
    try:
        value = float(field)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise ConfigurationError(file, f"line {line}, column {column}", field, "a finite number")
    return value
