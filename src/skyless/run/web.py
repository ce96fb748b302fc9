"""Servers on this machine: who may send them requests, and the limits of servers and programs.

A page of another site can reach a server on the same computer or network in two ways. It requests the server's address,
and the browser sends that site as ``Origin``; or its own name resolves to this address (DNS rebinding), and the browser
sends that name as ``Host``.
"""

import ipaddress
import platform
import re
from collections.abc import Collection
from typing import Final
from urllib.parse import urlsplit

from msgspec import Struct

_HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::\d{1,5})?")


def is_own_host(host: str, names: Collection[str] = (), *, remote: bool) -> bool:
    """Whether a ``Host`` is a name of this server: ``localhost``, one of ``names``, or an address.

    ``remote``: whether other machines can reach it. Then any IP address is allowed, otherwise only a loopback one.
    """
    match = _HOST.fullmatch(host.lower())
    if match is None:
        return False
    name = match["name"].strip("[]").removesuffix(".")
    if name == "localhost" or name in names:
        return True
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return False
    return remote or address.is_loopback


def own_names(host: str) -> frozenset[str]:
    """Names of a server that listens on this host: the host itself, and the names of this computer."""
    node = platform.node().lower()
    return frozenset({host.lower(), node, f"{node.partition('.')[0]}.local"})


def same_origin(origin: str, host: str) -> bool:
    """Whether the requesting page comes from this server itself."""
    try:
        parts = urlsplit(origin.lower())
    except ValueError:
        return False
    return parts.scheme in {"http", "https"} and parts.netloc == host.lower()


def is_local_origin(origin: str) -> bool:
    """Whether the requesting page comes from a server on this computer."""
    try:
        parts = urlsplit(origin.lower())
        return parts.scheme in {"http", "https"} and is_own_host(parts.netloc, remote=False)
    except ValueError:
        return False


# Limits of servers and programs (``docs/limits.md``); the broker's are in ``broker.py``.


class PageLimits(Struct, frozen=True):
    """Beyond them a client gets an answer that names the limit."""

    connections: int = 600
    """Connections in all: well below the 1,024 open files that a program usually may have."""
    connections_per_address: int = 200
    """Connections of one computer."""
    request_s: float = 10.0
    """For how long a connection may be without a whole request; one that waits makes room before."""
    body_s: float = 60.0
    """For how long a body may come."""
    accepts_log_s: float = 60.0
    """Interval between lines about connections that the system could not accept."""
    pages: int = 400
    """Open pages."""
    pages_per_address: int = 100
    """Open pages of one computer."""
    streams: int = 200
    """Open streams of the HTTP interface."""
    message_bytes: int = 16_384
    """A message of a page or stream."""
    body_bytes: int = 1_000_000
    """The body of a request; that of assets or rules may have twice the bytes of a table of assets."""
    floor_plan_bytes: int = 8_000_000
    """A floor plan, as on MQTT. The page's ``survey/plan.js`` has the same limit."""
    sites: int = 20
    """Sites of one broker that are shown."""
    site_idle_s: float = 600.0
    """A site without zones or alarm rules is let go when nobody has looked at it for this long."""
    questions: int = 20
    """Questions to the history that wait for their turn."""
    question_s: float = 60.0
    """For how long a question to the history is answered, its waiting included."""
    answer_bytes: int = 16_000_000
    """An answer of the history, or of another process of the server."""


class HistoryLimits(Struct, frozen=True):
    """A question beyond them is refused with what would be accepted; rows beyond them are counted as dropped."""

    memory_mb: int = 64
    """What DuckDB may use before it writes to temporary files; Python and the libraries take 100 MB besides."""
    points: int = 20_000
    """Points of a way."""
    rows: int = 100_000
    """Rows of a table of stays, or of the answer of SQL that is written to no file."""
    contacts: int = 100_000
    """Contacts of a tag."""
    contact_m: float = 50.0
    """Distance within which tags count as in contact."""
    cells: int = 1_000_000
    """Cells of a heat map."""
    waiting_rows: int = 1_000_000
    """Fixes, and as many events, that wait in memory for the next file; further ones are left in the stream."""
    tags: int = 200_000
    """Tags of a site."""
    first_unix_s: float = 1e9
    """Earlier times, before 2001, are those of a computer without a clock."""
    last_unix_s: float = 8e9
    """Later times, in more than 200 years, are no times."""


class BridgeLimits(Struct, frozen=True):
    """Beyond them a client is refused, or the oldest messages are dropped and counted."""

    clients: int = 32
    """Clients of Foxglove's protocol, connections to Prometheus's metrics."""
    readers: int = 64
    """Connections to one TCP server of lines."""
    request_bytes: int = 65_536
    """A message of a client of Foxglove's protocol."""
    head_bytes: int = 8_192
    """The head of a request for metrics."""
    answer_s: float = 5.0
    """After this time a connection to the metrics is ended, even in the middle of an answer."""
    waiting_messages: int = 500
    """Messages that wait for one client; beyond it the oldest are dropped."""
    channels: int = 2_000
    """Channels of Foxglove's protocol."""
    deliveries: int = 1_000
    """Mails or web hooks that wait; beyond it the oldest are dropped."""


PAGE: Final = PageLimits()
HISTORY: Final = HistoryLimits()
BRIDGES: Final = BridgeLimits()
