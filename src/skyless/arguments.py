"""Options of commands and arguments of Python functions: each stated once, as a field of a frozen struct.

A field states type, default and, in its docstring, its meaning. What is ``Annotated`` adds which values are right (a
``Rule``), how a text of the command line is read (``Text``), and the option's name where it differs from the field's.
``skyless.cli.common`` makes command lines of these structs, ``python_function`` functions. Errors and
docstrings write ``--option``, which becomes the argument's name in Python.
"""

import inspect
import math
import os
import re
from ast import AnnAssign, ClassDef, Constant, Expr, Name, parse
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from itertools import pairwise
from numbers import Integral
from pathlib import Path
from textwrap import dedent, fill
from types import UnionType
from typing import Annotated, Any, Final, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

from msgspec import NODEFAULT, Struct
from msgspec.structs import force_setattr

from skyless.core.errors import SkylessError
from skyless.core.method_names import METHODS

_LONGEST_VALUE: Final = 60
_OPTION: Final = re.compile(r"(?<![\w./-])--([a-z][a-z0-9-]*)")

_Arguments = ParamSpec("_Arguments")
_Asked = TypeVar("_Asked", bound="Options")
_Result = TypeVar("_Result")


class OptionError(SkylessError):
    """A mistake in options; its text names the arguments, ``as_options`` the options of the command."""

    def __init__(self, as_options: str, struct: "type[Options]") -> None:
        super().__init__(as_arguments(as_options, struct))
        required = "|".join(field.option for field in option_fields(struct).values() if field.default is NODEFAULT)
        self.as_options = re.sub(f"--({required})(?= is )", lambda found: found[1].upper(), as_options)


class Rule(Struct, frozen=True):
    """Which values of a field are right."""

    check: Callable[[str, Any], Any]
    """Gets the option's name with its dashes and a value other than None; returns it as the program uses it.

    Raises SkylessError.
    """


class Text(Struct, frozen=True):
    """How the command line states a field that is neither a word nor a number."""

    read: Callable[[str, str], Any]
    """Gets the option's name with its dashes, and the text. Raises SkylessError."""
    form: str = ""
    """The text's form, for the help."""
    many: bool = False
    """Whether the option may be given several times, each adding a value."""


class Option(Struct, frozen=True):
    """What the command line calls a field; empty where it does not have it."""

    name: str


IN_PYTHON_ONLY: Final = Option("")


class Options(Struct, frozen=True, kw_only=True):
    """Options of a command; checked when made.

    Raises OptionError: naming the option, its value and what would be right.
    """

    def __post_init__(self) -> None:
        struct = type(self)
        try:
            for name, field in option_fields(struct).items():
                value = getattr(self, name)
                if value is not None:
                    for rule in field.rules:
                        value = rule.check(f"--{field.option}", value)
                    force_setattr(self, name, value)
            self.check()
        except SkylessError as error:
            raise OptionError(str(error), struct) from None

    def check(self) -> None:
        """See that the options fit one another. Raises SkylessError."""

    def given(self, *names: str) -> list[str]:
        """Which of these fields differ from their defaults."""
        known = option_fields(type(self))
        return [name for name in names if getattr(self, name) != known[name].default]

    def leave_out(self, *names: str, why: str) -> None:
        """See that options which have no effect here are not given. Raises SkylessError."""
        for name in self.given(*names):
            value, option = getattr(self, name), option_fields(type(self))[name].option
            shown = f"{value:g}" if isinstance(value, float) else _shown(value)
            raise SkylessError(f"--{option} is {shown}; it should be left out: {why}")


class OptionField(Struct, frozen=True):
    """A field of a struct of options."""

    option: str
    """Without dashes; empty where the command line does not have it."""
    default: Any
    """``NODEFAULT`` of msgspec where a value is required."""
    token: Any
    """Type of a word on the command line."""
    rules: tuple[Rule, ...]
    text: Text | None
    metadata: tuple[Any, ...]
    """Everything that the field's type is annotated with."""


