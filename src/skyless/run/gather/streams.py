"""The streams of a site at its NATS server: what they keep, and how they are read."""

import asyncio
import contextlib
import os
import platform
import re
import ssl
import time
from collections import Counter
from collections.abc import AsyncGenerator, Iterable
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import unquote, urlsplit

import msgspec
from msgspec import Struct
from nats.errors import Error
from nats.js.api import ConsumerConfig, DeliverPolicy, StreamConfig
from nats.js.errors import APIError, NotFoundError

from skyless.core.errors import SkylessError
from skyless.machine import extra_module
from skyless.run.mqtt.address import PASSWORD_VARIABLE, hide_password, tls_context
from skyless.run.process import Log

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

# Subjects and streams of NATS (``docs/batches.md``). ``{}`` is the site's number, or ``*`` for all sites.
#
# MQTT topics are subjects with dots instead of slashes. nats-server writes a dot within a level of a topic as ``//``.

JSON_FIXES: Final = "skyless.v1.{}.tag.*.fix"
STATUSES: Final = "skyless.v1.{}.*.*.status"
SITES: Final = "skyless.v1.{}.site"
FIXES: Final = "skyless.v2.{}.fixes.*"
"""Batches; the last level is the sender's host."""
NAMES: Final = "skyless.v2.{}.names.*"
"""``TagName``; the last level is the tag's number."""
SUMMARY: Final = "skyless.v2.{}.summary"

STATE: Final = (
    "skyless.v1.{}.site",
    "skyless.v1.{}.floor_plan",
    "skyless.v1.{}.floor_plan.*",
    "skyless.v1.{}.*.*.status",
    "skyless.v1.{}.zones",
    "skyless.v1.{}.assets",
    "skyless.v1.{}.alarm_rules",
    "skyless.v1.{}.survey.state",
    "skyless.v1.{}.survey.placement",
    "skyless.v1.{}.survey.watch",
)
"""Retained messages of MQTT of which the newest matters."""
EVENTS: Final = ("skyless.v1.{}.zone.*.event", "skyless.v1.{}.alarm.*.*.state")
"""Messages of MQTT of which each is an event."""

FIX_STREAM: Final = "FIX_{}"
NAMES_STREAM: Final = "NAMES_{}"
STATE_STREAM: Final = "STATE_{}"
EVENT_STREAM: Final = "EVENTS_{}"

"""Streams of a site at its own server; a hub's have the same names, and there a reader asks for the site's subjects."""
SOURCED: Final = "sourced.{}"
"""How the subjects begin under which a site's messages come to the streams of a hub."""
DOMAIN: Final = "site{}"
"""JetStream's domain of a site."""

NAME_REQUESTS: Final = "$JS.API.DIRECT.GET.*.skyless.v2.*.names.*"
"""Where the server is asked for the name of one number."""
PAGE_INBOX: Final = "_INBOX_PAGE"
"""How the subjects begin under which pages are answered."""

EVERY: Final = "*"


def at(pattern: str, site: int | str, last: int | str = "") -> str:
    """A subject or stream of a site, with its last level where the pattern leaves it open."""
    subject = pattern.format(site)
    return f"{subject[:-1]}{last}" if last else subject


def own_host() -> str:
    """Name of the own computer as one level of a subject."""
    return re.sub(r"[^A-Za-z0-9_-]", "-", platform.node()) or "host"


def tag_in(subject: str) -> str:
    """Name of the tag in a subject of ``JSON_FIXES``, as in the MQTT topic."""
    return subject.split(".")[4].replace("//", ".")


def subject_of(topic: str) -> str:
    """The subject of a topic of MQTT, or the pattern of a topic filter."""
    levels = (level.replace(".", "//") for level in topic.split("/"))
    return ".".join("*" if level == "+" else level for level in levels)


def topic_of(subject: str) -> str:
    """The topic of MQTT of a subject."""
    return "/".join(level.replace("//", ".") for level in subject.split("."))


def site_in(subject: str) -> int | None:
    """Number of the site in a subject, or None where it has none."""
    level = subject.split(".")[2]
    return int(level) if level.isdecimal() and len(level) < 6 else None


