"""What a running site publishes, gathered for the text view: the newest of each thing, and when it came."""

import platform
import time
from collections import Counter
from collections.abc import Callable
from typing import Final, Literal

from msgspec import Struct

from skyless.page.condition.evidence import ALERTS, FRESH_S, Evidence, Node
from skyless.page.condition.monitor import Condition, ConditionMonitor
from skyless.run.mqtt import topics
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import (
    AlarmMessage,
    AnchorHealth,
    AssetsMessage,
    EtherHealth,
    FixMessage,
    SiteMessage,
    StatusMessage,
    TagHealth,
    Vector,
    WatchMessage,
    WrongMessageError,
    ZonesMessage,
    read_message,
)
from skyless.run.process import reader
from skyless.run.zones.monitor import ZoneMonitor
from skyless.run.zones.zone_list import BadZonesError, read_zones, zones_of

_MAX_ALARMS: Final = 10_000
_NOT_DROPS: Final = frozenset({"heard", "sent", "takeover"})
"""Other counters of anchors."""


class TagRow(Struct, frozen=True):
    """A tag as it is shown."""

    tag: str
    state: Literal["fix", "no fix", "offline"]
    name: str = ""
    """What people call it; empty: it has no asset."""
    age_s: float | None = None
    """Since the last frame of the newest fix; None before the first."""
    position_m: Vector | None = None
    std_m: float | None = None
    hpl_m: float | None = None
    updates_per_s: float | None = None
    anchors: int = 0
    alert: str = ""
    """Empty where the newest fix has none that means trouble."""
    reason: str = ""
    """Why it has no fix, as it says."""
    zones: tuple[str, ...] = ()


class AnchorRow(Struct, frozen=True):
    """An anchor as it is shown."""

    anchor: str
    state: str
    """Its role, ``silent`` where it does not report, or ``offline``."""
    age_s: float | None = None
    """Since its last report."""
    hears: int | None = None
    """Other anchors that it has heard within ``FRESH_S``."""
    missed_share: float | None = None


class Picture(Struct, frozen=True):
    """A site at one moment."""

    site: str
    number: int
    simulated: bool
    unix_s: float
    broker: str
    trouble: str | None
    """Why the broker is not connected; None while it is."""
    condition: Condition
    tags: tuple[TagRow, ...]
    """Those with trouble first, then by name."""
    anchors: tuple[AnchorRow, ...]
    alarms: tuple[AlarmMessage, ...]
    """Those that nobody has acknowledged first."""
    drops: dict[str, int]
    """What tags and anchors have dropped since they started, by reason, the most frequent first."""
    wrong_messages: int
    """Messages that could not be read."""


