"""Load a validated site from a TOML file, and edit values in the file's text."""

import difflib
import json
import re
import tomllib
from collections.abc import Mapping
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import Struct

from skyless.arguments import existing_file, wrong
from skyless.core.errors import ConfigurationError
from skyless.core.site import (
    AccuracySite,
    AlarmRule,
    AnchorSite,
    FloorPlanSite,
    FloorSite,
    GeoreferenceSite,
    NoiseSite,
    ScheduleSite,
    Site,
    TagsSite,
    UnplacedAnchor,
    WallSite,
)
from skyless.site.file.check import check_floor_plans, check_site, expected, with_anchor

_MAX_BYTES: Final = 1 << 24  # a device would never end
_TOO_DEEP: Final = re.compile(rb"(?:[\w-]+[ \t]*\.[ \t]*){64}")
"""A dotted key of more than 64 parts: parsing takes quadratic time, and a site file needs only two."""

_TABLES: Final[dict[str, type[Struct]]] = {
    "schedule": ScheduleSite,
    "noise": NoiseSite,
    "accuracy": AccuracySite,
    "tags": TagsSite,
    "floor_plan": FloorPlanSite,
    "georeference": GeoreferenceSite,
}
_LISTS: Final[dict[str, type[Struct]]] = {
    "anchors": AnchorSite,
    "walls": WallSite,
    "floors": FloorSite,
    "alarms": AlarmRule,
}

_FINDING = re.compile(r"(?P<finding>.*?)(?: - at `\$\.?(?P<path>.*)`)?", re.DOTALL)
_MISSING = re.compile(r"Object missing required field `(?P<name>\w+)`")


def load_site(path: Path | str) -> Site:
    """Load and check a site file.

    Raises:
        ConfigurationError: naming the file, the key, its value and what would be right.
    """
    path = Path(path)
    document = _parse(path)
    _refuse_mode_slots(path, document)
    _refuse_unknown_keys(path, document)
    rows = _separate_unplaced(path, document)
    try:
        try:
            site = msgspec.convert(document, Site)
        except msgspec.ValidationError as error:
            raise _wrong_type(path, document, str(error)) from None
        check_site(site, path)
    except ConfigurationError as error:
        key, right = _in_file(error.key, rows), _in_file(error.expected, rows)
        raise ConfigurationError(path, key, error.value, right) from None
    check_floor_plans(site, path)
    return site


def _refuse_mode_slots(path: Path, document: dict[str, Any]) -> None:
    """Refuse the mode ``slots`` of version 0.2, and say what replaces it."""
    schedule = document.get("schedule")
    if isinstance(schedule, dict) and schedule.get("mode") == "slots":
        right = (
            '"free": without a master anchors send at random instants; '
            "leave out slot_s, guard_s, slots, reuse_m, site_time and the anchors' slot"
        )
        raise ConfigurationError(path, "schedule.mode", "slots", right)


def _separate_unplaced(path: Path, document: dict[str, Any]) -> dict[str, list[int]]:
    """Move a protocol 2 document's anchors without a position to a separate list, and name a master if there is none.

    Returns the rows in the file of both lists; none for protocol 1, and for a document that the conversion will refuse.
    """
    schedule, entries = document.get("schedule"), document.get("anchors")
    mode = schedule.get("mode") if isinstance(schedule, dict) else None
    if mode != "free":
        return {}
    if "anchors" not in document:
        raise ConfigurationError(path, "anchors", None, expected("anchors"))
    if not isinstance(entries, list):
        document.setdefault("master", 0)
        return {}
    if entries and isinstance(entries[0], dict) and "id" in entries[0]:
        document.setdefault("master", entries[0]["id"])
    rows: dict[str, list[int]] = {"anchors": [], "unplaced": []}
    for row, entry in enumerate(entries):
        unplaced = isinstance(entry, dict) and "x_m" not in entry and "y_m" not in entry
        rows["unplaced" if unplaced else "anchors"].append(row)
        if unplaced:
            _refuse_without_position(path, f"anchors[{row}]", entry)
    document |= {name: [entries[row] for row in own] for name, own in rows.items()}
    return rows


def _refuse_without_position(path: Path, row: str, entry: dict[str, Any]) -> None:
    """Refuse keys that only an anchor with a position may have."""
    for key, value in entry.items():
        if key not in UnplacedAnchor.__struct_fields__:
            right = "left out, or given with x_m and y_m: this anchor has no position"
            raise ConfigurationError(path, f"{row}.{key} (anchor {entry.get('id')})", value, right)


def _in_file(text: str, rows: dict[str, list[int]]) -> str:
    """Replace rows of the separate lists of anchors in a text by those of the file's single list."""
    if not rows:
        return text
    return re.sub(r"\b(anchors|unplaced)\[(\d+)\]", lambda match: f"anchors[{rows[match[1]][int(match[2])]}]", text)


