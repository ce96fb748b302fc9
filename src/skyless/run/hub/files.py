"""The files of a hub: one states what was asked and all passwords, and the others are made of it.

The servers of a hub are plain nats-server. Each tenant is an account with one user that may do everything, and one for
each of its sites.
"""

import re
import secrets
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.errors import SkylessError
from skyless.core.whole_files import replace_files
from skyless.run.gather.address import FIRST_PORT, MAX_PAYLOAD, NatsAddress
from skyless.run.gather.subjects import DOMAIN, SOURCED, SUMMARY, at
from skyless.run.hub.leaf import Leaf
from skyless.run.mqtt.address import PASSWORD_VARIABLE, is_loopback

CLUSTER_PORT: Final = 2000
LEAF_PORT: Final = 3200
MONITOR_PORT: Final = 4000
"""What is added to a node's port for other servers of the hub, for sites, and for monitoring on the node itself."""
PLAN: Final = "hub.json"
SERVER: Final = "nats-server.conf"

_COUNTS: Final = (1, 3, 5)
_NODE: Final = re.compile(r"([A-Za-z0-9][A-Za-z0-9.-]*)(?::(\d{1,5}))?")
_TENANT: Final = re.compile(r"[a-z][a-z0-9-]{0,30}")
_PASSWORD_BYTES: Final = 24


class Node(Struct, frozen=True):
    """A server of a hub."""

    host: str
    port: int

    @property
    def name(self) -> str:
        """Name of the server and of its folder."""
        return self.host if self.port == FIRST_PORT else f"{self.host}-{self.port}"


class Tenant(Struct, frozen=True):
    """The passwords of a tenant: its own, and those of its sites by number."""

    password: str
    sites: dict[int, str] = {}


class Hub(Struct, frozen=True, kw_only=True):
    """What was asked of a hub, and all of its passwords."""

    nodes: tuple[Node, ...]
    tenants: dict[str, Tenant]
    cluster_password: str
    admin_password: str
    fixes_gb: float = 50.0
    """Fixes that each server keeps of each tenant."""
    data: str = "/var/lib/skyless-hub"
    certificates: str = "/etc/skyless-hub"

    @property
    def loopback(self) -> bool:
        """Whether it is on this machine alone. Others use TLS."""
        return all(is_loopback(node.host) for node in self.nodes)

    @property
    def ca(self) -> Path | None:
        """Certificates that all machines trust; None without TLS."""
        return None if self.loopback else Path(self.certificates) / "ca.pem"

    def address(self, tenant: str) -> NatsAddress:
        """Where a tenant's programs connect."""
        hosts = ",".join(f"{node.host}:{node.port}" for node in self.nodes)
        return NatsAddress(f"{self._scheme}://{hosts}", tenant, self.tenants[tenant].password, self.ca)

    def leaf(self, tenant: str, site: int) -> Leaf:
        """What a site needs."""
        return Leaf(
            site=site,
            tenant=tenant,
            urls=[f"{self._scheme}://{node.host}:{node.port + LEAF_PORT}" for node in self.nodes],
            user=_site_user(tenant, site),
            password=self.tenants[tenant].sites[site],
            ca=None if self.ca is None else str(self.ca),
        )

    @property
    def _scheme(self) -> str:
        return "nats" if self.loopback else "tls"


def read_node(option: str, text: str) -> Node:
    """HOST or HOST:PORT. Raises SkylessError."""
    found = _NODE.fullmatch(text)
    port = int((found and found[2]) or FIRST_PORT)
    if found is None or not 1 <= port <= 0xFFFF - MONITOR_PORT:
        most = 0xFFFF - MONITOR_PORT
        raise SkylessError(f"{option} is {text!r}; it should be HOST or HOST:PORT, the port at most {most}")
    return Node(found[1], port)


def new_hub(nodes: tuple[Node, ...]) -> Hub:
    """A hub without tenants. Raises SkylessError."""
    if len(nodes) not in _COUNTS or len(set(nodes)) < len(nodes):
        shown = ", ".join(node.name for node in nodes) or "not given"
        raise SkylessError(f"--node is {shown}; it should be given 1, 3 or 5 times, each another server")
    if len({is_loopback(node.host) for node in nodes}) > 1:
        raise SkylessError("--node names this machine and others; it should name hosts as all machines reach them")
    return Hub(nodes=nodes, tenants={}, cluster_password=_new_password(), admin_password=_new_password())


def read_hub(folder: Path) -> Hub:
    """The hub of a folder. Raises SkylessError."""
    file = folder / PLAN
    try:
        return msgspec.json.decode(file.read_bytes(), type=Hub)
    except FileNotFoundError:
        raise SkylessError(f"{file} is missing; skyless hub init makes it") from None
    except OSError as error:
        raise SkylessError(f"{file} cannot be read: {error.strerror}") from None
    except (msgspec.DecodeError, UnicodeError) as error:
        raise SkylessError(f"{file} is none of skyless hub init: {error}") from None


