"""``skyless history run``: write a site's messages, a large site's batches, or recordings to a history."""

import asyncio
import platform
import re
import time
import zlib
from collections import Counter
from collections.abc import Callable, Coroutine
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct
from msgspec.structs import replace
from nats.errors import Error
from numpy.typing import NDArray

from skyless.core.errors import SkylessError
from skyless.run.fix_batch import MAX_RECORDS, BadBatchError, Batch, Records, decode_batch, records_of
from skyless.run.gather import subjects
from skyless.run.gather.streams import Names, follow
from skyless.run.gather.subjects import NatsAddress, connect, rarely
from skyless.run.history.layout import FIX_COLUMNS, current_events, current_files, day_of
from skyless.run.history.tables import REMEMBERED_KINDS, Event, EventLog, read_events, read_table, unix_ms
from skyless.run.history.writer import FILE_ROWS, Intake, Keep, Writer, tidy
from skyless.run.hub import LIST_S, sites_at
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Handler, Link, Subscriptions
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
from skyless.run.recordings.recording import McapRecording
from skyless.run.web import HISTORY as LIMITS
from skyless.run.zones import read_zones

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

# Fixes of a large site, from the stream that a gather fills instead of from MQTT.

_PERIOD_S: Final = 0.2
_STREAM_RETRY_S: Final = 2.0
_MAX_WAITING: Final = 100_000
"""While more rows than this wait for the disk, further ones are left in the stream."""
_NAMES_S: Final = 60.0
"""How much later than a batch its tags' names may come: a hub's streams catch up one after the other."""
_MAX_SENDERS: Final = 1000


class BatchTaker:
    """Passes the batches of a stream to a history, each once."""

    def __init__(self, names: Names, writer: Writer, log: Log) -> None:
        self._names, self._writer, self._say = names, writer, rarely(log)
        self._sequences: dict[int, int] = {}
        """Last sequence number of each run of a sender."""
        self._given_up = 0
        """Largest number whose name did not come in time."""

    async def take(self, message: "Msg") -> None:
        """Add the batch of a message to the history, unless it is already known.

        Waits for the disk, and for the names of its tags.
        """
        while self._writer.fixes.waiting > _MAX_WAITING:
            await asyncio.sleep(_PERIOD_S)
        place = message.metadata.sequence.stream
        if place <= self._writer.fixes.position:
            return
        try:
            batch = decode_batch(message.data)
        except BadBatchError:
            self._writer.drops["wrong-batch"] += 1
            return
        if not self._is_next(batch):
            return
        await self._read_names(batch.names_issue)
        now_s = time.time()
        self._writer.fixes.add(self._renumbered(batch.records, now_s), now_s, place)

    def _is_next(self, batch: Batch) -> bool:
        """Whether a batch is new. Batches missing since the sender's last one are counted as lost."""
        before = self._sequences.pop(batch.run, None)
        self._sequences[batch.run] = max(batch.sequence, before or 0)
        if len(self._sequences) > _MAX_SENDERS:
            del self._sequences[next(iter(self._sequences))]
        if before is not None and batch.sequence > before + 1:
            lost = batch.sequence - before - 1
            self._writer.drops["lost-batches"] += lost
            self._say(f"site {self._writer.site}: {lost} batches were dropped before they could be read")
        return before is None or batch.sequence > before

    async def _read_names(self, issue: int) -> None:
        deadline_s = time.monotonic() + _NAMES_S
        while self._names.issue < issue > self._given_up:
            try:
                await self._names.read()
            except Error as error:
                self._say(f"the names of site {self._writer.site} cannot be read: {error or type(error).__name__}")
                deadline_s = time.monotonic() + _NAMES_S
            if self._names.issue < issue:
                if time.monotonic() > deadline_s:
                    self._given_up = issue
                await asyncio.sleep(_PERIOD_S)

    def _renumbered(self, records: Records, now_s: float) -> Records:
        """Return the records to keep, with this history's numbers for their tags. The others are counted."""
        writer = self._writer
        given, rows = np.unique(records["tag"], return_inverse=True)
        tags = (self._names.tags.get(int(number)) for number in given)
        own = np.array([(tag and writer.tag_number(tag.name, now_s)) or 0 for tag in tags], np.uint32)[rows]
        in_time = (records["unix_us"] >= 1e6 * LIMITS.first_unix_s) & (records["unix_us"] <= 1e6 * LIMITS.last_unix_s)
        writer.drops["no-name"] += int(np.count_nonzero(own == 0))
        writer.drops["wrong-time"] += int(np.count_nonzero((own != 0) & ~in_time))
        kept: Records = records[(own != 0) & in_time].copy()
        kept["tag"] = own[(own != 0) & in_time]
        return kept


