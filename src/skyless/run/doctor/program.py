"""Runs all checks."""

import asyncio
import contextlib
import os
import time
from collections.abc import Callable, Sequence

from msgspec import Struct

from skyless.core.site import NoiseSite, Site
from skyless.radio.serial.serial_radio import SerialRadio
from skyless.run.doctor.board import BoardProbe
from skyless.run.doctor.check import Check
from skyless.run.doctor.host import host_checks
from skyless.run.doctor.site import SiteProbe
from skyless.run.find_site import find_site
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
from skyless.run.process import Log, keep

_FIND_S = 8.0
_REQUEST_S = 1.0


class Examination(Struct, frozen=True):
    """What is to be checked."""

    duration_s: float
    boards: Sequence[SerialRadio] = ()
    broker: MqttAddress | None = None
    site_id: int | None = None
    site: Site | None = None
    """That of a site file."""


async def examine(asked: Examination, log: Log, progress: Callable[[float], None]) -> tuple[Check, ...]:
    """All checks; ``progress`` is called with the seconds that have gone.

    Raises:
        SkylessError: several sites are online, and none is asked for.
    """
    began_s = time.monotonic()
    found = host_checks()
    probes = [BoardProbe(radio, asked.site_id) for radio in asked.boards]
    listening = [asyncio.ensure_future(probe.run(asked.duration_s)) for probe in probes]
    site: SiteProbe | None = None
    link: asyncio.Task[None] | None = None
    try:
        if asked.broker is None:
            found += (Check("broker", "not checked", "No broker was asked for."),)
        elif (number := await _site_number(asked, asked.broker)) is None:
            advice = "Start the broker and the site's programs, or give --mqtt or --mqtt none."
            found += (Check("site", "failed", f"No program of a site is online at {asked.broker}.", advice),)
        else:
            name = f"{os.uname().nodename}-{os.getpid()}"
            site = SiteProbe(Link(asked.broker, name, site=number, kind="doctor"), number, name)
            link = asyncio.ensure_future(keep(site.link, log))
        while (site is not None or probes) and time.monotonic() - began_s < asked.duration_s:
            await asyncio.sleep(min(_REQUEST_S, max(began_s + asked.duration_s - time.monotonic(), 0.0)))
            progress(time.monotonic() - began_s)
            if site is not None:
                site.request()
        noise = asked.site.noise if asked.site is not None else (site and site.noise) or NoiseSite()
        for probe in probes:
            found += probe.checks(noise)
        return found if site is None else (*found, *site.checks(asked.site))
    finally:
        for task in (*listening, *((link,) if link else ())):
            task.cancel()
        await asyncio.gather(*listening, *((link,) if link else ()), return_exceptions=True)


async def _site_number(asked: Examination, broker: MqttAddress) -> int | None:
    if asked.site_id is not None:
        return asked.site_id
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(min(_FIND_S, asked.duration_s)):
            return await find_site(broker)
    return None
