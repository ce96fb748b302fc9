"""The streams of a hub, which take what the sites' own streams have whenever their lines are up."""

import asyncio
import contextlib
from collections import Counter
from typing import TYPE_CHECKING, Final

import msgspec
from nats.errors import Error
from nats.js.api import ExternalStream, StreamConfig, StreamSource

from skyless.core.errors import SkylessError
from skyless.run.gather import subjects
from skyless.run.gather.address import connect, rarely
from skyless.run.gather.node import Summary
from skyless.run.gather.streams import EVENT_BYTES, KEEP_EVENTS_S, KEEP_S, NEWEST_OF_EACH, make_stream
from skyless.run.hub.files import Hub
from skyless.run.process import Log

if TYPE_CHECKING:
    from nats.js import JetStreamContext

_READY_S: Final = 60.0
_RETRY_S: Final = 1.0
_LISTEN_S: Final = 2.5


async def make_hub_streams(stream: "JetStreamContext", hub: Hub, tenant: str) -> None:
    """Make the streams of a tenant, or add sites to those that are there. Raises nats.errors.Error."""
    fixes = {"max_age": KEEP_S, "max_bytes": round(1e9 * hub.fixes_gb)}
    for name, of_site, limits in (
        (subjects.HUB_STATE, subjects.STATE_STREAM, NEWEST_OF_EACH),
        (subjects.HUB_NAMES, subjects.NAMES_STREAM, NEWEST_OF_EACH),
        (subjects.HUB_EVENTS, subjects.EVENT_STREAM, {"max_age": KEEP_EVENTS_S, "max_bytes": 4 * EVENT_BYTES}),
        (subjects.HUB_FIXES, subjects.FIX_STREAM, fixes),
    ):
        sources = [_source(of_site, site) for site in hub.sites[tenant]]
        await make_stream(stream, StreamConfig(name=name, num_replicas=len(hub.nodes), sources=sources, **limits))


def _source(pattern: str, site: int) -> StreamSource:
    api = f"$JS.{subjects.at(subjects.DOMAIN, site)}.API"
    external = ExternalStream(api=api, deliver=subjects.at(subjects.SOURCED, site))
    return StreamSource(name=subjects.at(pattern, site), external=external)


async def make_streams_of(hub: Hub, tenant: str, log: Log) -> dict[int, Summary | None]:
    """Make the streams of a tenant, or extend them. Returns what each site says; None where it is not heard.

    Raises SkylessError: the hub is not ready within a minute.
    """
    address, say = hub.address(tenant), rarely(lambda trouble: log(f"waits for the hub: {trouble}"))
    try:
        async with asyncio.timeout(_READY_S):
            client = await connect(address, "skyless hub", say, Counter())
            while True:
                try:
                    await make_hub_streams(client.jetstream(), hub, tenant)
                    break
                except (Error, TimeoutError) as error:
                    say(str(error) or type(error).__name__)
                await asyncio.sleep(_RETRY_S)
    except TimeoutError:
        raise SkylessError(f"the hub {address} is not ready, or has no room for --fixes-gb {hub.fixes_gb:g}") from None
    async with client:
        heard = await client.subscribe(subjects.at(subjects.SUMMARY, subjects.EVERY))
        await asyncio.sleep(_LISTEN_S)
        messages = [await heard.next_msg() for _ in range(heard.pending_msgs)]
    found = dict[int | None, Summary]()
    for one in messages:
        with contextlib.suppress(msgspec.MsgspecError):
            found[subjects.site_in(one.subject)] = msgspec.json.decode(one.data, type=Summary)
    return {site: found.get(site) for site in hub.sites[tenant]}