KEEP_S: Final = 24 * 3600.0
"""How long the stream keeps fixes."""
KEEP_EVENTS_S: Final = 365 * 24 * 3600.0
EVENT_BYTES: Final = 500_000_000
NEWEST_OF_EACH: Final[dict[str, Any]] = {"max_msgs_per_subject": 1, "allow_direct": True}
"""Limits of a stream that keeps the newest message of each subject, which can be asked for."""

_NO_ROOM: Final = 10047  # JetStream's code of an error
_DUPLICATES_S: Final = 120.0
_READ_S: Final = 10.0
_IDLE_S: Final = 2.0
_ABANDONED_S: Final = 60.0
_RETRY_S: Final = 1.0


async def make_streams(stream: "JetStreamContext", site: int, keep_bytes: int) -> None:
    """Make the streams of a site, or set the limits of those that are there: what a hub takes from there.

    Raises:
        SkylessError: the server has no room for these bytes.
    """
    all_fixes = {"max_age": KEEP_S, "max_bytes": keep_bytes, "duplicate_window": _DUPLICATES_S}
    for name, taken, limits in (
        (FIX_STREAM, (FIXES,), all_fixes),
        (NAMES_STREAM, (NAMES,), NEWEST_OF_EACH),
        (STATE_STREAM, STATE, NEWEST_OF_EACH),
        (EVENT_STREAM, EVENTS, {"max_age": KEEP_EVENTS_S, "max_bytes": EVENT_BYTES}),
    ):
        patterns = [at(subject, site) for subject in taken]
        try:
            await make_stream(stream, StreamConfig(name=at(name, site), subjects=patterns, **limits))
        except APIError as error:
            if error.err_code != _NO_ROOM:
                raise
            right = f"less than the server's max_file_store leaves: {error.description}"
            raise SkylessError(f"--keep-gb is {keep_bytes / 1e9:g}; it should be {right}") from None


async def make_stream(stream: "JetStreamContext", config: StreamConfig) -> None:
    """Make a stream, or change the one that is there: to add it again would reserve its bytes twice."""
    try:
        await stream.update_stream(config)
    except NotFoundError:
        try:
            await stream.add_stream(config)
        except APIError:
            with contextlib.suppress(NotFoundError):
                await stream.update_stream(config)  # another gather has made it at this moment
                return
            raise


async def messages(
    stream: "JetStreamContext", name: str, after: int = 0, subject: str = ">"
) -> AsyncGenerator["Msg", None]:
    """The messages of a stream after the one with this number, in order, until the last one that it has now.

    ``subject`` is the pattern of those that are wanted; ``message.metadata.sequence.stream`` is a message's number.
    Raises nats.errors.Error: the stream is not there.
    """
    state = (await stream.stream_info(name)).state
    if state.messages == 0 or state.last_seq <= after:
        return
    config = ConsumerConfig(deliver_policy=DeliverPolicy.BY_START_SEQUENCE, opt_start_seq=after + 1)
    reading = await stream.subscribe(subject, stream=name, ordered_consumer=True, config=config)
    try:
        found = await reading.consumer_info()
        is_empty = not found.num_pending and not (found.delivered and found.delivered.consumer_seq)
        while not is_empty:
            message = await reading.next_msg(_READ_S)
            yield message
            is_empty = message.metadata.num_pending == 0
    finally:
        await reading.unsubscribe()


async def follow(
    stream: "JetStreamContext", name: str, subject: str, say: Log, after: int = 0, *, newest_of_each: bool = False
) -> AsyncGenerator["Msg", None]:
    """The messages of a stream after the one with this number, in order and each once, until cancelled.

    It waits for a stream that is not there, and goes on at another server when one is lost. ``subject`` is a pattern.
    With ``newest_of_each`` it begins with the newest message of each subject.
    """
    while True:
        first = DeliverPolicy.LAST_PER_SUBJECT if newest_of_each else DeliverPolicy.ALL
        config = ConsumerConfig(deliver_policy=first, inactive_threshold=_ABANDONED_S)
        if after:
            config.deliver_policy, config.opt_start_seq = DeliverPolicy.BY_START_SEQUENCE, after + 1
        try:
            reading = await stream.subscribe(subject, stream=name, ordered_consumer=True, config=config)
            try:
                for place in count(1):
                    message = await _next(reading, place)
                    if message.metadata.sequence.consumer != place:  # some were lost with a connection
                        break
                    after = message.metadata.sequence.stream
                    yield message
            finally:
                with contextlib.suppress(Error):
                    await reading.unsubscribe()
        except Error as error:
            say(f"the stream {name} cannot be read: {error or type(error).__name__}")
            await asyncio.sleep(_RETRY_S)


