"""Which recordings lie below a folder, and what belongs to each: its truth and its anchors."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from msgspec import Struct

from skyless.core.errors import ConfigurationError
from skyless.research.foreign.formats import Format, format_of
from skyless.run.recordings.recording import is_mcap

_TABLE: Final = re.compile(r"_(?:tdoa|data)(?=\.)")
_TRUTHS: Final = ("_pose", "_truth", "_lighthouse")
"""``NAME_tdoa.csv`` has its truth in ``NAME_pose.csv``, or with another of these words."""

_ANCHORS: Final = ("anchors*.csv", "anchors/anchors*.csv", "anchor_positions.yaml")

_SMALLEST: Final = 200
"""Bytes that a recording has at least."""


class Found(Struct, frozen=True):
    """A recording and what belongs to it."""

    name: str
    """Its path from the folder, without endings."""
    path: Path
    format: str
    truth: Path | None = None
    anchors: Path | None = None


def recordings_below(folder: Path) -> Iterator[Found]:
    """All recordings that can be read, by their content, in the order of their names."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    truths = {companion for path in paths if (companion := truth_of(path))}
    for path in paths:
        if path in truths or path.stat().st_size < _SMALLEST or "anchors" in path.name:
            continue
        kind = _kind_of(path)
        if kind is not None:
            name = re.sub(r"(_tdoa)?\.[\w.]+$", "", str(path.relative_to(folder)))
            yield Found(name, path, kind, truth_of(path), anchors_of(path, folder))


def _kind_of(path: Path) -> str | None:
    if is_mcap(path):
        return "skyless-mcap"
    try:
        found: Format = format_of(path)
    except ConfigurationError:
        return None
    return found.name


def truth_of(path: Path) -> Path | None:
    """The table of truth that lies beside a recording."""
    companions = (path.with_name(_TABLE.sub(word, path.name)) for word in _TRUTHS if _TABLE.search(path.name))
    return next((one for one in companions if one.is_file()), None)


def anchors_of(path: Path, folder: Path) -> Path | None:
    """The nearest table of anchors: one of ``_ANCHORS`` beside the recording or above.

    Of several the one whose ending stands in the recording's path, as ``const1`` of ``anchors_const1.csv``.
    """
    for place in (one for one in path.parents if one == folder or folder in one.parents):
        tables = sorted(table for name in _ANCHORS for table in place.glob(name))
        fitting = [table for table in tables if table.stem.partition("_")[2] in path.parts]
        if fitting or len(tables) == 1:
            return (fitting or tables)[0]
    return None
