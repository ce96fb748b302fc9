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
from skyless.run.fix_batch import BadBatchError, Batch, decode_batch, encode_batch
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect, rarely
from skyless.run.gather.condition import SiteCondition
from skyless.run.gather.names import NEVER_WRITTEN, Names
from skyless.run.gather.packer import Packer
from skyless.run.gather.streams import make_streams, messages
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.connection import RefusedError, kept_messages, trouble_with
from skyless.run.process import Log, together

PERIOD_S: Final = 0.1
SUMMARY_S: Final = 1.0
_RETRY_S: Final = 0.5
_LEAVE_S: Final = 2.0
_QUEUE: Final = "gather"


class Summary(Struct, frozen=True, kw_only=True):
    """What a gather has done since its start, published once a second. A gather of an older version lacks some."""

    unix_s: float
    host: str
    version: str
    site: str
    """Name of the site; empty until it was published."""
    simulated: bool
    since: str = ""
    """When the site's streams were made, in ISO 8601: of two sites with one number, each has another."""
    condition: str = ""
    """A ``ConditionWord``; empty of an older version, which states none, and another word of a newer one perhaps."""
    reasons: list[str] = []
    """Why the condition is not good."""
    tags_heard: int = 0
    """Tags with a fix in the last ten seconds, in batches of this gather or of other programs."""
    names: int
    """Tags that have a number."""
    online: dict[str, int]
    """Programs that are online, by kind."""
    versions: dict[str, int] = {}
    """The same by their versions."""
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

    def __init__(
        self, address: NatsAddress, site: int | None, keep_bytes: int, log: Log, broker: MqttAddress | None = None
    ) -> None:
        """``site`` None: the first site of which anything is heard. ``broker`` is the same server's for MQTT."""
        self.site = site
        self._address, self._keep_bytes, self._log, self._broker = address, keep_bytes, log, broker
        self._say = rarely(log)
        self._host = subjects.own_host()
        self._packer = Packer(secrets.randbits(32))
        self._client: Client | None = None
        self._names: Names | None = None
        self._ready: Batch | None = None
        self._condition = SiteCondition(time.monotonic())
        self._since = ""
        self._batches = 0

    @property
    def summary(self) -> Summary:
        """What it has done since its start."""
        now_s, site = time.monotonic(), self._condition.site
        waiting = self._packer.waiting + (0 if self._ready is None else len(self._ready.records))
        condition, reasons = self._condition.reasons(self._packer.drops, waiting, now_s)
        return Summary(
            unix_s=time.time(),
            host=self._host,
            version=installed_version(),
            site="" if site is None else site.site.name,
            simulated=self._packer.simulated,
            since=self._since,
            condition=condition,
            reasons=reasons,
            tags_heard=self._condition.tags_heard(now_s),
            names=0 if self._names is None else len(self._names.numbers),
            online=self._condition.online(),
            versions=self._condition.versions(),
            fixes=self._packer.fixes,
            batches=self._batches,
            waiting=waiting,
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
            await client.subscribe(subjects.at(subjects.FIXES, site), cb=self._on_batch)
            for pattern in (subjects.STATUSES, subjects.SITES):
                await client.subscribe(subjects.at(pattern, site), cb=self._on_message)
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

    async def _on_batch(self, message: Msg) -> None:
        with contextlib.suppress(BadBatchError):
            self._condition.on_batch(decode_batch(message.data).records, time.monotonic())

    async def _on_message(self, message: Msg) -> None:
        levels = message.subject.split(".")
        self._condition.on_message(levels[3], levels[-2], message.data)
        if self._condition.site is not None:
            self._packer.simulated = self._condition.site.simulated

    # Sending

    async def _send(self, stream: JetStreamContext, site: int) -> None:
        """Send for ever. While the server cannot take fixes, they wait."""
        while True:
            try:
                await make_streams(stream, site, self._keep_bytes)
                self._since = str((await stream.stream_info(subjects.at(subjects.FIX_STREAM, site))).created)
                await self._copy_state(stream, site)
                names = Names(stream, site)
                await names.read()
                self._names = names
                while True:
                    await self._send_waiting(stream, site, names)
                    await asyncio.sleep(PERIOD_S)
            except Error as error:
                self._say(f"the fixes of site {site} wait: {error or type(error).__name__}")
                await asyncio.sleep(_RETRY_S)

    async def _copy_state(self, stream: JetStreamContext, site: int) -> None:
        """Read the state that the stream has. What the broker has kept from before the stream was made is put there."""
        state, known = subjects.at(subjects.STATE_STREAM, site), set[str]()
        async for message in messages(stream, state):
            known.add(message.subject)
            if message.subject.endswith((".site", ".status")):
                await self._on_message(message)
        if self._broker is None:
            return
        filters = [subjects.topic_of(subjects.at(one, site)).replace("*", "+") for one in subjects.STATE]
        try:
            kept = await kept_messages(self._broker, filters)
        except (OSError, RefusedError) as error:
            self._say(f"what the broker has kept is not copied: {trouble_with(self._broker, error)}")
            return
        for topic, payload in kept.items():
            if (subject := subjects.subject_of(topic)) not in known:
                with contextlib.suppress(APIError):  # it has come at this moment
                    await stream.publish(subject, payload, headers=dict(NEVER_WRITTEN))

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
