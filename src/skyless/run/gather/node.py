"""The gather of a site: takes single fixes from MQTT's subjects, and publishes them to the site's stream in batches."""

import asyncio
import contextlib
import secrets
import time
from collections import Counter, deque
from collections.abc import Mapping
from itertools import count
from typing import Final, Literal

import msgspec
from msgspec import Struct
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.aio.subscription import Subscription
from nats.errors import Error
from nats.js import JetStreamContext
from nats.js.errors import APIError

from skyless.core.version import installed_version
from skyless.run.condition.evidence import Evidence
from skyless.run.condition.monitor import ConditionMonitor
from skyless.run.fix_batch import (
    ALERT_BITS,
    ALERTS,
    MAX_RECORDS,
    BadBatchError,
    Batch,
    Records,
    decode_batch,
    encode_batch,
    records_of,
)
from skyless.run.gather import subjects
from skyless.run.gather.streams import NEVER_WRITTEN, Names, TagName, check_cancelled, make_streams, messages
from skyless.run.gather.subjects import NatsAddress, connect, rarely
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.connection import RefusedError, kept_messages, trouble_with
from skyless.run.mqtt.messages import AnchorHealth, EtherHealth, FixMessage, SiteMessage, StatusMessage, TagHealth
from skyless.run.process import Log, together
from skyless.run.site_feed import Channel, SiteFeed
from skyless.run.site_table import Health, SiteTable

MAX_WAITING: Final = 100_000
"""Largest number of fixes waiting for the stream; the oldest are dropped and counted beyond it."""


class Packer:
    """Packs single fixes into batches. No I/O: times are passed in. ``run`` is the random number of this start."""

    def __init__(self, run: int) -> None:
        self.fixes, self.simulated = 0, False
        self.drops: Counter[str] = Counter()
        self._run, self._sequences = run, count(1)
        self._waiting: deque[FixMessage] = deque(maxlen=MAX_WAITING)
        self._next: list[FixMessage] = []
        self._decoder = msgspec.json.Decoder(FixMessage)

    @property
    def waiting(self) -> int:
        """Number of fixes not in a batch yet."""
        return len(self._waiting) + len(self._next)

    def add(self, name: str, payload: bytes) -> None:
        """Add a ``FixMessage`` in JSON received under a tag's name. Unusable ones are counted in ``drops``."""
        try:
            fix = self._decoder.decode(payload)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            self.drops["wrong"] += 1
            return
        if fix.tag != name:
            self.drops["wrong"] += 1
            return
        if len(self._waiting) == MAX_WAITING:
            self.drops["late"] += 1
        self.fixes += 1
        self._waiting.append(fix)

    def next_tags(self) -> list[str]:
        """Tags of the fixes in the next batch, oldest first. They must get numbers before ``next_batch``."""
        if not self._next:
            self._next = [self._waiting.popleft() for _ in range(min(len(self._waiting), MAX_RECORDS))]
        return [fix.tag for fix in self._next]

    def next_batch(self, numbers: Mapping[str, int], issue: int, now_unix_s: float) -> Batch | None:
        """Return the fixes of ``next_tags`` as a batch; None if none of these tags has a number."""
        fixes, self._next = self._next, []
        taken = [(numbers[fix.tag], fix) for fix in fixes if fix.tag in numbers]
        if len(taken) < len(fixes):
            self.drops["no-number"] += len(fixes) - len(taken)
        if not taken:
            return None
        records = records_of(taken, simulated=self.simulated)
        return Batch(self._run, next(self._sequences), round(1e6 * now_unix_s), issue, records)


# Condition of a site in one word, with reasons, for lists of sites: the page's, and the gather's own.

_DROPS_S: Final = 60.0
_MAX_WAITING: Final = 5_000

ConditionWord = Literal["good", "degraded", "bad"]