def _parse(path: Path) -> dict[str, Any]:
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise ConfigurationError(path, "", None, "a site file, not a pipe or a device")
        with path.open("rb") as file:
            text = file.read(_MAX_BYTES + 1)
        if len(text) > _MAX_BYTES:
            raise ConfigurationError(path, "", None, f"a site file, {_MAX_BYTES >> 20} MiB at most")
        if _TOO_DEEP.search(text):
            raise ConfigurationError(path, "", None, "a site file; this one nests or counts too far")
        return tomllib.loads(text.decode("utf-8-sig"))  # Windows editors add a byte order mark
    except OSError as error:
        raise ConfigurationError(path, "", None, f"a readable site file ({error.strerror})") from None
    except UnicodeDecodeError as error:
        raise ConfigurationError(path, f"byte {error.start}", "not UTF-8", "a TOML file in UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(path, "", None, f"valid TOML: {error}") from None
    except (RecursionError, ValueError):  # brackets nested thousands deep, numbers of thousands of digits
        raise ConfigurationError(path, "", None, "a site file; this one nests or counts too far") from None


def _refuse_unknown_keys(path: Path, document: dict[str, Any]) -> None:
    _refuse_unknown(path, document, "", document, Site)
    for name, struct in _TABLES.items():
        _refuse_unknown(path, document, f"{name}.", document.get(name), struct)
    for name, struct in _LISTS.items():
        entries = document.get(name)
        for index, entry in enumerate(entries if isinstance(entries, list) else ()):
            _refuse_unknown(path, document, f"{name}[{index}].", entry, struct)


def _refuse_unknown(path: Path, document: dict[str, Any], prefix: str, table: object, struct: type[Struct]) -> None:
    if not isinstance(table, dict):
        return  # a wrong type, which the conversion reports
    known = [name for name in struct.__struct_fields__ if name != "unplaced"]
    for key, value in table.items():
        if key not in known:
            near = difflib.get_close_matches(key, known, n=2)
            right = f"called {' or '.join(near)}" if near else f"left out; the keys here are {', '.join(known)}"
            raise ConfigurationError(path, _named(document, prefix + key), value, right)


def _wrong_type(path: Path, document: dict[str, Any], message: str) -> ConfigurationError:
    """Translate msgspec's message: which key of the file, its value, and what would be right."""
    match = _FINDING.fullmatch(message)
    key_path = (match["path"] or "" if match else "").removesuffix("[...]")  # so it names any key of a table
    missing = _MISSING.match(message)
    if missing:
        key_path = f"{key_path}.{missing['name']}".lstrip(".")
    key = re.sub(r"\[\d+\]", "", key_path).replace("unplaced.", "anchors.")
    value = None if missing else _value_at(document, key_path)
    return ConfigurationError(path, _named(document, key_path), value, expected(key, protocol_2="unplaced" in document))


def _named(document: dict[str, Any], key_path: str) -> str:
    anchors, unplaced = document.get("anchors"), document.get("unplaced", [])
    return with_anchor(key_path, anchors, unplaced) if isinstance(anchors, list) else key_path


def _value_at(document: object, key_path: str) -> object:
    for step in re.findall(r"\w+", key_path):
        if isinstance(document, list):
            document = document[int(step)]
        elif isinstance(document, dict):
            document = document[step]
    return document


def site_of(site: Site | str | Path) -> tuple[Site, Path]:
    """A checked site, and the file to name in errors and to find images; ``site`` for a site without a file.

    Raises:
        SkylessError: there is no such file, or the site has an invalid value.
    """
    if isinstance(site, Site):
        file = Path("site")
        check_site(site, file)
        if site.floor_plan is not None and not Path(site.floor_plan.image).is_file():
            right = "an image in the working folder; or give the path of the site's file, next to which it lies"
            raise wrong("site.floor_plan.image", site.floor_plan.image, right)
        return site, file
    file = existing_file("--site", site)
    return load_site(file), file


# Edits of values of anchors and sections in the text of a site file, which keep everything else including comments.

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
    """Set values in a site file's text, adding missing keys. ``what`` names the values in errors.

    Raises:
        ConfigurationError: the anchors or the sections have a form that cannot be edited.
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
    line_end = "\r\n" if "\r\n" in result else "\n"
    for name, values in of_sections.items():
        if name not in present:
            rows = [f"{key} = {_toml(value)}" for key, value in values.items()]
            result += ("" if result.endswith("\n") or not result else line_end) + line_end.join(
                ["", f"[{name}]", *rows, ""]
            )
    if not _parses_to(result, _expected(text, of_anchors, of_sections)):
        expected = f"in [[anchors]] tables, one line for each key, so that {what} can be written into them"
        raise ConfigurationError(path, "anchors", "written otherwise", expected)
    return result


def _with_all(lines: list[str], values: Mapping[str, float | str]) -> list[str]:
    for key, value in values.items():
        lines = _with_value(lines, key, value)
    return lines


def _with_value(lines: list[str], key: str, new: float | str) -> list[str]:
    """Set a key's value in the lines of one table, or add it after the last key."""
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
