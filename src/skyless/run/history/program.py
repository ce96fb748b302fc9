"""``skyless history run``: what a site's programs publish, into its history."""

import asyncio
import math
import platform
import re
import time
import zlib
from collections.abc import Callable
from datetime import UTC, date, datetime
from typing import Any, Final

from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.run.fix_batch import MAX_RECORDS, records_of
from skyless.run.history.events import EventLog
from skyless.run.history.retention import GRACE_S, Keep, remove_replaced, tidy
from skyless.run.history.sink import FILE_S, Event
from skyless.run.history.writer import Intake, Writer
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import AlarmMessage, FixMessage, SiteMessage, StatusMessage, ZoneEvent
from skyless.run.process import Log, every, keep, reader, together
from skyless.run.zones.zone_list import BadZonesError, read_zones

_STORE_S: Final = 0.1
_SYNC_S: Final = 1.0
_RETRY_S: Final = 10.0  # while the disk is full, or after a file could not be written
_LATE_S: Final = 2 * FILE_S  # after midnight, the files of the day before are complete


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


class HistoryNode:
    """Keeps the history of one site until cancelled."""

    def __init__(self, writer: Writer, address: MqttAddress, keep: Keep, log: Log) -> None:
        """Raises SkylessError: the events of the past cannot be read."""
        host = re.sub(r"[^A-Za-z0-9_.-]", "-", platform.node())
        name = f"{host}-{zlib.crc32(str(writer.folder.resolve()).encode()):08x}"
        self.link = Link(address, name, site=writer.site, kind="history")
        self._writer, self._keep, self._log = writer, keep, log
        self._events = EventLog(writer.past_events())
        self._fixes: list[tuple[int, FixMessage]] = []
        self._taken = {"fixes": 0, "events": 0}
        self._simulated = False
        self._trouble: dict[str, str] = {}
        self._tidied: date | None = None
        self._started_s = time.monotonic()
        self._subscribe(topics.site_topic, SiteMessage, self._on_site)
        self._subscribe(topics.fix_topic, FixMessage, self._on_fix, "+", qos=0)
        self._subscribe(topics.zone_event_topic, ZoneEvent, self._on_event, "+")
        self._subscribe(topics.alarm_topic, AlarmMessage, self._on_event, "+", "+")
        for kind in ("tag", "anchor"):
            self._subscribe(topics.status_topic, StatusMessage, self._on_event, kind, "+")
        self.link.subscribe(topics.zones_topic(writer.site), self._on_zones, qos=1)

    async def run(self) -> None:
        """Keep it. Finally everything becomes files; what cannot waits in the journal for the next start."""
        try:
            await together(keep(self.link, self._log), every(_STORE_S, self._store), self._work())
        finally:
            self._store()
            self._try("files", self._writer.close)

    def state(self) -> HistoryState:
        """Progress so far."""
        intakes = (self._writer.fixes, self._writer.events)
        return HistoryState(
            seconds=time.monotonic() - self._started_s,
            **self._taken,
            tags=len(self._writer.names.rows),
            waiting=sum(intake.sink.waiting + intake.waiting for intake in intakes),
            lost=sum(intake.dropped for intake in intakes),
            drops=dict(self._writer.drops),
            trouble=self.link.trouble,
            disk=next(iter(self._trouble.values()), None),
        )

    def _subscribe(
        self, topic: Callable[..., str], kind: type[Struct], act: Callable[[Any], None], *names: str, qos: int = 1
    ) -> None:
        handler = reader(kind, act, lambda: self._writer.drops.update(["wrong-message"]))
        self.link.subscribe(topic(self._writer.site, *names), handler, qos=qos)

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
            self._taken["fixes"] += len(self._fixes)
            self._writer.fixes.add(records_of(self._fixes, simulated=self._simulated), time.time())
            self._fixes.clear()

    def _on_event(self, message: ZoneEvent | AlarmMessage | StatusMessage) -> None:
        now_s = time.time()
        events: list[Event]
        if isinstance(message, ZoneEvent):
            events = self._events.of_zone(message)
        elif isinstance(message, AlarmMessage):
            events = self._events.of_alarm(message)
        else:
            events = self._events.of_status(message, now_s)
        if events:
            self._taken["events"] += len(events)
            self._writer.events.add(tuple(events), now_s)

    def _on_zones(self, _topic: str, payload: bytes) -> None:
        try:
            self._writer.set_zones(read_zones(payload).zones if payload else ())
        except BadZonesError:
            self._writer.drops["wrong-message"] += 1

    def _store(self) -> None:
        self._add_fixes()
        self._try("journal", self._writer.store)

    async def _work(self) -> None:
        """What another thread does: sync the journal, write files, tidy."""
        retry_s, replaced_s = 0.0, math.inf
        intakes: dict[str, Intake[Any]] = {"fixes": self._writer.fixes, "events": self._writer.events}
        while True:
            await asyncio.sleep(_SYNC_S)
            now_s = time.time()
            for kind, intake in intakes.items():
                await asyncio.to_thread(self._try, f"journal of {kind}", intake.sync)
                files = f"files of {kind}"
                is_full = "journal" in self._trouble and intake.sink.waiting > 0  # files are smaller than the journal
                if time.monotonic() < retry_s or not (is_full or intake.sink.is_due(now_s)):
                    continue
                is_done = self._try(files, intake.begin) and await asyncio.to_thread(self._try, files, intake.write)
                if is_full or not is_done:
                    retry_s = time.monotonic() + _RETRY_S
            today = datetime.fromtimestamp(now_s - _LATE_S, UTC).date()
            if today != self._tidied:
                self._tidied, replaced_s = today, time.monotonic()
                await asyncio.to_thread(self._try, "daily work", self._tidy)
            elif time.monotonic() > replaced_s + 2.0 * GRACE_S:
                replaced_s = math.inf
                await asyncio.to_thread(self._try, "daily work", self._remove_replaced)

    def _tidy(self) -> None:
        tidy(self._writer.root, self._writer.site, self._keep, time.time())

    def _remove_replaced(self) -> None:
        remove_replaced(self._writer.root, self._writer.site, time.time())

    def _try(self, what: str, act: Callable[[], None]) -> bool:
        """Do something with the disk; when its trouble begins and ends, a line says so."""
        try:
            act()
        except (OSError, SkylessError) as error:
            text = f"the history's {what} cannot be written: {getattr(error, 'strerror', None) or error}"
            if self._trouble.get(what) != text:
                self._log(text)
            self._trouble[what] = text
            return False
        if self._trouble.pop(what, None) is not None:
            self._log(f"the history's {what} can be written again; {self.state().lost} rows were lost so far")
        return True
