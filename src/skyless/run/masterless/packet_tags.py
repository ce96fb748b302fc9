"""Tags on sniffers, FiRa boards and phones, which receive the packets of a system without a master.

The anchors' positions are configured, or stated in the messages of a FiRa board or a phone.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from msgspec import Struct, structs

from skyless.core.air.masterless_packets import Packet, Point
from skyless.core.errors import ConfigurationError
from skyless.core.geometry import GUESSED_STD_M, plane_height_m
from skyless.core.motion_sample import MotionSample
from skyless.core.site import AnchorSite, GeoreferenceSite, Site, TagsSite
from skyless.core.ticks import TICK_BITS
from skyless.radio.foreign.bitcraze import STAMP_BITS
from skyless.radio.foreign.foreign_radios import SnifferRadio, UciRadio
from skyless.radio.foreign.phone_radio import PhoneRadio
from skyless.radio.interface import Gone, Hint, Restarted
from skyless.run.fix_log import FIX_LEAVES_S, FixListener, FixLog
from skyless.run.masterless.packet_tracking import DL_TDOA, DL_TDOA_ONE_WAY, MASTERLESS, PacketTracking
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.messages import Counters, FixMessage, TagHealth
from skyless.run.mqtt.topics import fix_topic, health_topic
from skyless.run.open_radio import RadioMonitor
from skyless.run.process import HEALTH_S, Log, SitePublisher, Usage, every, keep, link_of, together
from skyless.site.file.check import check_site
from skyless.site.survey.anchor_errors import DifferenceCalibration

TDOA_SITE: Final = 0
"""Site number in the topics of a system without a site identifier."""

_NEW_HEIGHT_M: Final = 0.05  # change of the anchors' mean height that restarts tracking

PacketRadio = SnifferRadio | UciRadio | PhoneRadio


class PacketTagSettings(Struct, frozen=True):
    """Configuration of the tags of a system without a master."""

    anchors_m: Mapping[int, Point]
    """Positions of the anchors; empty if messages state them."""
    site: int = TDOA_SITE
    height_m: float | None = None
    """Known height of the tags, or None to estimate it."""
    height_std_m: float = 0.0
    """Standard deviation of a known height."""
    auto_height: bool = False
    """Whether tags assume the anchors' height once these turn out to be too flat to determine the height."""
    calibration: DifferenceCalibration | None = None
    publish_hz: float = 50.0


def site_of(
    settings: PacketTagSettings, heard_m: Mapping[int, Point] | None = None, origin: GeoreferenceSite | None = None
) -> Site | None:
    """The system as a site that a page can draw; None for anchors that no site can have.

    ``heard_m``: positions of the anchors if they are not configured; ``origin``: origin of these on the Earth.
    """
    positions_m = settings.anchors_m or heard_m or {}
    anchors = tuple(AnchorSite(anchor, *position_m) for anchor, position_m in sorted(positions_m.items()))
    if not anchors:
        return None
    tags = TagsSite(height_m=settings.height_m)
    site = Site("TDoA system", settings.site, anchors[0].id, anchors, tags=tags, georeference=origin)
    try:
        check_site(site, Path("the table of anchors"))
    except ConfigurationError:
        return None
    return site


