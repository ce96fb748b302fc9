"""Common parts of commands: options, JSON and text on standard output, and progress on a terminal."""

import inspect
import os
import sys
import time
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TextIO, get_type_hints

import msgspec
from cyclopts import Parameter
from msgspec import NODEFAULT

from skyless.arguments import OptionError, OptionField, Options, option_field, option_fields, option_helps
from skyless.core.errors import SkylessError, writing
from skyless.files import whole_file, write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

NO_FIX: Final = 1
"""Exit code of a simulation, a replay or an export without any fix."""

USER_ERROR: Final = 2
"""Exit code for a user's error."""


def print_json(value: object) -> None:
    """Print a struct or mapping as one line of JSON; NaN and infinities become null.

    The first key is the version of Skyless, which determines the names of the others (``CHANGELOG.md``).
    """
    from skyless.core.version import installed_version

    print(f'{{"skyless_version":"{installed_version()}",{to_json(value)[1:]}')


def to_json(value: object) -> str:
    """Encode a tree of structs, dataclasses, containers, NumPy values and paths as one line of JSON."""
    return msgspec.json.encode(value, enc_hook=json_form).decode()


def json_form(value: object) -> object:
    """Convert types unknown to msgspec: paths, and NumPy's scalars and arrays (without importing NumPy)."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"{type(value).__name__} has no form in JSON")


def console() -> "Console":
    """Console for tables for people: standard output, without colour if it is not a terminal."""
    from rich.console import Console

    return Console(file=sys.stdout, highlight=False)


def print_facts(title: str, facts: Iterable[tuple[str, str]]) -> None:
    """Print a table of names and values."""
    from rich.markup import escape
    from rich.table import Table
    from rich.text import Text

    table = Table("", "", title=escape(title), show_header=False)
    for name, value in facts:
        table.add_row(Text(name), Text(value))
    console().print(table)


_COLUMNS: Final = 100
"""Width of a table that is written to a file or a program."""

_FRAME: Final = 3
"""Characters between two columns."""


def print_table(
    title: str, heads: Iterable[str], rows: Iterable[Iterable[str]], *, figures: bool = False, caption: str = ""
) -> None:
    """Print a table that fits the screen, with a caption below it.

    ``figures``: the cells are numbers, which are right-aligned and never wrapped, except the first column and columns
    without a name, which are words or belong to the column before. A table that is too wide is split into several,
    which all begin with the first column.
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
    """Split columns into parts of a table up to ``most`` wide; columns without a name stay with the one before."""
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
    """Print warnings, one per line."""
    from rich.text import Text

    for warning in warnings:
        console().print(Text.assemble(("warning: ", "bold yellow"), warning))


def dropped(drops: Mapping[str, int]) -> str:
    """The three most frequent reasons for drops, in words."""
    most = sorted(drops.items(), key=lambda item: -item[1])[:3]
    return f"dropped: {', '.join(f'{count} × {name}' for name, count in most)}"


def number(value: float | None, form: str = "{:z.3f}", scale: float = 1.0) -> str:
    """Format a number for people; a dash for None."""
    return "–" if value is None else form.format(scale * value)


def cm(value_m: float | None) -> str:
    """Format a length in centimetres for people; a dash for None."""
    return number(value_m, "{:z.2f} cm", 100.0)


def plain(text: str, keep: str = "") -> str:
    """Replace characters of a text from the network that would control the terminal, except those in ``keep``."""
    return "".join(one if one.isprintable() or one in keep else "\N{REPLACEMENT CHARACTER}" for one in text)


@contextmanager
def new_table(path: Path) -> Iterator[TextIO]:
    """Open a table for writing; it replaces an old one when the block ends, whole or not at all.

    After Ctrl-C, the rows written so far are kept.

    Raises SkylessError: the file cannot be written.
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
    """Write a file whole or not at all. Raises SkylessError if it cannot be written."""
    with writing(path):
        write_whole(path, data)


def write_picture(path: Path, figure: "Figure") -> None:
    """Write a figure in the format of the file's ending, and say so. Raises SkylessError if it cannot be written."""
    from skyless.site.report import picture

    write_file(path, picture(figure, path.suffix.removeprefix(".")))
    say_written(path)


def say_written(path: Path) -> None:
    """Print the name of a written file on standard error."""
    print(f"wrote {path}", file=sys.stderr)


# Command lines from structs of options (``skyless.arguments``), and checks of files that commands write.


class JsonOptions(Options, frozen=True, kw_only=True):
    """Options of every command."""

    json: bool = False
    """Write one JSON object instead of text."""


RecordingFile = Annotated[Path, Parameter(help="The recording, an MCAP file of skyless record.")]


def command(run: Callable[..., int | None]) -> Callable[..., int | None]:
    """Adapt a function to cyclopts: the fields of each parameter that is a struct of options become options.

    Fields without a default become positional arguments. Other parameters are checked by the rules in their
    annotations.
    """
    hints, own = get_type_hints(run, include_extras=True), inspect.signature(run)
    structs = {name: kind for name, kind in hints.items() if isinstance(kind, type) and issubclass(kind, Options)}
    plain = {name: option_field(name, hints[name], None) for name in own.parameters if name not in structs}
    parameters: list[inspect.Parameter] = []
    for name, parameter in own.parameters.items():
        parameters += _parameters(structs[name]) if name in structs else [parameter.replace(annotation=hints[name])]
    signature = inspect.Signature(sorted(parameters, key=lambda parameter: parameter.kind))

    def call(*words: object, **options: object) -> int | None:
        values = signature.bind(*words, **options).arguments
        made = {name: _made(struct, values) for name, struct in structs.items()}
        for name, value in values.items():
            for rule in plain[name].rules if value is not None else ():
                rule.check(f"--{plain[name].option}", value)
        given = {name: made.get(name, values.get(name)) for name in own.parameters if name in made or name in values}
        bound = inspect.BoundArguments(own, given)
        return run(*bound.args, **bound.kwargs)

    call.__name__, call.__doc__ = run.__name__, run.__doc__
    call.__signature__ = signature  # type: ignore[attr-defined]
    return call


