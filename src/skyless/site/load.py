"""From a TOML file to a validated site."""

import difflib
import re
import tomllib
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import Struct

from skyless.errors import ConfigurationError
from skyless.site.check import check_floor_plan, check_site, expected, with_anchor
from skyless.site.model import (
    AccuracySite,
    AnchorSite,
    FloorPlanSite,
    GeoreferenceSite,
    NoiseSite,
    ScheduleSite,
    Site,
    TagsSite,
    WallSite,
)

_TABLES: Final[dict[str, type[Struct]]] = {
    "schedule": ScheduleSite,
    "noise": NoiseSite,
    "accuracy": AccuracySite,
    "tags": TagsSite,
    "floor_plan": FloorPlanSite,
    "georeference": GeoreferenceSite,
}
_LISTS: Final[dict[str, type[Struct]]] = {"anchors": AnchorSite, "walls": WallSite}

_FINDING = re.compile(r"(?P<finding>.*?)(?: - at `\$\.?(?P<path>.*)`)?", re.DOTALL)
_MISSING = re.compile(r"Object missing required field `(?P<name>\w+)`")


def load_site(path: Path | str) -> Site:
    """The site that a TOML file describes.

    Raises:
        ConfigurationError: naming the file, the key, its value and what would be right.
    """
    path = Path(path)
    document = _parse(path)
    _refuse_unknown_keys(path, document)
    try:
        site = msgspec.convert(document, Site)
    except msgspec.ValidationError as error:
        raise _wrong_type(path, document, str(error)) from None
    check_site(site, path)
    check_floor_plan(site, path)
    return site


def _parse(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
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
    known = struct.__struct_fields__
    for key, value in table.items():
        if key not in known:
            near = difflib.get_close_matches(key, known, n=2)
            right = f"called {' or '.join(near)}" if near else f"left out; the keys here are {', '.join(known)}"
            raise ConfigurationError(path, _named(document, prefix + key), value, right)


def _wrong_type(path: Path, document: dict[str, Any], message: str) -> ConfigurationError:
    """The error that msgspec's message means: which key of the file, its value, and what would be right."""
    match = _FINDING.fullmatch(message)
    key_path = match["path"] or "" if match else ""
    missing = _MISSING.match(message)
    if missing:
        key_path = f"{key_path}.{missing['name']}".lstrip(".")
    key = re.sub(r"\[\d+\]", "", key_path)
    value = None if missing else _value_at(document, key_path)
    return ConfigurationError(path, _named(document, key_path), value, expected(key))


def _named(document: dict[str, Any], key_path: str) -> str:
    anchors = document.get("anchors")
    return with_anchor(key_path, anchors) if isinstance(anchors, list) else key_path


def _value_at(document: object, key_path: str) -> object:
    for step in re.findall(r"\w+", key_path):
        if isinstance(document, list):
            document = document[int(step)]
        elif isinstance(document, dict):
            document = document[step]
    return document
