"""The sites at a hub that pages show: each is connected while somebody looks at it, and some time longer."""

import asyncio
import time
from collections.abc import Callable
from typing import Final

from msgspec import Struct
from starlette.exceptions import HTTPException

from skyless.page.live import LiveSite
from skyless.page.sites import connected, number_of
from skyless.run.gather.subjects import NatsAddress
from skyless.run.hub import HubLink, HubSites

LET_GO_S: Final = 60.0
"""Time after the last look until a site is disconnected, as health messages of all its tags use its line."""

_CHECK_S: Final = 1.0


class _Shown(Struct):
    live: LiveSite
    work: asyncio.Task[None]
    asked_s: float


class ShownSites:
    """Replacement of ``LiveSites`` at a hub."""

    def __init__(self, address: NatsAddress, name: str, make: Callable[[], LiveSite]) -> None:
        """``name``: shown at the hub; ``make`` creates the state of a site."""
        self.known = HubSites(address, time.monotonic())
        self._name, self._make = name, make
        self._shown: dict[int, _Shown] = {}
        self._tasks: asyncio.TaskGroup

    @property
    def all(self) -> list[LiveSite]:
        """The connected sites."""
        return [shown.live for shown in self._shown.values()]

    def has(self, asked: str | None) -> bool:
        """Whether this is the number of a site."""
        return number_of(asked) in self.known.names()

    def of(self, asked: str | None) -> LiveSite:
        """The site with a number, which is connected if need be. Raises HTTPException."""
        if not self.has(asked):
            right = "the number of a site at this hub, as in /api/sites"
            raise HTTPException(404, f"site is {(asked or '')[:20]!r}; it should be {right}")
        number = number_of(asked)
        if number not in self._shown:
            link, live = HubLink(self.known.address, number, self._name), self._make()
            live.attach(link, number)
            link.on_state.append(live.on_connection)
            self._shown[number] = _Shown(live, self._tasks.create_task(connected(link, live)), 0.0)
        self._shown[number].asked_s = time.monotonic()
        return self._shown[number].live

    async def run(self) -> None:
        """Stay connected until cancelled."""
        async with asyncio.TaskGroup() as self._tasks:
            self._tasks.create_task(self.known.run(self._name))
            while True:
                await asyncio.sleep(_CHECK_S)
                now_s = time.monotonic()
                for number, shown in list(self._shown.items()):
                    if shown.live.pages or shown.live.streams:
                        shown.asked_s = now_s
                    elif now_s - shown.asked_s > LET_GO_S:
                        shown.work.cancel()
                        del self._shown[number]