def _parameters(struct: type[Options]) -> Iterator[inspect.Parameter]:
    helps = option_helps(struct)
    for name, field in option_fields(struct).items():
        if not field.option:
            continue
        required = field.default is NODEFAULT
        form = "" if field.text is None or not field.text.form else f" As {field.text.form}."
        described = Parameter(name=None if required else f"--{field.option}", help=helps[name] + form)
        shown = None if field.text is not None or not field.default else field.default
        yield inspect.Parameter(
            name,
            inspect.Parameter.POSITIONAL_ONLY if required else inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if required else shown,
            annotation=Annotated[
                _token(field), described, *(one for one in field.metadata if isinstance(one, Parameter))
            ],
        )


def _token(field: OptionField) -> Any:  # noqa: ANN401 - a type
    if field.text is not None:
        return list[str] | None if field.text.many else str | None
    return field.token if field.default is NODEFAULT else field.token | None


def _made(struct: type[Options], values: dict[str, Any]) -> Options:
    """Build the struct from values of the command line. Raises SkylessError, which names options."""
    found = {}
    for name, field in option_fields(struct).items():
        value = values.pop(name, None)
        if value is None:
            continue
        if field.text is not None:
            texts = value if field.text.many else [value]
            read = tuple(field.text.read(f"--{field.option}", text) for text in texts)
            value = read if field.text.many else read[0]
        found[name] = value
    try:
        return struct(**found)
    except OptionError as error:
        raise SkylessError(error.as_options) from None


def check_output(option: str, output: Path | None, *inputs: Path | None) -> None:
    """Check that an output is not another file of the command, which would be destroyed.

    Raises SkylessError: it is one of them, even by another name.
    """
    if output is None:
        return
    for other in inputs:
        if other is not None and _same(output, other):
            raise SkylessError(f"--{option} is {str(output)!r}, another file of this command; writing would destroy it")


def check_folder(option: str, output: Path) -> None:
    """Check that an output is not a folder, and is in an existing one. Raises SkylessError."""
    if output.is_dir() or not output.parent.is_dir():
        raise SkylessError(f"{option} is {str(output)!r}; it should be a file in a folder that exists")


def check_new(file: Path, *, force: bool) -> None:
    """Check that a file does not exist yet, unless ``force``. Raises SkylessError."""
    if file.exists() and not force:
        raise SkylessError(f"{file} exists; --force overwrites it")


def make_folder(option: str, folder: Path) -> None:
    """Make a folder unless it exists. Raises SkylessError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SkylessError(f"{option} is {str(folder)!r}, which is no folder: {error.strerror}") from None


def _same(a: Path, b: Path) -> bool:
    """Whether two paths lead to the same file, possibly through links, even if it does not exist."""
    try:
        return a.samefile(b)
    except OSError:
        return a.absolute() == b.absolute()


def check_picture(plot: Path | None) -> None:
    """Check before long work that --plot can be written. Raises SkylessError."""
    if plot is None:
        return
    endings = (".png", ".svg", ".pdf")
    if plot.suffix.lower() not in endings:
        raise SkylessError(f"--plot is {str(plot)!r}; its ending should be one of {', '.join(endings)}")
    check_folder("--plot", plot)


# Progress of long work only: a bar on a terminal, a line now and then for a pipe or a file.

_HIDDEN_S: Final = 1.5
_REDRAW_S: Final = 0.1
_LINE_S: Final = 5.0


@contextmanager
def progress_bar(description: str, total: float = 1.0) -> Iterator[Callable[[float], None]]:
    """Show a bar on standard error if the work in the block turns out to be long; in a pipe print lines.

    Yields a function to be called with the amount done, cheap enough for every chunk of work.
    """
    if sys.stderr is None or not sys.stderr.isatty():
        yield _lines(description, total)
        return
    from rich.console import Console
    from rich.progress import Progress

    progress = Progress(console=Console(stderr=True), transient=True)
    task = progress.add_task(description, total=total)
    next_s = time.monotonic() + _HIDDEN_S

    def reach(done: float) -> None:
        nonlocal next_s
        if time.monotonic() >= next_s:
            next_s = time.monotonic() + _REDRAW_S
            progress.start()
            progress.update(task, completed=done)

    try:
        yield reach
    finally:
        if progress.live.is_started:
            progress.stop()


def _lines(description: str, total: float) -> Callable[[float], None]:
    """Progress function that prints a line on standard error every few seconds."""
    next_s = time.monotonic() + _LINE_S

    def reach(done: float) -> None:
        nonlocal next_s
        if time.monotonic() >= next_s and done < total and sys.stderr is not None:
            next_s = time.monotonic() + _LINE_S
            print(f"{description}: {done / total:.0%}", file=sys.stderr, flush=True)

    return reach


@contextmanager
def status(description: str) -> Iterator[Callable[[str], None]]:
    """Show a spinner for work of unknown length, on a terminal only. Yields a function to change the description."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.markup import escape

    with Console(stderr=True).status(description) as shown:
        yield lambda words: shown.update(escape(words))


async def with_status(work: Coroutine[Any, Any, None], words: Callable[[], str]) -> None:
    """Run ``work``, showing ``words()`` on the terminal, refreshed twice a second."""
    from skyless.run.process import every, outlasting

    with status("") as show:
        await outlasting(every(0.5, lambda: show(words())), work)
