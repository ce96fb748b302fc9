"""Watching a running site over MQTT: errors of fixes against the truth, health, latencies."""

import time
from collections import Counter
from typing import Final

from msgspec import Struct

from skyless.core.alert import Alert
from skyless.run.fix_log import Latencies
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import (
    AnchorHealth,
    EtherHealth,
    FixMessage,
    TagHealth,
    TruthBuffer,
    TruthMessage,
    Vector,
)
from skyless.run.mqtt.topics import EVERY_NODE, fix_topic, health_topic, truth_topic
from skyless.run.process import reader
from skyless.sim.evaluation.statistics import ErrorStatistics

_WARMUP_S: Final = 1.0  # fixes of a tag count for the errors from this time after its first

_ALERTS: Final = frozenset(alert.value for alert in Alert)


class WatchedTag(Struct):
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
    """Collects what the nodes of a site publish, and the errors of its fixes."""

    def __init__(self, link: Link, site: int, *, planar: bool) -> None:
        self.tags: dict[str, WatchedTag] = {}
        self.anchors: dict[int, AnchorHealth] = {}
        self.ether: EtherHealth | None = None
        self.errors = ErrorStatistics(planar=planar)
        self.variance_sum_m2 = 0.0
        self.judged = 0
        self.alerts: Counter[str] = Counter()
        """How often fixes reported each state of their integrity, for methods that report one."""
        self.arrivals = Latencies()  # from the end of a fix's last frame to its arrival in this process
        self.latencies = Latencies()  # from there to the computed fix, as the tags report them
        self.wrong = 0  # messages that could not be read
        self._truths = TruthBuffer()
        for topic, kind, handle in (
            (fix_topic(site, EVERY_NODE), FixMessage, self._on_fix),
            (truth_topic(site), TruthMessage, self._truths.add),
            (health_topic(site, "tag", EVERY_NODE), TagHealth, self._on_tag),
            (health_topic(site, "anchor", EVERY_NODE), AnchorHealth, self._on_anchor),
            (health_topic(site, "ether", EVERY_NODE), EtherHealth, self._on_ether),
        ):
            link.subscribe(topic, reader(kind, handle, self._on_wrong))

    def _on_wrong(self) -> None:
        self.wrong += 1

    def _on_fix(self, fix: FixMessage) -> None:
        self.arrivals.add(time.time() - fix.unix_s)
        self.latencies.add(fix.latency_s)
        tag = self.tags.get(fix.tag)
        if tag is None:
            tag = self.tags[fix.tag] = WatchedTag(fix.unix_s, fix)
        tag.fix = fix
        if fix.alert in _ALERTS:
            self.alerts[fix.alert] += 1
            if fix.alert != Alert.NONE:
                tag.alerted, tag.alerted_s = fix, time.monotonic()
        true_m = self._truths.at(fix.tag, fix.unix_s)
        tag.error_m = None
        if true_m is not None:
            self._add_error(tag, true_m)

    def _add_error(self, tag: WatchedTag, true_m: Vector) -> None:
        fix = tag.fix
        dx, dy, dz = (have - true for have, true in zip(fix.position_m, true_m, strict=True))
        dz = 0.0 if fix.height_known else dz
        tag.error_m = (dx * dx + dy * dy + dz * dz) ** 0.5
        if fix.unix_s - tag.first_unix_s >= _WARMUP_S:
            self.errors.add(dx, dy, dz)
            self.judged += 1
            self.variance_sum_m2 += fix.std_m**2

    def _on_tag(self, health: TagHealth) -> None:
        tag = self.tags.get(health.tag)
        if tag is not None:
            restarted = tag.health is not None and health.fixes < tag.health.fixes
            tag.health = health
            if tag.began is None or restarted:
                tag.began = health.unix_s, health.fixes

    def _on_anchor(self, health: AnchorHealth) -> None:
        self.anchors[health.anchor] = health

    def _on_ether(self, health: EtherHealth) -> None:
        self.ether = health