class PacketTagNode:
    """Runs ``PacketTracking`` on a radio. ``publish`` is called with the fixes to publish."""

    def __init__(
        self,
        settings: PacketTagSettings,
        radio: PacketRadio,
        publish: FixListener,
        log: Log,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``clock``: the host's monotonic time in s, as in ``host_s`` of the packets."""
        self.settings, self.radio, self._clock = settings, radio, clock
        self._height_m, self._height_std_m = settings.height_m, settings.height_std_m
        self._anchors_seen = 0
        self.tracking = self._new_tracking()
        self.packets = 0
        self.fix_log = FixLog(radio.name, publish, settings.publish_hz, clock)
        self.monitor = RadioMonitor(f"tag {radio.name}", "listening", log, radio.advice)
        self._drops: Counter[str] = Counter()
        self.motion_counters: Counter[str] = Counter()
        """Unusable messages of the motion sensor, by reason."""
        self._notes: tuple[str, ...] = ()
        self._known = 0  # packets of anchors with known positions

    def _new_tracking(self) -> PacketTracking:
        asked = self.settings
        known = {"height_m": self._height_m, "height_std_m": self._height_std_m}
        is_dl_tdoa = isinstance(self.radio, UciRadio | PhoneRadio)
        return PacketTracking(
            (DL_TDOA if is_dl_tdoa else MASTERLESS).changed(**known),
            asked.anchors_m,
            TICK_BITS if is_dl_tdoa else STAMP_BITS,
            calibration=asked.calibration,
            one_way=DL_TDOA_ONE_WAY.changed(**known) if is_dl_tdoa else None,
        )

    @property
    def drops(self) -> Counter[str]:
        """Unusable data, by reason."""
        unused = self._drops + self.tracking.drops + self.radio.counters
        return unused + self.fix_log.lateness.drops + self.motion_counters

    def check_reception(self, now_s: float) -> None:
        """Log advice if the radio receives nothing usable. ``now_s``: the host's monotonic clock."""
        self.monitor.check(now_s, self.packets, self._known, self.drops)

    def new_notes(self, log: Log) -> tuple[str, ...]:
        """What is wrong with the anchors; what was not before is logged."""
        notes, before, self._notes = self.tracking.notes, self._notes, self.tracking.notes
        for note in notes:
            if note not in before:
                log(f"tag {self.radio.name}: {note}")
        return notes

    def hear_motion(self, sample: MotionSample) -> None:
        """Process what the tag's motion sensor shows, at a time of the host's monotonic clock."""
        self.tracking.hear_motion(sample)

    async def run(self) -> None:
        """Listen until cancelled."""
        await self.radio.run(self.on_event)

    def on_event(self, event: Packet | Restarted | Gone | Hint) -> None:
        """Process an event of the radio."""
        if isinstance(event, Packet):
            self._receive(event)
            return
        self.monitor.on_event(event)
        # A phone that connects again goes on; whether its time has begun again, its stamps say, as in a file.
        if isinstance(event, Restarted) and self.packets and not isinstance(self.radio, PhoneRadio):
            self._height_m, self._height_std_m = self.settings.height_m, self.settings.height_std_m
            self._anchors_seen = 0  # the anchors may have been moved
            self._begin_again()

    def _begin_again(self) -> None:
        self._drops += self.tracking.drops
        self.tracking = self._new_tracking()

    def _update_height(self) -> None:
        """When another anchor has stated its position, decide again whether to assume the anchors' height."""
        known_m = self.tracking.anchors_m
        if not self.settings.auto_height or len(known_m) <= self._anchors_seen:
            return
        self._anchors_seen = len(known_m)
        plane_m, before_m = plane_height_m(known_m), self._height_m
        is_new = (plane_m is None) is not (before_m is None)
        if is_new or (plane_m is not None and before_m is not None and abs(plane_m - before_m) > _NEW_HEIGHT_M):
            self._height_m, self._height_std_m = plane_m, GUESSED_STD_M
            self._begin_again()

    def _receive(self, packet: Packet) -> None:
        self.packets += 1
        host_s = None if isinstance(self.radio, PhoneRadio) else packet.host_s  # a phone's packets have its own time
        if host_s is not None and not self.fix_log.lateness.admits(host_s, self._clock()):
            return
        fix = self.tracking.on_packet(packet)
        self._known += packet.anchor in self.tracking.anchors_m
        self._update_height()
        if fix is not None:
            done_s = self._clock()
            self.fix_log.add(fix, done_s if host_s is None else host_s, done_s)


class PacketTags:
    """The tags of one process, each with its radio and its MQTT connection."""

    def __init__(
        self,
        settings: PacketTagSettings,
        radios: Sequence[PacketRadio],
        address: MqttAddress | None,
        log: Log,
        *,
        simulated: Callable[[], bool],
        on_fix: FixListener | None = None,
        on_health: Callable[[TagHealth], None] | None = None,
        on_anchors: Callable[[Mapping[int, Point], GeoreferenceSite | None], None] | None = None,
    ) -> None:
        """``simulated`` is called again when a radio has restarted, as its port may lead to another device.

        ``on_fix`` and ``on_health`` are called with everything to publish, with or without a broker; ``on_anchors``
        with positions stated in messages, and their origin on the Earth, whenever they change.
        """
        self._settings, self._log, self._on_fix, self._on_health = settings, log, on_fix, on_health
        self._links = tuple(link_of(address, radio.name, site=settings.site, kind="tag") for radio in radios)
        self.nodes = tuple(
            PacketTagNode(settings, radio, self._publisher(index), log) for index, radio in enumerate(radios)
        )
        self._usage = Usage()
        self._simulated, self._on_anchors = simulated, on_anchors
        self._heard_m: dict[int, Point] = {}
        site = site_of(settings)
        self._site_publisher = None if site is None else self._new_publisher(site)

    async def run(self) -> None:
        """Serve until cancelled."""
        parts = [node.run() for node in self.nodes]
        parts += [keep(link, self._log) for link in self._links if link is not None]
        await together(*parts, every(HEALTH_S, self._publish_health))

    def _publisher(self, index: int) -> FixListener:
        def publish(message: FixMessage) -> None:
            if self._on_fix is not None:
                self._on_fix(message)
            link = self._links[index]
            if link is not None:
                ended_s = message.unix_s - self.nodes[index].fix_log.unix_less_host_s
                link.publish(fix_topic(self._settings.site, message.tag), message, until_s=ended_s + FIX_LEAVES_S)

        return publish

    def _publish_health(self) -> None:
        """Publish the health of all tags, and the site with the anchors' positions."""
        share, memory_bytes = self._usage.sample()
        if not self._settings.anchors_m:
            self._update_site()
        for node, link in zip(self.nodes, self._links, strict=True):
            node.fix_log.update_clock_offset()
            node.check_reception(time.monotonic())
            counted = node.fix_log.health(
                method="joint",
                receptions=node.packets,
                reason=str(node.tracking.reason),
                counters=node.drops,
                mqtt=Counters(0, 0, 0) if link is None else link.counters,
                cpu=share / len(self.nodes),
                memory_bytes=memory_bytes,
                late_in_link=0 if link is None else link.late,
            )
            health = structs.replace(counted, notes=node.new_notes(self._log))
            if self._on_health is not None:
                self._on_health(health)
            if link is not None:
                if self._site_publisher is not None:
                    self._site_publisher.update(sum(each.monitor.restarts for each in self.nodes))
                    self._site_publisher.publish(link)
                link.publish(health_topic(self._settings.site, "tag", node.radio.name), health)

    def _update_site(self) -> None:
        heard_m = dict(self._heard_m)
        for node in self.nodes:
            heard_m |= node.tracking.anchors_m
        if heard_m == self._heard_m:
            return
        self._heard_m = heard_m
        radio = self.nodes[0].radio
        origin = radio.frame.origin if isinstance(radio, UciRadio | PhoneRadio) else None
        if self._on_anchors is not None:
            self._on_anchors(heard_m, origin)
        site = site_of(self._settings, heard_m, origin)
        if site is not None and self._site_publisher is not None:
            self._site_publisher.place(site)
        elif site is not None:
            self._site_publisher = self._new_publisher(site)

    def _new_publisher(self, site: Site) -> SitePublisher:
        publisher = SitePublisher(site, self._simulated)
        publisher.system = "dl-tdoa" if isinstance(self.nodes[0].radio, UciRadio | PhoneRadio) else "tdoa"
        return publisher
