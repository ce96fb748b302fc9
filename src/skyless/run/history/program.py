"""``skyless history run``: write what is in a site's streams, or in recordings, to a history."""

import asyncio
import contextlib
import platform
import re
import secrets
import time
import zlib
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Coroutine
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from nats.errors import Error
from numpy.typing import NDArray

from skyless.core.errors import SkylessError
from skyless.run.broker import Broker, BrokerSettings, start_broker
from skyless.run.fix_batch import BadBatchError, Batch, Records, decode_batch, records_of
from skyless.run.gather import subjects
from skyless.run.gather.node import Gather
from skyless.run.gather.streams import Names, follow, make_streams
from skyless.run.gather.subjects import NatsAddress, connect, rarely
from skyless.run.history.layout import FIX_COLUMNS, Place, current_events, current_files, day_of, sites_in
from skyless.run.history.tables import REMEMBERED, Event, EventLog, read_columns, read_events, unix_ms
from skyless.run.history.writer import FILE_ROWS, Intake, Keep, Writer, tidy
from skyless.run.hub import LIST_S, sites_at
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import AlarmMessage, AssetsMessage, FixMessage, StatusMessage, ZoneEvent, ZonesMessage
from skyless.run.process import Log, keep, together
from skyless.run.recordings.recording import McapRecording
from skyless.run.site_feed import Channel, SiteFeed
from skyless.run.web import HISTORY as LIMITS

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

# The history of a site, from its streams.

_PERIOD_S: Final = 0.2
_NAMES_S: Final = 60.0
"""How much later than a batch its tags' names may come: a hub's streams catch up one after the other."""
_MAX_SENDERS: Final = 1000


async def _until_room(intake: Intake) -> None:
    """Wait until few enough rows wait for the disk; further ones are left in the stream."""
    while intake.waiting > LIMITS.waiting_rows:
        await asyncio.sleep(_PERIOD_S)


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
        fixes, number = self._writer.fixes, message.metadata.sequence.stream
        if number <= fixes.place.number:
            return
        await _until_room(fixes)
        try:
            batch = decode_batch(message.data)
        except BadBatchError:
            self._writer.drops["wrong-batch"] += 1
            return
        if not self._is_next(batch):
            return
        await self._read_names(batch.names_issue)
        now_s = time.time()
        fixes.place = replace(fixes.place, number=number)
        fixes.add(self._renumbered(batch.records, now_s), now_s)

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


_CHECK_S: Final = 2.0
_FIRST_FILE_S: Final = 30.0
FILE_S: Final = 600.0
"""Longest interval between files. The first files come early, so that a new history can be queried; the interval then
doubles up to this."""
_RETRY_S: Final = 5.0  # after a file could not be written


class HistoryState(Struct, frozen=True):
    """Progress of a history."""

    seconds: float
    fixes: int
    events: int
    tags: int
    waiting: int
    """Rows not in a Parquet file yet, which the stream has, too."""
    drops: dict[str, int]
    """Messages that were not kept, by reason."""
    trouble: str | None
    """Why there is no connection to the broker; None while there is one."""
    disk: str | None
    """Why nothing can be written; None while writing works."""


def take_messages(feed: SiteFeed, writer: Writer, log: EventLog, add: Callable[[list[Event], float], None]) -> None:
    """Keep the zones and names of assets that a feed states, and ``add`` its new events with their time of arrival."""

    def on_event(message: ZoneEvent | AlarmMessage | StatusMessage | None, channel: Channel) -> None:
        if message is not None and channel.who in ("", "tag", "anchor"):
            add(log.of(message, feed.now_s), feed.now_s)

    for kind in (ZoneEvent, AlarmMessage, StatusMessage):
        feed.on(kind, on_event)
    feed.on(AssetsMessage, lambda message, _: writer.set_assets(message.assets if message else ()))
    feed.on(ZonesMessage, lambda message, _: writer.set_zones(message.zones if message else ()))