@cache
def option_fields(struct: type[Options]) -> dict[str, OptionField]:
    """The fields by name, a class's own before those that it inherits."""
    annotations: dict[str, Any] = {}
    for one in struct.__mro__:
        annotations |= {
            name: kind for name, kind in vars(one).get("__annotations__", {}).items() if name not in annotations
        }
    names, stated = struct.__struct_fields__, struct.__struct_defaults__
    defaults = dict(zip(names, (*(NODEFAULT for _ in names[len(stated) :]), *stated), strict=True))
    return {name: option_field(name, kind, defaults[name]) for name, kind in annotations.items() if name in defaults}


def option_field(name: str, annotation: Any, default: Any) -> OptionField:  # noqa: ANN401 - of any type
    """What a field's annotation says."""
    kinds, metadata = _parts(annotation)
    options = [one.name for one in metadata if isinstance(one, Option)]
    texts = [one for one in metadata if isinstance(one, Text)]
    tokens = [one for one in metadata if isinstance(one, type)]
    token = (*tokens, *kinds, str)[0]
    usual = Rule(partial(_check_kind, token))
    return OptionField(
        option=(*options, name.replace("_", "-"))[0],
        default=default,
        token=token,
        rules=tuple(one for one in metadata if isinstance(one, Rule)) or ((usual,) if not tokens and not texts else ()),
        text=texts[0] if texts else None,
        metadata=metadata,
    )


def _parts(annotation: Any) -> tuple[list[Any], tuple[Any, ...]]:  # noqa: ANN401 - any type
    """Types of an annotation but None, and what they are annotated with."""
    if get_origin(annotation) is Annotated:
        inner, *metadata = get_args(annotation)
        kinds, more = _parts(inner)
        return kinds, (*more, *metadata)
    if get_origin(annotation) not in {Union, UnionType}:
        return [annotation] if annotation is not type(None) else [], ()
    found = [_parts(one) for one in get_args(annotation)]
    return [kind for kinds, _ in found for kind in kinds], tuple(one for _, more in found for one in more)


def _check_kind(kind: Any, name: str, value: Any) -> Any:  # noqa: ANN401 - any type
    if kind is float:
        check_number(name, value)
    elif get_origin(kind) is Literal:
        check_choice(name, value, get_args(kind))
    return value


# The same in Python


@cache
def option_helps(struct: type[Options]) -> dict[str, str]:
    """The docstring of each field, in one line."""
    helps: dict[str, str] = {}
    for one in reversed(struct.__mro__[: struct.__mro__.index(Options)]):
        (tree,) = parse(dedent(inspect.getsource(one))).body
        assert isinstance(tree, ClassDef)
        for field, doc in pairwise(tree.body):
            match field, doc:
                case AnnAssign(target=Name(id=name)), Expr(value=Constant(value=str(text))):
                    helps[name] = " ".join(text.split())
    return helps


def python_function(
    options: Callable[_Arguments, _Asked], run: Callable[[_Asked], _Result]
) -> Callable[_Arguments, _Result]:
    """The function whose arguments are the fields of a struct of options."""
    assert isinstance(options, type)

    def function(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        asked = options(*args, **kwargs)
        try:
            return run(asked)
        except SkylessError as error:
            text = as_arguments(str(error), options)
            if text == str(error):
                raise
            raise SkylessError(text) from None

    helps = (
        fill(f"{name}: {as_arguments(text, options)}", 116, initial_indent=" " * 8, subsequent_indent=" " * 12)
        for name, text in option_helps(options).items()
    )
    raises = "SkylessError: one line that names the argument or file, its value and what it should be."
    arguments = "\n".join(helps)
    function.__doc__ = (
        f"{(run.__doc__ or '').rstrip()}\n\n    Args:\n{arguments}\n\n    Raises:\n        {raises}\n    "
    )
    function.__name__ = function.__qualname__ = run.__name__.removeprefix("run_")
    function.__module__ = run.__module__
    parameters = [
        inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        if field.default is NODEFAULT
        else inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=field.default)
        for name, field in option_fields(options).items()
    ]
    ordered = sorted(parameters, key=lambda parameter: parameter.kind)
    function.__signature__ = inspect.Signature(ordered)  # type: ignore[attr-defined]
    return function


def as_arguments(text: str, struct: type[Options]) -> str:
    """A text with arguments instead of options."""
    names = {field.option: name for name, field in option_fields(struct).items()}
    return _OPTION.sub(lambda found: names.get(found[1], found[1].replace("-", "_")), text)


