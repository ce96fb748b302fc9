"""What all programs of a site share: tasks that stand and fall together, and something once a second."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, Final

from skyless.mqtt.address import MqttAddress
from skyless.mqtt.link import Link

HEALTH_S: Final = 1.0

Log = Callable[[str], None]
"""Takes one line for a person."""


class AskedAgain:
    """An answer that holds until something has happened again."""

    def __init__(self, ask: Callable[[], bool]) -> None:
        self._ask = ask
        self._times: int | None = None
        self._answer = False

    def at(self, times: int) -> bool:
        """The answer when it has happened so many times."""
        if times != self._times:
            self._times, self._answer = times, self._ask()
        return self._answer


async def together(*parts: Coroutine[Any, Any, None]) -> None:
    """Run until one part fails or all are cancelled; a failure cancels the others and is raised as itself."""
    tasks = [asyncio.ensure_future(part) for part in parts]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def every(seconds: float, act: Callable[[], None]) -> None:
    """Do something once in so many seconds, for ever."""
    while True:
        await asyncio.sleep(seconds)
        act()


def link_of(address: MqttAddress | None, name: int | str, *, site: int, kind: str) -> Link | None:
    """The node's connection to the broker; None without one."""
    return None if address is None else Link(address, name, site=site, kind=kind)


async def keep(link: Link, say: Log) -> None:
    """Run a link for ever: a fault in it is told, and costs neither a fix nor a beacon."""
    while True:
        try:
            await link.run()
        except Exception as error:  # noqa: BLE001 - whatever it is, positioning goes on
            say(f"the link to {link.address} failed ({error!r}); started again")
        await asyncio.sleep(HEALTH_S)


async def outlasting(lasting: Coroutine[Any, Any, None], others: Coroutine[Any, Any, None]) -> None:
    """Run both until one ends or all is cancelled; ``lasting`` is cancelled when the others have ended."""
    last, first = asyncio.ensure_future(lasting), asyncio.ensure_future(others)
    try:
        done, _ = await asyncio.wait((last, first), return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in (first, last):
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
