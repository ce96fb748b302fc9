"""What a site's programs publish, into its history."""

import asyncio
import platform
import re
import time
import zlib
from collections.abc import Callable, Coroutine
from datetime import UTC, datetime
from functools import partial
from typing import Any, Final

import pyarrow.compute as pc
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.errors import SkylessError
from skyless.run.fix_batch import MAX_RECORDS, records_of
from skyless.run.gather.address import NatsAddress
from skyless.run.history.events import REMEMBERED_KINDS, EventLog
from skyless.run.history.layout import current_events
from skyless.run.history.retention import Keep, tidy
from skyless.run.history.tables import read_events
from skyless.run.history.writer import FILE_ROWS, Writer
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Handler, Link
from skyless.run.mqtt.messages import (
    AlarmMessage,
    AssetsMessage,
    FixMessage,
    SiteMessage,
    StatusMessage,
    ZoneEvent,
    ZonesMessage,
)
from skyless.run.process import Log, every, keep, reader, together
from skyless.run.zones.zone_list import read_zones

_STORE_S: Final = 0.1
_SYNC_S: Final = 1.0
_FIRST_FILE_S: Final = 30.0
FILE_S: Final = 600.0
"""The first files come soon, so that a new history can be asked, later ones after twice the time, up to this."""
_RETRY_S: Final = 10.0  # after a file could not be written


class HistoryState(Struct, frozen=True):
    """Progress of a history."""

    seconds: float
    fixes: int
    events: int
    tags: int
    waiting: int
    """Rows that are in no Parquet file yet."""
    lost: int
    """Rows that the disk did not take in time."""
    drops: dict[str, int]
    """Messages that are not kept, by reason."""
    trouble: str | None
    """Why there is no broker; None while there is one."""
    disk: str | None
    """Why nothing can be written; None while it can."""


