"""What commands write: JSON for programs, text for people, files all at once."""

import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, TextIO

import msgspec

from skyless.core.errors import writing
from skyless.core.whole_files import whole_file, write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console


NO_FIX: Final = 1
"""Exit code of a simulation, a replay or an export without any fix."""

USER_ERROR: Final = 2
"""Exit code of a command that was asked for what is not possible."""


def print_json(value: object) -> None:
    """Write a struct or mapping as one line of JSON on standard output; NaN and infinities become null.

    The first key is the version of Skyless, to which the names of the others belong (``CHANGELOG.md``).
    """
    from skyless.core.version import installed_version

    print(f'{{"skyless_version":"{installed_version()}",{to_json(value)[1:]}')


def to_json(value: object) -> str:
    """Write a tree of structs, dataclasses, containers, NumPy values and paths as one line of JSON."""
    return msgspec.json.encode(value, enc_hook=json_form).decode()


def json_form(value: object) -> object:
    """What msgspec does not know: NumPy's scalars and arrays (which need not be imported for this), paths."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"{type(value).__name__} has no form in JSON")


def console() -> "Console":
    """Where tables for people go: standard output, without colour when it is not a terminal."""
    from rich.console import Console

    return Console(file=sys.stdout, highlight=False)


def print_facts(title: str, facts: Iterable[tuple[str, str]]) -> None:
    """Show a table of names and values."""
    from rich.markup import escape
    from rich.table import Table
    from rich.text import Text

    table = Table("", "", title=escape(title), show_header=False)
    for name, value in facts:
        table.add_row(Text(name), Text(value))
    console().print(table)


_COLUMNS: Final = 100
"""Width of a table that goes to a file or a program."""

_FRAME: Final = 3
"""Characters between two columns."""


def print_table(
    title: str, heads: Iterable[str], rows: Iterable[Iterable[str]], *, figures: bool = False, caption: str = ""
) -> None:
    """Show a table that fits the screen, with a caption below it.

    ``figures``: it is of numbers, which are never wrapped and stand on the right, but for the first column and columns
    without a name, which hold words or belong to the one before. What is too wide is continued in further tables, which
    begin with the first column.
    """
    from rich.markup import escape
    from rich.table import Table
    from rich.text import Text

    columns = list(zip(heads, *rows, strict=True))
    out = console()
    if not out.is_terminal and "COLUMNS" not in os.environ:
        out.width = _COLUMNS
    wraps = figures and sum(max(map(len, column)) + _FRAME for column in columns) >= out.width
    widths = [max(map(len, (*head.split(), *cells)), default=0) for head, *cells in columns]
    parts = list(_parts([head for head, *_ in columns], widths, out.width)) if wraps else [[*range(len(columns))]]
    for part in parts:
        table = Table(title=escape(title) if part is parts[0] else None)
        table.caption = escape(caption) if caption and part is parts[-1] else None
        for column in part:
            head = columns[column][0]
            justify: Literal["left", "right"] = "right" if figures and column and head else "left"
            table.add_column(head, justify=justify, overflow="fold", width=widths[column] if wraps else None)
        for line in zip(*(columns[column][1:] for column in part), strict=True):
            table.add_row(*map(Text, line))
        out.print(table)


def _parts(heads: list[str], widths: list[int], most: int) -> Iterator[list[int]]:
    """The columns of each part of a table that is ``most`` wide; those without a name stay with the one before."""
    starts = [0, *(column for column, head in enumerate(heads) if head and column), len(heads)]
    first, *others = (list(range(*ends)) for ends in pairwise(starts))
    part = first
    for group in others:
        if part != first and sum(widths[column] + _FRAME for column in part + group) >= most:
            yield part
            part = first
        part = part + group
    yield part


def print_warnings(warnings: Iterable[str]) -> None:
    """Show warnings, one a line."""
    from rich.text import Text

    for warning in warnings:
        console().print(Text.assemble(("warning: ", "bold yellow"), warning))


def dropped(drops: Mapping[str, int]) -> str:
    """The most frequent reasons for which something was dropped."""
    most = sorted(drops.items(), key=lambda item: -item[1])[:3]
    return f"dropped: {', '.join(f'{count} × {name}' for name, count in most)}"


def number(value: float | None, form: str = "{:.3f}", scale: float = 1.0) -> str:
    """A number for people; a dash where there is none."""
    return "–" if value is None else form.format(scale * value)


def cm(value_m: float | None) -> str:
    """A length in centimetres for people; a dash where there is none."""
    return number(value_m, "{:.2f} cm", 100.0)


def plain(text: str, keep: str = "") -> str:
    """A text from the network without characters that would control the terminal, but for those to be kept."""
    return "".join(one if one.isprintable() or one in keep else "\N{REPLACEMENT CHARACTER}" for one in text)


@contextmanager
def new_table(path: Path) -> Iterator[TextIO]:
    """A table to be written row by row, which replaces an old one when the block ends: whole or not at all.

    Ctrl-C ends it, too: what is written by then is kept.

    Raises:
        SkylessError: the file cannot be written.
    """
    with writing(path), whole_file(path) as scratch, scratch.open("w", newline="", encoding="utf-8") as file:
        try:
            yield file
        except KeyboardInterrupt as error:
            interrupt: KeyboardInterrupt | None = error
        else:
            interrupt = None
    if interrupt is not None:
        raise interrupt


def write_file(path: Path, data: bytes) -> None:
    """Write a file whole or not at all. Raises SkylessError when it cannot be written."""
    with writing(path):
        write_whole(path, data)


def write_picture(path: Path, figure: "Figure") -> None:
    """Write a figure in the format of the file's ending, and say so. Raises SkylessError when it cannot be written."""
    from skyless.site.report import picture

    write_file(path, picture(figure, path.suffix.removeprefix(".")))
    say_written(path)


def say_written(path: Path) -> None:
    """Name a file that was written, on standard error."""
    print(f"wrote {path}", file=sys.stderr)
