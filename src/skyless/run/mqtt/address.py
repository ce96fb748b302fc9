"""Address of an MQTT broker, or of several of a cluster, with user, password and certificates."""

import os
import re
import ssl
from pathlib import Path
from typing import Final
from urllib.parse import SplitResult, unquote, urlsplit

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.errors import SkylessError

PASSWORD_VARIABLE: Final = "SKYLESS_MQTT_PASSWORD"
_PORTS: Final = {"mqtt": 1883, "mqtts": 8883}
_LOOPBACK: Final = re.compile(r"localhost|127(\.\d{1,3}){3}|::1")
_PASSWORD: Final = re.compile(
    r"^((?>(?:[^:/?#]*://)?)(?>\[[\da-fA-F:.]+\]|[^:/?#@]*)):(?!\d{1,5}(?:/[^?#@]*)?\?\w+(?:[=&]|$)).*@"
)
"""What comes after a colon behind user or host, up to the last ``@``; not a port and a query such as ``?to=a@b``."""


class MqttAddress(Struct, frozen=True):
    """A broker; its ``str()`` never shows the password."""

    host: str
    port: int
    tls: bool = False
    user: str | None = None
    password: str | None = None
    ca: Path | None = None
    """Certificates to trust instead of the system's."""
    others: tuple[tuple[str, int], ...] = ()
    """Hosts and ports of further brokers with the same messages, users and certificates."""

    def __str__(self) -> str:
        user = f"{self.user}@" if self.user is not None else ""
        hosts = ",".join(f"[{host}]:{port}" if ":" in host else f"{host}:{port}" for host, port in self._hosts)
        return f"mqtt{'s' if self.tls else ''}://{user}{hosts}"

    def __repr__(self) -> str:
        return f"MqttAddress({str(self)!r})"

    @property
    def loopback(self) -> bool:
        """Whether the broker, and each of several, is on this machine."""
        return all(is_loopback(host) for host, _ in self._hosts)

    @property
    def brokers(self) -> "tuple[MqttAddress, ...]":
        """Each broker by itself."""
        return tuple(replace(self, host=host, port=port, others=()) for host, port in self._hosts)

    @property
    def _hosts(self) -> tuple[tuple[str, int], ...]:
        return ((self.host, self.port), *self.others)

    def tls_context(self) -> ssl.SSLContext | None:
        """The checks of the broker's certificate; None without TLS.

        Raises:
            SkylessError: the file of certificates cannot be used.
        """
        return tls_context(self.ca) if self.tls else None


def tls_context(ca: Path | None) -> ssl.SSLContext:
    """The checks of a server's certificate; ``ca`` has those to trust. Raises SkylessError: it cannot be used."""
    try:
        return ssl.create_default_context(cafile=ca)
    except OSError as error:
        reason = "it should hold certificates in PEM form" if isinstance(error, ssl.SSLError) else error.strerror
        raise SkylessError(f"{ca} cannot be used as --mqtt-ca: {reason}") from None


def mqtt_address(url: str, ca: Path | None = None) -> MqttAddress:
    """The broker of a URL, or the brokers; the password may also be in ``SKYLESS_MQTT_PASSWORD``.

    Several are separated by commas: ``mqtts://ann@a,b:8884,c``.

    Raises:
        SkylessError: with what would be right; it never shows the password.
    """
    several = re.fullmatch(r"([^:/?#]*://(?:[^/?#]*@)?)([^/?#@]*)(.*)", url, re.DOTALL)
    before, hosts, after = several.groups() if several else ("", url, "")
    first, *others = (_broker(url, f"{before}{host}{after}", ca) for host in hosts.split(","))
    return replace(first, others=tuple((other.host, other.port) for other in others))


def _broker(url: str, single: str, ca: Path | None) -> MqttAddress:
    """The broker of a URL with one host; errors show the whole URL."""
    try:
        parts = urlsplit(single)
        port = parts.port
    except ValueError:
        raise _wrong(url, "a port between 1 and 65535 after the host") from None
    if parts.scheme not in _PORTS:
        raise _wrong(url, "mqtt://HOST[:PORT] or mqtts://[USER@]HOST[:PORT], several hosts with commas between them")
    if not _is_host(parts.hostname):
        raise _wrong(url, f"a host name or address after {parts.scheme}://")
    if port == 0:
        raise _wrong(url, "a port between 1 and 65535 after the host")
    if parts.path not in ("", "/") or parts.query or parts.fragment:
        raise _wrong(url, "nothing after the port; topics are the same on every broker")
    if ca is not None and parts.scheme != "mqtts":
        raise _wrong(url, "mqtts://… together with --mqtt-ca")
    user, password = _credentials(url, parts)
    host = parts.hostname or ""
    return MqttAddress(host, port or _PORTS[parts.scheme], parts.scheme == "mqtts", user, password, ca)


def _credentials(url: str, parts: SplitResult) -> tuple[str | None, str | None]:
    user = unquote(parts.username) if parts.username else None
    password = unquote(parts.password) if parts.password else None
    if user is None:
        if password is not None:
            raise _wrong(url, "a user's name before the password")
        return None, None
    return user, os.environ.get(PASSWORD_VARIABLE) if password is None else password


def _is_host(host: str | None) -> bool:
    """Whether a resolver can be asked for it: labels of 1 … 63 characters, without blanks."""
    if not host or re.search(r"[\s\x00-\x1f]", host):
        return False
    return all(0 < len(label) <= 63 for label in host.removesuffix(".").split("."))


def _wrong(url: str, expected: str) -> SkylessError:
    return SkylessError(f"--mqtt is {hide_password(url)!r}; it should be {expected}")


def hide_password(url: str) -> str:
    """The URL with asterisks in place of its password, however wrong the rest is."""
    return _PASSWORD.sub(r"\1:***@", url)


def is_loopback(host: str) -> bool:
    """Whether a host is this machine."""
    return _LOOPBACK.fullmatch(host) is not None
