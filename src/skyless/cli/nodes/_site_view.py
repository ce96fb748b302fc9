"""What a running site publishes, gathered for ``skyless watch`` and ``skyless doctor``: the newest of each thing."""

import asyncio
import contextlib
import os
import platform
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from operator import setitem
from typing import Final, Literal

from msgspec import Struct

from skyless.cli.nodes.options import log
from skyless.core.errors import SkylessError
from skyless.page.condition.evidence import ALERTS, FRESH_S, Evidence, Health, Node
from skyless.page.condition.monitor import EVALUATION_S, Condition, ConditionMonitor
from skyless.run.assets import assets_at, read_assets
from skyless.run.find_site import find_site
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import (
    NOT_DROPS,
    AlarmMessage,
    AnchorHealth,
    AssetsMessage,
    EtherHealth,
    FixMessage,
    SiteMessage,
    StatusMessage,
    TagHealth,
    WatchMessage,
)
from skyless.run.process import keep, reader, together

GONE: Final = ("silent", "offline")
"""States of anchors that are not there."""

LINK_NAME: Final = f"{platform.node()}-{os.getpid()}"
_WAIT_SHARE: Final = 3.0


class TagRow(Struct, frozen=True):
    """A tag as it is shown."""

    tag: str
    state: Literal["fix", "no fix", "offline"]
    age_s: float | None = None
    """Since the last frame of the newest fix; None before the first."""
    fix: FixMessage | None = None
    health: TagHealth | None = None
    """None where it does not report."""
    name: str = ""
    """What people call it, as the page shows it; empty where no asset names it."""


class AnchorRow(Struct, frozen=True):
    """An anchor as it is shown."""

    anchor: str
    state: str
    """Its role; ``used`` where it has no program of its own; ``silent`` or ``offline``."""
    age_s: float | None = None
    """Since its last report."""
    health: AnchorHealth | None = None


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


async def site_number(address: MqttAddress, longest_s: float | None) -> int:
    """The number of the site that is online. Raises SkylessError where there is none by then, or several are."""
    try:
        async with asyncio.timeout(longest_s):
            return await find_site(address)
    except TimeoutError:
        raise SkylessError(f"no program of a site is online at {address}; --site-id shows one all the same") from None


