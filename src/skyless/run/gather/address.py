"""Address of a NATS server, and connections to it."""

import os
import time
from collections import Counter
from typing import TYPE_CHECKING, Final
from urllib.parse import unquote, urlsplit

from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.core.extras import extra_module
from skyless.run.mqtt.address import PASSWORD_VARIABLE, hide_password
from skyless.run.process import Log

if TYPE_CHECKING:
    from nats.aio.client import Client

FIRST_PORT: Final = 4222
_RETRY_S: Final = 0.5
_SAME_TROUBLE_S: Final = 30.0


class NatsAddress(Struct, frozen=True):
    """A NATS server; its ``str()`` never shows the password."""

    url: str
    """Without user and password, as nats://127.0.0.1:4222."""
    user: str | None = None
    password: str | None = None

    def __str__(self) -> str:
        return self.url if self.user is None else self.url.replace("://", f"://{self.user}@", 1)

    def __repr__(self) -> str:
        return f"NatsAddress({str(self)!r})"


def nats_address(url: str) -> NatsAddress:
    """The server of a URL; the password may also be in ``SKYLESS_MQTT_PASSWORD``.

    Raises:
        SkylessError: with what would be right; it never shows the password.
    """
    right = f"nats://[USER@]HOST[:PORT] or tls://[USER@]HOST[:PORT], as nats://127.0.0.1:{FIRST_PORT}"
    fault = SkylessError(f"--nats is {hide_password(url)!r}; it should be {right}")
    try:
        parts = urlsplit(url)
        port = FIRST_PORT if parts.port is None else parts.port
    except ValueError:
        raise fault from None
    if parts.scheme not in {"nats", "tls"} or not parts.hostname or port == 0 or parts.path.strip("/") or parts.query:
        raise fault
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    user = unquote(parts.username) if parts.username else None
    password = unquote(parts.password) if parts.password else os.environ.get(PASSWORD_VARIABLE)
    return NatsAddress(f"{parts.scheme}://{host}:{port}", user, user and password)


def rarely(log: Log) -> Log:
    """Log a trouble once, and again every half minute while it lasts."""
    last, last_s = "", 0.0

    def say(trouble: str) -> None:
        nonlocal last, last_s
        now_s = time.monotonic()
        if trouble != last or now_s > last_s + _SAME_TROUBLE_S:
            last, last_s = trouble, now_s
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
        address.url,
        name=name,
        user=address.user,
        password=address.password,
        error_cb=on_error,
        inbox_prefix=inbox,
        max_reconnect_attempts=-1,
        reconnect_time_wait=_RETRY_S,
    )
    return client
