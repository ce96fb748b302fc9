"""Writes antenna delays and slots into the text of a site file; everything else stays unchanged, comments included."""

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
_SCHEDULE = re.compile(r"\s*\[\s*schedule\s*\]")
_ID = re.compile(r"\s*id\s*=\s*(\d+)\s*(#.*)?$")
_ASSIGNMENT = re.compile(r"(\s*)[\w-]+\s*=.*?(\r?\n)?$", re.DOTALL)


def with_tx_delays(text: str, delays_ticks: Mapping[int, int], path: str | PathLike[str]) -> str:
    """The text with the TX antenna delays of some anchors changed, or added where the key is missing.

    Raises:
        ConfigurationError: the anchors are written in a form that this cannot edit, such as inline tables.
    """
    return _with_values(text, DELAY_KEY, delays_ticks, None, path)


def with_slots_written(text: str, slots: Mapping[int, int], count: int, path: str | PathLike[str]) -> str:
    """The text with the slots of some anchors and ``schedule.slots`` changed, or added where the key is missing.

    Raises:
        ConfigurationError: the anchors or the schedule are written in a form that this cannot edit.
    """
    return _with_values(text, "slot", slots, count, path)


def _with_values(
    text: str, key: str, of_anchors: Mapping[int, int], slots: int | None, path: str | PathLike[str]
) -> str:
    """The text with one key of anchors, by identifier, and ``schedule.slots`` if given."""
    lines = text.splitlines(keepends=True)
    starts = [number for number, line in enumerate(lines) if _HEADER.match(line)]
    changed = lines[: starts[0]] if starts else lines
    for start, end in pairwise([*starts, len(lines)]):
        table = lines[start + 1 : end]
        if _ANCHOR.match(lines[start]):
            identifier = next((int(match[1]) for match in map(_ID.match, table) if match), None)
            if identifier is not None and identifier in of_anchors:
                table = _with_value(table, key, of_anchors[identifier])
        elif slots is not None and _SCHEDULE.match(lines[start]):
            table = _with_value(table, "slots", slots)
        changed += [lines[start], *table]
    result = "".join(changed)
    if not _parses_to(result, _expected(text, key, of_anchors, slots)):
        what = "delays" if slots is None else "slots"
        expected = f"in [[anchors]] tables, one line for each key, so that the {what} can be written into them"
        raise ConfigurationError(path, "anchors", "written otherwise", expected)
    return result


def _with_value(lines: list[str], key: str, value: int) -> list[str]:
    """The lines of one table with a key's value changed, or added after the last key."""
    present = re.compile(rf"(\s*{key}\s*=\s*)([\d_]+)(.*)", re.DOTALL)
    for number, line in enumerate(lines):
        match = present.match(line)
        if match:
            return [*lines[:number], f"{match[1]}{value}{match[3]}", *lines[number + 1 :]]
    last = max((number for number, line in enumerate(lines) if _ASSIGNMENT.match(line)), default=-1)
    match = _ASSIGNMENT.match(lines[last]) if last >= 0 else None
    if match is None:
        return lines
    end = match[2] or "\n"
    before = lines[last] if match[2] else lines[last] + end
    return [*lines[:last], before, f"{match[1]}{key} = {value}{end}", *lines[last + 1 :]]


def _expected(text: str, key: str, of_anchors: Mapping[int, int], slots: int | None) -> dict[str, Any]:
    document = tomllib.loads(text)
    for anchor in document["anchors"]:
        if anchor["id"] in of_anchors:
            anchor[key] = of_anchors[anchor["id"]]
    if slots is not None:
        document.setdefault("schedule", {})["slots"] = slots
    return document


def _parses_to(text: str, document: dict[str, Any]) -> bool:
    try:
        return tomllib.loads(text) == document
    except tomllib.TOMLDecodeError:
        return False
