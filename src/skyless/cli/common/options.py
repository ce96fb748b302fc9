"""Values of options that several commands share."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

from cyclopts import Parameter
from cyclopts.validators import Number

from skyless.errors import SkylessError
from skyless.method_names import METHODS, PROTECTED

if TYPE_CHECKING:
    from skyless.positioning.integrity import IntegrityRequirement

Positive = Annotated[float, Parameter(validator=Number(gt=0, lt=math.inf))]
NotNegative = Annotated[float, Parameter(validator=Number(gte=0, lt=math.inf))]
Picoseconds = Annotated[float, Parameter(validator=Number(gt=0, lte=1e6))]
"""Noise of a stamp, as far as a site file and the almanac can tell it."""

Finite = Annotated[float, Parameter(validator=Number(gt=-math.inf, lt=math.inf))]

IntegrityRisk = Annotated[float, Parameter(validator=Number(gt=0, lte=0.1))]
"""Probability, for each fix, that an error exceeds its protection level; 10⁻⁴ where none is given."""


def integrity_of(
    risk: float | None,
    alert_limit_m: float | None,
    max_acceleration_mps2: float | None,
    method: str | None = None,
    height_std_m: float | None = None,
) -> "IntegrityRequirement":
    """What --integrity-risk, --alert-limit-m, --max-acceleration and --height-std say of tags and their levels.

    Raises:
        SkylessError: the method gives none, so that a limit would be watched by nobody.
    """
    from skyless.positioning.integrity import RISK, IntegrityRequirement

    if method in METHODS and method != PROTECTED:
        asked = {
            "integrity-risk": risk, "alert-limit-m": alert_limit_m, "max-acceleration": max_acceleration_mps2,
            "height-std": height_std_m,
        }  # fmt: skip
        for option, value in asked.items():
            if value is not None:
                raise SkylessError(
                    f"--{option} is {value:g}; it should be left out: {method} gives no protection levels"
                )

    risk = RISK if risk is None else risk
    return IntegrityRequirement(risk, alert_limit_m, max_acceleration_mps2 or 0.0, height_std_m or 0.0)


def see_that_a_height_is_given(height_std_m: float | None, height_m: float | None) -> None:
    """See that --height-std has a height to be the standard deviation of. Raises SkylessError."""
    if height_std_m is not None and height_m is None:
        raise SkylessError(f"--height-std is {height_std_m:g}; it should be left out: the height is estimated")


def known_method(method: str, names: Sequence[str] = METHODS) -> None:
    """See that a positioning method is one of these. Raises SkylessError."""
    if method not in names:
        raise SkylessError(f"--method is {method!r}; it should be one of {', '.join(names)}")


def finite_numbers(option: str, text: str, counts: tuple[int, ...], separator: str = ",") -> tuple[float, ...]:
    """Numbers of an option's value, as many as one of ``counts`` says.

    Raises:
        SkylessError: naming the option, its value and what it should be.
    """
    try:
        values = tuple(float(part) for part in text.split(separator))
    except ValueError:
        values = ()
    if len(values) not in counts or not all(math.isfinite(value) for value in values):
        wanted = " or ".join(str(count) for count in counts)
        raise SkylessError(f"--{option} is {text!r}; it should be {wanted} number(s) separated by {separator!r}")
    return values


def open_for_writing(path: Path) -> TextIO:
    """Open a table to be written row by row.

    Raises:
        SkylessError: the file cannot be written.
    """
    try:
        return path.open("w", newline="", encoding="utf-8")
    except OSError as error:
        raise SkylessError(f"{path} cannot be written: {error.strerror}") from None


def spare_inputs(option: str, output: Path | None, *inputs: Path | None) -> None:
    """See that an output is none of the other files of the command: opening it would empty them.

    Raises:
        SkylessError: it is one of them, be it by another name.
    """
    if output is None:
        return
    for other in inputs:
        if other is not None and _same(output, other):
            raise SkylessError(f"--{option} is {str(output)!r}, another file of this command; writing would destroy it")


def _same(a: Path, b: Path) -> bool:
    """Whether two paths lead to one file, through links of either kind, existing or not."""
    try:
        return a.samefile(b)
    except OSError:
        return a.absolute() == b.absolute()
