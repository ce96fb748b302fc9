"""Address of a NATS server, and connections to it."""

import contextlib
import os
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Final
from urllib.parse import SplitResult, unquote, urlsplit

from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.core.extras import extra_module
from skyless.run.mqtt.address import PASSWORD_VARIABLE, hide_password

if TYPE_CHECKING:
    from nats.aio.client import Client

FIRST_PORT: Final = 4222
NATS_VARIABLE: Final = "SKYLESS_NATS"
_RETRY_S: Final = 0.5
_PENDING_BYTES: Final = 32 * 1024 * 1024
"""What may wait to be sent while the server is away."""


class NatsAddress(Struct, frozen=True):
    """A NATS server; its ``str()`` never shows the password."""

    host: str
    port: int = FIRST_PORT
    tls: bool = False
    user: str | None = None
    password: str | None = None

    def __str__(self) -> str:
        user = f"{self.user}@" if self.user is not None else ""
        return f"{'tls' if self.tls else 'nats'}://{user}{self._server}"

    def __repr__(self) -> str:
        return f"NatsAddress({str(self)!r})"

    @property
    def url(self) -> str:
        """The address without user and password."""
        return f"{'tls' if self.tls else 'nats'}://{self._server}"

    @property
    def _server(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def nats_address(url: str, option: str = "--nats") -> NatsAddress:
    """The server of a URL; the password may also be in ``SKYLESS_MQTT_PASSWORD``.

    Raises:
        SkylessError: with what would be right; it never shows the password.
    """
    parts, port = SplitResult("", "", "", "", ""), None
    with contextlib.suppress(ValueError):
        parts = urlsplit(url)
        port = parts.port
    is_whole = parts.scheme in {"nats", "tls"} and parts.hostname and port != 0
    if not is_whole or parts.path not in ("", "/") or parts.query or parts.fragment:
        right = f"nats://[USER@]HOST[:PORT] or tls://[USER@]HOST[:PORT], as nats://127.0.0.1:{FIRST_PORT}"
        raise SkylessError(f"{option} is {hide_password(url)!r}; it should be {right}")
    user = unquote(parts.username) if parts.username else None
    password = unquote(parts.password) if parts.password else os.environ.get(PASSWORD_VARIABLE)
    return NatsAddress(parts.hostname or "", port or FIRST_PORT, parts.scheme == "tls", user, user and password)


async def connect(
    address: NatsAddress,
    name: str,
    on_error: Callable[[Exception], Awaitable[None]],
    on_cut: Callable[[], Awaitable[None]] | None = None,
    *,
    patient: bool = True,
) -> "Client":
    """A connection that is made again whenever it is lost. ``on_error`` is called with each trouble.

    ``on_cut`` is called whenever it is lost.
    ``patient``: wait for a server that is not there yet, instead of failing.

    Raises:
        SkylessError: nats-py is not installed, or nobody answers and the caller is not patient.
    """
    nats = extra_module("nats", "NATS")
    try:
        client: Client = await nats.connect(
            address.url,
            name=name,
            user=address.user,
            password=address.password,
            error_cb=on_error,
            disconnected_cb=on_cut,
            allow_reconnect=True,
            max_reconnect_attempts=-1 if patient else 1,
            reconnect_time_wait=_RETRY_S,
            pending_size=_PENDING_BYTES,
        )
    except (OSError, TimeoutError, nats.errors.Error) as error:
        raise SkylessError(f"the NATS server {address} cannot be reached: {error or type(error).__name__}") from None
    return client