async def first_place(stream: "JetStreamContext", name: str, intake: Intake, say: Log) -> int:
    """Return the place in a stream up to which an intake is complete. Waits for the stream."""
    while True:
        try:
            last = (await stream.stream_info(name)).state.last_seq
            break
        except Error as error:
            say(f"waits for the stream {name}, which a gather or skyless hub apply makes: {error or 'no answer'}")
            await asyncio.sleep(_STREAM_RETRY_S)
    if intake.position > last:
        say(f"the stream {name} was deleted and made again; it is taken from its beginning")
        intake.position = 0
    return intake.position


async def take_batches(stream: "JetStreamContext", writer: Writer, say: Log) -> None:
    """Pass the batches of a site's stream to a history until cancelled, from where it last stopped.

    The place in the stream is stored together with the rows, so that each batch is taken once.
    """
    name, own = subjects.at(subjects.FIX_STREAM, writer.site), subjects.at(subjects.FIXES, writer.site)
    taker = BatchTaker(Names(stream, writer.site), writer, say)
    async for message in follow(stream, name, own, say, await first_place(stream, name, writer.fixes, say)):
        await taker.take(message)


async def take_stream(address: NatsAddress, writer: Writer, log: Log) -> None:
    """Run ``take_batches`` over a connection of its own."""
    say = rarely(log)
    client = await connect(address, "skyless history", say, writer.drops)
    try:
        await take_batches(client.jetstream(), writer, say)
    finally:
        await client.close()


_STORE_S: Final = 0.1
_SYNC_S: Final = 1.0
_FIRST_FILE_S: Final = 30.0
FILE_S: Final = 600.0
"""Longest interval between files. The first files come early, so that a new history can be queried; the interval then
doubles up to this.
"""
_RETRY_S: Final = 10.0  # after a file could not be written


class HistoryState(Struct, frozen=True):
    """Progress of a history."""

    seconds: float
    fixes: int
    events: int
    tags: int
    waiting: int
    """Rows not in a Parquet file yet."""
    lost: int
    """Rows dropped because the disk was too slow."""
    drops: dict[str, int]
    """Messages that were not kept, by reason."""
    trouble: str | None
    """Why there is no connection to the broker; None while there is one."""
    disk: str | None
    """Why nothing can be written; None while writing works."""