class SiteHistory:
    """Keeps the history of one site from its streams at a server.

    The place in a stream is stored together with the rows, so that each message is taken once. Messages in the streams
    under another site's subjects are ignored.
    """

    def __init__(self, writer: Writer, keep: Keep, log: Log) -> None:
        """Raises SkylessError if the past events cannot be read."""
        self._writer, self._keep, self._log, self._say = writer, keep, log, rarely(log)
        self._trouble: dict[str, str] = {}
        log_of_events = EventLog(read_events(current_events(writer.root, writer.site), REMEMBERED))
        self._started_s = time.monotonic()
        self._feed = SiteFeed(time.time)
        take_messages(self._feed, writer, log_of_events, writer.events.add)

    async def run(self, stream: "JetStreamContext") -> None:
        """Keep the history until cancelled, then write what waits; what cannot be written is still in the streams."""
        self._stream = stream
        try:
            others = self._take_others(subjects.EVENT_STREAM, self._writer.events)
            await together(self._take_fixes(), others, self._take_others(subjects.STATE_STREAM), self._work())
        finally:
            self._try("files", self._writer.close)

    def state(self) -> HistoryState:
        """Return the progress so far."""
        writer = self._writer
        return HistoryState(
            seconds=time.monotonic() - self._started_s,
            fixes=writer.fixes.taken,
            events=writer.events.taken,
            tags=len(writer.names.rows),
            waiting=writer.waiting,
            drops=dict(+writer.drops + Counter({"wrong-message": self._feed.drops.total()})),
            trouble=None,
            disk=next(iter(self._trouble.values()), None),
        )

    # Streams

    async def _take_fixes(self) -> None:
        taker = BatchTaker(Names(self._stream, self._writer.site), self._writer, self._say)
        own = subjects.at(subjects.FIXES, self._writer.site)
        async for message in self._follow(subjects.FIX_STREAM, self._writer.fixes, own):
            await taker.take(message)

    async def _take_others(self, pattern: str, intake: Intake | None = None) -> None:
        async for message in self._follow(pattern, intake):
            await _until_room(self._writer.events)
            if intake is not None:
                intake.place = replace(intake.place, number=message.metadata.sequence.stream)
            self._feed.receive(subjects.topic_of(message.subject), message.data)

    async def _follow(
        self, pattern: str, intake: Intake | None = None, subject: str | None = None
    ) -> "AsyncGenerator[Msg, None]":
        """Yield the messages of a stream: those after the place of an intake, or else the newest of each subject."""
        site, say = self._writer.site, self._say
        name, own = subjects.at(pattern, site), subject or f"skyless.v1.{site}.>"
        after = 0 if intake is None else await self._place(name, intake)
        async for message in follow(self._stream, name, own, say, after, newest_of_each=intake is None):
            yield message

    async def _place(self, name: str, intake: Intake) -> int:
        """Return the number of the last message of a stream that an intake has. Waits for the stream."""
        while True:
            try:
                found = await self._stream.stream_info(name)
                break
            except Error as error:
                why = error or "no answer"
                self._say(f"waits for the stream {name}, which a gather or skyless hub apply makes: {why}")
                await asyncio.sleep(2.0)
        made = f"{self._writer.source} {found.created}"
        if intake.place.stream not in {"", made}:
            self._say(f"the stream {name} was deleted and made again; it is taken from its beginning")
        if intake.place.stream != made:
            intake.place = Place(made)
        elif found.state.last_seq < intake.place.number:
            self._say(f"the stream {name} has lost its last messages, which the history has; a power cut may do so")
            intake.place = Place(made, found.state.last_seq)
        lost = found.state.first_seq - 1 - intake.place.number
        if intake.place.number and lost > 0:
            self._writer.drops["lost-batches" if intake is self._writer.fixes else "lost-events"] += lost
            self._say(f"the stream {name} has dropped {lost} messages before they could be read")
        return intake.place.number

    # Files

    async def _work(self) -> None:
        """Write files and tidy up; runs in another thread."""
        due_s, file_s, tidied = time.monotonic() + _FIRST_FILE_S, _FIRST_FILE_S, None
        while True:
            await asyncio.sleep(_CHECK_S)
            if self._writer.waiting >= FILE_ROWS or time.monotonic() >= due_s or "files" in self._trouble:
                await asyncio.to_thread(self._try, "files", self._save)
                file_s = min(2.0 * file_s, FILE_S)
                due_s = time.monotonic() + file_s
            else:
                await asyncio.to_thread(self._try, "files", self._writer.check)
            today = datetime.fromtimestamp(time.time() - 2.0 * FILE_S, UTC).date()  # the day before is complete
            if today != tidied:
                tidied = today
                work = partial(tidy, self._writer.root, self._writer.site, self._keep, time.time())
                await asyncio.to_thread(self._try, "daily work", work)

    def _save(self) -> None:
        self._writer.check()
        self._writer.write()

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
                self._log(f"the history's {what} can be written again")


