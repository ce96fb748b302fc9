"""What a site publishes on MQTT, as a hub has it: for programs that only read."""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect, rarely
from skyless.run.gather.streams import follow
from skyless.run.mqtt.link import Handler, Subscriptions
from skyless.run.process import together

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg

SILENT_S: Final = 5.0
"""The line to a site counts as cut when its gather has not been heard for so long."""
_CHECK_S: Final = 0.5
_KEPT: Final = (*subjects.STATE, *subjects.EVENTS, subjects.JSON_FIXES)
"""What comes from streams, fixes as batches."""

_log = logging.getLogger("skyless.run.hub")


class HubLink:
    """Takes the place of ``Link`` at a hub: handlers get the messages of one site by MQTT's topics.

    Retained messages and events come from the hub's streams, so that they are complete after every cut; healths and
    the like come while the line is up. Fixes come in batches only, not here. What is published is dropped: a site is
    changed at the site.
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
        """Call ``handler`` with every message of a filter. All of a link's handlers stand before it runs."""
        self._subscriptions.add(topic_filter, handler, qos)

    def publish(
        self, topic: str, message: Struct | bytes, *, qos: int = 0, retain: bool = False, until_s: float = 0.0
    ) -> None:
        """Drop a message."""

    def forget(self, topic: str) -> None:
        """Nothing is repeated."""

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
        """Whether the messages of a filter are in no stream."""
        levels = subjects.subject_of(topic_filter).split(".")
        for subject in _KEPT:
            kept = subjects.at(subject, self.site).split(".")
            if len(kept) == len(levels) and all(one in ("*", level) for one, level in zip(kept, levels, strict=True)):
                return False
        return True

    async def _follow(self, client: "Client", pattern: str) -> None:
        name, own = subjects.at(pattern, self.site), f"skyless.v1.{self.site}.>"
        found = follow(client.jetstream(), name, own, self._say, newest_of_each=True)
        async for message in found:
            await self._on_message(message)

    async def _watch(self, client: "Client") -> None:
        """State whether the site is heard."""
        while True:
            if not client.is_connected:
                self._set_state(f"the hub {self.address} cannot be reached")
            elif time.monotonic() - self._heard_s > SILENT_S:
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