class SiteView:
    """Subscribes to a site's topics. It publishes nothing but its own status."""

    def __init__(
        self,
        link: Link,
        number: int,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
        used_share: Callable[[float], float | None] | None = None,
    ) -> None:
        """``used_share`` is as for the page's ``LiveSite``."""
        self.link, self._number, self._clock, self._wall_clock = link, number, clock, wall_clock
        self._used_share = used_share
        self.evidence = Evidence(platform.node(), clock())
        self._monitor, self._zones = ConditionMonitor(self.evidence), ZoneMonitor()
        self.condition = self._monitor.evaluate(clock())
        self._site: SiteMessage | None = None
        self._fixes: dict[str, tuple[FixMessage, float]] = {}  # with the time at which its last frame ended
        self._assets, self._kept_zones = AssetsMessage(()), ZonesMessage(())
        self._alarms: dict[str, AlarmMessage] = {}
        self._watch: tuple[WatchMessage, float] | None = None  # with the time at which it was made
        self._wrong = 0
        for topic, kind, handle in (
            (topics.site_topic(number), SiteMessage, self._on_site),
            (topics.fix_topic(number, "+"), FixMessage, self._on_fix),
            (topics.status_topic(number, "+", "+"), StatusMessage, self._on_status),
            (topics.health_topic(number, "tag", "+"), TagHealth, lambda one: self._on_health("tag", one.tag, one)),
            (topics.health_topic(number, "anchor", "+"), AnchorHealth,
             lambda one: self._on_health("anchor", str(one.anchor), one)),
            (topics.health_topic(number, "ether", "+"), EtherHealth, lambda one: self._on_health("ether", "air", one)),
            (topics.assets_topic(number), AssetsMessage, lambda one: setattr(self, "_assets", one)),
            (topics.watch_topic(number), WatchMessage, self._on_watch),
        ):  # fmt: skip
            link.subscribe(topic, reader(kind, handle, self._on_wrong))
        link.subscribe(topics.zones_topic(number), self._on_zones, qos=1)
        link.subscribe(topics.alarm_topic(number, "+", "+"), self._on_alarm, qos=1)
        link.on_state.append(self._on_state)

    def _on_state(self, connected: bool) -> None:
        self._watch = None
        if not connected:
            self._alarms.clear()  # the broker sends again what it keeps
        self.evidence.set_connected(connected=connected, now_s=self._clock())

    def _on_wrong(self) -> None:
        self._wrong += 1

    def _on_site(self, message: SiteMessage) -> None:
        self._site = message
        self.evidence.set_site(message.site, self._clock())
        self._set_zones()

    def _on_fix(self, fix: FixMessage) -> None:
        now_s = self._clock()
        if self.evidence.roster.admits("tag", fix.tag):
            self._fixes[fix.tag] = fix, now_s - self.evidence.add_fix(fix, now_s)
            self._zones.update(fix, now_s)

    def _on_status(self, status: StatusMessage) -> None:
        self.evidence.add_status(status, self._clock())

    def _on_health(self, kind: str, name: str, health: TagHealth | AnchorHealth | EtherHealth) -> None:
        self.evidence.add_health(kind, name, health, self._clock(), self._wall_clock())

    def _on_watch(self, message: WatchMessage) -> None:
        """Note when it was made: the first after a connection may be an old one that the broker kept."""
        kept_s = max(0.0, self._wall_clock() - message.unix_s) if self._watch is None else 0.0
        self._watch = message, self._clock() - kept_s

    def _on_zones(self, _topic: str, payload: bytes) -> None:
        try:
            self._kept_zones = read_zones(payload) if payload else ZonesMessage(())
        except BadZonesError:
            self._on_wrong()
        self._set_zones()

    def _set_zones(self) -> None:
        if self._site is not None:
            self._zones.set_zones(zones_of(self._kept_zones, self._site.site.name).zones, self._wall_clock())

    def _on_alarm(self, topic: str, payload: bytes) -> None:
        if not payload:
            self._alarms.pop(topic, None)
            return
        try:
            alarm = read_message(payload, AlarmMessage)
        except WrongMessageError:
            self._on_wrong()
        else:
            if topic in self._alarms or len(self._alarms) < _MAX_ALARMS:
                self._alarms[topic] = alarm

    def evaluate(self, lag_s: float = 0.0) -> None:
        """Find the condition again, as the page does. ``lag_s`` is the delay of this call."""
        now_s = self._clock()
        watch, made_s = self._watch or (None, now_s)
        age_s = None if watch is None else now_s - made_s
        used = None if self._used_share is None else self._used_share(now_s)
        self.condition = self._monitor.evaluate(now_s, lag_s, watch, age_s, used, self.link.unread_s)
        self._zones.expire_tags(now_s, self._wall_clock())

    def picture(self) -> Picture:
        """The site now."""
        now_s, site = self._clock(), self._site
        names: dict[str, str] = {}
        if site is not None and self._assets.site in ("", site.site.name):
            names = {asset.tag: asset.name for asset in self._assets.assets}
        tags = [self._tag_row(name, node, names.get(name, ""), now_s) for name, node in self.evidence.of("tag")]
        nodes = dict.fromkeys(self.evidence.site_anchors(), Node()) | dict(self.evidence.of("anchor"))
        drops: Counter[str] = Counter()
        for kind in ("tag", "anchor"):
            for _, node in self.evidence.of(kind):
                if node.reports(now_s) and isinstance(node.health, TagHealth | AnchorHealth):
                    drops.update(node.health.counters)
        return Picture(
            site="" if site is None else site.site.name,
            number=self._number,
            simulated=site is not None and site.simulated,
            unix_s=self._wall_clock(),
            broker=str(self.link.address),
            trouble=self.link.trouble,
            condition=self.condition,
            tags=tuple(sorted(tags, key=_tag_rank)),
            anchors=tuple(sorted((_anchor_row(*one, now_s) for one in nodes.items()), key=_anchor_rank)),
            alarms=tuple(sorted(self._alarms.values(), key=_alarm_rank)),
            drops={reason: count for reason, count in drops.most_common() if count and reason not in _NOT_DROPS},
            wrong_messages=self._wrong,
        )

    def _tag_row(self, tag: str, node: Node, name: str, now_s: float) -> TagRow:
        state: Literal["fix", "no fix", "offline"] = "no fix"
        if node.online is False:
            state = "offline"
        elif self.evidence.connected and node.has_fix(now_s):
            state = "fix"
        health = node.health if node.reports(now_s) and isinstance(node.health, TagHealth) else None
        rate, reason = (None, "") if health is None else (health.updates_per_s, health.reason or "")
        if tag not in self._fixes:
            return TagRow(tag, state, name, updates_per_s=rate, reason=reason)
        fix, ended_s = self._fixes[tag]
        return TagRow(
            tag, state, name, now_s - ended_s, fix.position_m, fix.std_m, fix.hpl_m, rate, len(fix.anchors),
            fix.alert if fix.alert in ALERTS and fix.alert else "", reason,
            tuple(zone.name for zone in self._zones.zones_with(tag)) if state == "fix" else (),
        )  # fmt: skip


def _anchor_row(name: str, node: Node, now_s: float) -> AnchorRow:
    health, age_s = node.health, now_s - node.health_s
    if not isinstance(health, AnchorHealth):
        used = now_s - node.used_s < FRESH_S  # as an anchor of another system, which has no program of its own
        return AnchorRow(name, "used" if used else "offline" if node.online is False else "silent")
    state = "offline" if node.online is False else health.role if node.reports(now_s) else "silent"
    hears = sum(heard_s < FRESH_S for heard_s in health.heard_age_s.values())
    return AnchorRow(name, state, age_s, hears, health.missed_share)


def _tag_rank(row: TagRow) -> tuple[int, str, str]:
    trouble = {"no fix": 0, "fix": 3 - ALERTS.get(row.alert, 0), "offline": 4}[row.state]
    return trouble, row.name or row.tag, row.tag


def _anchor_rank(row: AnchorRow) -> tuple[bool, int, str]:
    return row.state not in ("silent", "offline"), int(row.anchor) if row.anchor.isdecimal() else 1 << 30, row.anchor


def _alarm_rank(alarm: AlarmMessage) -> tuple[bool, bool, int, float]:
    severity = ("critical", "warning", "info").index(alarm.severity)
    return alarm.acknowledged_unix_s is not None, alarm.ended_unix_s is not None, severity, -alarm.unix_s
