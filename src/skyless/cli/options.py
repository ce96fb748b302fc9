"""Values of options that several commands share."""

import math
from pathlib import Path
from typing import TextIO

from skyless.errors import SkylessError


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
    """See that an output is none of the files that are read: opening it would empty them.

    Raises:
        SkylessError: it is one of them, be it by another name.
    """
    if output is None or not output.exists():
        return
    for read in inputs:
        if read is not None and read.exists() and output.samefile(read):
            raise SkylessError(f"--{option} is {str(output)!r}, which is read; it should be another file")
