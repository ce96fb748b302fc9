"""Files of a hub: one states the settings and all passwords, and the others are generated from it.

Each tenant is an account of plain nats-server, with one user for everything and one for each site. A ``Leaf``
is the file with a site's connection: ``skyless hub init`` writes it, ``skyless broker --hub`` reads it.
"""

import re
import secrets
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from skyless.core.errors import SkylessError, writing
from skyless.files import replace_files
from skyless.run.gather.subjects import DOMAIN, FIRST_PORT, MAX_PAYLOAD, SOURCED, SUMMARY, NatsAddress, at
from skyless.run.mqtt.address import PASSWORD_VARIABLE, is_loopback

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


def read_json(file: Path, kind: type[Kind]) -> Kind:
    """Read a file of a hub. Raises SkylessError if it cannot be read or is none of ``skyless hub init``."""
    try:
        return msgspec.json.decode(file.read_bytes(), type=kind)
    except (OSError, msgspec.DecodeError, UnicodeError) as error:
        raise SkylessError(
            f"{file} cannot be used: {getattr(error, 'strerror', error)}; skyless hub init makes it"
        ) from None


CLUSTER_PORT: Final = 2000
LEAF_PORT: Final = 3200
MONITOR_PORT: Final = 4000
"""Offsets from a node's port: for other servers of the hub, for sites, and for monitoring on the node itself."""
PLAN: Final = "hub.json"
_NODE: Final = re.compile(r"([A-Za-z0-9][A-Za-z0-9.-]*)(?::(\d{1,5}))?")
_CLUSTER: Final = "hub.node"
_ADMIN: Final = "hub.admin"
_SITE: Final = "{}.site{}"
"""User name of a site; names of tenants have no dot."""


class Node(Struct, frozen=True):
    """A server of a hub."""

    host: str
    port: int

    @property
    def name(self) -> str:
        """Name of the server and of its folder."""
        return self.host if self.port == FIRST_PORT else f"{self.host}-{self.port}"


def read_node(option: str, text: str) -> Node:
    """Parse HOST or HOST:PORT. Raises SkylessError."""
    found = _NODE.fullmatch(text)
    most = 0xFFFF - MONITOR_PORT
    if found is None or not 1 <= int(found[2] or FIRST_PORT) <= most:
        raise SkylessError(f"{option} is {text!r}; it should be HOST or HOST:PORT, the port at most {most}")
    return Node(found[1], int(found[2] or FIRST_PORT))


class Hub(Struct, frozen=True):
    """Settings of a hub, with all of its passwords."""

    nodes: tuple[Node, ...]
    fixes_gb: float = 50.0
    """GB of fixes that each server keeps for each tenant."""
    data: str = "/var/lib/skyless-hub"
    certificates: str = "/etc/skyless-hub"
    sites: dict[str, list[int]] = {}
    """Sites of each tenant."""
    passwords: dict[str, str] = {}
    """Passwords by user."""

    @property
    def ca(self) -> str | None:
        """Certificates that all machines trust; None without TLS, on a single machine."""
        return None if all(is_loopback(node.host) for node in self.nodes) else f"{self.certificates}/ca.pem"

    def address(self, user: str, added: int = 0) -> NatsAddress:
        """Address for a user; the offset ``added`` to the ports selects the service."""
        hosts = ",".join(f"{node.host}:{node.port + added}" for node in self.nodes)
        url, ca = (f"nats://{hosts}", None) if self.ca is None else (f"tls://{hosts}", Path(self.ca))
        return NatsAddress(url, user, self.passwords[user], ca)

    def leaf(self, tenant: str, site: int) -> Leaf:
        """Return the settings with which a site connects."""
        user = _SITE.format(tenant, site)
        urls = self.address(user, LEAF_PORT).servers
        return Leaf(site=site, tenant=tenant, urls=urls, user=user, password=self.passwords[user], ca=self.ca)


