"""Address of one or several MQTT brokers, with user, password and certificates; roles at the broker."""

import os
import re
import secrets
import ssl
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Final
from urllib.parse import SplitResult, unquote, urlsplit

from msgspec import Struct
from msgspec.structs import replace
from paho.mqtt.client import topic_matches_sub

from skyless.core.errors import SkylessError, writing
from skyless.files import replace_files
from skyless.run.mqtt import topics
from skyless.run.mqtt.topics import EVERY_NODE, EVERY_SITE

PASSWORD_VARIABLE: Final = "SKYLESS_MQTT_PASSWORD"
_PORTS: Final = {"mqtt": 1883, "mqtts": 8883}
_LOOPBACK: Final = re.compile(r"localhost|127(\.\d{1,3}){3}|::1")
_PASSWORD: Final = re.compile(
    r"^((?>(?:[^:/?#]*://)?)(?>\[[\da-fA-F:.]+\]|[^:/?#@]*)):(?!\d{1,5}(?:/[^?#@]*)?\?\w+(?:[=&]|$)).*@"
)
"""The text between a colon after user or host and the last ``@``; not a port with a query such as ``?to=a@b``."""


class MqttAddress(Struct, frozen=True):
    """One broker, or several of a cluster; ``str()`` never shows the password."""

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
        """Whether all of the brokers are on this machine."""
        return all(is_loopback(host) for host, _ in self._hosts)

    @property
    def brokers(self) -> "tuple[MqttAddress, ...]":
        """Each broker as an address of its own."""
        return tuple(replace(self, host=host, port=port, others=()) for host, port in self._hosts)

    @property
    def _hosts(self) -> tuple[tuple[str, int], ...]:
        return ((self.host, self.port), *self.others)

    def tls_context(self) -> ssl.SSLContext | None:
        """TLS settings for the broker; None without TLS. Raises SkylessError if the certificates cannot be used."""
        return tls_context(self.ca) if self.tls else None


def tls_context(ca: Path | None) -> ssl.SSLContext:
    """TLS settings that trust the certificates in ``ca``. Raises SkylessError if the file cannot be used."""
    try:
        return ssl.create_default_context(cafile=ca)
    except OSError as error:
        reason = "it should hold certificates in PEM form" if isinstance(error, ssl.SSLError) else error.strerror
        raise SkylessError(f"{ca} cannot be used as --mqtt-ca: {reason}") from None


def mqtt_address(url: str, ca: Path | None = None) -> MqttAddress:
    """Parse the URL of one or several brokers; the password may also be in ``SKYLESS_MQTT_PASSWORD``.

    Several are separated by commas: ``mqtts://ann@a,b:8884,c``.

    Raises SkylessError: with what would be right, never showing the password.
    """
    several = re.fullmatch(r"([^:/?#]*://(?:[^/?#]*@)?)([^/?#@]*)(.*)", url, re.DOTALL)
    before, hosts, after = several.groups() if several else ("", url, "")
    first, *others = (_broker(url, f"{before}{host}{after}", ca) for host in hosts.split(","))
    return replace(first, others=tuple((other.host, other.port) for other in others))


def _broker(url: str, single: str, ca: Path | None) -> MqttAddress:
    """Parse a URL with one host; errors show the whole URL."""
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
    return MqttAddress(parts.hostname or "", port or _PORTS[parts.scheme], parts.scheme == "mqtts", user, password, ca)


def _credentials(url: str, parts: SplitResult) -> tuple[str | None, str | None]:
    user = unquote(parts.username) if parts.username else None
    password = unquote(parts.password) if parts.password else None
    if user is None:
        if password is not None:
            raise _wrong(url, "a user's name before the password")
        return None, None
    return user, os.environ.get(PASSWORD_VARIABLE) if password is None else password


def _is_host(host: str | None) -> bool:
    """Whether a host name is well-formed: labels of 1 … 63 characters, without blanks."""
    if not host or re.search(r"[\s\x00-\x1f]", host):
        return False
    return all(0 < len(label) <= 63 for label in host.removesuffix(".").split("."))


def _wrong(url: str, expected: str) -> SkylessError:
    return SkylessError(f"--mqtt is {hide_password(url)!r}; it should be {expected}")


def hide_password(url: str) -> str:
    """Replace the password in a URL by asterisks, however malformed the rest is."""
    return _PASSWORD.sub(r"\1:***@", url)


def is_loopback(host: str) -> bool:
    """Whether a host is this machine."""
    return _LOOPBACK.fullmatch(host) is not None


# Roles at the broker (``docs/mqtt.md``, Roles): permitted topics, and passwords. A private folder has one file for each
# role, ``<role>.env``, which systemd, Docker and the shell can read; each is copied only to the machines of its role.


class Role(StrEnum):
    """Purpose of a client, and its user name; a stranger has none."""

    ANCHORS = "anchors"
    """Anchors, and the emulated air."""
    TAGS = "tags"
    PAGE = "page"
    """Programs that show, record and forward: dashboard, watch, doctor, record, bridge; also Home Assistant itself."""
    SURVEY = "survey"
    """Programs that move anchors: survey, and a dashboard whose users set up the site."""
    OPERATOR = "operator"
    """A person, and programs that are a whole site: the demo, tags in a system without Skyless's anchors."""
    STRANGER = "stranger"
    """A client without user and password, if the operator admits it."""


class Access(Struct, frozen=True):
    """Topic filters permitted to a role."""

    publish: tuple[str, ...]
    subscribe: tuple[str, ...]


EVERYTHING: Final = "#"


def _of(topic: topics.Topic, *kinds: str) -> tuple[str, ...]:
    return tuple(topic(EVERY_SITE, kind, EVERY_NODE) for kind in kinds)


