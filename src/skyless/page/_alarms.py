"""The alarms of a site: evaluation of its messages, publication, and the messages to pages.

Of a site's dashboards the first one online leads: it raises and publishes the alarms. The others follow with engines
that have seen the same messages, so that the next one can take over.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Final

from msgspec.structs import replace

from skyless.core.site import AlarmRule
from skyless.page.events import Kept, SiteLink
from skyless.page.state import encode
from skyless.run.alarms import MAX_KEPT, AlarmEngine, Key, is_over
from skyless.run.mqtt.messages import (
    AcknowledgeMessage,
    AlarmMessage,
    AlarmRulesMessage,
    SiteMessage,
    StatusMessage,
    WrongMessageError,
    read_message,
)
from skyless.run.mqtt.topics import alarm_rules_topic, alarm_topic
from skyless.run.site_feed import Channel, SiteFeed
from skyless.run.site_table import SiteTable
from skyless.run.zones import ZoneMonitor
from skyless.site.alarm_rules import check_rules

MAX_SENT: Final = 500
"""Most alarms sent to a page: unacknowledged ones first, then the newest."""

KEPT_WAIT_S: Final = 2.0
"""Time after connecting by which the broker's retained messages have arrived."""


class NoAlarmError(Exception):
    """There is no such alarm."""


