"""Messages of ``/live2``: tags of a large site as points or counts, and anchors, in binary (``docs/batches.md``)."""

import math
import struct
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from skyless.core.site import AnchorSite
from skyless.run.fix_batch import ALERT_BITS, RECORD, Records
from skyless.run.site_table import THRESHOLDS

# The newest fix of every tag of a large site in NumPy arrays, by tag number. No I/O.

MAX_NUMBER: Final = 1_000_000
MAX_DUE: Final = 1_000

_SET_BACK_US: Final = 10_000_000
"""A fix older than the newest by more than this is from a clock that was set back; other old ones are late."""

_INTERVAL_S: Final = 0.5
_DUE_PER_S: Final = 20_000
"""The interval of ``pop_due`` is longer if more tags than this would be due per second."""

Array = NDArray[Any]


class Columns:
    """The newest record of each tag, with its time of arrival."""

    def __init__(self) -> None:
        self.serial = self.dropped = 0
        """Number of batches, and of fixes dropped because their tag numbers are too large."""
        self.names: dict[int, str] = {}
        """Names by tag number, as far as requested; empty for tags without a name."""
        self._used = 0
        self._newest = np.zeros(MAX_NUMBER + 1, RECORD)  # the system allocates only pages that are written
        self._arrived_s, self._popped_s, self._gone_after_s = np.zeros((3, MAX_NUMBER + 1))

    def update(self, records: Records, now_s: float) -> None:
        """Add the records of a batch."""
        self.serial += 1
        allowed = records["tag"] <= MAX_NUMBER
        self.dropped += int(len(records) - allowed.sum())
        records = records.compress(allowed)  # ten times as fast as indexing
        records = records.take(np.argsort(records["unix_us"], kind="stable"))  # so that a tag's last record is kept
        unix_us = records["unix_us"].astype(np.int64)
        before_us = self._newest["unix_us"][records["tag"]].astype(np.int64)
        records = records.compress((unix_us >= before_us) | (unix_us < before_us - _SET_BACK_US))
        self._used = max(self._used, int(records["tag"].max(initial=0)) + 1)
        self._newest.put(records["tag"], records)
        self._arrived_s[records["tag"]] = now_s

    def visible(self, view: tuple[float, float, float, float], now_s: float) -> tuple[Records, Array]:
        """Records of the tags within a view (least x, y and largest x, y in m), and their ages since arrival.

        Tags that have gone are left out.
        """
        low_x, low_y, high_x, high_y = (1000.0 * edge for edge in view)
        x_mm, y_mm, _ = self._newest["position_mm"][: self._used].T
        inside = (x_mm >= low_x) & (x_mm <= high_x) & (y_mm >= low_y) & (y_mm <= high_y)
        gone_after_s = np.maximum(self._gone_after_s[: self._used], THRESHOLDS.gone_s)
        inside &= self._arrived_s[: self._used] > np.maximum(0.0, now_s - gone_after_s)
        tags = np.flatnonzero(inside)
        return self._newest.take(tags), now_s - self._arrived_s.take(tags)

    def pop_due(self, now_s: float, first: Sequence[int] = ()) -> tuple[Records, Array]:
        """Return about ``MAX_DUE`` new records at most, for consumers of single fixes, with their times of arrival.

        Each tag is due at most once per interval, the longest waiting ones first; tags in ``first`` never wait.
        """
        interval_s = max(_INTERVAL_S, self._used / _DUE_PER_S)
        arrived_s, popped_s = self._arrived_s[: self._used], self._popped_s[: self._used]
        is_new = arrived_s > popped_s
        tags = np.flatnonzero(is_new & (popped_s <= now_s - interval_s))
        if len(tags) > MAX_DUE:
            tags = tags[np.argpartition(popped_s[tags], MAX_DUE)[:MAX_DUE]]
        tags = np.union1d(tags, [tag for tag in first if is_new[tag]]).astype(np.int64)
        self._popped_s[tags] = now_s
        return self._newest.take(tags), arrived_s.take(tags)

    def set_gone_after(self, gone_after_s: Mapping[int, float]) -> None:
        """Set for how long tags that send rarely must be silent to be gone, by number; others have the shortest."""
        for number, seconds in gone_after_s.items():
            self._gone_after_s[number] = seconds

    def heard_since(self, time_s: float) -> list[int]:
        """Numbers of the tags with a fix that arrived after a time."""
        numbers: list[int] = np.flatnonzero(self._arrived_s[: self._used] > time_s).tolist()
        return numbers


MAX_POINTS: Final = 5_000
MAX_CELLS: Final = 16_384
MIN_CELL_PX: Final = 8

