"""A hub of several sites: its streams and sites, and the link by which programs read one site there."""

import asyncio
import contextlib
import json
import logging
import re
import time
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
from msgspec import Struct
from nats.errors import Error
from nats.js.api import ExternalStream, StreamConfig, StreamSource
from nats.js.errors import NotFoundError
from paho.mqtt.client import topic_matches_sub

from skyless.core.errors import SkylessError
from skyless.run.broker import Broker
from skyless.run.find_site import KnownSites
from skyless.run.gather import subjects
from skyless.run.gather.node import Summary
from skyless.run.gather.streams import EVENT_BYTES, KEEP_EVENTS_S, KEEP_S, NEWEST_OF_EACH, follow, make_stream
from skyless.run.gather.subjects import NatsAddress, connect, rarely
from skyless.run.hub_files import Hub, Leaf, StuckLineError
from skyless.run.mqtt.link import Handler, Subscriptions
from skyless.run.process import Log, together
from skyless.run.site_table import THRESHOLDS

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg

_CHECK_S: Final = 0.5
_KEPT: Final = (*subjects.STATE, *subjects.EVENTS, subjects.JSON_FIXES)
"""Subjects in streams, which are not read live; fixes come as batches."""

_log = logging.getLogger("skyless.run.hub")


class HubLink:
    """Stands in for ``Link`` at a hub: handlers get one site's messages by their MQTT topics.

    Retained messages and events come from the hub's streams, so they are complete after every disconnection; healths
    and the like come while the site is connected. Fixes come in batches, not here. Published messages are dropped,
    because a site can only be changed at the site.
    """

    def __init__(self, address: NatsAddress, site: int, name: str) -> None:
        self.address, self.site = address, site
        self.connected = False
        """Whether the hub is connected and the site's gather is heard there."""
        self.trouble: str | None = "not connected yet"
        self.on_state: list[Callable[[bool], None]] = []
        """Called with ``connected`` whenever it changes."""
        self.unacknowledged, self.unread_s, self.refused = 0, 0.0, frozenset[str]()
        self.drops: Counter[str] = Counter()
        self._name = name
        self._subscriptions = Subscriptions()
        self._heard_s = float("-inf")
        self._say = rarely(_log.warning)

    def subscribe(self, topic_filter: str, handler: Handler, qos: int = 0) -> None:
        """Call ``handler`` with every message that matches a filter. All handlers must be set before ``run``."""
        self._subscriptions.add(topic_filter, handler, qos)

    def publish(
        self, topic: str, message: Struct | bytes, *, qos: int = 0, retain: bool = False, until_s: float = 0.0
    ) -> None:
        """Drop a message."""

    def forget(self, topic: str) -> None:
        """Do nothing: no message is repeated."""

    async def run(self) -> None:
        """Read until cancelled."""
        client = await connect(self.address, self._name, self._say, self.drops)
        try:
            await client.subscribe(subjects.at(subjects.SUMMARY, self.site), cb=self._on_summary)
            for topic_filter in self._subscriptions.filters:
                if self._is_live(topic_filter):
                    await client.subscribe(subjects.subject_of(topic_filter), cb=self._on_message)
            await together(
                self._follow(client, subjects.STATE_STREAM),
                self._follow(client, subjects.EVENT_STREAM),
                self._watch(client),
            )
        finally:
            await client.close()
            self._set_state("stopped")

    def _is_live(self, topic_filter: str) -> bool:
        """Whether a filter's messages come only live, because no stream has them."""
        return not any(topic_matches_sub(subjects.filter_of(kept, self.site), topic_filter) for kept in _KEPT)

    async def _follow(self, client: "Client", pattern: str) -> None:
        name, own = subjects.at(pattern, self.site), f"skyless.v1.{self.site}.>"
        async for message in follow(client.jetstream(), name, own, self._say, newest_of_each=True):
            await self._on_message(message)

    async def _watch(self, client: "Client") -> None:
        """Update ``connected`` and ``trouble`` until cancelled."""
        while True:
            if not client.is_connected:
                self._set_state(f"the hub {self.address} cannot be reached")
            elif time.monotonic() - self._heard_s > THRESHOLDS.site_s:
                self._set_state(f"site {self.site} is not heard: its line to the hub is cut, or no gather runs there")
            else:
                self._set_state(None)
            await asyncio.sleep(_CHECK_S)

    def _set_state(self, trouble: str | None) -> None:
        self.trouble = trouble
        if self.connected != (trouble is None):
            self.connected = trouble is None
            for callback in self.on_state:
                callback(self.connected)

    async def _on_summary(self, _message: "Msg") -> None:
        self._heard_s = time.monotonic()

    async def _on_message(self, message: "Msg") -> None:
        self._subscriptions.receive(subjects.topic_of(message.subject), message.data)


