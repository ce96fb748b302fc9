"""The history of the sites of a hub: fixes, events and the rest from its streams."""

import asyncio
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Final

from skyless.core.errors import SkylessError
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect, rarely
from skyless.run.gather.names import Names
from skyless.run.gather.streams import follow
from skyless.run.history.program import HistoryState, SiteHistory
from skyless.run.history.retention import Keep
from skyless.run.history.stream_source import BatchTaker, first_place
from skyless.run.history.writer import Intake, Writer
from skyless.run.mqtt.link import Subscriptions
from skyless.run.process import Log

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

_QUEUE: Final = 200
"""Batches of a site that wait for its names or the disk; then all sites wait."""


class _Site:
    """One site that is kept."""

    def __init__(self, stream: "JetStreamContext", writer: Writer, keep: Keep, log: Log) -> None:
        self.writer, self.history = writer, SiteHistory(writer, keep, log)
        self._batches: asyncio.Queue[Msg] = asyncio.Queue(_QUEUE)
        self._subscriptions = Subscriptions()
        self.history.attach(self._subscriptions.add, fixes=False)
        self._taker = BatchTaker(Names(stream, writer.site, subjects.HUB_NAMES), writer, log)

    async def receive(self, name: str, message: "Msg") -> None:
        """Take a message of a stream, unless it is known."""
        if name == subjects.HUB_FIXES:
            await self._batches.put(message)
            return
        if name == subjects.HUB_EVENTS:
            place = message.metadata.sequence.stream
            if place <= self.writer.events.position:
                return
            self.history.event_place = place
        self._subscriptions.receive(subjects.topic_of(message.subject), message.data)

    async def run(self) -> None:
        """Keep it until cancelled."""
        await self.history.run(self._take())

    async def _take(self) -> None:
        while True:
            await self._taker.take(await self._batches.get())


class HubHistory:
    """Keeps the history of all sites of a tenant at a hub, or of one, until cancelled."""

    def __init__(self, folder: Path, address: NatsAddress, site: int | None, keep: Keep, log: Log) -> None:
        self._folder, self._address, self._keep, self._log = folder, address, keep, log
        self._only = subjects.EVERY if site is None else str(site)
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
                for folder in self._folder.glob(f"site={self._only}"):
                    if (number := folder.name.removeprefix("site=")).isdecimal():
                        self._site(int(number))
                for name in (subjects.HUB_STATE, subjects.HUB_EVENTS, subjects.HUB_FIXES):
                    self._tasks.create_task(self._take(name))
        except* SkylessError as errors:
            raise errors.exceptions[0] from None
        finally:
            await client.close()

    def _site(self, number: int) -> _Site:
        if number not in self._sites:
            site = self._sites[number] = _Site(self._stream, Writer(self._folder, number), self._keep, self._log)
            self._tasks.create_task(site.run())
        return self._sites[number]

    async def _take(self, name: str) -> None:
        """Give the messages of a stream to their sites."""

        def intakes() -> list[Intake]:
            writers = [site.writer for site in self._sites.values()]
            return [writer.fixes if name == subjects.HUB_FIXES else writer.events for writer in writers]

        is_state = name == subjects.HUB_STATE
        after = 0 if is_state else await first_place(self._stream, name, intakes, self._say)
        pattern = f"skyless.*.{self._only}.>"
        async for message in follow(self._stream, name, pattern, self._say, after, newest_of_each=is_state):
            if (number := subjects.site_in(message.subject)) is not None:
                await self._site(number).receive(name, message)
