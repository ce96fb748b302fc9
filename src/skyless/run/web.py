"""Who may ask a server of this machine: not the pages of other sites that somebody opens in a browser.

A page of another site reaches a server on the same computer or network in two ways. It asks for its address, and the
browser names that site as ``Origin``; or it lets its own name point to this address (DNS rebinding), and the browser
sends that name as ``Host``.
"""

import ipaddress
import platform
import re
from collections.abc import Collection
from urllib.parse import urlsplit

_HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::\d{1,5})?")


def is_own_host(host: str, names: Collection[str] = (), *, remote: bool) -> bool:
    """Whether a ``Host`` is a name of this server: ``localhost``, one of ``names``, or an address.

    ``remote``: whether other machines can reach it. Then it may be any IP address, otherwise a loopback one.
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
    """Names of a server that listens at this host: that one, and those of this computer."""
    node = platform.node().lower()
    return frozenset({host.lower(), node, f"{node.partition('.')[0]}.local"})


def same_origin(origin: str, host: str) -> bool:
    """Whether the page that asks comes from this server itself."""
    try:
        parts = urlsplit(origin.lower())
    except ValueError:
        return False
    return parts.scheme in {"http", "https"} and parts.netloc == host.lower()


def is_local_origin(origin: str) -> bool:
    """Whether the page that asks comes from a server of this computer."""
    try:
        parts = urlsplit(origin.lower())
        return parts.scheme in {"http", "https"} and is_own_host(parts.netloc, remote=False)
    except ValueError:
        return False
