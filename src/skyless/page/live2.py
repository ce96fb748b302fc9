"""The stream ``/live2`` of a large site: tags as points or counts, and the anchors, in binary (``docs/batches.md``)."""

import asyncio
import math
import struct
import time
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
import numpy as np
from msgspec import Meta, Struct
from starlette.websockets import WebSocket, WebSocketDisconnect

from skyless.core.site import AnchorSite
from skyless.page._state import UNHEARD_S
from skyless.page.columns import Array, Columns, Visible
from skyless.page.live import GONE_S, MAX_PAGES, LiveSite

if TYPE_CHECKING:
    from skyless.page.gathered import Gathered

PERIOD_S: Final = 0.1
MAX_POINTS: Final = 5_000
MAX_CELLS: Final = 16_384
MIN_CELL_PX: Final = 8
_STILL_S: Final = 1.0
"""Without a new fix, a page is sent the tags at this interval: their ages grow."""

_SEND_S: Final = 10.0
_TRY_LATER: Final = 1013
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
"""0 is unknown."""

_Edge = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Pixels = Annotated[int, Meta(ge=1, le=16_384)]


class View(Struct, frozen=True):
    """What a page shows."""

    view: tuple[_Edge, _Edge, _Edge, _Edge]
    """Least x and y, and largest x and y in m."""
    px: tuple[_Pixels, _Pixels]
    floor: int = 0
    named: Annotated[tuple[str, ...], Meta(max_length=200)] = ()

    @classmethod
    def read(cls, text: str) -> "View | None":
        """A page's view, or None for a text that is none."""
        try:
            view = msgspec.json.decode(text, type=cls)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return None
        x0, y0, x1, y1 = view.view
        return view if x0 < x1 and y0 < y1 else None


def tags_message(columns: Columns, view: View, now_s: float, unix_us: int) -> bytes:
    """``P``, or ``B`` where more than ``MAX_POINTS`` tags are visible."""
    found = columns.visible(view.view, now_s)
    x0, y0, x1, y1 = view.view
    x_share, y_share = (found.x_m - x0) / (x1 - x0), (found.y_m - y0) / (y1 - y0)
    if len(found.numbers) > MAX_POINTS:
        return _counts(x_share, y_share, view.px, unix_us)
    return _points(found, x_share, y_share, unix_us)


def _points(found: Visible, x_share: Array, y_share: Array, unix_us: int) -> bytes:
    points = np.empty(len(found.numbers), POINT)
    points["tag"], points["sigma_mm"], points["alert"] = found.numbers, found.sigma_mm, found.alert
    points["x"], points["y"] = np.rint(_MAX_U16 * x_share), np.rint(_MAX_U16 * y_share)
    points["freshness"] = np.clip(10.0 * found.age_s, 0.0, 10.0 * UNHEARD_S)
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


def anchors_message(anchors: tuple[AnchorSite, ...], unix_us: int) -> bytes:
    """``A``: where the anchors hang."""
    rows = [(a.id, round(1e3 * a.x_m), round(1e3 * a.y_m), round(1e2 * a.z_m), a.floor & 0xFF, 0) for a in anchors]
    return _HEAD.pack(ord("A"), 0, len(rows), unix_us) + np.array(rows, ANCHOR).tobytes()


def conditions_message(anchors: tuple[AnchorSite, ...], conditions: dict[str, str], unix_us: int) -> bytes:
    """``H``: the condition of each anchor, in the order of ``A``."""
    codes = bytes(CONDITIONS.get(conditions.get(str(anchor.id), ""), 0) for anchor in anchors)
    return _HEAD.pack(ord("H"), 0, len(codes), unix_us) + codes


class _Page:
    """What one page is to be sent: everything is made when it is sent, so that a slow page gets only the newest."""

    def __init__(self, live: LiveSite, gathered: "Gathered") -> None:
        self.view: View | None = None
        self.heard_s = time.monotonic()
        self._live, self._gathered = live, gathered
        self._shown: tuple[View | None, int] = (None, -1)
        self._shown_s = 0.0
        self._anchors: tuple[AnchorSite, ...] | None = None
        self._codes = b""

    def messages(self, now_s: float, unix_us: int) -> list[bytes]:
        """What is new to the page."""
        new = []
        anchors = () if self._live.site is None else self._live.site.site.anchors
        if anchors != self._anchors:
            self._anchors, self._codes = anchors, b""
            new.append(anchors_message(anchors, unix_us))
        health = conditions_message(anchors, self._live.state.conditions, unix_us)
        if anchors and health[_HEAD.size :] != self._codes:
            self._codes = health[_HEAD.size :]
            new.append(health)
        columns = self._gathered.columns(self._live.site_id)
        shown = self.view, columns.serial
        if self.view is not None and (shown != self._shown or now_s - self._shown_s >= _STILL_S):
            self._shown, self._shown_s = shown, now_s
            new.append(tags_message(columns, self.view, now_s, unix_us))
        return new

    async def read(self, socket: WebSocket) -> None:
        """Take what the page sends until it closes."""
        while True:
            text = await socket.receive_text()
            self.heard_s = time.monotonic()
            self.view = View.read(text) or self.view


async def serve_page(socket: WebSocket, live: LiveSite, gathered: "Gathered") -> None:
    """Serve one accepted page until it closes."""
    if len(gathered.pages) >= MAX_PAGES:
        await socket.close(_TRY_LATER, f"too many pages are open: {len(gathered.pages)}")
        return
    page = _Page(live, gathered)
    gathered.pages.add(page)
    reading = asyncio.create_task(page.read(socket))
    try:
        while not (reading.done() or gathered.ending or time.monotonic() - page.heard_s > GONE_S):
            begun_s = time.monotonic()
            async with asyncio.timeout(_SEND_S):
                for message in page.messages(begun_s, round(1e6 * time.time())):
                    await socket.send_bytes(message)
            await asyncio.wait((reading,), timeout=max(0.0, begun_s + PERIOD_S - time.monotonic()))
        await socket.close()
    except (WebSocketDisconnect, RuntimeError, TimeoutError):
        pass  # the page was closed meanwhile, or does not respond
    finally:
        gathered.pages.discard(page)
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)
