"""Events at a site, from the messages of MQTT or of a recording. No I/O.

``now_s`` is the time of the owner: the page server's monotonic clock, so that setting a clock ends nothing, or the
recording's times.
"""

from collections import deque
from collections.abc import Callable
from itertools import islice, takewhile
from typing import TYPE_CHECKING, Final, Generic, Literal, TypeAlias, TypeVar

from msgspec import Struct
from msgspec.structs import asdict

from skyless.page.state import encode
from skyless.run.condition.evidence import ALERT_WORDS, ALERTS, LeaderTracker
from skyless.run.condition.monitor import Condition
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import (
    AlarmMessage,
    AnchorHealth,
    FixMessage,
    StatusMessage,
    SurveyMessage,
    WatchMessage,
    WrongMessageError,
    ZoneEvent,
)
from skyless.run.site_table import THRESHOLDS, Health, SiteTable

if TYPE_CHECKING:
    from skyless.run.hub import HubLink

MAX_LOGGED: Final = 500
"""Most events kept; the oldest are dropped."""

ALERT_END_S: Final = 1.0
"""An alert ends when no fix has had it for this long."""

ALERT_INTERVAL_S: Final = 10.0
"""Alerts of one tag that begin sooner than this after the last one are only counted."""

_KEPT_S: Final = 5.0  # an older first status is a retained one, and no event

MAX_EVENTS: Final = 50
"""Most zone events kept for pages."""

TAKEOVER_S: Final = 1.0
"""How long a dashboard waits, per dashboard of lower rank, for another one to publish an event."""

_SAME_EVENT_S: Final = 2.0

_SUBJECTS: Final = {"ether": "the emulated air", "dashboard": "page server", "survey": "survey program"}

_BUSY: Final = frozenset({"slow", "busy", "behind"})
"""Reasons that come and go when a computer is too slow."""

Kind = Literal["anchor", "master", "watch", "alert", "tag", "program", "survey", "condition", "alarm"]
Severity = Literal["good", "note", "warning", "bad"]


class Event(Struct, frozen=True):
    """One line of the list."""

    serial: int
    """Number of the event, from 1; of a line of several events, the last one's."""
    unix_s: float
    kind: Kind
    level: Severity
    name: str
    """Subject, such as ``tag/t1``, ``anchor/3`` or ``recorder/demo``; empty for the site."""
    text: str
    count: int = 1
    """Number of events in the line: consecutive changes of the master, or of whether computers keep up, are joined."""
    first: int = 0
    """Serial of the first event of the line."""


class _Alert:
    """The alert of one tag."""

    def __init__(self) -> None:
        self.seen_s = self.logged_s = float("-inf")
        self.alert: str | None = None  # the current alert
        self.logged = False  # whether the beginning of this alert is in the list
        self.skipped = 0