# The history of one site on a broker.

_HEARD_S: Final = 3.0
"""A gather says every second that it is there."""
_START_S: Final = 5.0
"""How long the nats-server of a history that was killed may take to end."""
_KEEP_BYTES: Final = 1_000_000_000
"""Limit of the fixes in a stream that is made here, which are mostly those that are in no file yet."""
_MAX_PASSING: Final = 10_000
_PASSED_ON: Final = (*(one for one in subjects.STATE if "floor_plan" not in one), *subjects.EVENTS)
_NO_SUBJECT: Final = re.compile(r"[\s*>]|\.\.|\.$")


class HistoryNode:
    """Keeps the history of one site on a broker until cancelled.

    Its rows come from the streams that a gather fills. Where no gather is heard, one runs here; for a broker without
    NATS, beside a nats-server of its own, to whose streams this passes on what the site publishes.
    """

    def __init__(
        self, folder: Path, site: int, address: MqttAddress, keep: Keep, log: Log, nats: NatsAddress | None = None
    ) -> None:
        """``nats`` is the broker's NATS address. Raises SkylessError if the history cannot be written or read."""
        host = re.sub(r"[^A-Za-z0-9_.-]", "-", platform.node())
        self.link = Link(address, f"{host}-{zlib.crc32(str(folder.resolve()).encode()):08x}", site=site, kind="history")
        self._writer = Writer(folder, site)
        self._history = SiteHistory(self._writer, keep, log)
        self._address, self._nats, self._log, self._say = address, nats, log, rarely(log)
        self._gather: Gather | None = None
        self._passing: deque[tuple[str, bytes]] = deque()

    def state(self) -> HistoryState:
        """Return the progress so far."""
        state = self._history.state()
        dropped = Counter(state.drops) + Counter({} if self._gather is None else self._gather.drops)
        return replace(state, drops=dict(dropped), trouble=self.link.trouble)

    async def run(self) -> None:
        """Keep the history until cancelled. Raises SkylessError if a nats-server of its own does not start."""
        site, work = self._writer.site, list[Coroutine[Any, Any, None]]()
        async with contextlib.AsyncExitStack() as until_end:
            nats = self._nats
            if nats is None:
                server = await until_end.enter_async_context(await _own_server(self._writer.folder / "stream"))
                nats = cast("NatsAddress", server.nats)
                work.append(self._restart(server))
            client = await connect(nats, "skyless history", self._say, self._writer.drops)
            until_end.push_async_callback(client.close)
            stream = client.jetstream()
            if self._nats is None or not await _is_gathered(client, site):
                broker = None if self._nats is None else self._address
                keep_bytes = await _bytes_of(stream, site)
                with contextlib.suppress(Error):  # the gather tries again
                    await make_streams(stream, site, keep_bytes)
                gather = self._gather = Gather(nats, site, keep_bytes, self._log, broker)
                work.append(gather.run())
            if self._nats is None:
                self._take_messages(gather)
                work.append(self._pass_on(stream))
            await together(*work, keep(self.link, self._log), self._history.run(stream))

    async def _restart(self, server: Broker) -> None:
        """Start a server again that has ended, or whose disk was full, as it would take nothing more."""
        was_full = False
        while True:
            await asyncio.sleep(_CHECK_S)
            is_full = self._history.state().disk is not None
            if server.has_ended or (was_full and not is_full):
                self._say("the history's own nats-server is started again")
                try:
                    await server.restart()
                except SkylessError as error:
                    self._say(str(error))
                    continue
            was_full = is_full

    def _take_messages(self, gather: Gather) -> None:
        """Subscribe to what ends in the streams."""

        def on_fix(topic: str, payload: bytes) -> None:
            gather.add_fix(topic.split("/")[4], payload)

        def on_other(topic: str, payload: bytes) -> None:
            gather.add_message(topic, payload)  # at once: fixes behind it are of that site
            subject = subjects.subject_of(topic)
            if _NO_SUBJECT.search(subject):
                self._writer.drops["wrong-topic"] += 1
            elif len(self._passing) >= _MAX_PASSING:
                self._writer.drops["late"] += 1
            else:
                self._passing.append((subject, payload))

        self.link.subscribe(subjects.filter_of(subjects.JSON_FIXES, self._writer.site), on_fix)
        for pattern in _PASSED_ON:
            self.link.subscribe(subjects.filter_of(pattern, self._writer.site), on_other, qos=1)

    async def _pass_on(self, stream: "JetStreamContext") -> None:
        """Publish messages to the streams, each until a stream has acknowledged it."""
        while True:
            while self._passing:
                try:
                    await stream.publish(*self._passing[0])
                except Error as error:
                    self._say(f"the messages of site {self._writer.site} wait: {error or type(error).__name__}")
                    break
                self._passing.popleft()
            await asyncio.sleep(_PERIOD_S)


