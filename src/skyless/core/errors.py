"""Errors for the user: faults that the user can correct, with messages that name what to correct."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike, fspath

_LONGEST_VALUE = 60


class SkylessError(Exception):
    """A fault outside the program; its message is for the user, and the command line exits with 2."""


@contextmanager
def writing(path: str | PathLike[str]) -> Iterator[None]:
    """Convert an OSError while writing to a SkylessError that names the file or folder."""
    try:
        yield
    except OSError as error:
        raise SkylessError(f"{path} cannot be written: {error.strerror}") from None


class ConfigurationError(SkylessError):
    """An unusable configuration: file, key, value, and what would be right."""

    def __init__(self, file: str | PathLike[str], key: str, value: object, expected: str) -> None:
        """``key`` is empty for the file as a whole; ``value`` is None if the key is missing."""
        self.file = fspath(file)
        self.key = key
        self.value = value
        self.expected = expected
        super().__init__(f"{self.file}: {self._finding()}it should be {expected}")

    def _finding(self) -> str:
        if not self.key:
            return ""
        if self.value is None:
            return f"{self.key} is missing; "
        return f"{self.key} is {_shown(self.value)}; "


def _shown(value: object) -> str:
    """The value as a configuration file would show it, shortened."""
    try:
        text = json.dumps(value, ensure_ascii=False) if isinstance(value, str | bool) else str(value)
    except RecursionError:
        return "nested too far to be shown"
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 1] + "…"