def with_sites(hub: Hub, name: str, sites: Iterable[int]) -> Hub:
    """The hub with a tenant and its sites; passwords that are there stay. Raises SkylessError."""
    if not _TENANT.fullmatch(name):
        right = "a letter, then at most 30 small letters, digits and hyphens"
        raise SkylessError(f"--tenant is {name!r}; it should be {right}")
    tenant = hub.tenants.get(name) or Tenant(_new_password())
    passwords = {site: _new_password() for site in sites} | tenant.sites
    return replace(hub, tenants=hub.tenants | {name: replace(tenant, sites=passwords)})


def write_files(hub: Hub, folder: Path) -> list[Path]:
    """Write what has changed, for the owner alone. The files' paths. Raises SkylessError."""
    texts = {folder / PLAN: _indented(hub)}
    texts |= {folder / node.name / SERVER: _indented(_server(hub, node)) for node in hub.nodes}
    for name, tenant in hub.tenants.items():
        texts[folder / "tenants" / f"{name}.env"] = _variables(hub, name)
        for site in tenant.sites:
            texts[folder / "sites" / f"{name}-site{site}.json"] = _indented(hub.leaf(name, site))
    try:
        changed = {file: data for file, data in texts.items() if not file.exists() or file.read_bytes() != data}
        for parent in {file.parent for file in changed}:
            parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        replace_files(changed, secret=changed)
    except OSError as error:
        raise SkylessError(f"{error.filename or folder} cannot be written: {error.strerror}") from None
    return list(changed)


def _indented(value: object) -> bytes:
    return msgspec.json.format(msgspec.json.encode(value), indent=1) + b"\n"


def _variables(hub: Hub, tenant: str) -> bytes:
    trusted = "" if hub.ca is None else f"SKYLESS_MQTT_CA={hub.ca}\n"
    return (
        f"# Skyless: the tenant {tenant} at the hub (docs/hub.md). It may read all of its sites there.\n"
        f"SKYLESS_HUB={hub.address(tenant)}\n"
        f"{PASSWORD_VARIABLE}={hub.tenants[tenant].password}\n{trusted}"
    ).encode()


def _server(hub: Hub, node: Node) -> dict[str, Any]:
    """The configuration of nats-server, whose format takes JSON."""
    host = node.host if hub.loopback else "0.0.0.0"
    others = [other for other in hub.nodes if other != node]
    folder = hub.certificates
    secure: dict[str, Any] = {}
    if not hub.loopback:
        secure = {"tls": {"cert_file": f"{folder}/cert.pem", "key_file": f"{folder}/key.pem"}}
    accounts: dict[str, Any] = {"SYS": {"users": [{"user": "hub.admin", "password": hub.admin_password}]}}
    for name, tenant in hub.tenants.items():
        users: list[dict[str, Any]] = [{"user": name, "password": tenant.password}]
        users += [_site(name, site, password) for site, password in tenant.sites.items()]
        accounts[name] = {"jetstream": "enabled", "users": users}
    whole: dict[str, Any] = {
        "server_name": node.name,
        "listen": f"{host}:{node.port}",
        "http": f"127.0.0.1:{node.port + MONITOR_PORT}",
        "max_payload": MAX_PAYLOAD,
        **secure,
        "jetstream": {"domain": "hub", "store_dir": f"{hub.data}/{node.name}"},
        "leafnodes": {"listen": f"{host}:{node.port + LEAF_PORT}", "no_advertise": True, **secure},
        "accounts": accounts,
        "system_account": "SYS",
    }
    if others:
        routes = [f"nats://node:{hub.cluster_password}@{other.host}:{other.port + CLUSTER_PORT}" for other in others]
        whole["cluster"] = {
            "name": "hub",
            "listen": f"{host}:{node.port + CLUSTER_PORT}",
            "no_advertise": True,
            "authorization": {"user": "node", "password": hub.cluster_password},
            "routes": routes,
            **({"tls": secure["tls"] | {"ca_file": str(hub.ca)}} if secure else {}),
        }
    return whole


def _site(tenant: str, site: int, password: str) -> dict[str, Any]:
    """The user of a site. It publishes its own site, and takes what the hub's streams need of it, but no command."""
    allowed = [f"skyless.v1.{site}.>", f"skyless.v2.{site}.>", f"{at(SOURCED, site)}.>", "$JSC.R.>", "$JS.R.>", "_R_.>"]
    taken = [f"$JS.{at(DOMAIN, site)}.API.>", "$JS.ACK.>", "$JS.FC.>", at(SUMMARY, site)]
    permissions = {"publish": {"allow": allowed}, "subscribe": {"allow": taken}}
    return {"user": _site_user(tenant, site), "password": password, "permissions": permissions}


def _site_user(tenant: str, site: int) -> str:
    return f"{tenant}.site{site}"


def _new_password() -> str:
    return secrets.token_urlsafe(_PASSWORD_BYTES)