def _all(*chosen: topics.Topic) -> tuple[str, ...]:
    return tuple(topic.everywhere for topic in chosen)


_SHOWN: Final = (
    *_all(topics.request_topic, topics.floor_plan_topic, topics.zones_topic, topics.zone_event_topic),
    *_all(topics.tag_zones_topic, topics.tag_position_topic, topics.assets_topic),
    *_all(topics.alarm_rules_topic, topics.alarm_topic, topics.acknowledge_topic),
)
"""What the page publishes, whether or not its users may set up the site."""

ACCESS: Final = {
    Role.ANCHORS: Access(
        publish=(
            *_all(topics.site_topic, topics.floor_plan_topic, topics.plan_of_floor_topic),
            *_all(topics.stamps_topic, topics.truth_topic),
            *_of(topics.status_topic, "anchor", "ether"),
            *_of(topics.health_topic, "anchor", "ether"),
        ),
        # A node reads its own status, to correct a late last will.
        subscribe=(*_all(topics.request_topic, topics.placement_topic), *_of(topics.status_topic, "anchor", "ether")),
    ),
    Role.TAGS: Access(
        publish=(
            *_all(topics.fix_topic, topics.receptions_topic),
            *_of(topics.status_topic, "tag"),
            *_of(topics.health_topic, "tag"),
        ),
        subscribe=(*_all(topics.request_topic), *_of(topics.status_topic, "tag")),
    ),
    Role.PAGE: Access(
        publish=(
            *_SHOWN,
            *_of(topics.status_topic, "dashboard", "recorder", "history", "bridge", "homeassistant", "watch", "doctor"),
            "homeassistant/device/+/config",
            "homeassistant/status",
        ),
        subscribe=("skyless/#", "homeassistant/#"),
    ),
    Role.SURVEY: Access(
        publish=(
            *_SHOWN,
            *_all(topics.survey_topic, topics.survey_facts_topic, topics.survey_save_topic),
            *_all(topics.placement_topic, topics.watch_topic),
            *_of(topics.status_topic, "dashboard", "survey"),
        ),
        subscribe=("skyless/#",),
    ),
    Role.OPERATOR: Access(publish=(EVERYTHING,), subscribe=(EVERYTHING,)),
    Role.STRANGER: Access(publish=(), subscribe=_all(topics.site_topic, topics.fix_topic)),
}


def may_subscribe(user: str | None, topic_filter: str) -> bool | None:
    """Whether the roles let a user subscribe to a filter; None if unknown, as at a broker without roles."""
    if user is not None and user not in ACCESS:
        return None
    granted = any(topic_matches_sub(one, topic_filter) for one in ACCESS[Role(user or Role.STRANGER)].subscribe)
    return granted or (None if user is None else False)


USERS: Final = tuple(role for role in Role if role is not Role.STRANGER)
"""Roles with a password."""

_PASSWORD_LINE: Final = re.compile(r"[A-Za-z0-9_-]{12,200}")
"""Characters without a meaning to a shell, systemd or nats-server."""
_PLAIN_ADDRESS: Final = re.compile(r"[\w.:@/\[\]-]+", re.ASCII)
_MAX_BYTES: Final = 65_536
_OTHERS: Final = 0o077


def create_access(folder: Path, address: MqttAddress) -> tuple[Path, ...]:
    """Create a folder's missing files with random passwords, keeping existing ones; return their paths.

    Raises SkylessError: none is missing, the address has a user, or the folder cannot be written.
    """
    if address.user is not None or not _PLAIN_ADDRESS.fullmatch(str(address)):
        raise SkylessError(f"--mqtt is {str(address)!r}; it should be the broker's address without a user")
    missing = {role: folder / f"{role}.env" for role in USERS if not os.path.lexists(folder / f"{role}.env")}
    if not missing:
        raise SkylessError(f"{folder} has the files of all roles; one that is to be replaced should be removed first")
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        files = {file: _text(role, replace(address, user=str(role))).encode() for role, file in missing.items()}
        replace_files(files, secret=files)
    return tuple(missing.values())


def _text(role: Role, address: MqttAddress) -> str:
    return (
        f"# Skyless: the role {role} at the MQTT broker (docs/mqtt.md). Only for machines of this role.\n"
        f"SKYLESS_MQTT={address}\n"
        f"{PASSWORD_VARIABLE}={secrets.token_urlsafe(24)}\n"
    )


def read_access(folder: Path) -> Mapping[Role, str]:
    """Read the password of each role.

    Raises SkylessError: a file is missing, is accessible to others than its owner, or has no usable password.
    """
    return {role: _password(folder / f"{role}.env") for role in USERS}


def _password(file: Path) -> str:
    try:
        with file.open("rb") as source:
            mode = os.fstat(source.fileno()).st_mode & 0o777
            text = source.read(_MAX_BYTES).decode(errors="replace")
    except FileNotFoundError:
        raise SkylessError(f"{file} is missing; skyless broker access {file.parent} makes it") from None
    except OSError as error:
        raise SkylessError(f"{file} cannot be read: {error.strerror}") from None
    if mode & _OTHERS:
        raise SkylessError(f"{file} has mode {mode:03o}; only its owner should have access: chmod 600 {file}")
    values = re.findall(rf"^[ \t]*{PASSWORD_VARIABLE}=(.*?)[ \t\r]*$", text, re.MULTILINE)
    if len(values) != 1 or not _PASSWORD_LINE.fullmatch(values[0]):
        raise SkylessError(
            f"{file} should have one line {PASSWORD_VARIABLE}=… with 12 to 200 letters, digits, hyphens and underscores"
        )
    return str(values[0])