class EventLog:
    """Derives events from messages, and from a site's table, to which its owner adds them."""

    def __init__(
        self, table: SiteTable, unix_offset_s: float = 0.0, add: Callable[[Event], None] = lambda _event: None
    ) -> None:
        """``add`` is called with each event. ``unix_offset_s``: Unix time less ``now_s``, to be kept up to date."""
        self.unix_offset_s, self._table, self._add_to_list = unix_offset_s, table, add
        self.serial = 0
        self.events: deque[Event] = deque(maxlen=MAX_LOGGED)
        """Events, the oldest first."""
        self._silent: set[tuple[str, str]] = set()  # nodes whose silence is in the list
        self._asleep: set[tuple[str, str]] = set()  # tags that disconnected as they fell asleep
        self._paused_s = float("-inf")
        self._leader = LeaderTracker()
        self._alerts: dict[str, _Alert] = {}
        self._findings: dict[tuple[str, tuple[int, ...]], str] = {}
        self._saved: int | None = None
        self._surveyed_by: str | None = None
        self._condition: Condition | None = None
        self._joins = ""  # key of the last event, if events with the same key are joined to its line

    # Nodes

    def on_status(self, status: StatusMessage, before: StatusMessage | None, now_s: float) -> None:
        """Process a status, and the one ``before``: a node may have come online or gone."""
        key = status.kind, status.name
        kept = now_s + self.unix_offset_s - status.unix_s >= _KEPT_S
        changed = before is not None and (
            before.online != status.online or (status.online and before.pid != status.pid)
        )
        happened = changed or (before is None and status.online and not kept)
        if not status.online and status.kind == "tag":
            self._end_alert(status.name, now_s)
        node = self._table.get(*key)
        if not status.online and node is not None and node.asleep_until_s > now_s:
            self._asleep.add(key)
            return
        if status.online and key in self._asleep:
            self._asleep.remove(key)
            if key not in self._silent:
                return
        if key in self._silent:
            if status.online and kept and not changed:
                return  # repeated by the broker
            self._silent.discard(key)
            happened = status.online  # its absence is already in the list
        if happened:
            was_online = status.online and before is not None and before.online
            words = "" if not was_online else "started again" if changed else "reports again"
            self._add_presence(key, status.online, now_s, words)

    def on_health(self, kind: str, name: str, health: Health, now_s: float) -> None:
        """Process a node's health message."""
        key = kind, name
        if key in self._silent:
            self._silent.discard(key)
            self._add_presence(key, True, now_s, "reports again")
        if isinstance(health, AnchorHealth):
            before = self._leader.leader
            leader = self._leader.update(health, now_s)
            if leader is not None:
                text = f"anchor {leader} is the master now, after anchor {before}"
                self._add(now_s, "master", "warning", f"anchor/{leader}", text, joins="master")

    def tick(self, now_s: float) -> None:
        """Find alerts that have ended and nodes that fell silent. To be called once or twice a second."""
        for kind in self._table.kinds:
            for name, node in self._table.senders(kind):
                key, has_ended = (kind, name), node.online is False and (kind, name) not in self._asleep
                if node.health is None or has_ended or key in self._silent:
                    continue
                reported_s = max(node.health_s, node.since_s or node.health_s, node.asleep_until_s, self._paused_s)
                if now_s - reported_s > THRESHOLDS.report_s and (
                    kind != "tag" or self._table.presence(node, now_s) in ("late", "gone")
                ):
                    self._silent.add(key)
                    self._add_presence(key, False, now_s, "does not report any more")
        for name, alert in self._alerts.items():
            if alert.alert is not None and now_s - alert.seen_s > ALERT_END_S:
                self._end_alert(name, now_s)

    def pause(self, now_s: float) -> None:
        """Replace ``tick`` while messages cannot arrive, when silence means nothing."""
        self._paused_s = now_s
        for alert in self._alerts.values():
            alert.seen_s = now_s

    def _add_presence(self, key: tuple[str, str], online: bool, now_s: float, words: str) -> None:
        kind, name = key
        level: Severity = "note"
        if kind in {"anchor", "tag", "ether"}:
            level = "good" if online else "bad" if kind != "tag" else "warning"
            words = words or ("is online" if online else "is offline")
        else:
            words = words or ("started" if online else "ended")
        group: Kind = "anchor" if kind == "anchor" else "tag" if kind == "tag" else "program"
        subject = _SUBJECTS.get(kind, kind)
        subject += "" if kind in {name, "ether"} else f" {name}"
        self._add(now_s, group, level, f"{kind}/{name}", f"{subject} {words}")

    # Fixes

    def on_fix(self, fix: FixMessage, now_s: float) -> None:
        """Process a fix, with or without an integrity alert."""
        alert = self._alerts.get(fix.tag)
        if ALERTS.get(fix.alert, 0) == 0:
            return
        if alert is None:
            alert = self._alerts[fix.tag] = _Alert()
        alert.seen_s = now_s
        if alert.alert is not None and ALERTS[fix.alert] <= ALERTS[alert.alert]:
            return
        worse = alert.alert is not None
        alert.alert = fix.alert
        if now_s - alert.logged_s < ALERT_INTERVAL_S and not worse:
            alert.skipped += 1
            return
        more = f" ({alert.skipped} more since the last one)" if alert.skipped else ""
        alert.logged, alert.logged_s, alert.skipped = True, now_s, 0
        level: Severity = "bad" if ALERTS[fix.alert] > 1 else "warning"
        self._add(now_s, "alert", level, f"tag/{fix.tag}", f"tag {fix.tag}: {ALERT_WORDS[fix.alert or '']}{more}")

    def _end_alert(self, name: str, now_s: float) -> None:
        alert = self._alerts.get(name)
        if alert is None or alert.alert is None:
            return
        alert.alert = None
        if alert.logged:
            alert.logged = False
            self._add(now_s, "alert", "good", f"tag/{name}", f"tag {name}: integrity alert ended")

    # Survey and watch

    def on_watch(self, watch: WatchMessage | None, now_s: float) -> None:
        """Process the current findings of the watch, or None when it has ended."""
        findings = () if watch is None else watch.findings
        now = {(str(finding.kind), finding.anchors): finding.sentence.rstrip(".") for finding in findings}
        before, self._findings = self._findings, now
        for (kind, anchors), sentence in now.items():
            if (kind, anchors) not in before:
                level: Severity = "bad" if kind == "moved" else "warning"
                self._add(now_s, "watch", level, f"anchor/{anchors[0]}" if anchors else "", sentence)
        for kind, anchors in before.keys() - now.keys():
            if watch is not None:
                text = f"no longer found: {before[kind, anchors]}"
                self._add(now_s, "watch", "good", f"anchor/{anchors[0]}" if anchors else "", text)

    def on_survey(self, survey: SurveyMessage | None, now_s: float) -> None:
        """Process the survey program's state. A saved result is an event."""
        if survey is None:
            return
        same = survey.by == self._surveyed_by
        if same and survey.saved_serial is not None and survey.saved_serial != self._saved:
            where = f" to {survey.file}" if survey.file else ""
            self._add(now_s, "survey", "note", "", f"survey result {survey.saved_serial} saved{where}")
        self._surveyed_by, self._saved = survey.by, survey.saved_serial

    # Alarms

    def on_alarm(self, what: str, alarm: AlarmMessage, now_s: float) -> None:
        """Add an event for an alarm that was raised, has ended or was acknowledged."""
        level: Severity = (
            "bad" if alarm.severity == "critical" else "warning" if alarm.severity == "warning" else "note"
        )
        who = f" by {alarm.acknowledged_by}" if what == "acknowledged" and alarm.acknowledged_by else ""
        words = "" if what == "raised" else f" {what}{who}"
        text = f"alarm {alarm.name}{words}: {alarm.sentence}"
        kind, _, name = alarm.subject.partition("-") if not alarm.tags else ("tag", "", alarm.tags[0])
        self._add(now_s, "alarm", level if what == "raised" else "note", f"{kind}/{name}", text)

    # Condition

    def on_condition(self, condition: Condition, now_s: float) -> None:
        """Process the site's condition. A change of its level, or of its first reason, is an event."""
        before, self._condition = self._condition, condition
        if before is not None and _first(before) == _first(condition):
            return
        if condition.level == "waiting" or (before is None and condition.level == "good"):
            return
        if condition.level == "good":
            was_busy = before is not None and _first(before)[1] in _BUSY
            why = f", after: {before.text}" if before is not None and was_busy else ""
            self._add(now_s, "condition", "good", "", f"condition good{why}", joins="busy" if was_busy else "")
        else:
            word = "fault" if condition.level == "bad" else "warning"
            joins = "busy" if _first(condition)[1] in _BUSY else ""
            self._add(now_s, "condition", condition.level, "", f"{word}: {condition.text}", joins=joins)

    def _add(self, now_s: float, kind: Kind, level: Severity, name: str, text: str, *, joins: str = "") -> None:
        self.serial += 1
        count, first = 1, self.serial
        before, self._joins = self._joins, joins
        if joins and joins == before:
            last = self.events.pop()
            count, first = last.count + 1, last.first
        event = Event(self.serial, now_s + self.unix_offset_s, kind, level, name, text, count, first)
        self.events.append(event)
        self._add_to_list(event)


