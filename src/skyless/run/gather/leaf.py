"""The file with a site's connection to a hub: ``skyless hub init`` writes it, ``skyless broker --hub`` reads it."""

from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct

from skyless.core.errors import SkylessError

Kind = TypeVar("Kind")

PING_INTERVAL: Final = "10s"
"""nats-server gives up a connection after two unanswered pings; by default they are 2 minutes apart."""


class StuckLineError(Exception):
    """nats-server no longer tries to reach the hub (nats-server #7615) and must be restarted."""


class Leaf(Struct, frozen=True, kw_only=True):
    """Settings with which a site's nats-server reaches the hub."""

    version: Literal[1] = 1
    site: Annotated[int, Meta(ge=0, le=0xFFFD)]
    tenant: str
    urls: Annotated[list[str], Meta(min_length=1)]
    """Each hub node's port for sites, as nats://HOST:PORT or tls://HOST:PORT."""
    user: str
    password: str
    ca: str | None
    """Path of the certificates to trust, absolute; None without TLS."""

    def configuration(self) -> dict[str, Any]:
        """Settings for nats-server. MQTT's own subjects stay at the site, as a tenant's sites share its account."""
        urls = [url.replace("://", f"://{self.user}:{self.password}@", 1) for url in self.urls]
        remote: dict[str, Any] = {"urls": urls, "deny_imports": ["$MQTT.>"], "deny_exports": ["$MQTT.>"]}
        if self.ca is not None:
            remote["tls"] = {"ca_file": self.ca}
        return {"no_advertise": True, "remotes": [remote]}


def read_json(file: Path, kind: type[Kind], maker: str) -> Kind:
    """Read a file of a hub. Raises SkylessError if it cannot be read or was not made by ``maker``."""
    try:
        return msgspec.json.decode(file.read_bytes(), type=kind)
    except (OSError, msgspec.DecodeError, UnicodeError) as error:
        raise SkylessError(f"{file} cannot be used: {getattr(error, 'strerror', error)}; {maker} makes it") from None
