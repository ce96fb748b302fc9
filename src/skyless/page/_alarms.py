"""The alarms of a site: what its messages mean for the rules, what is published, and what pages are sent.

Of the dashboards of a site the first one online leads: it raises the alarms and publishes them. The others follow, with
engines that have seen the same, so that the next one goes on where the first has ended.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

from msgspec.structs import replace

from skyless.core.alarm_rule import AlarmRule
from skyless.page._state import encode
from skyless.run.alarms.engine import MAX_KEPT, AlarmEngine, Key, is_over
from skyless.run.alarms.rules import read_rules
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import (
    AcknowledgeMessage,
    AlarmMessage,
    AlarmRulesMessage,
    Asset,
    SiteMessage,
    StatusMessage,
    WrongMessageError,
    read_message,
)
from skyless.run.mqtt.topics import acknowledge_topic, alarm_rules_topic, alarm_topic
from skyless.run.zones.monitor import ZoneMonitor
from skyless.site.alarm_rules import BadAlarmRulesError, check_rules

MAX_SENT: Final = 500
"""Alarms that a page is sent: those that nobody has acknowledged first, then the newest."""

KEPT_WAIT_S: Final = 2.0
"""After a connection, the messages that the broker has kept are here by then."""

_BROADCAST_S: Final = 0.25
_ASSETS_S: Final = 1.0
_MAX_ASKED: Final = 200

Handler = Callable[[str, bytes], None]


class NoAlarmError(Exception):
    """There is no such alarm."""


class SiteAlarms:
    """The rules and alarms of one site. Each change is handed to ``broadcast`` for the open pages."""

    def __init__(
        self,
        name: str,
        monitor: ZoneMonitor,
        broadcast: Callable[[str, bytes], None],
        log: Callable[[str, AlarmMessage, float], None] = lambda _what, _message, _now_s: None,
        assets: Callable[[], Mapping[str, Asset]] = dict,
    ) -> None:
        """``name`` is the dashboard's on MQTT; ``log`` is given what becomes of alarms; ``assets`` are by tag."""
        self.engine = AlarmEngine(monitor)
        self.rules: tuple[AlarmRule, ...] = ()
        """Those that were made on the page."""
        self.file_rules: tuple[AlarmRule, ...] = ()
        """Those of the site's file."""
        self.assets = assets
        self._name, self._broadcast, self._log = name, broadcast, log
        self._link: Link | None = None
        self._site_id: int | None = None
        self._site = ""
        self._stored = AlarmRulesMessage(())
        self._drawn: AlarmRulesMessage | None = None  # rules stored here that have not come back from the broker
        self._fault = ""  # why the rules that the broker keeps cannot be read
        self._kept: dict[Key, AlarmMessage] = {}
        self._received: dict[Key, AlarmMessage] = {}
        """Alarms as the broker has them, since the last connection."""
        self._asked: deque[tuple[Key, AcknowledgeMessage]] = deque(maxlen=_MAX_ASKED)
        """Acknowledgements that came while another one led, in case it has not published them."""
        self._connected_s: float | None = None
        self._rules_changed = self._changed = False
        self._sent_s = self._assets_s = float("-inf")

    # What pages see

    @property
    def messages(self) -> tuple[AlarmMessage, ...]:
        """The alarms that are kept: those that nobody has acknowledged first, then the newest."""
        kept = self._known().values()
        return tuple(sorted(kept, key=lambda one: (one.acknowledged_unix_s is not None, -one.unix_s)))

    def encoded(self) -> dict[str, bytes]:
        """The messages that a new page needs, by kind."""
        alarms = self.messages
        fields = {"alarms": alarms[:MAX_SENT], "more": max(0, len(alarms) - MAX_SENT)}
        return {"alarms": encode("alarms", fields), "alarm_rules": self._encoded_rules()}

    def _encoded_rules(self) -> bytes:
        return encode("alarm_rules", {"rules": self.rules, "file_rules": self.file_rules})

    def _known(self) -> dict[Key, AlarmMessage]:
        return self.engine.messages if self.engine.leading else self._kept

    # MQTT

    def attach(self, link: Link, site_id: int) -> dict[str, Handler]:
        """What is to be subscribed to, and who handles it."""
        self._link, self._site_id = link, site_id
        if self._drawn is not None:
            link.publish(alarm_rules_topic(site_id), self._drawn, qos=1, retain=True)
        return {
            alarm_rules_topic(site_id): self._on_rules,
            alarm_topic(site_id, "+", "+"): self._on_alarm,
            acknowledge_topic(site_id, "+", "+"): self._on_acknowledge,
        }

    def on_connection(self, connected: bool, now_s: float) -> None:
        """The broker is connected, or is not any more."""
        self._connected_s = now_s if connected else None
        self._received.clear()
        if not connected:
            self._rest()

    def on_site(self, site: SiteMessage, now_s: float, unix_s: float) -> None:
        """The site is known, with its rules."""
        self._site, self.file_rules = site.site.name, site.alarms
        self._apply_rules(now_s, unix_s)

    def _on_rules(self, topic: str, payload: bytes) -> None:
        try:
            message = read_rules(payload) if payload else AlarmRulesMessage(())
        except BadAlarmRulesError as error:
            self._fault = str(error)
            raise WrongMessageError(str(error)) from None
        if self._drawn is not None:
            if message != self._drawn:
                return  # older than the rules stored here, which are on their way
            self._drawn = None
        elif message != self._stored and self._link is not None:
            self._link.forget(topic)
        self._fault, self._stored, self._rules_changed = "", message, True

    def _on_alarm(self, topic: str, payload: bytes) -> None:
        rule, subject = topic.split("/")[-3:-1]
        key = rule, subject
        if self.engine.leading:
            if not payload and key not in self.engine.messages and self._link is not None:
                self._link.forget(topic)  # the broker has cleared it
            return
        self._changed = True
        message = read_message(payload, AlarmMessage) if payload else None
        if message is None or is_over(message):
            self._received.pop(key, None)
            self._kept.pop(key, None)
            return
        if (message.rule, message.subject) != key:
            raise WrongMessageError(f"it is of {message.rule[:40]!r} and {message.subject[:40]!r}")
        if key not in self._kept and len(self._kept) >= 2 * MAX_KEPT:
            raise WrongMessageError("there are too many alarms")
        self._received[key] = message
        self._kept[key] = _joined(self._kept.get(key), message)

    def _on_acknowledge(self, topic: str, payload: bytes) -> None:
        rule, subject = topic.split("/")[-3:-1]
        message = read_message(payload, AcknowledgeMessage)
        if self.engine.leading:
            self.engine.acknowledge(rule, subject, message.id, message.by[:100], message.unix_s)
        else:
            self._asked.append(((rule, subject), message))

    # What people do

    def store_rules(self, rules: Sequence[AlarmRule], site: str = "") -> None:
        """Store the rules of a page, for the site of this name. Raises BadAlarmRulesError."""
        if site and site != self._site:
            raise BadAlarmRulesError(None, "", "their site", site[:100], f"{self._site[:100]!r}, which is shown now")
        if self._fault:
            right = f"cleared to begin again; nothing was overwritten ({self._fault})"
            raise BadAlarmRulesError(None, "", "the topic alarm_rules", "not readable", right)
        check_rules(rules, self.file_rules)
        self._stored = self._drawn = AlarmRulesMessage(tuple(rules), self._site)
        self._rules_changed = True
        if self._link is not None and self._site_id is not None:
            self._link.publish(alarm_rules_topic(self._site_id), self._drawn, qos=1, retain=True)

    def acknowledge(
        self, rule: str, subject: str, occurrence: str, by: str, unix_s: float
    ) -> AcknowledgeMessage | None:
        """Acknowledge an alarm. Returns what is to be published where another dashboard leads. Raises NoAlarmError."""
        message = self._known().get((rule, subject))
        if message is None or message.id != occurrence:
            raise NoAlarmError(f"there is no alarm {occurrence[:120]!r} of {rule[:40]!r} and {subject[:80]!r} any more")
        if self.engine.leading:
            self.engine.acknowledge(rule, subject, occurrence, by[:100], unix_s)
            return None
        return AcknowledgeMessage(occurrence, by[:100], unix_s)

    # Work

    def tick(self, now_s: float, unix_s: float, dashboards: Iterable[StatusMessage], *, blind: bool) -> None:
        """Do what is due, 20 times a second. ``dashboards`` are those of the site; ``blind`` as of the engine."""
        if self._rules_changed:
            self._apply_rules(now_s, unix_s)
        if now_s - self._assets_s >= _ASSETS_S:
            self._assets_s = now_s
            self.engine.set_assets(self.assets(), now_s, unix_s)
        ready = self._connected_s is not None and now_s - self._connected_s >= KEPT_WAIT_S and bool(self._site)
        if ready and not blind:
            first = min(((one.unix_s, one.name) for one in dashboards if one.online), default=(0.0, ""))[1]
            if first == self._name and not self.engine.leading:
                self._lead(now_s, unix_s)
            elif first != self._name:
                self._rest()
                if first and len(self._kept) > len(self._received):
                    self._kept = {key: self._kept[key] for key in self._received}
                    self._changed = True
        for what, message in self.engine.tick(now_s, unix_s, blind=blind):
            self._changed = True
            self._log(what, message, now_s)
            self._publish(message, dropped=what == "dropped")
        if self._changed and now_s - self._sent_s >= _BROADCAST_S:
            self._changed, self._sent_s = False, now_s
            self._broadcast("alarms", self.encoded()["alarms"])

    def _apply_rules(self, now_s: float, unix_s: float) -> None:
        self._rules_changed = False
        ids = {rule.id for rule in self.file_rules}
        mine = self._stored.rules if self._stored.site in ("", self._site) else ()
        self.rules = tuple(rule for rule in mine if rule.id not in ids)
        self.engine.set_rules((*self.file_rules, *self.rules), now_s, unix_s)
        self._broadcast("alarm_rules", self._encoded_rules())

    def _lead(self, now_s: float, unix_s: float) -> None:
        """Go on with the alarms that are kept, and publish those that the broker does not have so."""
        for key, message in self._kept.items():
            if self._received.get(key) != message:
                self._publish(message)
        self.engine.resume(self._kept.values(), now_s, unix_s)
        for (rule, subject), asked in self._asked:
            self.engine.acknowledge(rule, subject, asked.id, asked.by[:100], asked.unix_s)
        self._asked.clear()

    def _rest(self) -> None:
        """Follow. What this one has published must not come back after a reconnect: another one may lead by then."""
        if not self.engine.leading:
            return
        self._kept = dict(self.engine.messages)
        self.engine.rest()
        for rule, subject in self._kept:
            if self._link is not None and self._site_id is not None:
                self._link.forget(alarm_topic(self._site_id, rule, subject))

    def _publish(self, message: AlarmMessage, *, dropped: bool = False) -> None:
        if self._link is None or self._site_id is None:
            return
        topic = alarm_topic(self._site_id, message.rule, message.subject)
        if not dropped:
            self._link.publish(topic, message, qos=1, retain=not is_over(message))
        if dropped or is_over(message):
            self._link.publish(topic, b"", qos=1, retain=True)


def _joined(mine: AlarmMessage | None, theirs: AlarmMessage) -> AlarmMessage:
    """What is known of an alarm from a copy that was kept here and that of the broker."""
    if mine is None or mine.id != theirs.id:
        return theirs if mine is None or theirs.unix_s >= mine.unix_s else mine
    if theirs.acknowledged_unix_s is None:
        who, when = mine.acknowledged_by, mine.acknowledged_unix_s
        theirs = replace(theirs, acknowledged_unix_s=when, acknowledged_by=who)
    return theirs if theirs.ended_unix_s is not None else replace(theirs, ended_unix_s=mine.ended_unix_s)