async def _next(reading: "JetStreamContext.PushSubscription", place: int) -> "Msg":
    """The next message. Raises nats.errors.Error: it was lost with a connection, or the server has lost the reader."""
    while True:
        try:
            return await reading.next_msg(_IDLE_S)
        except TimeoutError:
            sent = (await reading.consumer_info()).delivered
            if sent is not None and sent.consumer_seq >= place and not reading.pending_msgs:
                raise Error("messages were lost with a connection") from None


# The numbers of a site's tags, as its stream of names has them.

MAX_NAMES: Final = 200_000
_TAKEN: Final = 10071  # JetStream's code of an error
NEVER_WRITTEN: Final = {"Nats-Expected-Last-Subject-Sequence": "0"}


class TagName(Struct, frozen=True):
    """The name of a tag's number. A number is given once and never again."""

    name: str
    host: str
    """Where its fixes are packed."""
    since_unix_s: float


async def name_of(stream: "JetStreamContext", site: int, number: int) -> str:
    """The name of a tag's number, empty where it has none. Raises nats.errors.Error."""
    names, subject = at(NAMES_STREAM, site), at(NAMES, site, number)
    try:
        message = await stream.get_last_msg(names, subject, direct=True)
        return msgspec.json.decode(message.data or b"", type=TagName).name
    except (NotFoundError, msgspec.MsgspecError, ValueError):
        return ""


class Names:
    """Numbers and names of a site's tags. Every program that packs fixes gives numbers in this way."""

    def __init__(self, stream: "JetStreamContext", site: int) -> None:
        self.tags: dict[int, TagName] = {}
        self.numbers: dict[str, int] = {}
        self.issue = 0
        """The largest number that was given. Readers that know fewer read the names again."""
        self._stream, self._site, self._read = stream, site, 0

    async def read(self) -> None:
        """Read what the stream has that is not known here yet. Raises nats.errors.Error."""
        name, of_site = at(NAMES_STREAM, self._site), at(NAMES, self._site)
        async for message in messages(self._stream, name, self._read, of_site):
            self._read = message.metadata.sequence.stream
            with contextlib.suppress(msgspec.MsgspecError, ValueError):
                number = int(message.subject.rpartition(".")[2])
                self.issue = max(self.issue, number)
                self._add(number, msgspec.json.decode(message.data, type=TagName))

    async def give(self, names: Iterable[str], host: str, now_unix_s: float) -> None:
        """Give numbers to those names that have none; a full table gives none. Raises nats.errors.Error.

        Several programs may do so. The stream takes each number once, and a program gives a number only when it knows
        the names of all smaller ones, so no name has two.
        """
        for name in dict.fromkeys(names):
            while name not in self.numbers and len(self.numbers) < MAX_NAMES:
                number, tag = self.issue + 1, TagName(name, host, now_unix_s)
                subject = at(NAMES, self._site, number)
                try:
                    await self._stream.publish(subject, msgspec.json.encode(tag), headers=dict(NEVER_WRITTEN))
                    self._add(number, tag)
                except APIError as error:
                    if error.err_code != _TAKEN:
                        raise
                    await self.read()

    def _add(self, number: int, tag: TagName) -> None:
        self.tags[number], self.numbers[tag.name] = tag, number
        self.issue = max(self.issue, number)


# Address of a NATS server, or of the servers of a hub, and connections to it.

