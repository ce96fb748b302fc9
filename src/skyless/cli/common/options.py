"""Options that several commands share, and checks of their values.

A command's options are the fields of one frozen struct, which the decorator ``options`` makes: a field's name is the
option's, its docstring the help text. A struct within a struct is a group of options that several commands share.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar, dataclass_transform

from cyclopts import Parameter
from cyclopts.validators import Number

from skyless.air.page_codec import MAX_COORDINATE_M
from skyless.errors import SkylessError
from skyless.method_names import METHODS, PROTECTED

if TYPE_CHECKING:
    from skyless.positioning.integrity import IntegrityRequirement

_T = TypeVar("_T")

Positive = Annotated[float, Parameter(validator=Number(gt=0, lt=math.inf))]
NotNegative = Annotated[float, Parameter(validator=Number(gte=0, lt=math.inf))]
Finite = Annotated[float, Parameter(validator=Number(gt=-math.inf, lt=math.inf))]
Coordinate = Annotated[float, Parameter(validator=Number(gte=-MAX_COORDINATE_M, lte=MAX_COORDINATE_M))]
Seed = Annotated[int, Parameter(validator=Number(gte=0))]
Picoseconds = Annotated[float, Parameter(validator=Number(gt=0, lte=1e6))]
"""Noise of a stamp, in the range that a site file and the almanac can hold."""

IntegrityRisk = Annotated[float, Parameter(validator=Number(gt=0, lte=0.1))]
"""Probability, for each fix, that an error exceeds its protection level; 10⁻⁴ where none is given."""


@dataclass_transform(frozen_default=True, kw_only_default=True)
def options(struct: type[_T]) -> type[_T]:
    """Make a class a frozen struct of options, whose names stand on the command line without a prefix."""
    return Parameter(name="*")(dataclass(frozen=True, kw_only=True)(struct))


@options
class ProtectionOptions:
    """What is required of protection levels."""

    integrity_risk: IntegrityRisk | None = None
    """Probability, for each fix, that the error exceeds its protection level (joint); 1e-4 by default."""
    alert_limit_m: Positive | None = None
    """Fixes whose protection level exceeds this, in metres, carry an alert (joint)."""
    max_acceleration: NotNegative | None = None
    """The largest acceleration of the tags in m/s², for protection levels that cover their hardest turns (joint)."""

    @property
    def given(self) -> bool:
        """Whether any of them is given."""
        return (self.integrity_risk, self.alert_limit_m, self.max_acceleration) != (None,) * 3

    def requirement(self, method: str | None = None, height_std_m: float | None = None) -> "IntegrityRequirement":
        """Them and --tag-height-std as the filter takes them.

        Raises:
            SkylessError: the method gives no protection levels, so that a limit would have no effect.
        """
        from skyless.positioning.integrity import RISK, IntegrityRequirement

        if method in METHODS and method != PROTECTED:
            required = {
                "integrity-risk": self.integrity_risk, "alert-limit-m": self.alert_limit_m,
                "max-acceleration": self.max_acceleration, "tag-height-std": height_std_m,
            }  # fmt: skip
            for option, value in required.items():
                if value is not None:
                    raise SkylessError(
                        f"--{option} is {value:g}; it should be left out: {method} gives no protection levels"
                    )
        risk = RISK if self.integrity_risk is None else self.integrity_risk
        return IntegrityRequirement(risk, self.alert_limit_m, self.max_acceleration or 0.0, height_std_m or 0.0)


def check_left_out(given: Mapping[str, object], reason: str) -> None:
    """See that options that have no effect here are not given. Raises SkylessError."""
    for name, value in given.items():
        if value is not None:
            raise SkylessError(f"--{name} is {str(value)!r}; it should be left out: {reason}")


def check_method(method: str, names: Sequence[str] = METHODS) -> None:
    """See that a positioning method is one of these. Raises SkylessError."""
    if method not in names:
        raise SkylessError(f"--method is {method!r}; it should be one of {', '.join(names)}")


def check_height_std(height_std_m: float | None, height_m: float | None) -> None:
    """See that --tag-height-std has a height to be the standard deviation of. Raises SkylessError."""
    if height_std_m is not None and height_m is None:
        raise SkylessError(f"--tag-height-std is {height_std_m:g}; it should be left out: the height is estimated")


def finite_numbers(
    option: str, text: str, counts: tuple[int, ...], separator: str = ",", *, part: str | None = None
) -> tuple[float, ...]:
    """Numbers of an option's value, or of a part of it; how many is one of ``counts``.

    Raises:
        SkylessError: naming the option, its value and what it should be.
    """
    try:
        values = tuple(float(one) for one in (text if part is None else part).split(separator))
    except ValueError:
        values = ()
    if len(values) not in counts or not all(math.isfinite(value) for value in values):
        wanted = f"{' or '.join(str(count) for count in counts)} numbers separated by {separator!r}"
        subject = "it" if part is None else repr(part)
        raise SkylessError(f"--{option} is {text!r}; {subject} should be {'a number' if counts == (1,) else wanted}")
    return values


def metres(option: str, text: str, counts: tuple[int, ...], *, part: str | None = None) -> tuple[float, ...]:
    """Coordinates or lengths as ``finite_numbers``, within the range of the almanac. Raises SkylessError."""
    values = finite_numbers(option, text, counts, part=part)
    if any(abs(one) > MAX_COORDINATE_M for one in values):
        raise SkylessError(f"--{option} is {text!r}; it should be metres, at most {MAX_COORDINATE_M:g}")
    return values


def height_number(text: str, words: str) -> float:
    """A height in metres; ``words``: what --tag-height may be instead. Raises SkylessError."""
    try:
        return finite_numbers("tag-height", text, (1,))[0]
    except SkylessError:
        raise SkylessError(f"--tag-height is {text!r}; it should be metres, {words}") from None


def check_output(option: str, output: Path | None, *inputs: Path | None) -> None:
    """See that an output is none of the other files of the command: opening it would empty them.

    Raises:
        SkylessError: it is one of them, be it by another name.
    """
    if output is None:
        return
    for other in inputs:
        if other is not None and _same(output, other):
            raise SkylessError(f"--{option} is {str(output)!r}, another file of this command; writing would destroy it")


def check_folder(option: str, output: Path) -> None:
    """See that an output is no folder itself, and in one that exists. Raises SkylessError."""
    if output.is_dir() or not output.parent.is_dir():
        raise SkylessError(f"--{option} is {str(output)!r}; it should be a file in a folder that exists")


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
    check_folder("plot", plot)
