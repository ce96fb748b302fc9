"""The history of the sites of a hub: fixes, events and the rest from its streams."""

import asyncio
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from nats.errors import Error

from skyless.core.errors import SkylessError
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect, rarely
from skyless.run.gather.streams import follow
from skyless.run.history.program import HistoryState, SiteHistory
from skyless.run.history.retention import Keep
from skyless.run.history.stream_source import first_place, take_batches
from skyless.run.history.writer import Writer
from skyless.run.hub.sites import LIST_S
from skyless.run.hub.streams import sites_at
from skyless.run.mqtt.link import Subscriptions
from skyless.run.process import Log

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext


class _Site:
    """One site that is kept, from its own streams: what they have under another site's subjects is not read."""

    def __init__(self, stream: "JetStreamContext", writer: Writer, keep: Keep, log: Log) -> None:
        self.writer, self.history = writer, SiteHistory(writer, keep, log)
        self._stream, self._say = stream, rarely(log)
        self._subscriptions = Subscriptions()
        self.history.attach(self._subscriptions.add, fixes=False)

    async def run(self) -> None:
        """Keep it until cancelled."""
        await self.history.run(self._take_state(), self._take_events(), self._take_fixes())

    async def _take_fixes(self) -> None:
        await take_batches(self._stream, self.writer, self._say)

    async def _take_state(self) -> None:
        async for message in self._follow(subjects.STATE_STREAM, is_state=True):
            self._receive(message)

    async def _take_events(self) -> None:
        name, intake = subjects.at(subjects.EVENT_STREAM, self.writer.site), self.writer.events
        after = await first_place(self._stream, name, intake, self._say)
        async for message in self._follow(subjects.EVENT_STREAM, after):
            self.history.event_place = message.metadata.sequence.stream
            self._receive(message)

    def _follow(self, pattern: str, after: int = 0, *, is_state: bool = False) -> "AsyncGenerator[Msg, None]":
        name, own = subjects.at(pattern, self.writer.site), f"skyless.v1.{self.writer.site}.>"
        return follow(self._stream, name, own, self._say, after, newest_of_each=is_state)

    def _receive(self, message: "Msg") -> None:
        self._subscriptions.receive(subjects.topic_of(message.subject), message.data)


class HubHistory:
    """Keeps the history of all sites of a tenant at a hub, or of one, until cancelled."""

    def __init__(self, folder: Path, address: NatsAddress, site: int | None, keep: Keep, log: Log) -> None:
        self._folder, self._address, self._keep, self._log = folder, address, keep, log
        self._only = site
        self._say = rarely(log)
        self._sites: dict[int, _Site] = {}
        self._drops: Counter[str] = Counter()
        self._begin_s = time.monotonic()
        self._client: Client | None = None
        self._stream: JetStreamContext
        self._tasks: asyncio.TaskGroup

    def state(self) -> HistoryState:
        """Progress so far, of all sites."""
        states = [site.history.state() for site in self._sites.values()]
        client = self._client
        is_connected = client is not None and (client.is_connected or client.is_closed)  # it is closed at the end
        return HistoryState(
            seconds=time.monotonic() - self._begin_s,
            fixes=sum(state.fixes for state in states),
            events=sum(state.events for state in states),
            tags=sum(state.tags for state in states),
            waiting=sum(state.waiting for state in states),
            lost=sum(state.lost for state in states),
            drops=dict(sum((Counter(state.drops) for state in states), self._drops)),
            trouble=None if is_connected else f"the hub {self._address} cannot be reached",
            disk=next((state.disk for state in states if state.disk), None),
        )

    async def run(self) -> None:
        """Keep it. Raises SkylessError: a folder of a site cannot be written."""
        client = self._client = await connect(self._address, "skyless history", self._say, self._drops)
        self._stream = client.jetstream()
        try:
            async with asyncio.TaskGroup() as self._tasks:
                for folder in self._folder.glob("site=*"):
                    if (number := folder.name.removeprefix("site=")).isdecimal():
                        self._keep_site(int(number))
                self._tasks.create_task(self._find_sites(client))
        except* SkylessError as errors:
            raise errors.exceptions[0] from None
        finally:
            await client.close()

    def _keep_site(self, number: int) -> None:
        if number not in self._sites and self._only in {None, number}:
            writer = Writer(self._folder, number, "hub ")
            site = self._sites[number] = _Site(self._stream, writer, self._keep, self._log)
            self._tasks.create_task(site.run())

    async def _find_sites(self, client: "Client") -> None:
        """Keep all sites that the hub has."""
        while True:
            try:
                for number in sorted(await sites_at(client)):
                    self._keep_site(number)
            except Error as error:
                self._say(f"the sites at the hub cannot be listed: {error or type(error).__name__}")
            await asyncio.sleep(LIST_S)
