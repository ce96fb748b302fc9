"""Which recordings lie below a folder, and what belongs to each: its truth and its anchors."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from msgspec import Struct

from skyless.core.errors import ConfigurationError
from skyless.research.foreign.formats import format_of
from skyless.research.replays.site import SITE_FORMAT
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
    """A table of the body's positions beside it."""
    anchors: Path | None = None
    has_body_truth: bool = False
    """Whether the truth, of the table or in the recording itself, is of the body that carries the antenna."""


def recordings_below(folder: Path) -> Iterator[Found]:
    """All recordings that can be read, by their content, in the order of their names."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    truths = {companion for path in paths if (companion := truth_of(path))}
    for path in paths:
        if path in truths or path.stat().st_size < _SMALLEST or "anchors" in path.name:
            continue
        name, truth = re.sub(r"\.[\w.]+$", "", str(path.relative_to(folder))), truth_of(path)
        if is_mcap(path):
            yield Found(name, path, SITE_FORMAT)
            continue
        try:
            kind = format_of(path)
        except ConfigurationError:
            continue
        is_of_body = truth is not None
        if truth is None and kind.truth_is_of_body and kind.read_truth is not None:
            is_of_body = kind.read_truth(path, None) is not None
        yield Found(name, path, kind.name, truth, anchors_of(path, folder), is_of_body)


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
