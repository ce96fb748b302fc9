"""The file of a site's line to a hub: ``skyless hub init`` writes it, ``skyless broker --hub`` reads it."""

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from skyless.core.errors import SkylessError


class StuckLineError(Exception):
    """nats-server does not try to reach the hub any more (nats-server #7615): it is to be started again."""


class Leaf(Struct, frozen=True, kw_only=True):
    """What nats-server of a site needs to reach the hub."""

    version: Literal[1] = 1
    site: Annotated[int, Meta(ge=0, le=0xFFFD)]
    tenant: str
    urls: Annotated[list[str], Meta(min_length=1)]
    """The port for sites of each node, nats://HOST:PORT or tls://HOST:PORT."""
    user: str
    password: str
    ca: str | None
    """Certificates to trust, an absolute path; None without TLS."""

    def configuration(self) -> dict[str, Any]:
        """``leafnodes`` of nats-server.

        MQTT's own subjects stay at the site: sites of a tenant share its account, and each keeps its retained messages.
        """
        urls = [url.replace("://", f"://{self.user}:{self.password}@", 1) for url in self.urls]
        remote: dict[str, Any] = {"urls": urls, "deny_imports": ["$MQTT.>"], "deny_exports": ["$MQTT.>"]}
        if self.ca is not None:
            remote["tls"] = {"ca_file": self.ca}
        return {"no_advertise": True, "remotes": [remote]}


def read_leaf(file: Path) -> Leaf:
    """The file that ``--hub`` names. Raises SkylessError."""
    try:
        leaf = msgspec.json.decode(file.read_bytes(), type=Leaf)
    except OSError as error:
        raise SkylessError(f"--hub is {str(file)!r}, which cannot be read: {error.strerror}") from None
    except (msgspec.DecodeError, UnicodeError) as error:
        right = "a file of the folder sites of skyless hub init"
        raise SkylessError(f"--hub is {str(file)!r}; it should be {right}: {error}") from None
    if leaf.ca is not None and not Path(leaf.ca).is_file():
        raise SkylessError(f"--hub is {str(file)!r}, whose ca {leaf.ca!r} is missing; copy the hub's ca.pem there")
    return leaf
