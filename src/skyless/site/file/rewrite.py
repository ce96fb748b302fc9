"""Writes values of anchors and sections into the text of a site file; all else stays unchanged, comments included."""

import json
import re
import tomllib
from collections.abc import Mapping
from itertools import pairwise
from os import PathLike
from typing import Any

from skyless.core.errors import ConfigurationError

OfAnchors = Mapping[int, Mapping[str, float]]
"""Values by anchor and key."""
OfSections = Mapping[str, Mapping[str, float | str]]
"""Values by section and key."""

_HEADER = re.compile(r"\s*\[")
_ANCHOR = re.compile(r"\s*\[\[\s*anchors\s*\]\]")
_SECTION = re.compile(r"\s*\[\s*([\w-]+)\s*\]")
_ID = re.compile(r"\s*id\s*=\s*(\d+)\s*(#.*)?$")
_ASSIGNMENT = re.compile(r"(\s*)[\w-]+\s*=.*?(\r?\n)?$", re.DOTALL)


def with_values(text: str, of_anchors: OfAnchors, of_sections: OfSections, path: str | PathLike[str], what: str) -> str:
    """The text with values changed where their keys stand, and added where they do not; ``what`` names them in errors.

    Raises:
        ConfigurationError: the anchors or the sections are written in a form that this cannot edit.
    """
    lines = text.splitlines(keepends=True)
    starts = [number for number, line in enumerate(lines) if _HEADER.match(line)]
    changed = lines[: starts[0]] if starts else lines
    present = set()
    for start, end in pairwise([*starts, len(lines)]):
        table = lines[start + 1 : end]
        section = _SECTION.match(lines[start])
        if _ANCHOR.match(lines[start]):
            identifier = next((int(match[1]) for match in map(_ID.match, table) if match), None)
            if identifier is not None:
                table = _with_all(table, of_anchors.get(identifier, {}))
        elif section:
            present.add(section[1])
            table = _with_all(table, of_sections.get(section[1], {}))
        changed += [lines[start], *table]
    result = "".join(changed)
    for name, values in of_sections.items():
        if name not in present:
            result += _new_section(result, name, values)
    if not _parses_to(result, _expected(text, of_anchors, of_sections)):
        expected = f"in [[anchors]] tables, one line for each key, so that {what} can be written into them"
        raise ConfigurationError(path, "anchors", "written otherwise", expected)
    return result


def _with_all(lines: list[str], values: Mapping[str, float | str] | Mapping[str, float]) -> list[str]:
    for key, value in values.items():
        lines = _with_value(lines, key, value)
    return lines


def _with_value(lines: list[str], key: str, new: float | str) -> list[str]:
    """The lines of one table with a key's value changed, or added after the last key."""
    present = re.compile(rf"(\s*{key}\s*=\s*)(\"[^\"]*\"|[^\s#]+)(.*)", re.DOTALL)
    value = _toml(new)
    for number, line in enumerate(lines):
        match = present.match(line)
        if match:
            return [*lines[:number], f"{match[1]}{value}{match[3]}", *lines[number + 1 :]]
    last = max((number for number, line in enumerate(lines) if _ASSIGNMENT.match(line)), default=-1)
    match = _ASSIGNMENT.match(lines[last]) if last >= 0 else None
    if match is None:
        return [f"{key} = {value}\n", *lines]
    end = match[2] or "\n"
    before = lines[last] if match[2] else lines[last] + end
    return [*lines[:last], before, f"{match[1]}{key} = {value}{end}", *lines[last + 1 :]]


def _toml(value: float | str) -> str:
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else str(value)


def _new_section(text: str, name: str, values: Mapping[str, float | str]) -> str:
    end = "\r\n" if "\r\n" in text else "\n"
    rows = [f"{key} = {_toml(value)}" for key, value in values.items()]
    return ("" if text.endswith("\n") or not text else end) + end.join(["", f"[{name}]", *rows, ""])


def _expected(text: str, of_anchors: OfAnchors, of_sections: OfSections) -> dict[str, Any]:
    document = tomllib.loads(text)
    for anchor in document["anchors"]:
        anchor.update(of_anchors.get(anchor["id"], {}))
    for name, values in of_sections.items():
        document.setdefault(name, {}).update(values)
    return document


def _parses_to(text: str, document: dict[str, Any]) -> bool:
    try:
        return tomllib.loads(text) == document
    except tomllib.TOMLDecodeError:
        return False
