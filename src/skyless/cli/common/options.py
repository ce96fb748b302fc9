"""Command lines made of structs of options (``skyless.core.arguments``), and checks of files that commands write."""

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from cyclopts import Parameter
from msgspec import NODEFAULT

from skyless.core.arguments import OptionError, OptionField, Options, option_field, option_fields, option_helps
from skyless.core.errors import SkylessError


class JsonOptions(Options, frozen=True, kw_only=True):
    """What every command has."""

    json: bool = False
    """Write one JSON object instead of text."""


def command(run: Callable[..., int | None]) -> Callable[..., int | None]:
    """A function as cyclopts calls it: the fields of each parameter that is a struct of options are options.

    Fields without a default are arguments without a name. Other parameters obey the rules that they are annotated with.
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
    """The struct out of what the command line gave. Raises SkylessError, which names options."""
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
    """See that an output is none of the other files of the command: opening it would empty them.

    Raises:
        SkylessError: it is one of them, even if by another name.
    """
    if output is None:
        return
    for other in inputs:
        if other is not None and _same(output, other):
            raise SkylessError(f"--{option} is {str(output)!r}, another file of this command; writing would destroy it")


def check_folder(option: str, output: Path) -> None:
    """See that an output is no folder itself, and in one that exists. Raises SkylessError."""
    if output.is_dir() or not output.parent.is_dir():
        raise SkylessError(f"{option} is {str(output)!r}; it should be a file in a folder that exists")


def make_folder(option: str, folder: Path) -> None:
    """Make a folder for files that come later, unless it is there. Raises SkylessError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SkylessError(f"{option} is {str(folder)!r}, which is no folder: {error.strerror}") from None


def _same(a: Path, b: Path) -> bool:
    """Whether two paths lead to one file, through links of either kind, existing or not."""
    try:
        return a.samefile(b)
    except OSError:
        return a.absolute() == b.absolute()


def check_picture(plot: Path | None) -> None:
    """See that --plot can be written, before the long work instead of after it. Raises SkylessError."""
    if plot is None:
        return
    endings = (".png", ".svg", ".pdf")
    if plot.suffix.lower() not in endings:
        raise SkylessError(f"--plot is {str(plot)!r}; its ending should be one of {', '.join(endings)}")
    check_folder("--plot", plot)
