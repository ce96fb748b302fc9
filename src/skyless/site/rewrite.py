"""Writes antenna delays into the text of a site file; everything else stays unchanged, comments included."""

import re
import tomllib
from collections.abc import Mapping
from itertools import pairwise
from os import PathLike
from typing import Any, Final

from skyless.errors import ConfigurationError

DELAY_KEY: Final = "tx_antenna_delay_ticks"

_HEADER = re.compile(r"\s*\[")
_ANCHOR = re.compile(r"\s*\[\[\s*anchors\s*\]\]")
_ID = re.compile(r"\s*id\s*=\s*(\d+)\s*(#.*)?$")
_DELAY = re.compile(rf"(\s*{DELAY_KEY}\s*=\s*)([\d_]+)(.*)", re.DOTALL)
_ASSIGNMENT = re.compile(r"(\s*)[\w-]+\s*=.*?(\r?\n)?$", re.DOTALL)


def with_tx_delays(text: str, delays_ticks: Mapping[int, int], path: str | PathLike[str]) -> str:
    """The text with the TX antenna delays of some anchors changed, or added where the key is missing.

    Raises:
        ConfigurationError: the anchors are written in a form that this cannot edit, such as inline tables.
    """
    lines = text.splitlines(keepends=True)
    starts = [number for number, line in enumerate(lines) if _HEADER.match(line)]
    for start, end in reversed([*pairwise([*starts, len(lines)])]):
        if _ANCHOR.match(lines[start]):
            lines[start + 1 : end] = _with_delay(lines[start + 1 : end], delays_ticks)
    changed = "".join(lines)
    if not _parses_to(changed, _expected(text, delays_ticks)):
        expected = "in [[anchors]] tables, one line for each key, so that the delays can be written into them"
        raise ConfigurationError(path, "anchors", "written otherwise", expected)
    return changed


def _with_delay(lines: list[str], delays_ticks: Mapping[int, int]) -> list[str]:
    """The lines of one [[anchors]] table."""
    identifier = next((int(match[1]) for match in map(_ID.match, lines) if match), None)
    if identifier is None or identifier not in delays_ticks:
        return lines
    ticks = delays_ticks[identifier]
    for number, line in enumerate(lines):
        match = _DELAY.match(line)
        if match:
            return [*lines[:number], f"{match[1]}{ticks}{match[3]}", *lines[number + 1 :]]
    last = max((number for number, line in enumerate(lines) if _ASSIGNMENT.match(line)), default=-1)
    match = _ASSIGNMENT.match(lines[last]) if last >= 0 else None
    if match is None:
        return lines
    end = match[2] or "\n"
    before = lines[last] if match[2] else lines[last] + end
    return [*lines[:last], before, f"{match[1]}{DELAY_KEY} = {ticks}{end}", *lines[last + 1 :]]


def _expected(text: str, delays_ticks: Mapping[int, int]) -> dict[str, Any]:
    document = tomllib.loads(text)
    for anchor in document["anchors"]:
        if anchor["id"] in delays_ticks:
            anchor[DELAY_KEY] = delays_ticks[anchor["id"]]
    return document


def _parses_to(text: str, document: dict[str, Any]) -> bool:
    try:
        return tomllib.loads(text) == document
    except tomllib.TOMLDecodeError:
        return False
