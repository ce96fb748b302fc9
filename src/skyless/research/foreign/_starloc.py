"""STARLOC's tables of two-way exchanges (Dümbgen et al., arXiv 2309.05518), as differences of one tag's ranges.

In an exchange the tag sends (1), the anchor answers (2) and sends once more (3); both stamp all three. With the rate ν
of the tag's clock against the anchor's from the last two,

    range = ½·c·[(rx2 − tx1) − ν·(tx2 − rx1)],   ν = (rx3 − rx2) / (tx3 − tx2).

What a range has too much, such as antenna delays of the tag, cancels in the difference of two.
"""

import re
from collections.abc import Iterator
from contextlib import suppress
from io import BufferedIOBase
from math import isfinite
from os import PathLike
from pathlib import Path
from typing import Final, NamedTuple

from skyless.core.air.masterless_packets import PairTdoa, Point
from skyless.core.input_files import Drops, rows
from skyless.core.ticks import TICK_M, TICK_S, difference, wrap
from skyless.research.foreign._tdoa_tables import numbers, rows_of
from skyless.site.tables import Truth

_STAMPS: Final = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")
_TRUTH: Final = ("tag_pos_x", "tag_pos_y", "tag_pos_z")
COLUMNS: Final = ("time_s", "from_id", "to_id", *_STAMPS)
_STAMP_BITS: Final = 32
_TICK_NS: Final = 1e9 * TICK_S

_MAX_APART_S: Final = 0.05
"""Of the two ranges of a difference: a tag that walks has gone some centimetres by then."""

_MAX_RATE: Final = 100e-6
_FARTHEST_M: Final = 1000.0

_MARKERS: Final = {4: 12, 5: 15, 6: 16, 7: 11, 9: 9, 10: 13, 11: 10, 12: 6}
"""Anchors by their rows in the table of markers, in the sessions s1 and s2."""


class _Range(NamedTuple):
    time_s: float
    anchor: int
    range_m: float


def read(stream: BufferedIOBase, drops: Drops, listener: str | None = None) -> Iterator[PairTdoa]:
    """Yield differences of one tag's successive ranges; by default those of the tag of the first row."""
    before: _Range | None = None
    for row in rows_of(rows(stream, drops, COLUMNS), drops, listener):
        found = _range_of(row)
        if isinstance(found, str):
            drops[found] += 1
            continue
        if before is None or found.anchor == before.anchor or not 0.0 <= found.time_s - before.time_s < _MAX_APART_S:
            drops["range-without-another"] += 1
        else:
            yield PairTdoa(found.time_s, before.anchor, found.anchor, found.range_m - before.range_m)
        before = found


def _range_of(row: list[bytes]) -> _Range | str:
    """Range of a row whose fields are ``COLUMNS``, or the reason why it has none."""
    try:
        time_s, anchor = float(row[0]), int(row[2])
        stamps = [wrap(round(float(field) / _TICK_NS), _STAMP_BITS) for field in row[3:]]
    except (ValueError, OverflowError):
        return "malformed-number"
    if not isfinite(time_s):
        return "not-finite"
    tx1, rx1, tx2, rx2, tx3, rx3 = stamps
    span, reply = (wrap(later - earlier, _STAMP_BITS) for later, earlier in ((tx3, tx2), (tx2, rx1)))
    gain = difference(rx3 - rx2, span, _STAMP_BITS) / span if span else _MAX_RATE
    range_m = (difference(rx2 - tx1, reply, _STAMP_BITS) - gain * reply) / 2 * TICK_M
    if abs(gain) >= _MAX_RATE or abs(range_m) > _FARTHEST_M:
        return "stamps-of-no-exchange"
    return _Range(time_s, anchor, range_m)


def read_anchors(path: str | PathLike[str]) -> dict[int, Point]:
    """Where the anchors stand by the published table ``mocap/uwb_markers_v1.csv`` beside the recording's folder.

    Empty where that is missing, or the folder is of another session than s1 and s2.
    """
    folder = Path(path).absolute().parent
    table = folder.parent / "mocap" / "uwb_markers_v1.csv"
    if not re.search("_s[12]$", folder.name) or not table.is_file():
        return {}
    found: dict[int, Point] = {}
    for line in table.read_text(encoding="utf-8", errors="replace").splitlines():
        with suppress(ValueError):
            marker, x_m, y_m, z_m = line.split(",")
            found[int(marker)] = (float(x_m), float(y_m), float(z_m))
    return {anchor: found[marker] for anchor, marker in _MARKERS.items() if marker in found}


def read_truth(path: str | PathLike[str], listener: str | None) -> Truth | None:
    """Where one tag was by motion capture, by default that of the first row; None where the table has none."""
    table = numbers(path, ("time_s", *_TRUTH), ("from_id", listener))
    return Truth(table[:, 0], table[:, 1:], None) if len(table) else None
