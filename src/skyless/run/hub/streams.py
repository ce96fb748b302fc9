"""The streams of a hub, which take what the sites' own streams have whenever their lines are up.

Each site has its own, so that none can push out what another has sent. A source asks for the subjects of its site,
which the site's server may ignore: so readers ask the hub for those subjects again, and take the site from the stream.
"""

import asyncio
import contextlib
import json
import re
from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import msgspec
from nats.errors import Error
from nats.js.api import ExternalStream, StreamConfig, StreamSource
from nats.js.errors import NotFoundError

from skyless.core.errors import SkylessError
from skyless.run.gather import subjects
from skyless.run.gather.address import connect, rarely
from skyless.run.gather.node import Summary
from skyless.run.gather.streams import EVENT_BYTES, KEEP_EVENTS_S, KEEP_S, NEWEST_OF_EACH, make_stream
from skyless.run.hub.files import Hub
from skyless.run.process import Log

if TYPE_CHECKING:
    from nats.aio.client import Client

_READY_S: Final = 60.0
_RETRY_S: Final = 1.0
_LISTEN_S: Final = 2.5
_NAMES_BYTES: Final = 30_000_000
_STATE_BYTES: Final = 100_000_000
"""What a site can store at most: names of 200,000 tags; floor plans, and statuses of as many programs."""
_OF_ALL_SITES: Final = ("FIXES", "NAMES", "STATE", "EVENTS")
"""Streams of earlier hubs, in which each site could write as another."""


async def make_hub_streams(client: "Client", hub: Hub, tenant: str) -> None:
    """Make the streams of a tenant, or change those that are there. Raises nats.errors.Error."""
    stream, sites = client.jetstream(), hub.sites[tenant]
    for name in _OF_ALL_SITES:
        with contextlib.suppress(NotFoundError):
            await stream.delete_stream(name)
    share = 1.0 / max(1, len(sites))
    of_each: tuple[tuple[int, str, dict[str, Any]], ...] = (
        (1, subjects.STATE_STREAM, NEWEST_OF_EACH | {"max_bytes": _STATE_BYTES}),
        (2, subjects.NAMES_STREAM, NEWEST_OF_EACH | {"max_bytes": _NAMES_BYTES}),
        (1, subjects.EVENT_STREAM, {"max_age": KEEP_EVENTS_S, "max_bytes": round(4 * EVENT_BYTES * share)}),
        (2, subjects.FIX_STREAM, {"max_age": KEEP_S, "max_bytes": round(1e9 * hub.fixes_gb * share)}),
    )
    there = await sites_at(client)
    for site in sorted(sites, key=lambda site: site not in there):  # those that are there make room first
        api, deliver = f"$JS.{subjects.at(subjects.DOMAIN, site)}.API", subjects.at(subjects.SOURCED, site)
        for version, pattern, limits in of_each:
            name, own = subjects.at(pattern, site), f"skyless.v{version}.{site}.>"
            source = StreamSource(name=name, filter_subject=own, external=ExternalStream(api=api, deliver=deliver))
            config = StreamConfig(name=name, num_replicas=len(hub.nodes), sources=[source], **limits)
            await make_stream(stream, config)


async def sites_at(client: "Client") -> set[int]:
    """The sites of a tenant that have streams at its hub. Raises nats.errors.Error."""
    found, total = set[str](), 1
    while len(found) < total:
        answer = await client.request("$JS.API.STREAM.NAMES", json.dumps({"offset": len(found)}).encode())
        page = json.loads(answer.data)
        names, total = page.get("streams") or (), page.get("total", 0)
        if not names:
            break
        found.update(names)
    prefix = subjects.at(subjects.STATE_STREAM, "")
    return {int(name.removeprefix(prefix)) for name in found if re.fullmatch(rf"{prefix}\d{{1,5}}", name)}


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
                    await make_hub_streams(client, hub, tenant)
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