# A site's connection to the hub: whether it is up, and whether another site has the same number there.

_LINE_CHECK_S: Final = 2.0
_SILENT_CHECKS: Final = 3
_STUCK_S: Final = 300.0
_UP: Final = "Leafnode connection created"


async def watch_line(leaf: Leaf, broker: Broker, log: Log) -> None:
    """Log when the connection to the hub is lost or restored, until cancelled. Raises StuckLineError.

    nats-server's log names every attempt. A connection that the hub refuses or does not answer is up only briefly.
    """
    newest, said, unsteady, tried_s = "", "", 0, time.monotonic()
    while True:
        await asyncio.sleep(_LINE_CHECK_S)
        text = (broker.data / "nats-server.log").read_text(encoding="utf-8", errors="replace")
        found = re.findall(rf"^\[{broker.pid}\] (.*leaf.*)$", text, re.MULTILINE | re.IGNORECASE)
        before, newest = newest, found[-1] if found else newest
        newest_lines = found[-3:]
        faults = [line for line in newest_lines if "[ERR]" in line]
        if not faults and unsteady >= _SILENT_CHECKS:  # the hub accepts connections, but does not answer
            faults = [line for line in newest_lines if _UP not in line]
        is_up = _UP in newest
        unsteady = 0 if is_up and newest == before else unsteady + 1
        state = ""
        if not unsteady:
            state = f"the line to the hub is up, as site {leaf.site} of {leaf.tenant}"
        elif faults:
            state = f"no line to the hub; the site works on without it: {faults[-1].partition('] ')[2]}"
        kind = re.sub(r"\d+", "", state.rpartition(": ")[2])  # the same for each attempt
        if state and kind != said:
            said = kind
            log(state)
        if is_up or newest != before:
            tried_s = time.monotonic()
        elif time.monotonic() > tried_s + _STUCK_S:
            raise StuckLineError


async def refuse_second(leaf: Leaf, address: NatsAddress, log: Log) -> None:
    """Check that no other site with this number was at the hub before this one. Raises SkylessError if one was."""
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


# The streams of a hub, which copy the sites' own streams. Each site has its own ones, so that none can displace
# another's messages. A source requests its site's subjects, but the site's server may ignore that, so readers filter by
# those subjects again.

_RETRY_S: Final = 1.0
_NAMES_BYTES: Final = 30_000_000
_STATE_BYTES: Final = 100_000_000
"""Limits for each site: enough for the names of 200,000 tags, floor plans, and statuses of as many programs."""
_OF_ALL_SITES: Final = ("FIXES", "NAMES", "STATE", "EVENTS")
"""Streams of earlier hubs, in which each site could write under another's number."""


async def make_hub_streams(client: "Client", hub: Hub, tenant: str) -> None:
    """Make the streams of a tenant, or update existing ones. Raises nats.errors.Error."""
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
    for site in sorted(sites, key=lambda site: site not in there):  # existing streams make room first
        api, deliver = f"$JS.{subjects.at(subjects.DOMAIN, site)}.API", subjects.at(subjects.SOURCED, site)
        for version, pattern, limits in of_each:
            name, own = subjects.at(pattern, site), f"skyless.v{version}.{site}.>"
            source = StreamSource(name=name, filter_subject=own, external=ExternalStream(api=api, deliver=deliver))
            config = StreamConfig(name=name, num_replicas=len(hub.nodes), sources=[source], **limits)
            await make_stream(stream, config)


async def sites_at(client: "Client") -> set[int]:
    """Numbers of a tenant's sites with streams at its hub. Raises nats.errors.Error."""
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
    """Make or extend the streams of a tenant. Returns the summary of each site, None if it is not heard.

    Raises SkylessError if the hub is not ready within a minute.
    """
    address, say = hub.address(tenant), rarely(lambda trouble: log(f"waits for the hub: {trouble}"))
    try:
        async with asyncio.timeout(60.0):
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
        await asyncio.sleep(LISTEN_S)
        messages = [await heard.next_msg() for _ in range(heard.pending_msgs)]
    found = dict[int | None, Summary]()
    for one in messages:
        with contextlib.suppress(msgspec.MsgspecError):
            found[subjects.site_in(one.subject)] = msgspec.json.decode(one.data, type=Summary)
    return {site: found.get(site) for site in hub.sites[tenant]}


# Sites at a hub: names from retained messages, conditions from the summaries that gathers send every second.