def _first(condition: Condition) -> tuple[str, str]:
    return condition.level, condition.reasons[0].kind if condition.reasons else ""


# Tags that enter and leave zones


def publisher_rank(name: str, dashboards: list[StatusMessage]) -> int:
    """Number of online dashboards that came online before this one. The first publishes the events."""
    names = [other for _, other in sorted((status.unix_s, status.name) for status in dashboards if status.online)]
    return names.index(name) if name in names else 0


class EventQueue:
    """Zone events that wait to be published, and the last published ones.

    If several dashboards detect an event, only one publishes it.
    """

    def __init__(self) -> None:
        self.recent: deque[ZoneEvent] = deque(maxlen=MAX_EVENTS)
        self._waiting: list[tuple[float, ZoneEvent]] = []

    def schedule(self, events: list[ZoneEvent], rank: int, now_s: float) -> None:
        """Add events detected by this dashboard, which has this rank."""
        self._waiting += [(now_s + rank * TAKEOVER_S, event) for event in events]

    def pop_due(self, now_s: float) -> list[ZoneEvent]:
        """Return events that no other dashboard has published in time. They count as published."""
        due = [event for at_s, event in self._waiting if at_s <= now_s]
        if due:
            self._waiting = [(at_s, event) for at_s, event in self._waiting if at_s > now_s]
            self.recent.extend(due)
        return due

    def add_published(self, event: ZoneEvent) -> bool:
        """Add an event from MQTT. Returns False for the echo of an own event, or a repetition."""
        if event in self.recent:
            return False
        for index, (_, waiting) in enumerate(self._waiting):
            if _same(event, waiting):
                del self._waiting[index]
                break
        self.recent.append(event)
        return True


