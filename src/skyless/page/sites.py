"""The sites of one broker that pages show, each with its own live state, zones, survey and link to the broker.

A page stays connected to one of them while it is open, so that it cannot mix two sites. A site that nobody looks at is
disconnected some time later, unless it has zones or alarm rules, which are monitored here.
"""

import asyncio
import time
from collections.abc import Callable
from typing import Protocol

from starlette.exceptions import HTTPException

from skyless.page.events import SiteLink
from skyless.page.live import LiveSite
from skyless.run.alarms import MAX_KEPT
from skyless.run.find_site import SiteOnBroker, watch_sites
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.connection import Limits
from skyless.run.mqtt.link import Link
from skyless.run.process import every, together
from skyless.run.web import PAGE as LIMITS


def number_of(asked: str | None) -> int:
    """Parse the number of a site in a request; -1 if it is none."""
    return int(asked) if asked and asked.isascii() and asked.isdecimal() and len(asked) < 6 else -1


async def connected(link: SiteLink, live: LiveSite) -> None:
    """Keep a site connected until cancelled, possibly before it has begun."""
    await together(link.run(), live.run())


class Sites(Protocol):
    """The sites of a broker, or of a hub, for pages."""

    @property
    def all(self) -> list[LiveSite]:
        """The connected sites."""

    def of(self, asked: str | None) -> LiveSite:
        """The site with a number. Raises HTTPException."""


class LiveSites:
    """The sites shown: the named one, or any site of the broker that a page asks for."""

    def __init__(self, first: LiveSite, make: Callable[[], LiveSite] | None = None) -> None:
        """``first``: state of the first site; ``make`` creates the state of another."""
        self._first, self._make = first, make
        self._by_number: dict[int, LiveSite] = {}
        self._asked_s: dict[int, float] = {}
        self._work: dict[int, asyncio.Task[None] | None] = {}
        """Tasks that keep the sites connected."""
        self._on_broker: dict[int, SiteOnBroker] = {}
        self._default: int | None = None
        self._connect: Callable[[LiveSite, int], asyncio.Task[None] | None] = lambda _live, _number: None

    @property
    def all(self) -> list[LiveSite]:
        """The connected sites, and the first."""
        return [self._first, *(live for live in self._by_number.values() if live is not self._first)]

    def of(self, asked: str | None) -> LiveSite:
        """The site with a number, or without a number an active site. Raises HTTPException."""
        if not asked:
            return self._usual()
        number = number_of(asked)
        if number not in self._by_number and (number not in self._on_broker or self._make is None):
            raise HTTPException(404, f"site is {asked[:20]!r}; this broker has no such site, or it is not shown here")
        if number not in self._by_number and len(self._by_number) >= LIMITS.sites:
            raise HTTPException(503, f"{LIMITS.sites} sites are shown; those that nobody looks at are let go later")
        return self._shown(number)

    def _usual(self) -> LiveSite:
        """The default site, replaced by another one if only that is active."""
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
            self._work[number] = self._connect(live, number)
            self._report(live)
        self._asked_s[number] = time.monotonic()
        return live

    def let_go(self) -> None:
        """Disconnect sites that nobody has requested for a while, except the first."""
        now_s = time.monotonic()
        for number, live in list(self._by_number.items()):
            if live.pages or live.streams or live.monitor.zones or live.alarms.rules or live is self._first:
                self._asked_s[number] = now_s
            elif now_s - self._asked_s[number] > LIMITS.site_idle_s:
                del self._by_number[number]
                if (work := self._work.pop(number)) is not None:
                    work.cancel()

    def on_sites(self, sites: list[SiteOnBroker]) -> None:
        """Update the broker's sites. Without a default site, the first active one becomes it."""
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

            def connect(live: LiveSite, number: int) -> asyncio.Task[None]:
                link = Link(address, live.name, site=number, kind="dashboard", limits=Limits(topics=2 * MAX_KEPT))
                link.on_state.append(live.on_connection)
                live.attach(link, number)
                return tasks.create_task(link.run() if live is self._first else connected(link, live))

            self._connect = connect
            tasks.create_task(self._first.run())
            tasks.create_task(every(1.0, self.let_go))
            if site_id is None:
                await watch_sites(address, self.on_sites, self._on_broker_state)
            else:
                self._default = site_id
                self._shown(site_id)

    def _on_broker_state(self, connected: bool) -> None:
        """Pass on the connection's state while no site is shown, whose link would do that."""
        if self._default is None:
            self._first.on_connection(connected)