def with_sites(hub: Hub, tenant: str, sites: Iterable[int]) -> Hub:
    """Add a tenant and its sites to the hub; existing passwords stay."""
    numbers = hub.sites | {tenant: sorted({*hub.sites.get(tenant, ()), *sites})}
    users = [_CLUSTER, _ADMIN, *numbers, *(_SITE.format(name, site) for name in numbers for site in numbers[name])]
    return replace(hub, sites=numbers, passwords={user: secrets.token_urlsafe(24) for user in users} | hub.passwords)


def write_files(hub: Hub, folder: Path) -> list[Path]:
    """Write the files that have changed, private to the owner, and return their paths. Raises SkylessError."""
    values: dict[Path, object] = {folder / node.name / "nats-server.conf": _server(hub, node) for node in hub.nodes}
    for tenant, sites in hub.sites.items():
        values |= {folder / "sites" / f"{tenant}-site{site}.json": hub.leaf(tenant, site) for site in sites}
    values[folder / PLAN] = hub
    files = {file: msgspec.json.format(msgspec.json.encode(value), indent=1) for file, value in values.items()}
    trusted = "" if hub.ca is None else f"SKYLESS_MQTT_CA={hub.ca}\n"
    for tenant in hub.sites:
        text = f"SKYLESS_HUB={hub.address(tenant)}\n{PASSWORD_VARIABLE}={hub.passwords[tenant]}\n{trusted}"
        files[folder / "tenants" / f"{tenant}.env"] = text.encode()
    with writing(folder):
        changed = {file: data for file, data in files.items() if not file.exists() or file.read_bytes() != data}
        for file in changed:
            file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        replace_files(changed, secret=changed)
    return list(changed)


def _server(hub: Hub, node: Node) -> dict[str, Any]:
    """nats-server's configuration; its format accepts JSON."""
    host, tls, folder = node.host, {}, hub.certificates
    if hub.ca is not None:
        files = {"cert_file": f"{folder}/cert.pem", "key_file": f"{folder}/key.pem", "ca_file": hub.ca}
        host, tls = "0.0.0.0", {"tls": files}
    accounts: dict[str, Any] = {"SYS": {"users": [_user(hub, _ADMIN)]}}
    for tenant, sites in hub.sites.items():
        users = [_user(hub, tenant), *(_user(hub, _SITE.format(tenant, site), _access(site)) for site in sites)]
        accounts[tenant] = {"jetstream": "enabled", "users": users}
    whole: dict[str, Any] = {
        "server_name": node.name,
        "listen": f"{host}:{node.port}",
        "http": f"127.0.0.1:{node.port + MONITOR_PORT}",
        "max_payload": MAX_PAYLOAD,
        "ping_interval": PING_INTERVAL,
        "jetstream": {"domain": "hub", "store_dir": f"{hub.data}/{node.name}"},
        "leafnodes": {"listen": f"{host}:{node.port + LEAF_PORT}", "no_advertise": True, **tls},
        "accounts": accounts,
        "system_account": "SYS",
        **tls,
    }
    if len(hub.nodes) > 1:
        own, others = _user(hub, _CLUSTER), [other for other in hub.nodes if other != node]
        whole["cluster"] = {
            "name": "hub",
            "listen": f"{host}:{node.port + CLUSTER_PORT}",
            "no_advertise": True,
            "authorization": own,
            "routes": [f"nats://{':'.join(own.values())}@{one.host}:{one.port + CLUSTER_PORT}" for one in others],
            **tls,
        }
    return whole


def _user(hub: Hub, name: str, access: dict[str, Any] | None = None) -> dict[str, Any]:
    return {"user": name, "password": hub.passwords[name], **(access or {})}


def _access(site: int) -> dict[str, Any]:
    """Permissions of a site: it publishes its own messages and answers the hub's streams, but accepts no commands."""
    publish = [f"skyless.v1.{site}.>", f"skyless.v2.{site}.>", f"{at(SOURCED, site)}.>", "$JSC.R.>", "$JS.R.>", "_R_.>"]
    asked = f"$JS.{at(DOMAIN, site)}.API"
    subscribe = {"allow": [f"{asked}.>", "$JS.ACK.>", "$JS.FC.>", at(SUMMARY, site)], "deny": [f"{asked}.STREAM.>"]}
    return {"permissions": {"publish": {"allow": publish}, "subscribe": subscribe}}