def _same(a: ZoneEvent, b: ZoneEvent) -> bool:
    return (a.zone, a.tag, a.kind) == (b.zone, b.tag, b.kind) and abs(a.unix_s - b.unix_s) < _SAME_EVENT_S


# Numbered events at a site since the server's start, which programs read in pages.

MAX_KEPT: Final = 2_000
"""Most events kept; the oldest are dropped."""


class SiteEvent(Struct, frozen=True):
    """One event: a tag entered or left a zone, or a line of the page's list of events."""

    id: int
    """Counts from 1 since the server's start."""
    unix_s: float
    kind: Kind | Literal["zone"]
    level: Severity
    subject: str
    """Subject, such as ``tag/t1`` or ``anchor/3``; empty for the site."""
    text: str
    """For people."""
    zone_event: ZoneEvent | None = None
    """Event of kind ``zone``."""


class EventList:
    """The newest events with their messages to pages. Readers ask for those before or since a number."""

    def __init__(self) -> None:
        self.last = 0
        """Number of the newest event."""
        self._events: deque[tuple[SiteEvent, bytes]] = deque(maxlen=MAX_KEPT)

    def add_zone_event(self, event: ZoneEvent) -> None:
        """Add a zone event."""
        self.last += 1
        text = f"tag {event.tag} {'entered' if event.kind == 'enter' else 'left'} {event.name or event.zone}"
        found = SiteEvent(self.last, event.unix_s, "zone", "note", f"tag/{event.tag}", text, event)
        self._events.append((found, encode("zone_event", asdict(event))))

    def add_logged(self, event: Event) -> None:
        """Add an event of the page's list."""
        self.last += 1
        found = SiteEvent(self.last, event.unix_s, event.kind, event.level, event.name, event.text)
        self._events.append((found, encode("log", {"events": [event]})))

    def before(self, number: int, limit: int) -> list[SiteEvent]:
        """At most ``limit`` events before a number, the newest first."""
        return list(islice((event for event, _ in reversed(self._events) if event.id < number), limit))

    def since(self, number: int) -> list[tuple[SiteEvent, bytes]]:
        """Events after a number with their messages, the oldest first."""
        return list(takewhile(lambda kept: kept[0].id > number, reversed(self._events)))[::-1]


# Lists that pages edit and the broker retains: zones, alarm rules, assets.

SiteLink: TypeAlias = "Link | HubLink"
"""A site's connection to its broker, or to a hub, where nothing can be stored."""

_Message = TypeVar("_Message", bound=Struct)


class Kept(Generic[_Message]):
    """The retained message of one topic: the broker's, or the one last stored here."""

    def __init__(self, empty: _Message, read: Callable[[bytes], _Message]) -> None:
        """``empty``: value of a topic without a message; ``read`` decodes one, or raises ValueError."""
        self.message = empty
        self.fault: str | None = None
        """Why the broker's message cannot be read."""
        self._empty, self._read = empty, read
        self._link: SiteLink | None = None
        self._topic = ""
        self._is_on_its_way = False  # the message was stored here and has not come back from the broker

    def attach(self, link: SiteLink, topic: str) -> None:
        """Use a connection, and publish a message that was stored here before."""
        self._link, self._topic = link, topic
        if self._is_on_its_way:
            self.store(self.message)

    def receive(self, payload: bytes) -> bool:
        """Process the broker's message. Returns whether ``message`` has changed. Raises WrongMessageError."""
        try:
            message = self._read(payload) if payload else self._empty
        except ValueError as error:
            self.fault = f"what the broker keeps at {self._topic} cannot be read: {error}"
            raise WrongMessageError(str(error)) from None
        self.fault = None
        if message == self.message:
            self._is_on_its_way = False
            return False
        if self._is_on_its_way:
            return False  # older than the message stored here
        if self._link is not None:
            self._link.forget(self._topic)  # a message stored here must not be repeated after a reconnect
        self.message = message
        return True

    def check_store(self, site: str, shown: str) -> None:
        """Check that a page of ``site`` may replace the list of the site ``shown``. Raises WrongMessageError."""
        if site and site != shown:
            raise WrongMessageError(f"site is {site[:100]!r}; it should be {shown[:100]!r}, which is shown now")
        if self.fault is not None:
            raise WrongMessageError(f"{self.fault}; nothing was overwritten. Clear that topic to begin again")

    def store(self, message: _Message) -> None:
        """Replace the message, also at the broker."""
        self.message, self._is_on_its_way = message, True
        if self._link is not None:
            self._link.publish(self._topic, message, qos=1, retain=True)