# Which values are right


def wrong(name: str, value: object, right: str) -> SkylessError:
    """An error that says so of an option, to be raised."""
    return SkylessError(f"{name} is {_shown(value)}; it should be {right}")


def _shown(value: object) -> str:
    text = " ".join(repr(str(value) if isinstance(value, Path) else value).split())
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 1] + "…"


def number(
    *, above: float = -math.inf, least: float = -math.inf, below: float = math.inf, most: float = math.inf
) -> Rule:
    """A finite number within limits."""
    return Rule(partial(check_number, above=above, least=least, below=below, most=most))


def whole(least: int, most: int | None = None) -> Rule:
    """A whole number within limits."""
    return Rule(partial(check_whole, least=least, most=most))


class TagCount(int):
    """A number of tags, and the floor on which they walk where one is named."""

    floor: int | None = None


def tag_count(least: int, most: int) -> tuple[Rule, Text]:
    """A number of tags within limits; on the command line also ``3@1``, three on floor 1."""

    def check(name: str, value: object) -> TagCount:
        count = TagCount(check_whole(name, value, least=least, most=most))
        count.floor = value.floor if isinstance(value, TagCount) else None
        return count

    def read(name: str, text: str) -> TagCount:
        words = re.fullmatch(r"(-?\d+)(?:@(-?\d+))?", text)
        if words is None:
            raise wrong(name, text, "a whole number, or one with a floor, as 3@1")
        count = TagCount(words[1])
        count.floor = None if words[2] is None else int(words[2])
        return count

    return Rule(check), Text(read, "NUMBER or NUMBER@FLOOR")


def choice(*choices: str) -> Rule:
    """A text that is one of several."""
    return Rule(partial(check_choice, choices=choices))


def check_number(
    name: str,
    value: float,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    below: float = math.inf,
    most: float = math.inf,
) -> float:
    """A finite number within its limits. Raises SkylessError."""
    if not (_is_number(value) and above < value < below and least <= value <= most):
        raise wrong(name, value, f"a number{_limits(above, least, below, most)}")
    return value


def check_whole(name: str, value: object, *, least: int, most: int | None = None) -> int:
    """A whole number within its limits. Raises SkylessError."""
    highest = math.inf if most is None else most
    if isinstance(value, bool) or not isinstance(value, Integral) or not least <= int(value) <= highest:
        raise wrong(name, value, f"a whole number{_limits(-math.inf, least, math.inf, highest)}")
    return int(value)


def check_choice(name: str, value: Any, choices: Sequence[Any]) -> Any:  # noqa: ANN401 - words or numbers
    """A value that is one of several. Raises SkylessError."""
    if value not in choices:
        raise wrong(name, value, f"one of {', '.join(map(str, choices))}")
    return value


def sequence(name: str, value: object, right: str) -> tuple[Any, ...]:
    """Several values as a tuple. Raises SkylessError where they are none, ``right`` says what they should be."""
    if isinstance(value, str | bytes | Mapping) or not isinstance(value, Iterable):
        raise wrong(name, value, right)
    return tuple(value)


def check_point(name: str, value: object, counts: tuple[int, ...], farthest_m: float = math.inf) -> tuple[float, ...]:
    """Finite coordinates, as many as one of ``counts``, and not too far away. Raises SkylessError."""
    numbers = tuple(value) if isinstance(value, Iterable) and not isinstance(value, str | bytes) else ()
    if len(numbers) not in counts or not all(_is_number(one) and abs(one) <= farthest_m for one in numbers):
        right = f"{' or '.join(map(str, counts))} finite numbers in metres"
        raise wrong(name, value, right + (f", at most {farthest_m:g}" if math.isfinite(farthest_m) else ""))
    return tuple(map(float, numbers))


def point(*counts: int, farthest_m: float = math.inf) -> Rule:
    """Coordinates."""
    return Rule(partial(check_point, counts=counts, farthest_m=farthest_m))


def points(*counts: int, form: str, farthest_m: float = math.inf) -> Rule:
    """Several points or walls, ``form`` each."""

    def check(name: str, value: object) -> tuple[tuple[float, ...], ...]:
        found = sequence(name, value, f"{form} in metres each")
        return tuple(check_point(f"{name}[{number}]", one, counts, farthest_m) for number, one in enumerate(found))

    return Rule(check)


