"""Tags on sniffers: they hear the packets of a system without a master, and are told where its anchors stand."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from msgspec import Struct, structs

from skyless.air.masterless_packets import Packet, Point
from skyless.errors import ConfigurationError
from skyless.mqtt.address import MqttAddress
from skyless.mqtt.link import Link
from skyless.mqtt.messages import Counters, FixMessage, SiteMessage
from skyless.mqtt.topics import fix_topic, health_topic, site_topic
from skyless.nodes.fix_log import FixListener, FixLog
from skyless.nodes.hearing import Hearing
from skyless.nodes.process.running import HEALTH_S, AskedAgain, Log, every, keep, link_of, together
from skyless.nodes.process.usage import Usage
from skyless.positioning.masterless.anchor_errors import DifferenceCalibration
from skyless.positioning.masterless.packet_tracking import MASTERLESS, PacketTracking
from skyless.radios.interface import Gone, Restarted
from skyless.radios.serial.sniffer_radio import SnifferRadio
from skyless.site.check import check_site
from skyless.site.model import AnchorSite, Site, TagsSite

METHOD = "joint"
TDOA_SITE = 0
"""What topics call a system that has no site identifier."""


class PacketTagSettings(Struct, frozen=True):
    """What tags of such a system are told."""

    anchors_m: Mapping[int, Point]
    site: int = TDOA_SITE
    qa: float = MASTERLESS.qa
    height_m: float | None = None
    """Height of the tags where it is known; None to estimate it."""
    height_std_m: float = 0.0
    """Of a known one."""
    calibration: DifferenceCalibration | None = None
    publish_hz: float = 50.0


def site_of(settings: PacketTagSettings) -> Site | None:
    """The system as a site that a page can draw; None for a table of anchors that no site can have."""
    anchors = tuple(AnchorSite(anchor, *place_m) for anchor, place_m in settings.anchors_m.items())
    tags = TagsSite(height_m=settings.height_m)
    site = Site("TDoA system", settings.site, anchors[0].id, anchors, tags=tags)
    try:
        check_site(site, Path("the table of anchors"))
    except ConfigurationError:
        return None
    return site


class PacketTagNode:
    """Runs ``PacketTracking`` on a sniffer. ``publish`` is given the fixes that are to be published."""

    def __init__(self, settings: PacketTagSettings, radio: SnifferRadio, publish: FixListener, said: Log) -> None:
        self.settings, self.radio = settings, radio
        self.tracking = self._new_tracking()
        self.packets = self.restarts = 0
        self.book = FixLog(radio.name, publish, settings.publish_hz)
        self._drops: Counter[str] = Counter()
        self._said = said
        self._known = 0
        """Packets of anchors that stand in the table."""
        self._hearing = Hearing(f"tag {radio.name}", said, radio.advice)

    def _new_tracking(self) -> PacketTracking:
        asked = self.settings
        known = {"height_m": asked.height_m, "height_std_m": asked.height_std_m}
        filter_settings = structs.replace(MASTERLESS, qa=asked.qa, **known)
        return PacketTracking(filter_settings, asked.anchors_m, calibration=asked.calibration)

    @property
    def counters(self) -> Counter[str]:
        """What could not be used, by reason."""
        return self._drops + self.tracking.drops + self.radio.counters

    def look(self, now_s: float) -> None:
        """Log where to look if it hears nothing of use; ``now_s`` is the host's monotonic clock."""
        self._hearing.look(now_s, self.packets, self._known, self.counters)

    async def run(self) -> None:
        """Listen until cancelled."""
        await self.radio.run(self.hear)

    def hear(self, event: Packet | Restarted | Gone) -> None:
        """Take what the sniffer tells."""
        if isinstance(event, Packet):
            self._receive(event)
        elif isinstance(event, Restarted):
            self.restarts += 1
            self._hearing.begin()
            self._said(f"tag {self.radio.name}: listening" + (" again" if self.restarts > 1 else ""))
            if self.packets:
                self._drops += self.tracking.drops
                self.tracking = self._new_tracking()
        else:
            self._hearing.end()
            self._said(f"tag {self.radio.name}: {event.reason}; still looking for it")

    def _receive(self, packet: Packet) -> None:
        self.packets += 1
        self._known += packet.anchor in self.settings.anchors_m
        fix = self.tracking.on_packet(packet)
        if fix is not None:
            done_s = time.monotonic()
            self.book.take(fix, done_s if packet.host_s is None else packet.host_s, done_s)


class PacketTags:
    """The tags of one process, each with its sniffer and its MQTT connection."""

    def __init__(
        self,
        settings: PacketTagSettings,
        radios: Sequence[SnifferRadio],
        address: MqttAddress | None,
        say: Log,
        *,
        simulated: Callable[[], bool],
    ) -> None:
        """``simulated`` is asked again when a sniffer has come back: something else may stand behind its port."""
        self._settings, self._say = settings, say
        self._simulated = AskedAgain(simulated)
        self._told_simulated: bool | None = None
        self._links = tuple(link_of(address, radio.name, site=settings.site, kind="tag") for radio in radios)
        self.nodes = tuple(
            PacketTagNode(settings, radio, self._publisher(index), say) for index, radio in enumerate(radios)
        )
        self._usage = Usage()
        self._site: Site | None = site_of(settings)

    async def run(self) -> None:
        """Serve until cancelled."""
        parts = [node.run() for node in self.nodes]
        parts += [keep(link, self._say) for link in self._links if link is not None]
        await together(*parts, every(HEALTH_S, self._tell))

    def _publisher(self, index: int) -> FixListener:
        def publish(message: FixMessage) -> None:
            link = self._links[index]
            if link is not None:
                link.publish(fix_topic(self._settings.site, message.tag), message)

        return publish

    def _tell(self) -> None:
        share, memory_bytes = self._usage.take()
        for node, link in zip(self.nodes, self._links, strict=True):
            node.book.tie_clocks()
            node.look(time.monotonic())
            health = node.book.health(
                method=METHOD,
                receptions=node.packets,
                reason=str(node.tracking.reason),
                counters=node.counters,
                mqtt=Counters(0, 0, 0) if link is None else link.counters,
                cpu=share / len(self.nodes),
                memory_bytes=memory_bytes,
            )
            if link is not None:
                self._tell_site(link)
                link.publish(health_topic(self._settings.site, "tag", node.radio.name), health)

    def _tell_site(self, link: Link) -> None:
        """Where the anchors stand; retained, so that a page that comes later knows it at once."""
        simulated = self._simulated.at(sum(node.restarts for node in self.nodes))
        if self._site is not None and simulated is not self._told_simulated:
            self._told_simulated = simulated
            message = SiteMessage(self._site, simulated, time.time())
            link.publish(site_topic(self._site.id), message, qos=1, retain=True)