class SiteView:
    """Subscribes to a site's topics. It publishes nothing but its own status."""

    def __init__(
        self,
        link: Link,
        number: int,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
        used_share: Callable[[float], float | None] = lambda _: None,
    ) -> None:
        """``used_share`` is as for the page's ``LiveSite``."""
        self.link, self.number, self._clock, self._wall_clock = link, number, clock, wall_clock
        self._used_share = used_share
        self.evidence = Evidence(platform.node(), clock())
        self._monitor = ConditionMonitor(self.evidence)
        self.condition = self._monitor.evaluate(clock())
        self.site: SiteMessage | None = None
        self._fixes: dict[str, tuple[FixMessage, float]] = {}  # with the time at which its last frame ended
        self._alarms: dict[str, AlarmMessage] = {}
        self._watch: tuple[WatchMessage, float] | None = None  # with the time at which it was made
        self._wrong = 0
        self._assets = AssetsMessage(())
        self.on_fix: list[Callable[[FixMessage], None]] = []
        """Called with every fix."""
        self.on_health: list[Callable[[Health], None]] = []
        """Called with every health of a tag, an anchor or the air."""
        for topic, kind, handle in (
            (topics.site_topic(number), SiteMessage, self._on_site),
            (topics.fix_topic(number, "+"), FixMessage, self._on_fix),
            (topics.status_topic(number, "+", "+"), StatusMessage, lambda m: self.evidence.add_status(m, clock())),
            (topics.health_topic(number, "tag", "+"), TagHealth, lambda m: self._on_health("tag", m.tag, m)),
            (topics.health_topic(number, "anchor", "+"), AnchorHealth, self._on_anchor),
            (topics.health_topic(number, "ether", "+"), EtherHealth, lambda m: self._on_health("ether", "air", m)),
            (topics.watch_topic(number), WatchMessage, self._on_watch),
        ):  # fmt: skip
            link.subscribe(topic, reader(kind, handle, self._on_wrong))
        assets = reader(read_assets, self._on_assets, self._on_wrong, AssetsMessage(()))
        link.subscribe(topics.assets_topic(number), assets)
        link.subscribe(topics.alarm_topic(number, "+", "+"), self._on_alarm, qos=1)
        link.on_state.append(self._on_state)

    def _on_state(self, connected: bool) -> None:
        self._watch = None
        self._alarms.clear()  # the broker sends again what it keeps
        self.evidence.set_connected(connected=connected, now_s=self._clock())

    def _on_wrong(self) -> None:
        self._wrong += 1

    def _on_site(self, message: SiteMessage) -> None:
        self.site = message
        self.evidence.set_site(message.site, self._clock())

    def _on_fix(self, fix: FixMessage) -> None:
        now_s = self._clock()
        if self.evidence.roster.admits("tag", fix.tag):
            self._fixes[fix.tag] = fix, now_s - self.evidence.add_fix(fix, now_s)
            for listener in self.on_fix:
                listener(fix)

    def _on_anchor(self, health: AnchorHealth) -> None:
        self._on_health("anchor", str(health.anchor), health)

    def _on_health(self, kind: str, name: str, health: Health) -> None:
        self.evidence.add_health(kind, name, health, self._clock(), self._wall_clock())
        for listener in self.on_health:
            listener(health)

    def _on_watch(self, message: WatchMessage) -> None:
        """Note when it was made: the first after a connection may be an old one that the broker kept."""
        kept_s = max(0.0, self._wall_clock() - message.unix_s) if self._watch is None else 0.0
        self._watch = message, self._clock() - kept_s

    def _on_assets(self, message: AssetsMessage) -> None:
        self._assets = message

    def _on_alarm(self, topic: str, payload: bytes) -> None:
        if payload:
            reader(AlarmMessage, partial(setitem, self._alarms, topic), self._on_wrong)(topic, payload)
        else:
            self._alarms.pop(topic, None)

    async def run(self, seconds: float | None, act: Callable[[], None]) -> None:
        """Stay connected for some time; evaluate the condition twice a second, and call ``act`` each time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await together(keep(self.link, log), self._evaluate_often(act))

    async def _evaluate_often(self, act: Callable[[], None]) -> None:
        due_s = time.monotonic()
        while True:
            began_s = time.monotonic()
            self.evaluate(began_s - due_s)
            act()
            # Of very many tags it takes longer, and the messages are to be read as well.
            wait_s = max(EVALUATION_S, _WAIT_SHARE * (time.monotonic() - began_s))
            due_s = time.monotonic() + wait_s
            await asyncio.sleep(wait_s)

    def evaluate(self, lag_s: float = 0.0) -> None:
        """Find the condition again, as the page does. ``lag_s`` is the delay of this call."""
        now_s = self._clock()
        watch, made_s = self._watch or (None, now_s)
        used, unread_s, refused = self._used_share(now_s), self.link.unread_s, self.link.refused
        self.condition = self._monitor.evaluate(now_s, lag_s, watch, now_s - made_s, used, unread_s, refused)

    def picture(self) -> Picture:
        """The site now."""
        now_s, site = self._clock(), self.site
        tags, anchors = self.evidence.of("tag"), dict.fromkeys(self.evidence.site_anchors(), Node())
        anchors |= dict(self.evidence.of("anchor"))
        drops: Counter[str] = Counter()
        for node in (*(node for _, node in tags), *anchors.values()):
            if node.reports(now_s) and isinstance(node.health, TagHealth | AnchorHealth):
                drops.update(node.health.counters)
        return Picture(
            site="" if site is None else site.site.name,
            number=self.number,
            simulated=site is not None and site.simulated,
            unix_s=self._wall_clock(),
            broker=str(self.link.address),
            trouble=self.link.trouble,
            condition=self.condition,
            tags=self._tag_rows(tags, now_s),
            anchors=tuple(
                sorted((_anchor_row(*one, now_s) for one in anchors.items()), key=lambda row: row.state not in GONE)
            ),
            alarms=tuple(sorted(self._alarms.values(), key=_alarm_rank)),
            drops={reason: count for reason, count in drops.most_common() if count and reason not in NOT_DROPS},
            wrong_messages=self._wrong,
        )

    def _tag_rows(self, tags: list[tuple[str, Node]], now_s: float) -> tuple[TagRow, ...]:
        rows = []
        assets = {} if self.site is None else assets_at(self._assets, self.site.site.name)
        for tag, node in tags:
            has_fix = self.evidence.connected and node.has_fix(now_s)
            fix, ended_s = self._fixes.get(tag, (None, now_s))
            health = node.health if node.reports(now_s) and isinstance(node.health, TagHealth) else None
            state: Literal["fix", "no fix", "offline"] = "fix" if has_fix else "no fix"
            state = "offline" if node.online is False else state
            age_s = None if fix is None else now_s - ended_s
            name = assets[tag].name if tag in assets else ""
            rows.append(TagRow(tag, state, age_s, fix, health, name))
        return tuple(sorted(rows, key=_tag_rank))


def _anchor_row(name: str, node: Node, now_s: float) -> AnchorRow:
    health = node.health if isinstance(node.health, AnchorHealth) else None
    state = "silent"
    if node.online is False:
        state = "offline"
    elif health is None and now_s - node.used_s < FRESH_S:
        state = "used"
    elif health is not None and node.reports(now_s):
        state = health.role
    return AnchorRow(name, state, None if health is None else now_s - node.health_s, health)


def _tag_rank(row: TagRow) -> int:
    alert = None if row.fix is None else row.fix.alert
    return {"no fix": 0, "fix": 3 - ALERTS.get(alert, 0), "offline": 4}[row.state]


def _alarm_rank(alarm: AlarmMessage) -> tuple[bool, int, float]:
    severity = ("critical", "warning", "info").index(alarm.severity)
    return alarm.acknowledged_unix_s is not None, severity, -alarm.unix_s