class SiteHistory:
    """Keeps the history of one site, from whatever gives its messages."""

    def __init__(self, writer: Writer, keep: Keep, log: Log) -> None:
        """Raises SkylessError: the events of the past cannot be read."""
        self.trouble: str | None = None
        """Why there are no messages."""
        self.event_place = 0
        """Place in its source of the event that is handled next, where the source has places."""
        self._writer, self._keep, self._log = writer, keep, log
        self._trouble: dict[str, str] = {}
        self._try("files", writer.write)  # so that all events of the past are in files
        remembered = pc.field("kind").isin(REMEMBERED_KINDS)
        self._events = EventLog(read_events(current_events(writer.root, writer.site), remembered))
        self._fixes: list[tuple[int, FixMessage]] = []
        self._simulated = False
        self._started_s = time.monotonic()

    def attach(self, subscribe: Callable[[str, Handler, int], None], *, fixes: bool) -> None:
        """Subscribe to what is kept, with topic filters of MQTT; ``fixes``: also to single fixes."""
        site = self._writer.site

        def on_wrong() -> None:
            self._writer.drops["wrong-message"] += 1

        def take(topic: str, kind: type[Struct], act: Callable[[Any], None], qos: int = 1) -> None:
            subscribe(topic, reader(kind, act, on_wrong), qos)

        take(topics.site_topic(site), SiteMessage, self._on_site)
        if fixes:
            take(topics.fix_topic(site, "+"), FixMessage, self._on_fix, 0)
        take(topics.zone_event_topic(site, "+"), ZoneEvent, self._on_event)
        take(topics.alarm_topic(site, "+", "+"), AlarmMessage, self._on_event)
        for kind in ("tag", "anchor"):
            take(topics.status_topic(site, kind, "+"), StatusMessage, self._on_event)
        take(topics.assets_topic(site), AssetsMessage, lambda message: self._writer.set_assets(message.assets))
        zones = reader(read_zones, lambda message: self._writer.set_zones(message.zones), on_wrong, ZonesMessage(()))
        subscribe(topics.zones_topic(site), zones, 1)

    async def run(self, *sources: Coroutine[Any, Any, None]) -> None:
        """Keep what the sources give. Finally it becomes files; what cannot waits in the journal for the next start."""
        try:
            await together(*sources, every(_STORE_S, self._store), self._work())
        finally:
            self._store()
            self._try("files", self._writer.close)

    def state(self) -> HistoryState:
        """Progress so far."""
        intakes = (self._writer.fixes, self._writer.events)
        return HistoryState(
            seconds=time.monotonic() - self._started_s,
            fixes=self._writer.fixes.taken,
            events=self._writer.events.taken,
            tags=len(self._writer.names.rows),
            waiting=self._writer.unwritten + sum(intake.waiting for intake in intakes),
            lost=sum(intake.lost for intake in intakes),
            drops=dict(self._writer.drops),
            trouble=self.trouble,
            disk=next(iter(self._trouble.values()), None),
        )

    def _on_site(self, message: SiteMessage) -> None:
        self._simulated = message.simulated

    def _on_fix(self, fix: FixMessage) -> None:
        number = self._writer.number(fix, time.time())
        if number is not None:
            self._fixes.append((number, fix))
        if len(self._fixes) >= MAX_RECORDS:
            self._add_fixes()

    def _add_fixes(self) -> None:
        if self._fixes:
            self._writer.fixes.add(records_of(self._fixes, simulated=self._simulated), time.time())
            self._fixes.clear()

    def _on_event(self, message: ZoneEvent | AlarmMessage | StatusMessage) -> None:
        now_s = time.time()
        self._writer.events.add(self._events.of(message, now_s), now_s, self.event_place)

    def _store(self) -> None:
        self._add_fixes()
        self._try("journal", self._writer.store)

    async def _work(self) -> None:
        """What another thread does: sync the journal, write files, tidy."""
        due_s, file_s, tidied = time.monotonic() + _FIRST_FILE_S, _FIRST_FILE_S, None
        while True:
            await asyncio.sleep(_SYNC_S)
            await asyncio.to_thread(self._try, "journal", self._writer.journal.sync)
            if time.monotonic() >= due_s or (self._writer.unwritten >= FILE_ROWS and "files" not in self._trouble):
                await asyncio.to_thread(self._try, "files", self._writer.write)
                file_s = min(2.0 * file_s, FILE_S)
                due_s = time.monotonic() + (_RETRY_S if "files" in self._trouble else file_s)
            today = datetime.fromtimestamp(time.time() - 2.0 * FILE_S, UTC).date()  # the day before is complete
            if today != tidied:
                tidied = today
                work = partial(tidy, self._writer.root, self._writer.site, self._keep, time.time())
                await asyncio.to_thread(self._try, "daily work", work)

    def _try(self, what: str, act: Callable[[], None]) -> None:
        """Do something with the disk; when its trouble begins and ends, a line says so."""
        try:
            act()
        except (OSError, SkylessError) as error:
            text = f"the history's {what} cannot be written: {getattr(error, 'strerror', None) or error}"
            if self._trouble.get(what) != text:
                self._log(text)
            self._trouble[what] = text
        else:
            if self._trouble.pop(what, None) is not None:
                self._log(f"the history's {what} can be written again; {self.state().lost} rows were lost so far")


class HistoryNode:
    """Keeps the history of one site of a broker until cancelled."""

    def __init__(
        self, writer: Writer, address: MqttAddress, keep: Keep, log: Log, nats: NatsAddress | None = None
    ) -> None:
        """``nats`` is the server of a site with a gather, whose stream then gives the fixes.

        Raises SkylessError: the events of the past cannot be read.
        """
        host = re.sub(r"[^A-Za-z0-9_.-]", "-", platform.node())
        name = f"{host}-{zlib.crc32(str(writer.folder.resolve()).encode()):08x}"
        self.link = Link(address, name, site=writer.site, kind="history")
        self._writer, self._nats, self._log = writer, nats, log
        self._history = SiteHistory(writer, keep, log)
        self._history.attach(self.link.subscribe, fixes=nats is None)

    async def run(self) -> None:
        """Keep it until cancelled."""
        sources = [keep(self.link, self._log)]
        if self._nats is not None:
            from skyless.run.history.stream_source import take_stream  # noqa: PLC0415 - only large sites have NATS

            sources.append(take_stream(self._nats, self._writer, self._log))
        await self._history.run(*sources)

    def state(self) -> HistoryState:
        """Progress so far."""
        return replace(self._history.state(), trouble=self.link.trouble)
