"""Making the streams of a hub once its servers run, and asking which sites are heard there."""

import asyncio
from collections import Counter
from typing import Final

import msgspec
from nats.errors import Error
from nats.js.errors import APIError

from skyless.core.errors import SkylessError
from skyless.run.gather import subjects
from skyless.run.gather.address import connect, rarely
from skyless.run.gather.node import Summary
from skyless.run.gather.streams import NO_ROOM
from skyless.run.hub.files import Hub
from skyless.run.hub.streams import HubLimits, make_hub_streams
from skyless.run.process import Log

_READY_S: Final = 60.0
_RETRY_S: Final = 1.0
_LISTEN_S: Final = 2.5


async def apply(hub: Hub, tenant: str, log: Log) -> dict[int, Summary | None]:
    """Make the streams of a tenant, or extend them. Returns what each site says; None where it is not heard.

    Raises:
        SkylessError: the hub is not ready within a minute, or has no room.
    """
    address, trouble = hub.address(tenant), ["no answer"]
    sites = hub.tenants[tenant].sites
    limits = HubLimits(replicas=len(hub.nodes), fix_bytes=round(1e9 * hub.fixes_gb))
    say = rarely(log)

    def wait_for(reason: str) -> None:
        trouble[0] = reason
        say(f"waits for the hub: {reason}")

    try:
        async with asyncio.timeout(_READY_S), await connect(address, "skyless hub", wait_for, Counter()) as client:
            while True:
                try:
                    await make_hub_streams(client.jetstream(), sites, limits)
                    break
                except APIError as error:
                    if error.err_code == NO_ROOM:
                        right = f"less than what is free at each server: {error.description}"
                        raise SkylessError(f"--fixes-gb is {hub.fixes_gb:g}; it should be {right}") from None
                    wait_for(error.description or str(error))
                except (Error, TimeoutError) as error:
                    wait_for(str(error) or type(error).__name__)
                await asyncio.sleep(_RETRY_S)
            heard = await client.subscribe(subjects.at(subjects.SUMMARY, subjects.EVERY))
            await asyncio.sleep(_LISTEN_S)
            found: dict[int, Summary | None] = dict.fromkeys(sites)
            while heard.pending_msgs:
                message = await heard.next_msg()
                site = subjects.site_in(message.subject)
                if site in found:
                    found[site] = msgspec.json.decode(message.data, type=Summary)
            return found
    except TimeoutError:
        raise SkylessError(f"the hub {address} is not ready after {_READY_S:.0f} s: {trouble[0]}") from None
