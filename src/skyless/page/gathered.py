"""Batches of a broker with a gather, read from NATS into columns, and the pages that see them by ``/live2``."""

import asyncio
import logging
import time
from collections import Counter
from typing import Final

from nats.aio.msg import Msg
from starlette.websockets import WebSocket

from skyless.core.site import AnchorSite
from skyless.page._state import read_request
from skyless.page.columns import Columns
from skyless.page.live import MAX_PAGES, LiveSite
from skyless.page.live2 import View, anchors_message, conditions_message, tags_message
from skyless.page.sockets import TRY_LATER, send, serve_socket
from skyless.run.fix_batch import BadBatchError, decode_batch
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect, rarely

PERIOD_S: Final = 0.1
_MAX_SITES: Final = 64
_EMPTY: Final = Columns()


class Gathered:
    """The columns of all sites whose batches arrive, and the pages that are shown them."""

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

    async def run(self) -> None:
        """Read until cancelled."""
        client = await connect(self._address, "skyless dashboard", self._say, self.drops)
        try:
            await client.subscribe(subjects.at(subjects.FIXES, subjects.EVERY), cb=self._on_batch)
            await asyncio.Event().wait()
        finally:
            await client.close()

    async def _on_batch(self, message: Msg) -> None:
        site = subjects.site_in(message.subject)
        try:
            if site not in self._sites:
                if site is None or len(self._sites) >= _MAX_SITES:
                    raise BadBatchError(f"it is of a wrong site, or of more than {_MAX_SITES}")
                self._sites[site] = Columns()
            self._sites[site].update(decode_batch(message.data).records, time.monotonic())
        except BadBatchError as error:
            self.drops["wrong-batch"] += 1
            self._say(f"a batch under {message.subject} is not shown: {error}")

    async def serve(self, socket: WebSocket, live: LiveSite) -> None:
        """Serve one accepted page until it closes."""
        if self.pages >= MAX_PAGES:
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
    """One page. Messages are made when they are sent, so that a slow page gets only the newest."""

    def __init__(self) -> None:
        self._view: View | None = None
        self._shown: tuple[View, int, int] | None = None
        self._anchors: tuple[AnchorSite, ...] | None = None
        self._conditions: dict[str, str] | None = None

    def ask(self, text: str) -> None:
        """The page has another view."""
        self._view = read_request(text, View) or self._view

    def news(self, live: LiveSite, columns: Columns, now_s: float) -> list[bytes]:
        """What is new to the page."""
        found, unix_us = [], round(1e6 * time.time())
        anchors, conditions = () if live.site is None else live.site.site.anchors, live.state.conditions
        if anchors != self._anchors:
            self._anchors, self._conditions = anchors, None
            found.append(anchors_message(anchors, unix_us))
        if conditions != self._conditions:
            self._conditions = conditions
            found.append(conditions_message(anchors, conditions, unix_us))
        if self._view is not None:
            shown = self._view, columns.serial, int(now_s)  # without a new fix each second: their ages grow
            if shown != self._shown:
                self._shown = shown
                found.append(tags_message(columns, self._view, now_s, unix_us))
        return found
