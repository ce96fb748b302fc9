"""Checks of values that programs pass as arguments: one line names the argument, its value, what would be right."""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Integral
from pathlib import Path
from typing import Any, Final

from skyless.errors import SkylessError
from skyless.method_names import DYNAMICS_QA_M2PS3

_LONGEST_VALUE: Final = 60


def wrong(name: str, value: object, right: str) -> SkylessError:
    """An error that says so of an argument, to be raised."""
    text = repr(value)
    shown = text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 1] + "…"
    return SkylessError(f"{name} is {' '.join(shown.split())}; it should be {right}")


def check_number(
    name: str,
    value: float | None,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    below: float = math.inf,
    most: float = math.inf,
) -> None:
    """See that a number is finite and within its limits; None passes. Raises SkylessError."""
    if value is None:
        return
    if not (_is_number(value) and above < value < below and least <= value <= most):
        raise wrong(name, value, f"a number{_limits(above, least, below, most)}")


def check_whole(name: str, value: object, *, least: int, most: int | None = None) -> None:
    """See that a whole number is within its limits; None passes. Raises SkylessError."""
    if value is None:
        return
    whole = int(value) if not isinstance(value, bool) and isinstance(value, Integral) else None
    if whole is None or not least <= whole <= (math.inf if most is None else most):
        raise wrong(
            name, value, f"a whole number{_limits(-math.inf, least, math.inf, math.inf if most is None else most)}"
        )


def check_choice(name: str, value: object, choices: Sequence[str]) -> None:
    """See that a text is one of several. Raises SkylessError."""
    if value not in choices:
        raise wrong(name, value, f"one of {', '.join(choices)}")


def process_noise(qa: float | None, dynamics: str | None) -> float | None:
    """What filters assume, by either option; None where neither is given. Raises SkylessError."""
    if dynamics is None:
        return qa
    check_choice("--dynamics", dynamics, tuple(DYNAMICS_QA_M2PS3))
    if qa is not None:
        raise SkylessError("--qa and --dynamics both set the process noise; give either")
    return DYNAMICS_QA_M2PS3[dynamics]


def sequence(name: str, value: object, right: str) -> tuple[Any, ...]:
    """Several values as a tuple. Raises SkylessError where they are none, ``right`` says what they should be."""
    if isinstance(value, str | bytes) or not isinstance(value, Iterable):
        raise wrong(name, value, right)
    return tuple(value)


def check_kinds(name: str, values: Sequence[object], kind: type) -> None:
    """See that all values are of a type. Raises SkylessError."""
    for number, value in enumerate(values):
        if not isinstance(value, kind):
            raise wrong(f"{name}[{number}]", value, f"a {kind.__module__}.{kind.__name__}")


def check_point(name: str, value: object, counts: tuple[int, ...], farthest_m: float = math.inf) -> None:
    """See that coordinates are finite, as many as one of ``counts``, and not too far away. Raises SkylessError."""
    numbers = tuple(value) if isinstance(value, Iterable) and not isinstance(value, bytes) else ()
    if len(numbers) not in counts or not all(_is_number(one) and abs(one) <= farthest_m for one in numbers):
        right = f"{' or '.join(map(str, counts))} finite numbers in metres"
        raise wrong(name, value, right + (f", at most {farthest_m:g}" if math.isfinite(farthest_m) else ""))


def existing_file(name: str, value: object) -> Path:
    """A path to a file that exists. Raises SkylessError."""
    try:
        path = Path(value)  # type: ignore[arg-type]
    except TypeError:
        raise wrong(name, value, "a path to a file") from None
    if path.is_dir() or not path.exists():
        raise SkylessError(f"{name} is {str(path)!r}; it should be a file, and there is none")
    return path


@contextmanager
def named_as_arguments(names: Mapping[str, str]) -> Iterator[None]:
    """In the block errors that name an option of a command name the argument instead.

    ``names``: arguments by option, without dashes at the start, where they differ by more than dashes.
    """
    try:
        yield
    except SkylessError as error:
        text = re.sub(r"(?<![\w./-])--([a-z][a-z0-9-]*)", lambda found: _argument(found[1], names), str(error))
        if text == str(error):
            raise
        raise SkylessError(text) from None


def _argument(option: str, names: Mapping[str, str]) -> str:
    return names.get(option, option.replace("-", "_"))


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