class SiteAlarms:
    """The rules and alarms of one site. Each change is passed to ``broadcast`` for the open pages."""

    def __init__(
        self,
        name: str,
        monitor: ZoneMonitor,
        table: SiteTable,
        broadcast: Callable[[str, bytes], None],
        log: Callable[[str, AlarmMessage, float], None],
    ) -> None:
        """``name``: of the dashboard on MQTT; ``log`` is called with changes of alarms."""
        self.engine = AlarmEngine(monitor, table)
        self.rules: tuple[AlarmRule, ...] = ()
        """Rules made on the page."""
        self.file_rules: tuple[AlarmRule, ...] = ()
        """Rules of the site's file."""
        self._name, self._broadcast, self._log = name, broadcast, log
        self._link: SiteLink | None = None
        self._site_id = 0
        self._site = ""
        self._kept_rules = Kept(AlarmRulesMessage(()), read_rules)
        self._received: dict[Key, AlarmMessage] = {}
        """Alarms at the broker, received since the last connection."""
        self._connected_s: float | None = None
        self._changed = False
        self._sent_s = float("-inf")

    # Pages

    @property
    def messages(self) -> tuple[AlarmMessage, ...]:
        """Current alarms: unacknowledged ones first, then the newest."""
        kept = self.engine.messages.values()
        return tuple(sorted(kept, key=lambda one: (one.acknowledged_unix_s is not None, -one.unix_s)))

    def encoded(self) -> dict[str, bytes]:
        """The messages that a new page needs, by kind."""
        alarms = self.messages
        return {
            "alarms": encode("alarms", {"alarms": alarms[:MAX_SENT], "more": max(0, len(alarms) - MAX_SENT)}),
            "alarm_rules": encode("alarm_rules", {"rules": self.rules, "file_rules": self.file_rules}),
        }

    # MQTT

    def follow(self, feed: SiteFeed, link: SiteLink, site_id: int) -> None:
        """Get the rules and alarms of a feed, and use its connection."""
        self._link, self._site_id = link, site_id
        self._kept_rules.attach(link, alarm_rules_topic(site_id))
        feed.on_bytes("alarm_rules", lambda payload, _: self._on_rules(payload))
        feed.on(AlarmMessage, self._on_alarm)
        feed.on(AcknowledgeMessage, self._on_acknowledge)

    def on_connection(self, connected: bool, now_s: float) -> None:
        """The broker has been connected or disconnected."""
        self._connected_s = now_s if connected else None
        self._received.clear()
        if not connected:
            self._rest()

    def on_site(self, site: SiteMessage) -> None:
        """Use the site's name and rules."""
        self._site, self.file_rules = site.site.name, site.alarms
        self._apply_rules()

    def _on_rules(self, payload: bytes) -> None:
        if self._kept_rules.receive(payload):
            self._apply_rules()

    def _on_alarm(self, message: AlarmMessage | None, channel: Channel) -> None:
        rule, _, subject = channel.name.partition("/")
        key, kept, was_cleared = (rule, subject), self.engine.messages, message is None
        if message is not None and is_over(message):
            message = None
        if message is None:
            self._received.pop(key, None)
        elif key not in self._received and len(self._received) >= 2 * MAX_KEPT:
            raise WrongMessageError("there are too many alarms")
        else:
            self._received[key] = message
        if self.engine.leading:
            if was_cleared and key not in kept and self._link is not None:
                self._link.forget(alarm_topic(self._site_id, rule, subject))  # the broker has cleared it
            return
        self._changed = True
        if message is None:
            kept.pop(key, None)
        else:
            kept[key] = _joined(kept.get(key), message)

    def _on_acknowledge(self, message: AcknowledgeMessage, channel: Channel) -> None:
        """Acknowledge an alarm, even while following: the leader may end before it publishes the acknowledged alarm."""
        rule, _, subject = channel.name.partition("/")
        self._changed |= self.engine.acknowledge(rule, subject, message.id, message.by[:100], message.unix_s)

    # Actions of users

    def store_rules(self, rules: Sequence[AlarmRule], site: str = "") -> None:
        """Store rules from a page of this site. Raises WrongMessageError and BadAlarmRulesError."""
        self._kept_rules.check_store(site, self._site)
        check_rules(rules, self.file_rules)
        self._kept_rules.store(AlarmRulesMessage(tuple(rules), self._site))
        self._apply_rules()

    def check_is_kept(self, rule: str, subject: str, occurrence: str) -> None:
        """Raise NoAlarmError if there is no such alarm."""
        message = self.engine.messages.get((rule, subject))
        if message is None or message.id != occurrence:
            raise NoAlarmError(f"there is no alarm {occurrence[:120]!r} of {rule[:40]!r} and {subject[:80]!r} any more")

    def is_acknowledged(self, rule: str, subject: str, occurrence: str) -> bool:
        """Whether the broker has stored the acknowledgement of an alarm, so that it survives a restart."""
        message = self.engine.messages.get((rule, subject))
        is_open = message is not None and message.id == occurrence and message.acknowledged_unix_s is None
        is_stored = self._link is not None and not self._link.unacknowledged and not self.engine.has_changes
        return is_stored and not is_open

    # Work

    def tick(self, now_s: float, unix_s: float, dashboards: Iterable[StatusMessage], *, blind: bool) -> None:
        """Do due work, 20 times a second. ``dashboards``: of the site; ``blind``: see the engine."""
        ready = self._connected_s is not None and now_s - self._connected_s >= KEPT_WAIT_S and bool(self._site)
        if ready and not blind:
            first = min(((one.unix_s, one.name) for one in dashboards if one.online), default=(0.0, ""))[1]
            if first != self._name:
                self._rest()
                if first:  # drop alarms that the broker does not have, as another dashboard leads
                    kept = self.engine.messages
                    for key in kept.keys() - self._received.keys():
                        del kept[key]
                        self._changed = True
            elif not self.engine.leading:
                self._lead(now_s, unix_s)
        for what, message in self.engine.tick(now_s, unix_s, blind=blind):
            self._changed = True
            if what != "updated":
                self._log(what, message, now_s)
            self._publish(message, dropped=what == "dropped")
        if self._changed and now_s - self._sent_s >= 0.25:
            self._changed, self._sent_s = False, now_s
            self._broadcast("alarms", self.encoded()["alarms"])

    def _apply_rules(self) -> None:
        ids, kept = {rule.id for rule in self.file_rules}, self._kept_rules.message
        mine = kept.rules if kept.site in ("", self._site) else ()
        self.rules = tuple(rule for rule in mine if rule.id not in ids)
        self.engine.set_rules((*self.file_rules, *self.rules))
        self._broadcast("alarm_rules", self.encoded()["alarm_rules"])

    def _lead(self, now_s: float, unix_s: float) -> None:
        """Take over the lead: continue the known alarms, and publish those that differ at the broker."""
        for key, message in self.engine.messages.items():
            if self._received.get(key) != message:
                self._publish(message)
        self.engine.resume(self.engine.messages.values(), now_s, unix_s)

    def _rest(self) -> None:
        """Stop leading. Own publications must not be repeated after a reconnect, when another one may lead."""
        if self.engine.leading and self._link is not None:
            for rule, subject in self.engine.messages:
                self._link.forget(alarm_topic(self._site_id, rule, subject))
        self.engine.leading = False

    def _publish(self, message: AlarmMessage, *, dropped: bool = False) -> None:
        if self._link is None:
            return
        topic = alarm_topic(self._site_id, message.rule, message.subject)
        if not dropped:
            self._link.publish(topic, message, qos=1, retain=not is_over(message))
        if dropped or is_over(message):
            self._link.publish(topic, b"", qos=1, retain=True)


def read_rules(payload: bytes) -> AlarmRulesMessage:
    """Decode an ``AlarmRulesMessage`` and check its rules. Raises WrongMessageError and BadAlarmRulesError."""
    message = read_message(payload, AlarmRulesMessage)
    check_rules(message.rules)
    return message


def _joined(mine: AlarmMessage | None, theirs: AlarmMessage) -> AlarmMessage:
    """Merge the local copy of an alarm with the broker's."""
    if mine is None or mine.id != theirs.id:
        return theirs if mine is None or theirs.unix_s >= mine.unix_s else mine
    if theirs.acknowledged_unix_s is None:
        who, when = mine.acknowledged_by, mine.acknowledged_unix_s
        theirs = replace(theirs, acknowledged_unix_s=when, acknowledged_by=who)
    return theirs if theirs.ended_unix_s is not None else replace(theirs, ended_unix_s=mine.ended_unix_s)