_MAX_NAMED: Final = 200
_MAX_U16: Final = 65_535
_HEAD: Final = struct.Struct("<BBHQ")
_COUNTS_HEAD: Final = struct.Struct("<BBHHHQ")
POINT: Final = np.dtype(
    [("tag", "<u4"), ("x", "<u2"), ("y", "<u2"), ("sigma_mm", "<u2"), ("freshness", "u1"), ("alert", "u1")]
)
ANCHOR: Final = np.dtype(
    [("id", "<u2"), ("x_mm", "<i4"), ("y_mm", "<i4"), ("z_cm", "<i2"), ("floor", "u1"), ("zero", "u1")]
)
CONDITIONS: Final = {"good": 1, "warn": 2, "bad": 3}
"""Codes of conditions; 0 is unknown."""

_Edge = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Pixels = Annotated[int, Meta(ge=1, le=16_384)]


class View(Struct, frozen=True):
    """The view of a page."""

    view: tuple[_Edge, _Edge, _Edge, _Edge]
    """Least x and y, and largest x and y in m."""
    px: tuple[_Pixels, _Pixels]
    named: Annotated[tuple[int, ...], Meta(max_length=_MAX_NAMED)] = ()
    """Numbers of tags whose names are requested."""

    def __post_init__(self) -> None:
        """Raise ValueError if the view has no area."""
        x0, y0, x1, y1 = self.view
        if not (x0 < x1 and y0 < y1):
            raise ValueError("it has no area")


def tags_message(columns: Columns, view: View, now_s: float, unix_us: int) -> bytes:
    """Message ``P`` with points, or ``B`` with counts if more than ``MAX_POINTS`` tags are visible."""
    records, ages_s = columns.visible(view.view, now_s)
    x0, y0, x1, y1 = view.view
    x_m, y_m, _ = records["position_mm"].T / 1000.0
    x_share, y_share = (x_m - x0) / (x1 - x0), (y_m - y0) / (y1 - y0)
    if len(records) > MAX_POINTS:
        return _counts(x_share, y_share, view.px, unix_us)
    with np.errstate(invalid="ignore", over="ignore"):
        sigma_mm = 1000.0 * np.sqrt(records["covariance_m2"][:, 0] + records["covariance_m2"][:, 2])
    points = np.empty(len(records), POINT)
    points["tag"], points["alert"] = records["tag"], records["flags"] & ALERT_BITS
    points["x"], points["y"] = np.rint(_MAX_U16 * x_share), np.rint(_MAX_U16 * y_share)
    points["sigma_mm"] = np.minimum(np.nan_to_num(sigma_mm, nan=_MAX_U16), _MAX_U16)
    points["freshness"] = np.clip(10.0 * ages_s, 0.0, 10.0 * THRESHOLDS.gone_s)
    return _HEAD.pack(ord("P"), 0, len(points), unix_us) + points.tobytes()


def _counts(x_share: Array, y_share: Array, px: tuple[int, int], unix_us: int) -> bytes:
    cell = MIN_CELL_PX
    while math.ceil(px[0] / cell) * math.ceil(px[1] / cell) > MAX_CELLS:
        cell += 1
    columns, rows = math.ceil(px[0] / cell), math.ceil(px[1] / cell)
    column = np.minimum((x_share * px[0] / cell).astype(np.int64), columns - 1)
    row = np.minimum((y_share * px[1] / cell).astype(np.int64), rows - 1)
    counts = np.bincount(row * columns + column, minlength=columns * rows)
    head = _COUNTS_HEAD.pack(ord("B"), cell, columns, rows, 0, unix_us)
    return head + np.minimum(counts, _MAX_U16).astype("<u2").tobytes()


def names_message(columns: Columns, numbers: Sequence[int], unix_us: int) -> bytes:
    """Message ``N``: names of these tag numbers in JSON, as far as known."""
    names = {number: columns.names[number] for number in numbers if columns.names.get(number)}
    return _HEAD.pack(ord("N"), 0, len(names), unix_us) + msgspec.json.encode(names)


def anchors_message(anchors: tuple[AnchorSite, ...], unix_us: int) -> bytes:
    """Message ``A``: positions of the anchors."""
    rows = [(a.id, round(1e3 * a.x_m), round(1e3 * a.y_m), round(1e2 * a.z_m), a.floor & 0xFF, 0) for a in anchors]
    return _HEAD.pack(ord("A"), 0, len(rows), unix_us) + np.array(rows, ANCHOR).tobytes()


def conditions_message(anchors: tuple[AnchorSite, ...], conditions: dict[str, str], unix_us: int) -> bytes:
    """Message ``H``: condition of each anchor, in the order of ``A``."""
    codes = bytes(CONDITIONS.get(conditions.get(str(anchor.id), ""), 0) for anchor in anchors)
    return _HEAD.pack(ord("H"), 0, len(codes), unix_us) + codes
