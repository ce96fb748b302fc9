"""A site's line to the hub: whether it is up, and whether another site has the same number there."""

import asyncio
import contextlib
import json
import re
import time
import urllib.request
from collections import Counter
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import msgspec
from nats.errors import Error

from skyless.core.errors import SkylessError
from skyless.run.broker import Broker
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect, rarely
from skyless.run.gather.node import Summary, since
from skyless.run.hub.leaf import Leaf, StuckLineError
from skyless.run.process import Log

_CHECK_S: Final = 2.0
_ANSWER_S: Final = 2.0
_PATIENT_CHECKS: Final = 2
"""A line that is cut counts as lost at this check in a row: by then the log of nats-server says why."""
_STUCK_S: Final = 300.0
_LOG_BYTES: Final = 65_536


async def watch_line(leaf: Leaf, broker: Broker, log: Log) -> None:
    """Log when the line is lost and when it is back, until cancelled. Raises StuckLineError."""
    said, failed, newest, tried_s = "", 0, "", time.monotonic()
    while True:
        await asyncio.sleep(_CHECK_S)
        if await asyncio.to_thread(_is_up, broker.monitor):
            failed, tried_s = 0, time.monotonic()
            if said != "up":
                said = "up"
                log(f"the line to the hub is up, as site {leaf.site} of {leaf.tenant}")
            continue
        failed += 1
        found = await asyncio.to_thread(_newest_try, broker.log, broker.pid)
        if found != newest:
            newest, tried_s = found, time.monotonic()
        reason = newest.partition("] ")[2] or "nobody answers"
        kind = re.sub(r"\d+", "", reason.rpartition(": ")[2])
        if failed >= _PATIENT_CHECKS and kind != said:
            said = kind
            log(f"no line to the hub; the site works on without it: {reason}")
        if time.monotonic() > tried_s + _STUCK_S and await _answers(leaf):
            raise StuckLineError


def _is_up(monitor: str | None) -> bool:
    with (
        contextlib.suppress(OSError, ValueError),
        urllib.request.urlopen(f"{monitor}/leafz", timeout=_ANSWER_S) as page,
    ):
        return bool(json.load(page)["leafnodes"])
    return False


def _newest_try(server_log: Path, pid: int) -> str:
    """The newest line of a running nats-server's log that says why there is no line to the hub, from its kind on."""
    with contextlib.suppress(OSError), server_log.open("rb") as file:
        file.seek(max(0, server_log.stat().st_size - _LOG_BYTES))
        text = file.read().decode(errors="replace")
        lines = re.findall(rf"^\[{pid}\] (.*\[ERR\] .*leaf.*)$", text, re.MULTILINE | re.IGNORECASE)
        return str(lines[-1]) if lines else ""
    return ""


async def _answers(leaf: Leaf) -> bool:
    """Whether a port of the hub takes connections."""
    for url in map(urlsplit, leaf.urls):
        with contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(_ANSWER_S):
                _, writer = await asyncio.open_connection(url.hostname, url.port)
            writer.close()
            return True
    return False


async def refuse_second(leaf: Leaf, address: NatsAddress, log: Log) -> None:
    """Watch that no other site with this number was at the hub before this one. Raises SkylessError."""
    client = await connect(address, "skyless broker", rarely(log), Counter())
    try:
        heard = await client.subscribe(subjects.at(subjects.SUMMARY, leaf.site))
        own = ""
        async for message in heard.messages:
            with contextlib.suppress(Error, msgspec.DecodeError):
                own = own or await since(client.jetstream(), leaf.site)
                other = msgspec.json.decode(message.data, type=Summary)
                if other.since and other.since < own:
                    raise SkylessError(
                        f"--hub is of site {leaf.site}, which is already at this hub: {other.site!r}, gathered at host "
                        f"{other.host}; give this site another number"
                    )
    finally:
        await client.close()
