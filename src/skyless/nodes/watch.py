"""Watching a running site over MQTT: fixes beside the truth, health, and how late everything comes."""

import time
from collections import Counter
from collections.abc import Callable
from typing import Final

import msgspec
from msgspec import Struct

from skyless.evaluation.statistics import ErrorStatistics
from skyless.mqtt.link import Link
from skyless.mqtt.messages import AnchorHealth, EtherHealth, FixMessage, TagHealth, TruthMessage, Vector
from skyless.mqtt.topics import EVERY_NODE, fix_topic, health_topic, truth_topic
from skyless.mqtt.truth_buffer import TruthBuffer
from skyless.nodes.latency import Latencies
from skyless.positioning.integrity import Alert

WARMUP_S: Final = 1.0
"""Fixes of a tag count for the errors from so long after its first."""

ALERTS: Final = frozenset(alert.value for alert in Alert)


class Watched(Struct):
    """What is known of one tag."""

    first_unix_s: float
    fix: FixMessage
    error_m: float | None = None
    alerted: FixMessage | None = None
    """The newest fix that carried an alert."""
    alerted_s: float = 0.0
    """When it came, by the host's monotonic clock."""
    health: TagHealth | None = None
    began: tuple[float, int] | None = None
    """Time and number of fixes of the first health message that counts."""

    @property
    def updates_per_s(self) -> float | None:
        """Fixes per second between the first and the last health message that count."""
        if self.health is None or self.began is None or self.health.unix_s <= self.began[0]:
            return None
        return (self.health.fixes - self.began[1]) / (self.health.unix_s - self.began[0])


class Watch:
    """Gathers what the nodes of a site tell."""

    def __init__(self, link: Link, site: int, *, planar: bool) -> None:
        self.tags: dict[str, Watched] = {}
        self.anchors: dict[int, AnchorHealth] = {}
        self.ether: EtherHealth | None = None
        self.errors = ErrorStatistics(planar=planar)
        self.variance_sum_m2 = 0.0
        self.judged = 0
        self.alerts: Counter[str] = Counter()
        """What the fixes said of their integrity, of methods that say something."""
        self.arrivals = Latencies()
        """From the end of a fix's last frame to its arrival here."""
        self.latencies = Latencies()
        """From there to the computed fix, as the tags say."""
        self.wrong = 0
        """Messages that could not be read."""
        self._truths = TruthBuffer()
        for topic, kind, take in (
            (fix_topic(site, EVERY_NODE), FixMessage, self._take_fix),
            (truth_topic(site), TruthMessage, self._truths.add),
            (health_topic(site, "tag", EVERY_NODE), TagHealth, self._take_tag),
            (health_topic(site, "anchor", EVERY_NODE), AnchorHealth, self._take_anchor),
            (health_topic(site, "ether", EVERY_NODE), EtherHealth, self._take_ether),
        ):
            link.subscribe(topic, self._reader(msgspec.json.Decoder(kind), take))

    def _reader(self, decoder: msgspec.json.Decoder[Struct], take: Callable[..., None]) -> Callable[[str, bytes], None]:
        def read(_topic: str, payload: bytes) -> None:
            try:
                message = decoder.decode(payload)
            except msgspec.MsgspecError:
                self.wrong += 1
            else:
                take(message)

        return read

    def _take_fix(self, fix: FixMessage) -> None:
        self.arrivals.add(time.time() - fix.unix_s)
        self.latencies.add(fix.latency_s)
        tag = self.tags.get(fix.tag)
        if tag is None:
            tag = self.tags[fix.tag] = Watched(fix.unix_s, fix)
        tag.fix = fix
        if fix.alert in ALERTS:
            self.alerts[fix.alert] += 1
            if fix.alert != Alert.NONE:
                tag.alerted, tag.alerted_s = fix, time.monotonic()
        true_m = self._truths.at(fix.tag, fix.unix_s)
        tag.error_m = None
        if true_m is not None:
            self._judge(tag, true_m)

    def _judge(self, tag: Watched, true_m: Vector) -> None:
        fix = tag.fix
        dx, dy, dz = (have - true for have, true in zip(fix.position_m, true_m, strict=True))
        dz = 0.0 if fix.height_known else dz
        tag.error_m = (dx * dx + dy * dy + dz * dz) ** 0.5
        if fix.unix_s - tag.first_unix_s >= WARMUP_S:
            self.errors.add(dx, dy, dz)
            self.judged += 1
            self.variance_sum_m2 += fix.std_m**2

    def _take_tag(self, health: TagHealth) -> None:
        tag = self.tags.get(health.tag)
        if tag is not None:
            tag.health = health
            if tag.began is None or health.fixes < tag.began[1]:
                tag.began = health.unix_s, health.fixes

    def _take_anchor(self, health: AnchorHealth) -> None:
        self.anchors[health.anchor] = health

    def _take_ether(self, health: EtherHealth) -> None:
        self.ether = health