async def _own_server(folder: Path) -> Broker:
    """Start a nats-server for this process alone. Raises SkylessError."""
    password, deadline_s = secrets.token_urlsafe(24), time.monotonic() + _START_S
    settings = BrokerSettings(
        data=folder, user="history", password=password, gathered_bytes=_KEEP_BYTES, is_private=True
    )
    while True:
        try:
            return await start_broker(settings)
        except SkylessError:
            if time.monotonic() > deadline_s:
                raise
        await asyncio.sleep(_PERIOD_S)


async def _is_gathered(client: "Client", site: int) -> bool:
    heard = await client.subscribe(subjects.at(subjects.SUMMARY, site))
    try:
        await heard.next_msg(_HEARD_S)
    except TimeoutError:
        return False
    finally:
        await heard.unsubscribe()
    return True


async def _bytes_of(stream: "JetStreamContext", site: int) -> int:
    """Return the limit of a site's stream of fixes, which is not to change if the stream is there."""
    try:
        return (await stream.stream_info(subjects.at(subjects.FIX_STREAM, site))).config.max_bytes or _KEEP_BYTES
    except Error:
        return _KEEP_BYTES


# The histories of a hub's sites.


class HubHistory:
    """Keeps the history of all sites of a tenant at a hub, or of one site, until cancelled."""

    def __init__(self, folder: Path, address: NatsAddress, site: int | None, keep: Keep, log: Log) -> None:
        self._folder, self._address, self._keep, self._log = folder, address, keep, log
        self._only = site
        self._say = rarely(log)
        self._sites: dict[int, SiteHistory] = {}
        self._drops: Counter[str] = Counter()
        self._begin_s = time.monotonic()
        self._client: Client | None = None
        self._tasks: asyncio.TaskGroup

    def state(self) -> HistoryState:
        """Return the progress of all sites so far."""
        states = [site.state() for site in self._sites.values()]
        client = self._client
        is_connected = client is not None and (client.is_connected or client.is_closed)  # it is closed at the end
        return HistoryState(
            seconds=time.monotonic() - self._begin_s,
            fixes=sum(state.fixes for state in states),
            events=sum(state.events for state in states),
            tags=sum(state.tags for state in states),
            waiting=sum(state.waiting for state in states),
            drops=dict(sum((Counter(state.drops) for state in states), self._drops)),
            trouble=None if is_connected else f"the hub {self._address} cannot be reached",
            disk=next((state.disk for state in states if state.disk), None),
        )

    async def run(self) -> None:
        """Keep the histories. Raises SkylessError if a site's folder cannot be written."""
        client = self._client = await connect(self._address, "skyless history", self._say, self._drops)
        try:
            async with asyncio.TaskGroup() as self._tasks:
                for number in sites_in(self._folder):
                    self._keep_site(number, client)
                self._tasks.create_task(self._find_sites(client))
        except* SkylessError as errors:
            raise errors.exceptions[0] from None
        finally:
            await client.close()

    def _keep_site(self, number: int, client: "Client") -> None:
        if number not in self._sites and self._only in {None, number}:
            site = self._sites[number] = SiteHistory(Writer(self._folder, number, "hub"), self._keep, self._log)
            self._tasks.create_task(site.run(client.jetstream()))

    async def _find_sites(self, client: "Client") -> None:
        """Follow the hub's list of sites, and keep each of them."""
        while True:
            try:
                for number in sorted(await sites_at(client)):
                    self._keep_site(number, client)
            except Error as error:
                self._say(f"the sites at the hub cannot be listed: {error or type(error).__name__}")
            await asyncio.sleep(LIST_S)


# Import of recordings, without rows that the history already has.