FIRST_PORT: Final = 4222
MAX_PAYLOAD: Final = 8 * 1024 * 1024
"""Bytes of a message, such as a floor plan, that a site's server and a hub take."""
_FIND_AGAIN_S: Final = 0.5
_CONNECT_S: Final = 2
_PING_S: Final = 5
"""Two pings without an answer, and another server is tried."""
_SAME_TROUBLE_S: Final = 30.0


class NatsAddress(Struct, frozen=True):
    """A NATS server, or those of a hub; its ``str()`` never shows the password."""

    url: str
    """Without user and password, as nats://127.0.0.1:4222; of a hub as nats://a:4222,b:4222."""
    user: str | None = None
    password: str | None = None
    ca: Path | None = None
    """Certificates to trust instead of the system's."""

    @property
    def servers(self) -> list[str]:
        """The URL of each server."""
        scheme, _, hosts = self.url.partition("://")
        return [f"{scheme}://{host}" for host in hosts.split(",")]

    def tls_context(self) -> ssl.SSLContext | None:
        """The checks of the servers' certificates; None without TLS. Raises SkylessError: the file cannot be used."""
        return tls_context(self.ca) if self.url.startswith("tls:") else None

    def __str__(self) -> str:
        return self.url if self.user is None else self.url.replace("://", f"://{self.user}@", 1)

    def __repr__(self) -> str:
        return f"NatsAddress({str(self)!r})"


def nats_address(url: str, option: str = "--nats", ca: Path | None = None) -> NatsAddress:
    """The server of a URL, or the servers of a hub; the password may also be in ``SKYLESS_MQTT_PASSWORD``.

    Several are separated by commas: ``tls://plant@a,b:4223,c``.

    Raises:
        SkylessError: with what would be right; it never shows the password.
    """
    right = f"nats://[USER@]HOST[:PORT] or tls://[USER@]HOST[:PORT], as nats://127.0.0.1:{FIRST_PORT}"
    fault = SkylessError(f"{option} is {hide_password(url)!r}; it should be {right}")
    scheme, _, rest = url.partition("://")
    credentials, at, hosts = rest.rpartition("@")
    found = []
    for host in hosts.split(","):
        try:
            parts = urlsplit(f"{scheme}://{credentials}{at}{host}")
            port = FIRST_PORT if parts.port is None else parts.port
        except ValueError:
            raise fault from None
        is_whole = not (parts.path.strip("/") or parts.query or parts.fragment)
        if scheme not in {"nats", "tls"} or not parts.hostname or port == 0 or not is_whole:
            raise fault
        found.append(f"[{parts.hostname}]:{port}" if ":" in parts.hostname else f"{parts.hostname}:{port}")
    user = unquote(parts.username) if parts.username else None
    password = unquote(parts.password) if parts.password else os.environ.get(PASSWORD_VARIABLE)
    return NatsAddress(f"{scheme}://{','.join(found)}", user, user and password, ca)


def rarely(log: Log) -> Log:
    """Log each trouble once, and again every half minute while it lasts."""
    said_s: dict[str, float] = {}

    def say(trouble: str) -> None:
        now_s = time.monotonic()
        if now_s > said_s.get(trouble, float("-inf")) + _SAME_TROUBLE_S:
            said_s[trouble] = now_s
            log(trouble)

    return say


async def connect(address: NatsAddress, name: str, say: Log, drops: Counter[str], inbox: str = "_INBOX") -> "Client":
    """A connection, made again whenever it is lost; waits for a server that is not there yet.

    ``inbox`` is how the subjects of answers begin. Messages that came faster than they were read are counted under
    ``unread``. Raises SkylessError without nats-py.
    """
    nats = extra_module("nats", "NATS")

    async def on_error(error: Exception) -> None:
        if isinstance(error, nats.errors.SlowConsumerError):
            drops["unread"] += 1
        say(f"NATS server {address}: {error or type(error).__name__}")

    client: Client = await nats.connect(
        address.servers,
        name=name,
        tls=address.tls_context(),
        user=address.user,
        password=address.password,
        error_cb=on_error,
        inbox_prefix=inbox,
        max_reconnect_attempts=-1,
        reconnect_time_wait=_FIND_AGAIN_S,
        connect_timeout=_CONNECT_S,
        ping_interval=_PING_S,
    )
    return client
