"""The gather of a site: takes fixes from the subjects of MQTT, and puts them into the stream of the site in batches."""

import asyncio
import contextlib
import secrets
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from itertools import islice
from typing import Final

import msgspec
from msgspec import Struct
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error, SlowConsumerError
from nats.js import JetStreamContext
from nats.js.errors import APIError

from skyless.core.version import installed_version
from skyless.run.fix_batch import BadBatchError, decode_batch
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect
from skyless.run.gather.packer import NamesTable, Packer, ReadyBatch
from skyless.run.gather.streams import LostLockError, NumberTakenError, lock_site, make_streams, read_names, store_name
from skyless.run.process import Log, together

PERIOD_S: Final = 0.1
SUMMARY_S: Final = 1.0
_RETRY_S: Final = 0.5
_LEAVE_S: Final = 2.0
_SAME_TROUBLE_S: Final = 30.0
_NAMES_AT_ONCE: Final = 256
_PENDING_MESSAGES: Final = 100_000
_PENDING_BYTES: Final = 128 * 1024 * 1024


class _SiteName(Struct):
    """The part of a site that is read here."""

    name: str


class _SiteMessage(Struct):
    """The part of ``SiteMessage`` that is read here."""

    site: _SiteName
    simulated: bool


class _Status(Struct):
    """The part of ``StatusMessage`` that is read here."""

    online: bool


class Summary(Struct, frozen=True):
    """What a gather has done since its start, published once a second."""

    unix_s: float
    host: str
    version: str
    site: str
    """Name of the site; empty until it was published."""
    simulated: bool
    names: int
    """Tags that have a number."""
    online: dict[str, int]
    """Programs that are online, by kind."""
    fixes: int
    """Fixes taken from JSON."""
    packed: int
    """Fixes that came packed from other programs."""
    batches: int
    """Batches that the stream has acknowledged."""
    waiting: int
    """Fixes that are not in an acknowledged batch yet."""
    drops: dict[str, int]
    """Messages and fixes that were dropped, by reason."""
    cuts: int
    """How often the connection was lost; the server ends that of a reader which is too slow."""