class SiteCondition:
    """What a gather knows about its site. No I/O."""

    def __init__(self, now_s: float) -> None:
        self.site: SiteMessage | None = None
        self._now_s = now_s
        self._table = SiteTable(now_s)
        self._evidence = Evidence(self._table)
        self._monitor = ConditionMonitor(self._evidence)
        self._dropped: deque[tuple[float, int]] = deque()
        self._feed = SiteFeed(lambda: self._now_s)
        self._feed.on(SiteMessage, lambda message, _: self._on_site(message))
        self._feed.on(StatusMessage, lambda status, _: status and self._evidence.add_status(status, self._now_s))
        for kind in (TagHealth, AnchorHealth, EtherHealth):
            self._feed.on(kind, self._on_health)

    def _on_site(self, message: SiteMessage | None) -> None:
        if message is not None:
            self.site = message
            self._table.set_site(message.site, self._now_s, addresses=message.system == "dl-tdoa")

    def _on_health(self, health: Health, channel: Channel) -> None:
        self._table.add_health(channel.who, channel.name, health, self._now_s)

    def on_message(self, topic: str, payload: bytes, now_s: float) -> None:
        """Process a message with the site, or with a program's status or health."""
        self._now_s = now_s
        self._feed.receive(topic, payload)

    def on_batch(self, records: Records, names: Mapping[int, TagName], now_s: float) -> None:
        """Process the fixes of a batch of this gather or another program."""
        known = {
            number: names[number].name if number in names else str(number) for number in set(records["tag"].tolist())
        }
        self._table.hear(known.values(), now_s)
        alerts = records["flags"] & ALERT_BITS
        for number, alert in set(zip(records["tag"][alerts > 0].tolist(), alerts[alerts > 0].tolist(), strict=True)):
            self._evidence.note_alert(known[number], ALERTS[min(alert, len(ALERTS)) - 1])

    def _online(self) -> list[StatusMessage]:
        nodes = (node for kind in self._table.kinds for _, node in self._table.senders(kind))
        return [node.status for node in nodes if node.status is not None and node.status.online]

    def online(self) -> dict[str, int]:
        """Programs that are online, by kind."""
        return dict(Counter(status.kind for status in self._online()))

    def versions(self) -> dict[str, int]:
        """Programs that are online, by version."""
        return dict(Counter(status.version or "unknown" for status in self._online()))

    def tags_heard(self, now_s: float) -> int:
        """Tags that are there, by their fixes."""
        self._table.tick(now_s)
        return sum(not tag.is_gone for tag in self._table.all("tag").values())

    def reasons(self, drops: Mapping[str, int], waiting: int, now_s: float) -> tuple[ConditionWord, list[str]]:
        """Return the condition, and why it is not good. ``drops`` are the gather's since its start."""
        self._dropped.append((now_s, sum(drops.values())))
        while now_s - self._dropped[0][0] > _DROPS_S:
            self._dropped.popleft()
        self._table.tick(now_s)
        condition = self._monitor.evaluate(now_s)
        found = [reason.text for reason in condition.reasons]
        is_bad = condition.level == "bad"
        if self.site is None:
            is_bad, found = True, ["the site is not published: no anchor or emulated air is running"]
        elif condition.level == "waiting" and not self._table.in_grace(now_s):
            is_bad, found = True, [condition.text]
        if waiting > _MAX_WAITING:
            found.append(f"{waiting} fixes wait for the stream")
        if dropped := self._dropped[-1][1] - self._dropped[0][1]:
            found.append(f"{dropped} fixes were dropped in the last minute")
        return "bad" if is_bad else "degraded" if found else "good", found


PERIOD_S: Final = 0.1
SUMMARY_S: Final = 1.0
_RETRY_S: Final = 0.5
_LEAVE_S: Final = 2.0
_QUEUE: Final = "gather"


class Summary(Struct, frozen=True, kw_only=True):
    """A gather's counts since its start, published once a second. Older versions lack the fields with defaults."""

    unix_s: float
    host: str
    version: str
    site: str
    """Name of the site; empty until it was published."""
    simulated: bool
    since: str = ""
    """When the site's streams were made, in ISO 8601; tells apart two sites with the same number."""
    condition: str = ""
    """A ``ConditionWord``; empty from older versions. Newer versions may send other words."""
    reasons: list[str] = []
    """Why the condition is not good."""
    tags_heard: int = 0
    """Tags that are there, by their fixes in batches of this gather or of other programs."""
    names: int
    """Tags that have a number."""
    online: dict[str, int]
    """Programs that are online, by kind."""
    versions: dict[str, int] = {}
    """Programs that are online, by version."""
    fixes: int
    """Fixes taken from JSON."""
    batches: int
    """Batches that the stream has acknowledged."""
    waiting: int
    """Fixes that are not in an acknowledged batch yet."""
    drops: dict[str, int]
    """Messages and fixes that were dropped, by reason."""
    cuts: int
    """Reconnections to the server, which disconnects readers that are too slow."""