def existing_file(name: str, value: object) -> Path:
    """A path to a file that exists. Raises SkylessError."""
    try:
        path = Path(value)  # type: ignore[arg-type]
    except TypeError:
        raise wrong(name, value, "a path to a file") from None
    if path.is_dir() or not path.exists():
        raise SkylessError(f"{name} is {str(path)!r}; it should be a file, and there is none")
    return path


def folder_to_write(name: str, value: object) -> Path:
    """A folder for files, which may not exist yet. Raises SkylessError, before the long work."""
    try:
        path = Path(value)  # type: ignore[arg-type]
        if path.exists() and not path.is_dir():
            raise SkylessError(f"{name} is {str(path)!r}, which is a file; it should be a folder, or not exist yet")
        parent = next(folder for folder in (path, *path.absolute().parents) if folder.is_dir())
    except (TypeError, OSError):
        raise wrong(name, value, "a path to a folder") from None
    if not os.access(parent, os.W_OK):
        raise SkylessError(f"{name} is {str(path)!r}, where no folder can be written")
    return path


def _is_number(value: object) -> bool:
    if isinstance(value, bool | str | bytes):
        return False
    try:
        return math.isfinite(value)  # type: ignore[arg-type]
    except (TypeError, OverflowError):
        return False


def _limits(above: float, least: float, below: float, most: float) -> str:
    """The limits in words, each after a comma; empty without any."""
    limits = (("above", above), ("at least", least), ("below", below), ("at most", most))
    return "".join(f", {word} {limit:g}" for word, limit in limits if math.isfinite(limit))


# Texts of the command line


def read_numbers(
    name: str, text: str, counts: tuple[int, ...], separator: str = ",", *, part: str | None = None
) -> tuple[float, ...]:
    """Finite numbers of an option's value, or of a part of it; how many is one of ``counts``. Raises SkylessError."""
    try:
        values = tuple(float(one) for one in (text if part is None else part).split(separator))
    except ValueError:
        values = ()
    if len(values) not in counts or not all(math.isfinite(value) for value in values):
        wanted = f"{' or '.join(str(count) for count in counts)} numbers separated by {separator!r}"
        subject = "it" if part is None else repr(part)
        raise SkylessError(f"{name} is {text!r}; {subject} should be {'a number' if counts == (1,) else wanted}")
    return values


def read_height(name: str, text: str, words: tuple[str, ...]) -> float | str:
    """A height in metres, or one of some words instead. Raises SkylessError."""
    if text in words:
        return text
    try:
        return read_numbers(name, text, (1,))[0]
    except SkylessError:
        raise wrong(name, text, f"{', '.join(('metres', *words[:-1]))} or {words[-1]}") from None


def read_list(name: str, text: str) -> tuple[float, ...]:
    """Numbers separated by commas, as many as there are. Raises SkylessError."""
    return read_numbers(name, text, (text.count(",") + 1,))


def read_points(name: str, text: str, counts: tuple[int, ...]) -> tuple[tuple[float, ...], ...]:
    """Points separated by semicolons or spaces. Raises SkylessError."""
    return tuple(read_numbers(name, text, counts, part=part) for part in text.replace(";", " ").split())


def numbers(*counts: int, form: str, many: bool = False) -> Text:
    """Numbers with commas between."""
    return Text(partial(read_numbers, counts=counts), form, many)


# Fields that several commands have

Positive = Annotated[float, number(above=0.0)]
NotNegative = Annotated[float, number(least=0.0)]
Picoseconds = Annotated[float, number(above=0.0, most=1e6)]
"""Noise of a stamp, in the range that a site file and the almanac can hold."""
Seed = Annotated[int, whole(0)]
Method = Annotated[str, choice(*METHODS)]
Progress = Callable[[float], None]


def no_progress(_share: float) -> None:
    """Where progress goes that nobody asked for."""


class ComputedOptions(Options, frozen=True, kw_only=True):
    """What every computation takes."""

    progress: Annotated[Progress, IN_PYTHON_ONLY] = no_progress
    """Called now and then with the share of the work that is done, from 0 to 1."""
