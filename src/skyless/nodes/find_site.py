"""Which sites a broker carries, and how many of their programs are online: to choose one where none is named.

A broker keeps the last state of every site that ever ran on it. A site counts as alive while a program of its own, an
anchor, a tag or the emulated air, states that it is online. Programs that only observe a site do not count.
"""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterable
from typing import Final

from msgspec import Struct

from skyless.errors import SkylessError
from skyless.mqtt.address import MqttAddress
from skyless.mqtt.connection import Introduction, Reactions, RefusedError, open_connection, trouble_with
from skyless.mqtt.messages import StatusMessage, WrongMessageError, read_message
from skyless.mqtt.topics import EVERY_NODE, EVERY_SITE, site_topic, status_topic

_KEEPALIVE_S: Final = 10
_RETRY_S: Final = 0.5
_GATHER_S: Final = 0.25
"""Retained messages come one after the other: after this time without any, all have come."""

_LONGEST_GATHER_S: Final = 3.0
"""Sites whose programs come and go all the time are reported after this time."""

_MAX_PROGRAMS: Final = 200_000
"""Programs that are counted; a broker that invents names cannot fill the memory."""

_KINDS: Final = ("anchor", "tag", "ether")
_log = logging.getLogger("skyless.nodes")


class SiteOnBroker(Struct, frozen=True):
    """A site that a broker carries."""

    number: int
    name: str
    online: int
    """How many of its programs are online."""


class KnownSites:
    """The sites of a broker, gathered from its messages. No I/O."""

    def __init__(self) -> None:
        self.changes = 0
        """Counts messages that have changed something."""
        self._names: dict[int, str] = {}
        self._online: dict[int, set[str]] = {}
        self._programs = 0

    def add(self, topic: str, payload: bytes) -> None:
        """A message of a site or of a program's status; one that cannot be read changes nothing."""
        levels = topic.split("/")
        number = levels[2]
        if not number.isdecimal():
            return
        try:
            if levels[-1] == "site":
                self._set_name(int(number), read_message(payload, _SiteMessage).site.name if payload else None)
            else:
                online = bool(payload) and read_message(payload, StatusMessage).online
                self._set_online(int(number), topic, online=online)
        except WrongMessageError:
            pass

    def _set_name(self, number: int, name: str | None) -> None:
        if name == self._names.get(number):
            return
        self.changes += 1
        if name is None:
            del self._names[number]
        elif number in self._names or len(self._names) < _MAX_PROGRAMS:
            self._names[number] = name

    def _set_online(self, number: int, topic: str, *, online: bool) -> None:
        programs = self._online.setdefault(number, set()) if online else self._online.get(number, set())
        if online == (topic in programs) or (online and self._programs >= _MAX_PROGRAMS):
            return
        self.changes += 1
        self._programs += 1 if online else -1
        (programs.add if online else programs.discard)(topic)

    def sites(self) -> list[SiteOnBroker]:
        """The sites, by number."""
        return [
            SiteOnBroker(number, name, len(self._online.get(number, ())))
            for number, name in sorted(self._names.items())
        ]


class _Named(Struct):
    """The part of a site that is read here."""

    name: str


class _SiteMessage(Struct):
    """The part of ``SiteMessage`` that is read here."""

    site: _Named


async def find_site(address: MqttAddress) -> int:
    """Wait for a site that is alive.

    Raises:
        SkylessError: several are; the message names them.
    """
    found: asyncio.Future[list[SiteOnBroker]] = asyncio.get_running_loop().create_future()
    logged = ""

    def on_sites(sites: list[SiteOnBroker]) -> None:
        nonlocal logged
        alive = [site for site in sites if site.online]
        if alive and not found.done():
            found.set_result(alive)
        elif sites and not alive and (words := _gone(sites)) != logged:
            logged = words
            _log.warning("%s; waiting for a site", words)

    watching = asyncio.create_task(watch_sites(address, on_sites))
    try:
        await asyncio.wait((found, watching), return_when=asyncio.FIRST_COMPLETED)
        if watching.done():
            watching.result()
        alive = found.result()
    finally:
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)
    if len(alive) > 1:
        named = "; ".join(f"number {site.number}, {site.name!r}, {_programs(site.online)} online" for site in alive)
        raise SkylessError(
            f"the broker {address} carries {len(alive)} sites ({named}); --site-id should name one of them"
        )
    return alive[0].number


def _gone(sites: Iterable[SiteOnBroker]) -> str:
    return "; ".join(f"site {site.number} {site.name!r} was here, but none of its programs is online" for site in sites)


def _programs(number: int) -> str:
    return "1 program" if number == 1 else f"{number} programs"


async def watch_sites(
    address: MqttAddress,
    on_sites: Callable[[list[SiteOnBroker]], None],
    on_state: Callable[[bool], None] = lambda _: None,
) -> None:
    """Call ``on_sites`` with the sites whenever these have changed, until cancelled.

    ``on_state`` is called with whether the broker is there. A link needs its site from the start, for its last will;
    so this has a connection of its own.
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
    """Until the connection is lost."""
    known = KnownSites()
    who, react = Introduction("", _KEEPALIVE_S), Reactions(message=known.add)
    connection = await open_connection(address, address.tls_context(), who, react)
    try:
        on_state(True)
        statuses = [status_topic(EVERY_SITE, kind, EVERY_NODE) for kind in _KINDS]
        connection.subscribe(dict.fromkeys((site_topic(EVERY_SITE), *statuses), 0))
        reported, before, waited_s = -1, 0, 0.0
        while not connection.lost.is_set():
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_GATHER_S):
                    await connection.lost.wait()
            waited_s += _GATHER_S
            if known.changes == reported:
                waited_s = 0.0
            elif known.changes == before or waited_s >= _LONGEST_GATHER_S:
                reported, waited_s = known.changes, 0.0
                on_sites(known.sites())
            before = known.changes
    finally:
        connection.abort("sites are not watched any more")
