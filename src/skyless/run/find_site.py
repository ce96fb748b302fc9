"""Find the sites on a broker, and how many of their programs are online; choose one if none is named.

A broker keeps the last state of every site that ever ran on it. A site counts as alive while an anchor, a tag or the
emulated air of its own states that it is online. Programs that only observe a site do not count.
"""

import asyncio
import contextlib
import logging
from collections import Counter
from collections.abc import Callable
from typing import Final

from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.connection import Introduction, Reactions, RefusedError, open_connection, trouble_with
from skyless.run.mqtt.messages import StatusMessage, WrongMessageError, read_message
from skyless.run.mqtt.topics import EVERY_NODE, EVERY_SITE, site_topic, status_topic
from skyless.run.process import outlasting

_KEEPALIVE_S: Final = 10
_RETRY_S: Final = 0.5
_GATHER_S: Final = 0.25  # retained messages come one after the other: if none comes for this time, all have come

_LONGEST_GATHER_S: Final = 3.0  # sites whose programs come and go all the time are reported after this time

_NAMED: Final = 5
"""How many sites an error lists."""
_KINDS: Final = ("anchor", "tag", "ether")
_log = logging.getLogger("skyless.run")


class SiteOnBroker(Struct, frozen=True):
    """A site on a broker."""

    number: int
    name: str
    online: int
    """Number of its programs that are online."""
    versions: dict[str, int] = {}
    """Number of online programs by version."""


class KnownSites:
    """The sites on a broker, collected from its messages. No I/O."""

    def __init__(self) -> None:
        self._names: dict[int, str] = {}
        self._online: dict[int, dict[str, str]] = {}
        """Status topics and versions of programs that are online, by site."""

    def add(self, topic: str, payload: bytes) -> None:
        """Process a message of a site or a program's status. Unreadable ones are ignored."""
        levels = topic.split("/")
        if not levels[2].isdecimal():
            return
        number = int(levels[2])
        with contextlib.suppress(WrongMessageError):
            if levels[-1] != "site":
                programs = self._online.setdefault(number, {})
                programs.pop(topic, None)
                if payload and (status := read_message(payload, StatusMessage)).online:
                    programs[topic] = status.version
            elif payload:
                self._names[number] = read_message(payload, _SiteMessage).site.name
            else:
                self._names.pop(number, None)

    def sites(self) -> list[SiteOnBroker]:
        """Return the sites, by number."""
        found = []
        for number, name in sorted(self._names.items()):
            versions = Counter(self._online.get(number, {}).values())
            found.append(SiteOnBroker(number, name, versions.total(), dict(versions)))
        return found


class _Named(Struct):
    """The part of a site that is read here."""

    name: str


class _SiteMessage(Struct):
    """The part of ``SiteMessage`` that is read here."""

    site: _Named


async def find_site(address: MqttAddress) -> int:
    """Wait for a site that is alive, and return its number. Raises SkylessError if there are several, naming them."""
    found: asyncio.Future[list[SiteOnBroker]] = asyncio.get_running_loop().create_future()
    logged = ""

    def on_sites(sites: list[SiteOnBroker]) -> None:
        nonlocal logged
        alive = [site for site in sites if site.online]
        if alive and not found.done():
            found.set_result(alive)
        elif sites and not alive:
            words = "; ".join(f"site {s.number} {s.name!r} was here, but none of its programs is online" for s in sites)
            if words != logged:
                logged = words
                _log.warning("%s; waiting for a site", words)

    async def first() -> None:
        await found

    await outlasting(watch_sites(address, on_sites), first())
    alive = found.result()
    if len(alive) > 1:
        named = "; ".join(
            f"number {site.number}, {site.name!r}, {site.online} program{'s' if site.online > 1 else ''} online"
            for site in alive[:_NAMED]
        )
        named += f"; and {len(alive) - _NAMED} more" if len(alive) > _NAMED else ""
        raise SkylessError(
            f"the broker {address} carries {len(alive)} sites ({named}); --site-id should name one of them"
        )
    return alive[0].number


async def watch_sites(
    address: MqttAddress,
    on_sites: Callable[[list[SiteOnBroker]], None],
    on_state: Callable[[bool], None] = lambda _: None,
) -> None:
    """Call ``on_sites`` with the sites whenever they change, until cancelled.

    ``on_state`` is called with True when the broker is connected, and with False when it is lost. A ``Link`` needs its
    site from the start, for its last will, so this function has a connection of its own.
    """
    logged = ""
    while True:
        try:
            await _watch_connected(address, on_sites, on_state)
        except (OSError, RefusedError) as error:
            trouble = trouble_with(address, error)
            if trouble != logged:
                logged = trouble
                _log.warning("%s", trouble)
        on_state(False)
        await asyncio.sleep(_RETRY_S)


async def _watch_connected(
    address: MqttAddress, on_sites: Callable[[list[SiteOnBroker]], None], on_state: Callable[[bool], None]
) -> None:
    known = KnownSites()
    who, react = Introduction("", _KEEPALIVE_S), Reactions(message=known.add)
    connection = await open_connection(address, address.tls_context(), who, react)
    try:
        on_state(True)
        statuses = [status_topic(EVERY_SITE, kind, EVERY_NODE) for kind in _KINDS]
        connection.subscribe(dict.fromkeys((site_topic(EVERY_SITE), *statuses), 0))
        reported: list[SiteOnBroker] | None = None
        before: list[SiteOnBroker] = []
        waited_s = 0.0
        while not connection.lost.is_set():
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_GATHER_S):
                    await connection.lost.wait()
            waited_s += _GATHER_S
            sites = known.sites()
            if sites == reported:
                waited_s = 0.0
            elif sites == before or waited_s >= _LONGEST_GATHER_S:
                reported, waited_s = sites, 0.0
                on_sites(sites)
            before = sites
    finally:
        connection.abort("sites are not watched any more")
