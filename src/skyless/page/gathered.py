"""Fixes of a broker with a gather, from NATS into columns, and their messages of ``/live2`` (``docs/batches.md``)."""

import asyncio
import contextlib
import logging
import math
import struct
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final

import msgspec
import numpy as np
from msgspec import Meta, Struct
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error
from numpy.typing import NDArray
from starlette.websockets import WebSocket

from skyless.core.site import AnchorSite
from skyless.page.connections import TRY_LATER, send, serve_socket
from skyless.page.live import LiveSite
from skyless.page.sites import Sites
from skyless.page.state import read_request
from skyless.run.fix_batch import ALERT_BITS, FIELDS, RECORD, BadBatchError, Records, decode_batch, fix_of
from skyless.run.gather import subjects
from skyless.run.gather.streams import name_of
from skyless.run.gather.subjects import NatsAddress, connect, rarely
from skyless.run.site_table import THRESHOLDS
from skyless.run.web import PAGE as LIMITS

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


PERIOD_S: Final = 0.1
_HAND_OVER_S: Final = 0.05

_HEARD_S: Final = 1.0
"""Interval at which a site gets the names of all tags in batches."""

_MAX_ASKED: Final = 200

_ASK_AGAIN_S: Final = 2.0
"""Interval at which a missing name is asked for again, as when a hub's stream lags after a cut."""

_EMPTY: Final = Columns()


class Gathered:
    """The columns of the sites shown, and the pages that view them."""

    def __init__(self, address: NatsAddress) -> None:
        self.drops: Counter[str] = Counter()
        """Batches that were dropped, by reason."""
        self.pages = 0
        self._address = address
        self._sites: dict[int | None, Columns] = {}
        self._say = rarely(logging.getLogger("skyless.page").warning)

    def columns(self, site: int | None) -> Columns:
        """The columns of a site, empty before its first batch."""
        return self._sites.get(site, _EMPTY)

    async def run(self, sites: Sites) -> None:
        """Read batches until cancelled, and pass fixes to the sites shown."""
        client = await connect(self._address, "skyless dashboard", self._say, self.drops, subjects.PAGE_INBOX)
        try:
            async with asyncio.TaskGroup() as tasks:
                served: dict[LiveSite, asyncio.Task[None]] = {}
                while True:
                    shown = sites.all
                    for live in served.keys() - set(shown):
                        served.pop(live).cancel()
                    for live in shown:
                        if live.table.batches_connected != client.is_connected:
                            now_s = time.monotonic()
                            live.table.set_connected(connected=client.is_connected, now_s=now_s, batches=True)
                        if live.number is not None and live not in served:
                            served[live] = tasks.create_task(self._read(client, live.number, live))
                    await asyncio.sleep(PERIOD_S)
        finally:
            await client.close()

    async def _read(self, client: Client, site: int, live: LiveSite) -> None:
        self._sites[site] = Columns()
        reading = await client.subscribe(subjects.at(subjects.FIXES, site), cb=self._on_batch)
        try:
            await self._hand_over(client, site, live)
        finally:
            del self._sites[site]
            with contextlib.suppress(Error):
                await reading.unsubscribe()

    async def _hand_over(self, client: Client, site: int, live: LiveSite) -> None:
        """Pass fixes from batches to a site, endlessly, for zones, alarms and lists."""
        columns, heard_s = self._sites[site], 0.0
        stream, names, numbers = client.jetstream(), columns.names, dict[str, int]()
        missing_s = dict[int, float]()
        while True:
            now_s = time.monotonic()
            if now_s - heard_s >= _HEARD_S:
                heard, heard_s = columns.heard_since(heard_s), now_s
                rare = live.table.hear([name for number in heard if (name := names.get(number))], now_s)
                columns.set_gone_after({numbers[name]: gone_s for name, gone_s in rare.items() if name in numbers})
            named = {name for page in live.pages for name in page.named}
            records, arrived_s = columns.pop_due(now_s, [numbers[name] for name in named if name in numbers])
            unknown = (number for number in records["tag"].tolist() if number not in names)
            asked = [number for number in unknown if missing_s.get(number, 0.0) <= now_s][:_MAX_ASKED]
            try:
                answers = await asyncio.gather(*(name_of(stream, site, number) for number in asked))
                for number, name in zip(asked, answers, strict=True):
                    if name:
                        names[number], numbers[name] = name, number
                    else:
                        missing_s[number] = now_s + _ASK_AGAIN_S
            except Error as error:
                self._say(f"the names of site {site} cannot be read: {error or type(error).__name__}")
            for record, at_s in zip(FIELDS.iter_unpack(records.tobytes()), arrived_s.tolist(), strict=True):
                if name := names.get(record[0]):
                    live.add_fix(fix_of(name, record), at_s, batched=True)
            # Sleep at least as long as the work took, so that batches are read in time.
            await asyncio.sleep(max(_HAND_OVER_S if len(records) < MAX_DUE else 0.0, time.monotonic() - now_s))

    async def _on_batch(self, message: Msg) -> None:
        site = subjects.site_in(message.subject)
        try:
            if site in self._sites:
                self._sites[site].update(decode_batch(message.data).records, time.monotonic())
        except BadBatchError as error:
            self.drops["wrong-batch"] += 1
            self._say(f"a batch under {message.subject} is not shown: {error}")

    async def serve(self, socket: WebSocket, live: LiveSite) -> None:
        """Serve one accepted page until it closes."""
        if self.pages >= LIMITS.pages:
            await socket.close(TRY_LATER, f"too many pages are open: {self.pages}")
            return
        page = _Page()

        async def send_news() -> None:
            while True:
                await send(socket, page.news(live, self.columns(live.number), time.monotonic()), "bytes")
                await asyncio.sleep(PERIOD_S)

        self.pages += 1
        try:
            await serve_socket(socket, send_news(), page.ask)
        finally:
            self.pages -= 1


class _Page:
    """One page. Messages are created when they are sent, so that a slow page gets only the newest."""

    def __init__(self) -> None:
        self._view: View | None = None
        self._named: tuple[int, ...] = ()
        self._shown: tuple[View, int, int] | None = None
        self._anchors: tuple[AnchorSite, ...] | None = None
        self._conditions: dict[str, str] | None = None

    def ask(self, text: str) -> None:
        """Process a page's request: another view, or names."""
        if (view := read_request(text, View)) is not None:
            self._view, self._named = view, view.named or self._named

    def news(self, live: LiveSite, columns: Columns, now_s: float) -> list[bytes]:
        """Messages with everything that is new to the page."""
        found, unix_us = [], round(1e6 * time.time())
        anchors, conditions = () if live.site is None else live.site.site.anchors, live.state.conditions
        if anchors != self._anchors:
            self._anchors, self._conditions = anchors, None
            found.append(anchors_message(anchors, unix_us))
        if conditions != self._conditions:
            self._conditions = conditions
            found.append(conditions_message(anchors, conditions, unix_us))
        if self._named:
            found.append(names_message(columns, self._named, unix_us))
            self._named = ()
        if self._view is not None:
            shown = self._view, columns.serial, int(now_s)  # each second even without new fixes, as ages grow
            if shown != self._shown:
                self._shown = shown
                found.append(tags_message(columns, self._view, now_s, unix_us))
        return found
