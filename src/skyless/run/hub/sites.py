"""The sites at a hub: names from what they retain, conditions from what their gathers say every second."""

import asyncio
import contextlib
import logging
import time
from collections import Counter
from typing import TYPE_CHECKING, Final, Literal

import msgspec
from msgspec import Struct
from nats.errors import Error
from nats.js.errors import NotFoundError

from skyless.run.find_site import KnownSites
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect, rarely
from skyless.run.gather.node import Summary
from skyless.run.hub.link import SILENT_S
from skyless.run.hub.streams import sites_at

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg

LISTEN_S: Final = 2.5
"""After this time every site whose line is up has been heard."""
LIST_S: Final = 5.0
"""Interval at which the hub is asked which sites it has."""
_ORDER: Final = ("bad", "cut", "degraded", "unknown", "good")


class HubSite(Struct, frozen=True):
    """How a site is, as a hub knows it. What is not known of one that is not heard is None."""

    number: int
    name: str
    condition: Literal["bad", "cut", "degraded", "unknown", "good"]
    """``cut``: it is not heard. ``unknown``: it is not heard yet, or does not say."""
    reason: str
    """The first one; empty where all is well."""
    tags_heard: int | None = None
    anchors_online: int | None = None
    versions: dict[str, int] | None = None
    """Programs that are online, by version."""
    heard_unix_s: float | None = None
    """When this program heard it last."""


class HubSites:
    """The sites of a tenant at a hub."""

    def __init__(self, address: NatsAddress, now_s: float) -> None:
        self.address = address
        self._began_s = now_s
        self._known = KnownSites()
        self._heard: dict[int, tuple[float, float, Summary]] = {}
        """The newest summary of each, and when it came, by both clocks."""
        self._client: Client | None = None

    @property
    def connected(self) -> bool:
        """Whether the hub is."""
        return self._client is not None and self._client.is_connected

    @property
    def has_answered(self) -> bool:
        """Whether the hub has been connected."""
        return self._client is not None

    def add_site(self, topic: str, payload: bytes) -> None:
        """A site has published itself."""
        self._known.add(topic, payload)

    def add_summary(self, number: int, payload: bytes, now_s: float, unix_s: float) -> None:
        """The gather of a site has said how it is. What cannot be read changes nothing."""
        with contextlib.suppress(msgspec.MsgspecError):
            self._heard[number] = now_s, unix_s, msgspec.json.decode(payload, type=Summary)

    def names(self) -> dict[int, str]:
        """The names of the sites by their numbers."""
        heard = {number: summary.site for number, (_, _, summary) in self._heard.items()}
        known = {site.number: site.name for site in self._known.sites()}
        return heard | known | {number: name for number, name in heard.items() if name}

    def sites(self, now_s: float) -> list[HubSite]:
        """The sites, those in trouble first."""
        found = [self._site(number, name, now_s) for number, name in self.names().items()]
        return sorted(found, key=lambda site: (_ORDER.index(site.condition), site.number))

    def _site(self, number: int, name: str, now_s: float) -> HubSite:
        if number not in self._heard:
            if now_s - self._began_s < LISTEN_S:
                return HubSite(number, name, "unknown", "waiting for its gather")
            return HubSite(number, name, "cut", f"not heard for {_lasting(now_s - self._began_s)} or longer")
        heard_s, unix_s, summary = self._heard[number]
        if now_s - heard_s > SILENT_S:
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
        """Listen until cancelled. ``name`` is shown at the hub."""
        say = rarely(logging.getLogger("skyless.run.hub").warning)
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
                        with contextlib.suppress(NotFoundError):  # it has not come to the hub yet
                            name = subjects.at(subjects.STATE_STREAM, number)
                            found = await client.jetstream().get_last_msg(name, subject, direct=True)
                            self.add_site(subjects.topic_of(subject), found.data or b"")
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
