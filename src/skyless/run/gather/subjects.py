"""NATS subjects and streams (``docs/batches.md``). ``{}`` is the site's number, or ``*`` for all sites.

An MQTT topic is a subject with dots instead of slashes; nats-server writes a dot within a level of a topic as ``//``.
"""

import os
import platform
import re
import ssl
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import unquote, urlsplit

from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.machine import extra_module
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import PASSWORD_VARIABLE, hide_password, tls_context
from skyless.run.mqtt.topics import ROOT, Topic
from skyless.run.process import Log

if TYPE_CHECKING:
    from nats.aio.client import Client


def subject_of(topic: str) -> str:
    """Subject for an MQTT topic, or pattern for a topic filter."""
    levels = (level.replace(".", "//") for level in topic.split("/"))
    return ".".join("*" if level == "+" else level for level in levels)


def _of(*chosen: Topic) -> tuple[str, ...]:
    return tuple(subject_of(f"{ROOT}/{{}}/{topic.levels}") for topic in chosen)


JSON_FIXES, STATUSES, HEALTHS, SITES = _of(
    topics.fix_topic, topics.status_topic, topics.health_topic, topics.site_topic
)
FIXES: Final = "skyless.v2.{}.fixes.*"
"""Batches; the last level is the sender's host."""
NAMES: Final = "skyless.v2.{}.names.*"
"""``TagName``; the last level is the tag's number."""
SUMMARY: Final = "skyless.v2.{}.summary"

STATE: Final = _of(
    *(topics.site_topic, topics.floor_plan_topic, topics.plan_of_floor_topic, topics.status_topic),
    *(topics.zones_topic, topics.assets_topic, topics.alarm_rules_topic),
    *(topics.survey_topic, topics.placement_topic, topics.watch_topic),
)
"""Retained MQTT messages, of which only the newest matters."""
EVENTS: Final = _of(topics.zone_event_topic, topics.alarm_topic)
"""MQTT messages, each of which is an event."""

# Streams of a site at its own server. A hub's have the same names; readers there ask for the site's subjects.
FIX_STREAM: Final = "FIX_{}"
NAMES_STREAM: Final = "NAMES_{}"
STATE_STREAM: Final = "STATE_{}"
EVENT_STREAM: Final = "EVENTS_{}"

SOURCED: Final = "sourced.{}"
"""Prefix of the subjects under which a site's messages reach a hub's streams."""
DOMAIN: Final = "site{}"
"""JetStream domain of a site."""
NAME_REQUESTS: Final = "$JS.API.DIRECT.GET.*.skyless.v2.*.names.*"
"""Subject of requests to the server for the name of one tag."""
PAGE_INBOX: Final = "_INBOX_PAGE"
"""Prefix of the reply subjects of pages."""
EVERY: Final = "*"


def at(pattern: str, site: int | str, last: int | str = "") -> str:
    """Subject or stream of a site; ``last`` replaces the ``*`` at the pattern's end."""
    subject = pattern.format(site)
    return f"{subject[:-1]}{last}" if last else subject


def own_host() -> str:
    """Name of this computer, usable as one level of a subject."""
    return re.sub(r"[^A-Za-z0-9_-]", "-", platform.node()) or "host"


def tag_in(subject: str) -> str:
    """Name of the tag in a subject of ``JSON_FIXES``, as in the MQTT topic."""
    return subject.split(".")[4].replace("//", ".")


def topic_of(subject: str) -> str:
    """MQTT topic for a subject."""
    return "/".join(level.replace("//", ".") for level in subject.split("."))


def filter_of(pattern: str, site: int) -> str:
    """MQTT topic filter for a pattern of a site's subjects."""
    return topic_of(at(pattern, site)).replace("*", "+")


def site_in(subject: str) -> int | None:
    """Number of the site in a subject, or None."""
    level = subject.split(".")[2]
    return int(level) if level.isdecimal() and len(level) < 6 else None


FIRST_PORT: Final = 4222
MAX_PAYLOAD: Final = 8 * 1024 * 1024
"""Largest message in bytes, such as a floor plan, that a site's server and a hub take."""
_PING_S: Final = 5
"""After two unanswered pings another server is tried."""
_SAME_TROUBLE_S: Final = 30.0


class NatsAddress(Struct, frozen=True):
    """One NATS server, or those of a hub; ``str()`` never shows the password."""

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
        """TLS settings for the servers; None without TLS. Raises SkylessError if ``ca`` cannot be used."""
        return tls_context(self.ca) if self.url.startswith("tls:") else None

    def __str__(self) -> str:
        return self.url if self.user is None else self.url.replace("://", f"://{self.user}@", 1)

    def __repr__(self) -> str:
        return f"NatsAddress({str(self)!r})"


def nats_address(url: str, option: str = "--nats", ca: Path | None = None) -> NatsAddress:
    """Parse the URL of a server, or of a hub's servers; the password may also be in ``SKYLESS_MQTT_PASSWORD``.

    Several are separated by commas: ``tls://plant@a,b:4223,c``.

    Raises SkylessError: with what would be right, never showing the password.
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
    """Wrap ``log``: each text is passed on once, and again every half minute while it recurs."""
    said_s: dict[str, float] = {}

    def say(trouble: str) -> None:
        now_s = time.monotonic()
        if now_s > said_s.get(trouble, float("-inf")) + _SAME_TROUBLE_S:
            said_s[trouble] = now_s
            log(trouble)

    return say


async def connect(address: NatsAddress, name: str, say: Log, drops: Counter[str], inbox: str = "_INBOX") -> "Client":
    """Connect, waiting for a server that is not there yet; reconnect whenever the connection is lost.

    ``inbox`` is the prefix of reply subjects. Messages that arrive faster than they are read are counted in ``drops``
    as ``unread``. Raises SkylessError without nats-py.
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
        reconnect_time_wait=0.5,
        connect_timeout=2,
        ping_interval=_PING_S,
    )
    return client