class Gather:
    """The gather of one site. A second one of the same site waits until the first has ended."""

    def __init__(self, address: NatsAddress, site: int | None, keep_bytes: int, log: Log) -> None:
        """``site`` None: the first site of which anything is heard."""
        self.site, self.cuts = site, 0
        self._address, self._keep_bytes, self._log = address, keep_bytes, log
        self._host = subjects.own_host()
        self._packer = Packer(secrets.randbits(32), self._host)
        self._names = NamesTable({})
        self._ready: ReadyBatch | None = None
        self._site_name = ""
        self._online: dict[str, set[str]] = {}
        self._packed = self._batches = 0
        self._drops: Counter[str] = Counter()
        self._logged = ("", 0.0)

    @property
    def summary(self) -> Summary:
        """What it has done since its start."""
        waiting = self._packer.waiting + (self._ready.fixes if self._ready is not None else 0)
        return Summary(
            unix_s=time.time(),
            host=self._host,
            version=installed_version(),
            site=self._site_name,
            simulated=self._packer.simulated,
            names=len(self._names.numbers),
            online={kind: len(names) for kind, names in self._online.items()},
            fixes=self._packer.fixes,
            packed=self._packed,
            batches=self._batches,
            waiting=waiting,
            drops=dict(self._drops + self._packer.drops),
            cuts=self.cuts,
        )

    async def run(self) -> None:
        """Gather until cancelled. What waits is sent before the end."""
        client = await connect(self._address, "skyless gather", self._on_error, self._on_cut)
        stream = client.jetstream()
        try:
            if self.site is None:
                self.site = await self._first_site(client)
            while True:
                try:
                    await self._serve(client, stream, self.site)
                except (LostLockError, NumberTakenError, Error) as error:
                    self._say(f"site {self.site} is not gathered for a moment: {error or type(error).__name__}")
                    await asyncio.sleep(_RETRY_S)
        finally:
            await client.close()

    async def _first_site(self, client: Client) -> int:
        found: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        async def on_message(message: Msg) -> None:
            site = subjects.site_in(message.subject)
            if site is not None and not found.done():
                found.set_result(site)

        every = (subjects.JSON_FIXES, subjects.STATUSES, subjects.SITES)
        heard = [await client.subscribe(subjects.at(one, subjects.EVERY), cb=on_message) for one in every]
        site = await found
        for one in heard:
            await one.unsubscribe()
        self._log(f"gathers site {site}; --site-id names another")
        return site

    async def _serve(self, client: Client, stream: JetStreamContext, site: int) -> None:
        """Gather for as long as no other program does."""
        await make_streams(stream, site, self._keep_bytes)
        lock = await lock_site(stream, site, self._log)
        self._names = NamesTable(await read_names(stream, site))
        handlers: dict[str, Callable[[Msg], Awaitable[None]]] = {
            subjects.JSON_FIXES: self._on_fix,
            subjects.STATUSES: self._on_status,
            subjects.SITES: self._on_site,
            subjects.FIXES: self._relay(client, site),
        }
        heard = [
            await client.subscribe(
                subjects.at(subject, site),
                cb=handler,
                pending_msgs_limit=_PENDING_MESSAGES,
                pending_bytes_limit=_PENDING_BYTES,
            )
            for subject, handler in handlers.items()
        ]
        try:
            await together(lock.hold(), self._send(stream, site), self._summarise(client, site))
        finally:
            for one in heard:
                with contextlib.suppress(Error):
                    await one.unsubscribe()
            for last in (self._send_waiting(stream, site), lock.release()):
                with contextlib.suppress(Error, TimeoutError, NumberTakenError):
                    await asyncio.wait_for(last, _LEAVE_S)

    # Messages

    async def _on_fix(self, message: Msg) -> None:
        self._packer.add(subjects.tag_in(message.subject), message.data)

    async def _on_site(self, message: Msg) -> None:
        with contextlib.suppress(msgspec.MsgspecError):
            site = msgspec.json.decode(message.data, type=_SiteMessage)
            self._site_name, self._packer.simulated = site.site.name, site.simulated

    async def _on_status(self, message: Msg) -> None:
        kind, name = message.subject.split(".")[3:5]
        online = False
        with contextlib.suppress(msgspec.MsgspecError):
            online = msgspec.json.decode(message.data, type=_Status).online
        names = self._online.setdefault(kind, set())
        (names.add if online else names.discard)(name)

    def _relay(self, client: Client, site: int) -> Callable[[Msg], Awaitable[None]]:
        own, live = subjects.at(subjects.FIXES, site, self._host), subjects.at(subjects.LIVE, site)

        async def relay(message: Msg) -> None:
            try:
                records = decode_batch(message.data).records
            except BadBatchError:
                self._drops["wrong-batch"] += 1
                return
            if message.subject != own:
                self._packed += len(records)
            await client.publish(live, message.data)

        return relay

    # Sending

    async def _send(self, stream: JetStreamContext, site: int) -> None:
        while True:
            await asyncio.sleep(PERIOD_S)
            await self._send_waiting(stream, site)

    async def _send_waiting(self, stream: JetStreamContext, site: int) -> None:
        """Send until nothing waits. A batch counts as sent when the stream has acknowledged it.

        A batch that the stream refuses, as on a full disk, has reached those who read now, and is not sent again.
        """
        while True:
            if self._ready is None:
                while self._packer.give_numbers(self._names, time.time()):
                    await self._store_names(stream, site)  # first, so that every number in the stream has a name
                self._ready = self._packer.next_batch(self._names, time.time())
            if self._ready is None and not self._packer.waiting:
                return
            if self._ready is not None:
                subject, header = subjects.at(subjects.FIXES, site, self._host), {"Nats-Msg-Id": self._ready.id}
                try:
                    await stream.publish(subject, self._ready.data, headers=header)
                    self._batches += 1
                except APIError as error:
                    self._drops["not-stored"] += self._ready.fixes
                    self._say(f"the stream of site {site} takes no fixes: {error.description}")
                self._ready = None

    async def _store_names(self, stream: JetStreamContext, site: int) -> None:
        while some := list(islice(self._names.unsaved.items(), _NAMES_AT_ONCE)):
            await asyncio.gather(*(store_name(stream, site, number, tag) for number, tag in some))
            for number, _ in some:
                del self._names.unsaved[number]

    async def _summarise(self, client: Client, site: int) -> None:
        while True:
            await client.publish(subjects.at(subjects.SUMMARY, site), msgspec.json.encode(self.summary))
            await asyncio.sleep(SUMMARY_S)

    # Trouble

    async def _on_error(self, error: Exception) -> None:
        if isinstance(error, SlowConsumerError):
            self._drops["unread"] += 1
        self._say(f"NATS server {self._address}: {error or type(error).__name__}")

    async def _on_cut(self) -> None:
        self.cuts += 1

    def _say(self, trouble: str) -> None:
        """Log it once, and again every half minute while it lasts."""
        now_s = time.monotonic()
        if trouble != self._logged[0] or now_s > self._logged[1] + _SAME_TROUBLE_S:
            self._logged = (trouble, now_s)
            self._log(trouble)