LISTEN_S: Final = 2.5
"""After this time every connected site has been heard."""
LIST_S: Final = 5.0
"""Interval at which the hub is asked for its sites."""
_ORDER: Final = ("bad", "cut", "degraded", "unknown", "good")


class HubSite(Struct, frozen=True):
    """State of a site as known at a hub. Values that are unknown, because the site is not heard, are None."""

    number: int
    name: str
    condition: Literal["bad", "cut", "degraded", "unknown", "good"]
    """``cut``: not heard. ``unknown``: not heard yet, or not stated."""
    reason: str
    """The first reason for the condition; empty if it is good."""
    tags_heard: int | None = None
    anchors_online: int | None = None
    versions: dict[str, int] | None = None
    """Programs that are online, by version."""
    heard_unix_s: float | None = None
    """When this program last heard the site."""


class HubSites:
    """The sites of a tenant at a hub."""

    def __init__(self, address: NatsAddress, now_s: float) -> None:
        self.address = address
        self._began_s = now_s
        self.known = KnownSites()
        """What the sites have said about themselves."""
        self._heard: dict[int, tuple[float, float, Summary]] = {}
        """Newest summary of each site, and when it arrived, by the monotonic and the Unix clock."""
        self._client: Client | None = None

    @property
    def connected(self) -> bool:
        """Whether the hub is connected."""
        return self._client is not None and self._client.is_connected

    @property
    def has_answered(self) -> bool:
        """Whether the hub has ever been connected."""
        return self._client is not None

    def add_summary(self, number: int, payload: bytes, now_s: float, unix_s: float) -> None:
        """Process a summary of a site's gather. Unreadable ones are ignored."""
        with contextlib.suppress(msgspec.MsgspecError):
            self._heard[number] = now_s, unix_s, msgspec.json.decode(payload, type=Summary)

    def names(self) -> dict[int, str]:
        """Return the sites' names by number."""
        heard = {number: summary.site for number, (_, _, summary) in self._heard.items()}
        known = {site.number: site.name for site in self.known.sites()}
        return heard | known | {number: name for number, name in heard.items() if name}

    def sites(self, now_s: float) -> list[HubSite]:
        """Return the sites, those with problems first."""
        found = [self._site(number, name, now_s) for number, name in self.names().items()]
        return sorted(found, key=lambda site: (_ORDER.index(site.condition), site.number))

    def _site(self, number: int, name: str, now_s: float) -> HubSite:
        if number not in self._heard:
            if now_s - self._began_s < LISTEN_S:
                return HubSite(number, name, "unknown", "waiting for its gather")
            return HubSite(number, name, "cut", f"not heard for {_lasting(now_s - self._began_s)} or longer")
        heard_s, unix_s, summary = self._heard[number]
        if now_s - heard_s > THRESHOLDS.site_s:
            return HubSite(number, name, "cut", f"not heard for {_lasting(now_s - heard_s)}", heard_unix_s=unix_s)
        condition: Literal["bad", "degraded", "unknown", "good"]
        match summary.condition:
            case "bad" | "degraded" | "good" as condition:
                reason = "".join(summary.reasons[:1])
            case _:
                condition, reason = "unknown", f"its gather, version {summary.version}, states no condition"
        anchors = summary.online.get("anchor", 0)
        return HubSite(number, name, condition, reason, summary.tags_heard, anchors, summary.versions, unix_s)

    async def run(self, name: str) -> None:
        """Listen until cancelled. ``name`` identifies this program at the hub."""
        say = rarely(_log.warning)
        client = self._client = await connect(self.address, name, say, Counter())

        async def on_summary(message: "Msg") -> None:
            if (number := subjects.site_in(message.subject)) is not None:
                self.add_summary(number, message.data, time.monotonic(), time.time())

        try:
            await client.subscribe(subjects.at(subjects.SUMMARY, subjects.EVERY), cb=on_summary)
            while True:
                try:
                    for number in await sites_at(client) - {site for site, name in self.names().items() if name}:
                        subject = subjects.at(subjects.SITES, number)
                        with contextlib.suppress(NotFoundError):  # the message has not reached the hub yet
                            name = subjects.at(subjects.STATE_STREAM, number)
                            found = await client.jetstream().get_last_msg(name, subject, direct=True)
                            self.known.add(subjects.topic_of(subject), found.data or b"")
                except Error as error:
                    say(f"the sites at the hub cannot be listed: {error or type(error).__name__}")
                await asyncio.sleep(LIST_S)
        finally:
            await client.close()


def _lasting(seconds: float) -> str:
    for size_s, word in ((86_400.0, "d"), (3_600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size_s:
            return f"{seconds / size_s:.0f} {word}"
    return f"{seconds:.0f} s"
