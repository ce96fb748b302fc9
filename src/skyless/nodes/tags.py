"""``skyless tag``: one process with one or several tags, each with its own radio and its own MQTT connection."""

import asyncio
import secrets
import time
from collections.abc import Sequence
from typing import Final

import msgspec

from skyless.mqtt.address import MqttAddress
from skyless.mqtt.link import Link
from skyless.mqtt.messages import Counters, FixMessage, RequestMessage, TagHealth
from skyless.mqtt.topics import fix_topic, health_topic, receptions_topic, request_topic
from skyless.nodes.process.running import HEALTH_S, Log, every, keep, together
from skyless.nodes.process.usage import Usage
from skyless.nodes.tag import TagNode, TagSettings
from skyless.radios.interface import Radio
from skyless.recordings.mcap.reception_log import ReceptionLog, receiver_settings

COLLECT_S: Final = 0.05
_decode_request: Final = msgspec.json.Decoder(RequestMessage).decode


class Tag:
    """A tag and its link, which comes about once the tag's site is known, and anew in another site."""

    def __init__(self, settings: TagSettings, radio: Radio, address: MqttAddress | None, say: Log) -> None:
        self._address, self._say = address, say
        self.link: Link | None = None
        self._site: int | None = None
        self._link_tasks: list[asyncio.Task[None]] = []
        self._fix_topic = self._health_topic = self._receptions_topic = ""
        asked = receiver_settings(settings.method, settings.site, settings.qa, settings.z_bounds_m, settings.integrity)
        self.log = ReceptionLog(radio.name, asked, secrets.token_hex(4))
        self.node = TagNode(settings, radio, self._publish, say, self.log.add)

    async def run(self) -> None:
        """Serve until cancelled."""
        try:
            await self.node.run()
        finally:
            for task in self._link_tasks:
                task.cancel()
            await asyncio.gather(*self._link_tasks, return_exceptions=True)

    def _publish(self, message: FixMessage) -> None:
        self._connect()
        if self.link is not None:
            self.link.publish(self._fix_topic, message)

    def _connect(self) -> None:
        """See that the link is that of the site to which the tag listens."""
        site = self.node.receiver.site
        if self._address is None or site is None or site == self._site:
            return
        for task in self._link_tasks:
            task.cancel()  # it says goodbye to the site that was left
        self._link_tasks = [task for task in self._link_tasks if not task.done()]
        self._site = site
        self.link = Link(self._address, self.node.name, site=site, kind="tag")
        self._fix_topic = fix_topic(site, self.node.name)
        self._health_topic = health_topic(site, "tag", self.node.name)
        self._receptions_topic = receptions_topic(site, self.node.name)
        self.link.subscribe(request_topic(site), self._take_request, qos=1)
        self._link_tasks.append(asyncio.ensure_future(keep(self.link, self._say)))

    def _take_request(self, _topic: str, payload: bytes) -> None:
        """Somebody wants raw receptions; what cannot be read is counted."""
        try:
            request = _decode_request(payload)
        except msgspec.MsgspecError:
            self.log.counters["bad-request"] += 1
        else:
            self.log.request(request, time.monotonic())

    def tell_receptions(self) -> None:
        """Publish what was asked for and is due."""
        if self.link is None:
            return
        while (message := self.log.collect(time.monotonic(), self.node.book.unix_less_host_s)) is not None:
            self.link.publish(self._receptions_topic, message, qos=1)

    def tell_health(self, cpu: float, memory_bytes: int) -> None:
        """Publish how the tag does."""
        self.node.book.tie_clocks()
        self._connect()
        self.node.look(time.monotonic())
        health = self._health(cpu, memory_bytes)
        if self.link is not None:
            self.link.publish(self._health_topic, health)

    def _health(self, cpu: float, memory_bytes: int) -> TagHealth:
        node = self.node
        return node.book.health(
            method=node.settings.method,
            receptions=node.receptions,
            reason=str(node.receiver.reason),
            counters=node.drops | self.log.counters,
            mqtt=Counters(0, 0, 0) if self.link is None else self.link.counters,
            cpu=cpu,
            memory_bytes=memory_bytes,
            phases=node.phases.last,
        )


class Tags:
    """The tags of one process."""

    def __init__(self, settings: TagSettings, radios: Sequence[Radio], address: MqttAddress | None, say: Log) -> None:
        self.tags = tuple(Tag(settings, radio, address, say) for radio in radios)
        self._usage = Usage()

    async def run(self) -> None:
        """Serve until cancelled."""
        parts = [tag.run() for tag in self.tags]
        await together(*parts, every(HEALTH_S, self._tell), every(COLLECT_S, self._tell_receptions))

    def _tell(self) -> None:
        share, memory_bytes = self._usage.take()
        for tag in self.tags:
            tag.tell_health(share / len(self.tags), memory_bytes)

    def _tell_receptions(self) -> None:
        for tag in self.tags:
            tag.tell_receptions()
