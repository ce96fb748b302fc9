"""Batches of a broker with a gather, read from NATS into columns, and served to pages at ``/live2``."""

import asyncio
import contextlib
import logging
import time
from collections import Counter
from typing import Final

from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error
from starlette.websockets import WebSocket

from skyless.core.site import AnchorSite
from skyless.page.connections import TRY_LATER, send, serve_socket
from skyless.page.live import LiveSite
from skyless.page.live2 import MAX_DUE, Columns, View, anchors_message, conditions_message, names_message, tags_message
from skyless.page.sites import Sites
from skyless.page.state import read_request
from skyless.run.fix_batch import FIELDS, BadBatchError, decode_batch, fix_of
from skyless.run.gather import subjects
from skyless.run.gather.streams import name_of
from skyless.run.gather.subjects import NatsAddress, connect, rarely
from skyless.run.web import PAGE as LIMITS

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
        """Read the batches of a site until cancelled."""
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
                    live.on_batched_fix(fix_of(name, record), at_s)
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
