"""Which site a broker carries, for a dashboard or recorder without a configured one."""

import asyncio
import logging
from collections.abc import Callable
from typing import Final

from skyless.mqtt.address import MqttAddress
from skyless.mqtt.connection import Introduction, Reactions, RefusedError, open_connection, trouble_with
from skyless.mqtt.topics import EVERY_SITE, site_topic

_KEEPALIVE_S: Final = 10
_GATHER_S: Final = 0.2
"""Retained messages of several sites come one after the other."""

_RETRY_S: Final = 0.5
_log = logging.getLogger("skyless.dashboard")


async def find_site(address: MqttAddress, on_state: Callable[[bool], None]) -> int:
    """Wait for a site to be on the broker; of several the one with the lowest number.

    ``on_state`` is called with whether the broker is there. A link needs its site from the start, for its last will;
    so this has a connection of its own.
    """
    logged = ""
    while True:
        try:
            sites = await _sites(address, on_state)
        except (OSError, RefusedError) as error:
            sites = set()
            trouble = trouble_with(address, error)
            if trouble != logged:
                logged = trouble
                _log.warning("%s", trouble)
        on_state(False)
        if sites:
            if len(sites) > 1:
                others = ", ".join(str(site) for site in sorted(sites))
                _log.warning("the broker carries the sites %s: the first is used; --site-id chooses", others)
            return min(sites)
        await asyncio.sleep(_RETRY_S)


async def _sites(address: MqttAddress, on_state: Callable[[bool], None]) -> set[int]:
    """Sites whose messages have come before the connection was lost, or a moment after the first."""
    sites: set[int] = set()
    found = asyncio.Event()

    def on_message(topic: str, payload: bytes) -> None:
        number = topic.split("/")[-2]
        if payload and number.isdecimal():
            sites.add(int(number))
            found.set()

    who, react = Introduction("", _KEEPALIVE_S), Reactions(message=on_message)
    connection = await open_connection(address, address.tls_context(), who, react)
    on_state(True)
    connection.subscribe({site_topic(EVERY_SITE): 0})
    waits = [asyncio.create_task(found.wait()), asyncio.create_task(connection.lost.wait())]
    try:
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        if found.is_set():
            await asyncio.sleep(_GATHER_S)
    finally:
        for wait in waits:
            wait.cancel()
        connection.abort("the site is known")
    return sites
