"""Batches of fixes from NATS into the columns of each site, for a dashboard whose broker has a gather."""

import asyncio
import logging
import time
from typing import Final

from nats.aio.msg import Msg
from nats.errors import SlowConsumerError
from starlette.websockets import WebSocket

from skyless.page.columns import Columns
from skyless.page.live import LiveSite
from skyless.page.live2 import serve_page
from skyless.run.fix_batch import BadBatchError, decode_batch
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect

_PENDING_MESSAGES: Final = 2_000
_PENDING_BYTES: Final = 64 * 1024 * 1024
_MAX_SITES: Final = 64
_EMPTY: Final = Columns()
_log = logging.getLogger("skyless.page")


class Gathered:
    """The columns of all sites whose batches arrive."""

    def __init__(self, address: NatsAddress) -> None:
        self.dropped = 0
        """Batches that could not be read, or not in time."""
        self.pages: set[object] = set()
        self.ending = False
        self._address = address
        self._sites: dict[int | None, Columns] = {}

    def columns(self, site: int | None) -> Columns:
        """The columns of a site, empty before its first batch."""
        return self._sites.get(site, _EMPTY)

    async def serve(self, socket: WebSocket, live: LiveSite) -> None:
        """Serve one page of ``/live2`` until it closes."""
        await serve_page(socket, live, self)

    async def run(self) -> None:
        """Read until cancelled."""
        client = await connect(self._address, "skyless dashboard", self._on_error)
        try:
            await client.subscribe(
                subjects.at(subjects.FIXES, subjects.EVERY),
                cb=self._on_batch,
                pending_msgs_limit=_PENDING_MESSAGES,
                pending_bytes_limit=_PENDING_BYTES,
            )
            await asyncio.Event().wait()
        finally:
            await client.close()

    async def _on_batch(self, message: Msg) -> None:
        site = subjects.site_in(message.subject)
        try:
            if site is None or (site not in self._sites and len(self._sites) >= _MAX_SITES):
                raise BadBatchError("site")
            self._sites.setdefault(site, Columns()).update(decode_batch(message.data).records, time.monotonic())
        except BadBatchError:
            self.dropped += 1

    async def _on_error(self, error: Exception) -> None:
        if isinstance(error, SlowConsumerError):
            self.dropped += 1
        _log.warning("NATS server %s: %s", self._address, error or type(error).__name__)