class Gather:
    """One gather of a site. Several of one site share the fixes: the server gives each message to one of them."""

    def __init__(
        self, address: NatsAddress, site: int | None, keep_bytes: int, log: Log, broker: MqttAddress | None = None
    ) -> None:
        """``site`` None means the first site heard. ``broker`` is the same server's MQTT address."""
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
        """The counts since the start, and the site's condition."""
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

    @property
    def drops(self) -> dict[str, int]:
        """Messages and fixes that were dropped since the start, by reason."""
        return dict(self._packer.drops)

    def add_fix(self, name: str, payload: bytes) -> None:
        """Take a tag's fix in JSON that has come in another way than from the server."""
        self._packer.add(name, payload)

    def add_message(self, topic: str, payload: bytes) -> None:
        """Take the site, or a program's status or health, in the same way."""
        self._condition.on_message(topic, payload, time.monotonic())
        if self._condition.site is not None:
            self._packer.simulated = self._condition.site.simulated

    async def run(self) -> None:
        """Gather until cancelled, then send what is waiting."""
        client = self._client = await connect(self._address, "skyless gather", self._say, self._packer.drops)
        stream = client.jetstream()
        try:
            site = self.site = await self._first_site(client) if self.site is None else self.site
            fixes = await client.subscribe(subjects.at(subjects.JSON_FIXES, site), _QUEUE, self._on_fix)
            await client.subscribe(subjects.at(subjects.FIXES, site), cb=self._on_batch)
            for pattern in (subjects.STATUSES, subjects.SITES, subjects.HEALTHS):
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
        self.add_fix(subjects.tag_in(message.subject), message.data)

    async def _on_batch(self, message: Msg) -> None:
        with contextlib.suppress(BadBatchError, Error):
            batch, names = decode_batch(message.data), self._names
            if names is not None and batch.names_issue > names.issue:
                await names.read()
            self._condition.on_batch(batch.records, {} if names is None else names.tags, time.monotonic())

    async def _on_message(self, message: Msg) -> None:
        self.add_message(subjects.topic_of(message.subject), message.data)

    # Sending

    async def _send(self, stream: JetStreamContext, site: int) -> None:
        """Send until cancelled. Fixes wait while the server cannot take them."""
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
                check_cancelled()
                self._say(f"the fixes of site {site} wait: {error or type(error).__name__}")
                await asyncio.sleep(_RETRY_S)

    async def _copy_state(self, stream: JetStreamContext, site: int) -> None:
        """Read the state from the stream, and copy there what the broker retained before the stream was made."""
        state, known = subjects.at(subjects.STATE_STREAM, site), set[str]()
        async for message in messages(stream, state):
            known.add(message.subject)
            if message.subject.endswith((".site", ".status")):
                await self._on_message(message)
        if self._broker is None:
            return
        filters = [subjects.filter_of(one, site) for one in subjects.STATE]
        try:
            kept = await kept_messages(self._broker, filters)
        except (OSError, RefusedError) as error:
            self._say(f"what the broker has kept is not copied: {trouble_with(self._broker, error)}")
            return
        for topic, payload in kept.items():
            if (subject := subjects.subject_of(topic)) not in known:
                with contextlib.suppress(APIError):  # it has arrived meanwhile
                    await stream.publish(subject, payload, headers=dict(NEVER_WRITTEN))

    async def _send_waiting(self, stream: JetStreamContext, site: int, names: Names) -> None:
        """Send until nothing waits. A batch counts as sent once the stream has acknowledged it.

        A batch that the stream refuses, as on a full disk, has reached live readers and is not sent again.
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
        """Stop taking fixes, and send those that have come; another gather gets the rest at once."""
        await fixes.drain()  # type: ignore[no-untyped-call]
        if self._names is not None:
            await self._send_waiting(stream, site, self._names)

    async def _summarise(self, client: Client, site: int) -> None:
        while True:
            await client.publish(subjects.at(subjects.SUMMARY, site), msgspec.json.encode(self.summary))
            await asyncio.sleep(SUMMARY_S)
