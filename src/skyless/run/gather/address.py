"""Address of a NATS server, or of the servers of a hub, and connections to it."""

import os
import ssl
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import unquote, urlsplit

from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.core.extras import extra_module
from skyless.run.mqtt.address import PASSWORD_VARIABLE, hide_password, tls_context
from skyless.run.process import Log

if TYPE_CHECKING:
    from nats.aio.client import Client

FIRST_PORT: Final = 4222
MAX_PAYLOAD: Final = 8 * 1024 * 1024
"""Bytes of a message, such as a floor plan, that a site's server and a hub take."""
_RETRY_S: Final = 0.5
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
        reconnect_time_wait=_RETRY_S,
        connect_timeout=_CONNECT_S,
        ping_interval=_PING_S,
    )
    return client
