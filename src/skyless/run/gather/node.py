"""The gather of a site: takes fixes from the subjects of MQTT, and puts them into the stream of the site in batches."""

import asyncio
import contextlib
import secrets
import time
from typing import Final

import msgspec
from msgspec import Struct
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.aio.subscription import Subscription
from nats.errors import Error
from nats.js import JetStreamContext
from nats.js.errors import APIError

from skyless.core.version import installed_version
from skyless.run.fix_batch import Batch, encode_batch
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect, rarely
from skyless.run.gather.names import Names
from skyless.run.gather.packer import Packer
from skyless.run.gather.streams import make_streams
from skyless.run.mqtt.messages import SiteMessage, StatusMessage, WrongMessageError, read_message
from skyless.run.process import Log, together

PERIOD_S: Final = 0.1
SUMMARY_S: Final = 1.0
_RETRY_S: Final = 0.5
_LEAVE_S: Final = 2.0
_QUEUE: Final = "gather"


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
    batches: int
    """Batches that the stream has acknowledged."""
    waiting: int
    """Fixes that are not in an acknowledged batch yet."""
    drops: dict[str, int]
    """Messages and fixes that were dropped, by reason."""
    cuts: int
    """How often the connection was made again; the server ends that of a reader which is too slow."""


class Gather:
    """One gather of a site. Several of one site share the fixes: the server gives each message to one of them."""

    def __init__(self, address: NatsAddress, site: int | None, keep_bytes: int, log: Log) -> None:
        """``site`` None: the first site of which anything is heard."""
        self.site = site
        self._address, self._keep_bytes, self._log = address, keep_bytes, log
        self._say = rarely(log)
        self._host = subjects.own_host()
        self._packer = Packer(secrets.randbits(32))
        self._client: Client | None = None
        self._names: Names | None = None
        self._ready: Batch | None = None
        self._site_name = ""
        self._online: dict[str, set[str]] = {}
        self._batches = 0

    @property
    def summary(self) -> Summary:
        """What it has done since its start."""
        return Summary(
            unix_s=time.time(),
            host=self._host,
            version=installed_version(),
            site=self._site_name,
            simulated=self._packer.simulated,
            names=0 if self._names is None else len(self._names.numbers),
            online={kind: len(names) for kind, names in self._online.items()},
            fixes=self._packer.fixes,
            batches=self._batches,
            waiting=self._packer.waiting + (0 if self._ready is None else len(self._ready.records)),
            drops=dict(self._packer.drops),
            cuts=0 if self._client is None else self._client.stats["reconnects"],
        )

    async def run(self) -> None:
        """Gather until cancelled. What waits is sent before the end."""
        client = self._client = await connect(self._address, "skyless gather", self._say, self._packer.drops)
        stream = client.jetstream()
        try:
            site = self.site = await self._first_site(client) if self.site is None else self.site
            fixes = await client.subscribe(subjects.at(subjects.JSON_FIXES, site), _QUEUE, self._on_fix)
            await client.subscribe(subjects.at(subjects.STATUSES, site), cb=self._on_status)
            await client.subscribe(subjects.at(subjects.SITES, site), cb=self._on_site)
            try:
                await together(self._send(stream, site), self._summarise(client, site))
            finally:
                with contextlib.suppress(Error, TimeoutError):
                    await asyncio.wait_for(self._leave(fixes, stream, site), _LEAVE_S)
        finally:
            await client.close()

    async def _first_site(self, client: Client) -> int:
        heard = await client.subscribe("skyless.v1.*.>")
        while (site := subjects.site_in((await heard.next_msg(None)).subject)) is None:
            pass
        await heard.unsubscribe()
        self._log(f"gathers site {site}; --site-id names another")
        return site

    # Messages

    async def _on_fix(self, message: Msg) -> None:
        self._packer.add(subjects.tag_in(message.subject), message.data)

    async def _on_site(self, message: Msg) -> None:
        with contextlib.suppress(WrongMessageError):
            site = read_message(message.data, SiteMessage)
            self._site_name, self._packer.simulated = site.site.name, site.simulated

    async def _on_status(self, message: Msg) -> None:
        kind, name = message.subject.split(".")[3:5]
        online = False
        with contextlib.suppress(WrongMessageError):
            online = read_message(message.data, StatusMessage).online
        names = self._online.setdefault(kind, set())
        (names.add if online else names.discard)(name)

    # Sending

    async def _send(self, stream: JetStreamContext, site: int) -> None:
        """Send for ever. While the server cannot take fixes, they wait."""
        while True:
            try:
                await make_streams(stream, site, self._keep_bytes)
                names = Names(stream, site)
                await names.read()
                self._names = names
                while True:
                    await self._send_waiting(stream, site, names)
                    await asyncio.sleep(PERIOD_S)
            except Error as error:
                self._say(f"the fixes of site {site} wait: {error or type(error).__name__}")
                await asyncio.sleep(_RETRY_S)

    async def _send_waiting(self, stream: JetStreamContext, site: int, names: Names) -> None:
        """Send until nothing waits. A batch counts as sent when the stream has acknowledged it.

        A batch that the stream refuses, as on a full disk, has reached those who read now, and is not sent again.
        """
        subject = subjects.at(subjects.FIXES, site, self._host)
        while self._ready is not None or (tags := self._packer.next_tags()):
            if self._ready is None:
                await names.give(tags, self._host, time.time())  # first: every number in the stream has a name
                self._ready = self._packer.next_batch(names.numbers, names.issue, time.time())
            if self._ready is not None:
                try:
                    await stream.publish(subject, encode_batch(self._ready), headers={"Nats-Msg-Id": self._ready.id})
                    self._batches += 1
                except APIError as error:
                    self._packer.drops["not-stored"] += len(self._ready.records)
                    self._say(f"the stream of site {site} takes no fixes: {error.description}")
                self._ready = None

    async def _leave(self, fixes: Subscription, stream: JetStreamContext, site: int) -> None:
        """Take no more, and send what has come; another gather gets the rest at once."""
        await fixes.drain()  # type: ignore[no-untyped-call]
        if self._names is not None:
            await self._send_waiting(stream, site, self._names)

    async def _summarise(self, client: Client, site: int) -> None:
        while True:
            await client.publish(subjects.at(subjects.SUMMARY, site), msgspec.json.encode(self.summary))
            await asyncio.sleep(SUMMARY_S)
