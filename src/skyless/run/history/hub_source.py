"""The history of the sites of a hub: fixes, events and the rest from its streams."""

import asyncio
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from nats.errors import Error

from skyless.core.errors import SkylessError
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect, rarely
from skyless.run.gather.names import Names
from skyless.run.gather.streams import follow
from skyless.run.history.program import HistoryState, SiteHistory
from skyless.run.history.retention import Keep
from skyless.run.history.stream_source import MAX_WAITING, PERIOD_S, BatchTaker
from skyless.run.history.writer import Intake, Writer
from skyless.run.mqtt.link import Subscriptions
from skyless.run.process import Log

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

_QUEUE: Final = 200
"""Batches of a site that wait for its names or the disk; then all sites wait."""
_RETRY_S: Final = 2.0


class _Site:
    """One site that is kept."""

    def __init__(self, stream: "JetStreamContext", writer: Writer, keep: Keep, log: Log) -> None:
        self.writer, self.history = writer, SiteHistory(writer, keep, log)
        self.batches: asyncio.Queue[Msg] = asyncio.Queue(_QUEUE)
        self._subscriptions = Subscriptions()
        self.history.attach(self._subscriptions.add, fixes=False)
        self._say = rarely(log)
        self._taker = BatchTaker(Names(stream, writer.site, subjects.HUB_NAMES), writer, self._say)

    def receive(self, message: "Msg", *, place: int = 0) -> None:
        """Take a message of the site's state, or an event with its place."""
        if place:
            if place <= self.writer.events.position:
                return
            self.history.event_place = place
        self._subscriptions.receive(subjects.topic_of(message.subject), message.data)

    async def run(self) -> None:
        """Keep it until cancelled."""
        await self.history.run(self._take())

    async def _take(self) -> None:
        while True:
            message = await self.batches.get()
            while self.writer.fixes.waiting > MAX_WAITING:
                await asyncio.sleep(PERIOD_S)
            while True:
                try:
                    await self._taker.take(message)
                    break
                except Error as error:
                    self._say(f"the names of site {self.writer.site} cannot be read: {error or type(error).__name__}")
                    await asyncio.sleep(_RETRY_S)


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

    def state(self) -> HistoryState:
        """Progress so far, of all sites."""
        states = [site.history.state() for site in self._sites.values()]
        is_connected = self._client is not None and self._client.is_connected
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
        try:
            async with asyncio.TaskGroup() as tasks:
                hub = _Hub(client.jetstream(), tasks)
                for folder in self._folder.glob(f"site={self._only}"):
                    if (number := folder.name.removeprefix("site=")).isdecimal():
                        self._site(hub, int(number))
                for part in (self._take_state, self._take_events, self._take_fixes):
                    tasks.create_task(part(hub))
        except* SkylessError as errors:
            raise errors.exceptions[0] from None
        finally:
            await client.close()

    def _site(self, hub: "_Hub", number: int) -> _Site:
        if number not in self._sites:
            site = self._sites[number] = _Site(hub.stream, Writer(self._folder, number), self._keep, self._log)
            hub.tasks.create_task(site.run())
        return self._sites[number]

    async def _take_state(self, hub: "_Hub") -> None:
        found = follow(hub.stream, subjects.HUB_STATE, f"skyless.v1.{self._only}.>", self._say, newest_of_each=True)
        async for message in found:
            if (number := subjects.site_in(message.subject)) is not None:
                self._site(hub, number).receive(message)

    async def _take_events(self, hub: "_Hub") -> None:
        after = await self._place(hub, subjects.HUB_EVENTS, lambda writer: writer.events)
        async for message in follow(hub.stream, subjects.HUB_EVENTS, f"skyless.v1.{self._only}.>", self._say, after):
            if (number := subjects.site_in(message.subject)) is not None:
                self._site(hub, number).receive(message, place=message.metadata.sequence.stream)

    async def _take_fixes(self, hub: "_Hub") -> None:
        after = await self._place(hub, subjects.HUB_FIXES, lambda writer: writer.fixes)
        pattern = subjects.at(subjects.FIXES, self._only)
        async for message in follow(hub.stream, subjects.HUB_FIXES, pattern, self._say, after):
            if (number := subjects.site_in(message.subject)) is not None:
                await self._site(hub, number).batches.put(message)

    async def _place(self, hub: "_Hub", name: str, intake_of: Callable[[Writer], Intake]) -> int:
        """The place in a stream of which all sites have what is before. Waits for the stream."""
        while True:
            try:
                last = (await hub.stream.stream_info(name)).state.last_seq
                break
            except Error as error:
                self._say(
                    f"the stream {name} of the hub {self._address} cannot be read: {error or type(error).__name__}"
                )
                await asyncio.sleep(_RETRY_S)
        intakes = [intake_of(site.writer) for site in self._sites.values()]
        for intake in intakes:
            if intake.position > last:
                self._say(f"the stream {name} of the hub was made anew; it is taken from its beginning")
                intake.position = 0
        return min((intake.position for intake in intakes), default=0)


class _Hub(NamedTuple):
    """What reads the streams."""

    stream: "JetStreamContext"
    tasks: asyncio.TaskGroup