_CHUNK: Final = 100_000
_MARGIN: Final = timedelta(days=1)
"""How much earlier or later a message may have reached the running history."""
_SAME: Final = timedelta(seconds=5)
_NEVER: Final = datetime.min.replace(tzinfo=UTC)


class Imported(Struct, frozen=True):
    """The result of importing a recording."""

    fixes: int
    known_fixes: int
    """Fixes that the history already had."""
    events: int
    """Events that it did not have."""
    drops: dict[str, int]


def import_recording(recording: McapRecording, writer: Writer, reach: Callable[[float], None]) -> Imported:
    """Add a recording's rows, as from the running site. ``reach`` is called with the Unix time in s reached so far.

    A tag has at most one fix per millisecond.

    Raises:
        SkylessError: the history cannot be read.
        OSError: the disk fails; what was written stays, and importing again adds the rest.
    """
    simulated = recording.site is not None and recording.site.simulated
    known, is_known = _known(recording, writer)
    chunk: list[tuple[int, FixMessage]] = []
    counts = {"fixes": 0, "known_fixes": 0, "events": 0}
    day, arrived_s, feed = None, 0.0, SiteFeed()

    def add() -> None:
        records = records_of(chunk, simulated=simulated)
        keys, rows = np.unique(_keys(records["tag"], unix_ms(records)), return_index=True)
        new = records[rows[~np.isin(keys, known)]]
        writer.fixes.add(new, arrived_s)
        if writer.waiting >= FILE_ROWS:
            writer.write()
        counts["fixes"] += len(new)
        counts["known_fixes"] += len(chunk) - len(new)
        chunk.clear()

    def add_events(events: list[Event], now_s: float) -> None:
        new = [event for event in events if not is_known(event)]
        writer.events.add(new, now_s)
        counts["events"] += len(new)

    def on_fix(fix: FixMessage) -> None:
        nonlocal day, arrived_s
        of_day = datetime.fromtimestamp(feed.now_s, UTC).date()
        if chunk and (of_day != day or len(chunk) >= _CHUNK):
            add()
            reach(feed.now_s)
        day, arrived_s = of_day, feed.now_s
        number = writer.number(fix, feed.now_s)
        if number is not None:
            chunk.append((number, fix))

    feed.on(FixMessage, lambda fix, _: on_fix(fix))
    take_messages(feed, writer, EventLog(), add_events)
    feed.play(recording.messages({"fix", "event", "alarm", "status", "assets", "zones"}))
    add()
    writer.write()
    return Imported(**counts, drops=dict(writer.drops + recording.drops))


def _known(recording: McapRecording, writer: Writer) -> tuple[NDArray[np.int64], Callable[[Event], bool]]:
    """Return what the history already has for the time of a recording: keys of fixes, and whether it has an event."""
    summary = recording.summary()
    if summary.start_s is None or summary.end_s is None:
        return np.empty(0, np.int64), lambda _: False
    begin = datetime.fromtimestamp(summary.start_s, UTC) - _MARGIN
    end = datetime.fromtimestamp(summary.end_s, UTC) + _MARGIN
    span = f"t BETWEEN '{begin.isoformat()}' AND '{end.isoformat()}'"
    days = str(begin.date()), str(end.date())
    files = [file for file in current_files(writer.root, writer.site) if days[0] <= day_of(file) <= days[1]]
    columns = {name: FIX_COLUMNS[name] for name in ("tag", "t")}
    tables = [read_columns(file, columns, span) for file in files]
    keys = [_keys(table["tag"], table["t"]) for table in tables]
    wanted = f"{span} OR {REMEMBERED}"  # the broker keeps what is remembered, perhaps from long before
    events = set(read_events(current_events(writer.root, writer.site), wanted))
    ends = defaultdict[Event, list[datetime]](list)
    for event in events:
        if event.kind == "offline":
            ends[replace(event, t=_NEVER)].append(event.t)

    def is_known(event: Event) -> bool:
        """Whether the history has an event. That a node went offline has the time of arrival, which differs a bit."""
        return event in events or any(abs(event.t - t) < _SAME for t in ends.get(replace(event, t=_NEVER), ()))

    return np.concatenate([np.empty(0, np.int64), *keys]), is_known


def _keys(tag: NDArray[Any], ms: NDArray[np.int64]) -> NDArray[np.int64]:
    """Combine tag and time into one number; times have 43 bits (``LIMITS.last_unix_s``), tags fewer than 20."""
    return (tag.astype(np.int64) << 43) | ms
