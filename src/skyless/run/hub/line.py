"""A site's line to the hub: whether it is up, and whether another site has the same number there."""

import asyncio
import contextlib
import re
import time
from collections import Counter
from typing import Final

import msgspec
from nats.errors import Error

from skyless.core.errors import SkylessError
from skyless.run.broker import Broker
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect, rarely
from skyless.run.gather.node import Summary
from skyless.run.hub.leaf import Leaf, StuckLineError
from skyless.run.process import Log

_CHECK_S: Final = 2.0
_SILENT_CHECKS: Final = 3
_STUCK_S: Final = 300.0
_UP: Final = "Leafnode connection created"


async def watch_line(leaf: Leaf, broker: Broker, log: Log) -> None:
    """Log when the line is lost and when it is back, until cancelled. Raises StuckLineError.

    The log of nats-server names every try. A line that the hub refuses, or where it does not answer,
    is up for a moment.
    """
    newest, said, unsteady, tried_s = "", "", 0, time.monotonic()
    while True:
        await asyncio.sleep(_CHECK_S)
        text = (broker.data / "nats-server.log").read_text(encoding="utf-8", errors="replace")
        found = re.findall(rf"^\[{broker.pid}\] (.*leaf.*)$", text, re.MULTILINE | re.IGNORECASE)
        before, newest = newest, found[-1] if found else newest
        newest_lines = found[-3:]
        faults = [line for line in newest_lines if "[ERR]" in line]
        if not faults and unsteady >= _SILENT_CHECKS:  # the hub takes connections, and nothing comes back
            faults = [line for line in newest_lines if _UP not in line]
        is_up = _UP in newest
        unsteady = 0 if is_up and newest == before else unsteady + 1
        state = ""
        if not unsteady:
            state = f"the line to the hub is up, as site {leaf.site} of {leaf.tenant}"
        elif faults:
            state = f"no line to the hub; the site works on without it: {faults[-1].partition('] ')[2]}"
        kind = re.sub(r"\d+", "", state.rpartition(": ")[2])  # the same at every try
        if state and kind != said:
            said = kind
            log(state)
        if is_up or newest != before:
            tried_s = time.monotonic()
        elif time.monotonic() > tried_s + _STUCK_S:
            raise StuckLineError


async def refuse_second(leaf: Leaf, address: NatsAddress, log: Log) -> None:
    """Watch that no other site with this number was at the hub before this one. Raises SkylessError."""
    own = ""
    async with await connect(address, "skyless broker", rarely(log), Counter()) as client:
        heard = await client.subscribe(subjects.at(subjects.SUMMARY, leaf.site))
        async for message in heard.messages:
            with contextlib.suppress(Error, msgspec.DecodeError):
                stream = subjects.at(subjects.FIX_STREAM, leaf.site)
                own = own or str((await client.jetstream().stream_info(stream)).created)
                other = msgspec.json.decode(message.data, type=Summary)
                if other.since and other.since < own:
                    raise SkylessError(
                        f"--hub is of site {leaf.site}, which is already at this hub: {other.site!r}, gathered at host "
                        f"{other.host}; give this site another number"
                    )
