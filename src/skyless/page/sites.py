"""The sites of one broker that pages show: each has its own live state, zones, survey and link to the broker.

A page is connected to one of them for as long as it is open, so that it cannot mix two sites.
"""

import asyncio
from collections.abc import Callable
from typing import Protocol

from starlette.exceptions import HTTPException

from skyless.page.live import LiveSite
from skyless.run.alarms.engine import MAX_KEPT
from skyless.run.find_site import SiteOnBroker, watch_sites
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.outbox import Limits


def number_of(asked: str | None) -> int:
    """The number of a site in a request, or -1 where it is none."""
    return int(asked) if asked and asked.isascii() and asked.isdecimal() and len(asked) < 6 else -1


class Sites(Protocol):
    """The sites that pages are shown: of a broker, or of a hub."""

    @property
    def all(self) -> list[LiveSite]:
        """Those that are connected."""

    def of(self, asked: str | None) -> LiveSite:
        """The site of a number. Raises HTTPException."""


class LiveSites:
    """The sites that are shown: the named one, or any site of the broker that a page asks for."""

    def __init__(self, first: LiveSite, make: Callable[[], LiveSite] | None = None) -> None:
        """``first`` is connected to the first site, and ``make`` returns the state of another."""
        self._first, self._make = first, make
        self._by_number: dict[int, LiveSite] = {}
        self._on_broker: dict[int, SiteOnBroker] = {}
        self._default: int | None = None
        self._connect: Callable[[LiveSite, int], None] = lambda _live, _number: None

    @property
    def all(self) -> list[LiveSite]:
        """The sites that are connected, and the first."""
        return [self._first, *(live for live in self._by_number.values() if live is not self._first)]

    def of(self, asked: str | None) -> LiveSite:
        """The site of a number, or without a number a site that is alive. Raises HTTPException."""
        if not asked:
            return self._usual()
        number = number_of(asked)
        if number not in self._by_number and (number not in self._on_broker or self._make is None):
            raise HTTPException(404, f"site is {asked[:20]!r}; this broker has no such site, or it is not shown here")
        return self._shown(number)

    def _usual(self) -> LiveSite:
        """The site last shown for as long as it is alive, or no other is."""
        if self._default is None:
            return self._first
        alive = self._alive()
        if alive and self._default not in alive:
            self._default = alive[0]
        return self._shown(self._default)

    def _alive(self) -> list[int]:
        return [number for number, site in self._on_broker.items() if site.online]

    def _shown(self, number: int) -> LiveSite:
        live = self._by_number.get(number)
        if live is None:
            is_first = number == self._default and self._first not in self._by_number.values()
            live = self._first if is_first or self._make is None else self._make()
            self._by_number[number] = live
            self._connect(live, number)
            self._report(live)
        return live

    def on_sites(self, sites: list[SiteOnBroker]) -> None:
        """The sites of the broker have changed. The first site that is alive is shown from now on."""
        self._on_broker = {site.number: site for site in sites}
        if self._default is None and (alive := self._alive()):
            self._default = alive[0]
            self._shown(self._default)
        for live in self.all:
            self._report(live)

    def _report(self, live: LiveSite) -> None:
        live.set_sites([(site.number, site.name, site.online > 0) for site in self._on_broker.values()])

    async def run(self, address: MqttAddress, site_id: int | None) -> None:
        """Stay connected to the named site, or to the sites that pages ask for, until cancelled."""
        async with asyncio.TaskGroup() as tasks:

            def connect(live: LiveSite, number: int) -> None:
                link = Link(address, live.name, site=number, kind="dashboard", limits=Limits(topics=2 * MAX_KEPT))
                link.on_state.append(live.on_connection)
                live.attach(link, number)
                tasks.create_task(link.run())
                if live is not self._first:
                    tasks.create_task(live.run())

            self._connect = connect
            tasks.create_task(self._first.run())
            if site_id is None:
                await watch_sites(address, self.on_sites, self._on_broker_state)
            else:
                self._default = site_id
                self._shown(site_id)

    def _on_broker_state(self, connected: bool) -> None:
        """While no site is shown, no link states it."""
        if self._default is None:
            self._first.on_connection(connected)