class SiteHistory:
    """Keeps the history of one site, whatever the source of its messages."""

    def __init__(self, writer: Writer, keep: Keep, log: Log) -> None:
        """Raises SkylessError if the past events cannot be read."""
        self.event_place = 0
        """Place in the source of the next event, if the source has places."""
        self._writer, self._keep, self._log = writer, keep, log
        self._trouble: dict[str, str] = {}
        self._try("files", writer.write)  # so that all past events are in files
        remembered = pc.field("kind").isin(REMEMBERED_KINDS)
        self._events = EventLog(read_events(current_events(writer.root, writer.site), remembered))
        self._fixes: list[tuple[int, FixMessage]] = []
        self._simulated = False
        self._started_s = time.monotonic()

    def attach(self, subscribe: Callable[[str, Handler, int], None], *, fixes: bool) -> None:
        """Call ``subscribe`` with the MQTT topic filters of the messages to keep. ``fixes`` includes single fixes."""
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
        """Keep what the sources deliver.

        At the end write files; what cannot be written waits in the journal for the next start.
        """
        try:
            await together(*sources, every(_STORE_S, self._store), self._work())
        finally:
            self._store()
            self._try("files", self._writer.close)

    def state(self) -> HistoryState:
        """Return the progress so far."""
        intakes = (self._writer.fixes, self._writer.events)
        return HistoryState(
            seconds=time.monotonic() - self._started_s,
            fixes=self._writer.fixes.taken,
            events=self._writer.events.taken,
            tags=len(self._writer.names.rows),
            waiting=self._writer.unwritten + sum(intake.waiting for intake in intakes),
            lost=sum(intake.lost for intake in intakes),
            drops=dict(self._writer.drops),
            trouble=None,
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
        """Sync the journal, write files and tidy up; runs in another thread."""
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
        """Run a disk operation, and log when errors begin and end."""
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
    """Keeps the history of one site on a broker until cancelled."""

    def __init__(
        self, writer: Writer, address: MqttAddress, keep: Keep, log: Log, nats: NatsAddress | None = None
    ) -> None:
        """``nats`` is the server of a site with a gather; the fixes then come from its stream.

        Raises SkylessError if the past events cannot be read.
        """
        host = re.sub(r"[^A-Za-z0-9_.-]", "-", platform.node())
        name = f"{host}-{zlib.crc32(str(writer.folder.resolve()).encode()):08x}"
        self.link = Link(address, name, site=writer.site, kind="history")
        self._writer, self._nats, self._log = writer, nats, log
        self._history = SiteHistory(writer, keep, log)
        self._history.attach(self.link.subscribe, fixes=nats is None)

    async def run(self) -> None:
        """Keep the history until cancelled."""
        sources = [keep(self.link, self._log)]
        if self._nats is not None:
            sources.append(take_stream(self._nats, self._writer, self._log))
        await self._history.run(*sources)

    def state(self) -> HistoryState:
        """Return the progress so far."""
        return replace(self._history.state(), trouble=self.link.trouble)


# The histories of a hub's sites, from the hub's streams.


class _Site:
    """Keeps the history of one site of a hub. Messages in its streams under another site's subjects are ignored."""

    def __init__(self, stream: "JetStreamContext", writer: Writer, keep: Keep, log: Log) -> None:
        self.writer, self.history = writer, SiteHistory(writer, keep, log)
        self._stream, self._say = stream, rarely(log)
        self._subscriptions = Subscriptions()
        self.history.attach(self._subscriptions.add, fixes=False)

    async def run(self) -> None:
        """Keep the site's history until cancelled."""
        fixes = take_batches(self._stream, self.writer, self._say)
        await self.history.run(self._take_state(), self._take_events(), fixes)

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
    """Keeps the history of all sites of a tenant at a hub, or of one site, until cancelled."""

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
        """Return the progress of all sites so far."""
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
        """Keep the histories. Raises SkylessError if a site's folder cannot be written."""
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
        """Follow the hub's list of sites, and keep each of them."""
        while True:
            try:
                for number in sorted(await sites_at(client)):
                    self._keep_site(number)
            except Error as error:
                self._say(f"the sites at the hub cannot be listed: {error or type(error).__name__}")
            await asyncio.sleep(LIST_S)


# Import of recordings, without rows that the history already has.

_CHUNK: Final = 100_000
_MARGIN: Final = timedelta(days=1)
"""How much earlier or later a message may have reached the running history."""


class Imported(Struct, frozen=True):
    """The result of importing a recording."""

    fixes: int
    known_fixes: int
    """Fixes that the history already had."""
    events: int
    drops: dict[str, int]


def import_recording(recording: McapRecording, writer: Writer, reach: Callable[[float], None]) -> Imported:
    """Add a recording's fixes, zone events and zones. ``reach`` is called with the Unix time in s reached so far.

    A tag has at most one fix per millisecond.

    Raises:
        SkylessError: the history cannot be read.
        OSError: the disk fails; what was written stays, and importing again adds the rest.
    """
    writer.write()  # rows that an earlier import or run has left in the journal
    writer.set_zones(() if recording.zones is None else recording.zones.zones)
    simulated = recording.site is not None and recording.site.simulated
    known, known_events = _known(recording, writer)
    log = EventLog()
    chunk: list[tuple[int, FixMessage]] = []
    counts = {"fixes": 0, "known_fixes": 0, "events": 0}
    day, arrived_s = None, 0.0

    def add() -> None:
        records = records_of(chunk, simulated=simulated)
        keys, rows = np.unique(_keys(records["tag"], unix_ms(records)), return_index=True)
        new = records[rows[~np.isin(keys, known)]]
        writer.fixes.add(new, arrived_s)
        writer.store()
        if writer.unwritten >= FILE_ROWS:
            writer.write()
        counts["fixes"] += len(new)
        counts["known_fixes"] += len(chunk) - len(new)
        chunk.clear()

    for found in recording.messages({"fix", "event"}):
        if isinstance(found.message, ZoneEvent):
            events = [event for event in log.of(found.message, found.time_s) if event not in known_events]
            writer.events.add(events, found.time_s)
            counts["events"] += len(events)
            continue
        of_day = datetime.fromtimestamp(found.time_s, UTC).date()
        if chunk and (of_day != day or len(chunk) >= _CHUNK):
            add()
            reach(found.time_s)
        day, arrived_s = of_day, found.time_s
        fix = cast("FixMessage", found.message)
        number = writer.number(fix, found.time_s)
        if number is not None:
            chunk.append((number, fix))
    add()
    writer.write()
    return Imported(**counts, drops=dict(writer.drops + recording.drops))


def _known(recording: McapRecording, writer: Writer) -> tuple[NDArray[np.int64], set[Event]]:
    """Return what the history already has for the time of a recording: the keys of fixes, and events."""
    summary = recording.summary()
    if summary.start_s is None or summary.end_s is None:
        return np.empty(0, np.int64), set()
    begin = datetime.fromtimestamp(summary.start_s, UTC) - _MARGIN
    end = datetime.fromtimestamp(summary.end_s, UTC) + _MARGIN
    span = (pc.field("t") >= begin) & (pc.field("t") <= end)
    files, events = (
        [file for file in current(writer.root, writer.site) if str(begin.date()) <= day_of(file) <= str(end.date())]
        for current in (current_files, current_events)
    )
    columns = {name: FIX_COLUMNS[name] for name in ("tag", "t")}
    tables = [read_table(file, columns, span) for file in files]
    keys = [_keys(table["tag"].to_numpy(), table["t"].cast(pa.int64()).to_numpy()) for table in tables]
    return np.concatenate([np.empty(0, np.int64), *keys]), set(read_events(events, span))


def _keys(tag: NDArray[Any], ms: NDArray[np.int64]) -> NDArray[np.int64]:
    """Combine tag and time into one number; times have 43 bits (``LIMITS.last_unix_s``), tags fewer than 20."""
    return (tag.astype(np.int64) << 43) | ms
