"""Address of a NATS server, and connections to it."""

import os
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Final
from urllib.parse import unquote, urlsplit

from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.core.extras import extra_module
from skyless.run.mqtt.address import PASSWORD_VARIABLE, hide_password

if TYPE_CHECKING:
    from nats.aio.client import Client

FIRST_PORT: Final = 4222
NATS_VARIABLE: Final = "SKYLESS_NATS"
_RETRY_S: Final = 0.5


class NatsAddress(Struct, frozen=True):
    """A NATS server."""

    url: str
    """Without user and password, as nats://127.0.0.1:4222."""
    user: str | None = None
    password: str | None = None

    def __str__(self) -> str:
        return self.url if self.user is None else self.url.replace("://", f"://{self.user}@", 1)

    def __repr__(self) -> str:
        return f"NatsAddress({str(self)!r})"


def nats_address(url: str, option: str = "--nats") -> NatsAddress:
    """The server of a URL; the password may also be in ``SKYLESS_MQTT_PASSWORD``.

    Raises:
        SkylessError: with what would be right; it never shows the password.
    """
    right = f"nats://[USER@]HOST[:PORT] or tls://[USER@]HOST[:PORT], as nats://127.0.0.1:{FIRST_PORT}"
    fault = SkylessError(f"{option} is {hide_password(url)!r}; it should be {right}")
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


async def connect(
    address: NatsAddress,
    name: str,
    on_error: Callable[[Exception], Awaitable[None]],
    on_cut: Callable[[], Awaitable[None]] | None = None,
) -> "Client":
    """A connection, made again whenever it is lost; waits for a server that is not there yet.

    ``on_error`` is called with each trouble, ``on_cut`` when the connection is lost. Raises SkylessError without
    nats-py.
    """
    nats = extra_module("nats", "NATS")
    client: Client = await nats.connect(
        address.url,
        name=name,
        user=address.user,
        password=address.password,
        error_cb=on_error,
        disconnected_cb=on_cut,
        max_reconnect_attempts=-1,
        reconnect_time_wait=_RETRY_S,
    )
    return client
