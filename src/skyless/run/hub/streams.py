"""The streams of a hub, which take what the sites' own streams have whenever their lines are up."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

from msgspec import Struct
from nats.js.api import ExternalStream, StreamConfig, StreamSource

from skyless.run.gather import subjects
from skyless.run.gather.streams import EVENT_BYTES, KEEP_EVENTS_S, make_stream

if TYPE_CHECKING:
    from nats.js import JetStreamContext

_KEEP_FIXES_S: Final = 24 * 3600.0


class HubLimits(Struct, frozen=True):
    """What the streams of a tenant may take at each server of a hub."""

    replicas: int = 3
    fix_bytes: int = 50_000_000_000
    event_bytes: int = 4 * EVENT_BYTES


async def make_hub_streams(stream: "JetStreamContext", sites: Iterable[int], limits: HubLimits) -> None:
    """Make the streams of a tenant, or add sites to those that are there. Raises nats.errors.Error."""
    numbers = sorted(set(sites))
    for config in (
        StreamConfig(name=subjects.HUB_STATE, max_msgs_per_subject=1, allow_direct=True),
        StreamConfig(name=subjects.HUB_NAMES, max_msgs_per_subject=1, allow_direct=True),
        StreamConfig(name=subjects.HUB_EVENTS, max_age=KEEP_EVENTS_S, max_bytes=limits.event_bytes),
        StreamConfig(name=subjects.HUB_FIXES, max_age=_KEEP_FIXES_S, max_bytes=limits.fix_bytes),
    ):
        config.num_replicas = limits.replicas
        config.sources = [_source(_OF_SITE[config.name or ""], site) for site in numbers]
        await make_stream(stream, config)


_OF_SITE: Final = {
    subjects.HUB_STATE: subjects.STATE_STREAM,
    subjects.HUB_NAMES: subjects.NAMES_STREAM,
    subjects.HUB_EVENTS: subjects.EVENT_STREAM,
    subjects.HUB_FIXES: subjects.FIX_STREAM,
}


def _source(pattern: str, site: int) -> StreamSource:
    api = f"$JS.{subjects.at(subjects.DOMAIN, site)}.API"
    external = ExternalStream(api=api, deliver=subjects.at(subjects.SOURCED, site))
    return StreamSource(name=subjects.at(pattern, site), external=external)
