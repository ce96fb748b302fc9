"""Which events a site's messages tell of; a message that comes again, as retained ones do, tells of none. No I/O."""

from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any, Final

from skyless.run.history.layout import EventKind
from skyless.run.history.tables import Event
from skyless.run.limits import HISTORY as LIMITS
from skyless.run.mqtt.messages import AlarmMessage, StatusMessage, ZoneEvent

REMEMBERED_KINDS: Final = ("alarm-raised", "alarm-ended", "alarm-acknowledged", "offline", "online")
"""Events that retained messages tell of: those of the past must be known."""


class EventLog:
    """Tells new events from those that are known."""

    def __init__(self, past: Iterable[Event] = ()) -> None:
        """``past``: the events that the history has, in order."""
        self._alarms: set[tuple[EventKind, str]] = set()
        self._last: dict[tuple[str | None, ...], tuple[EventKind, datetime | None]] = {}
        """What was last heard of a node, or of a tag in a zone; of one that is offline, when it had come."""
        for event in past:
            self._remember(event)

    def of(self, message: ZoneEvent | AlarmMessage | StatusMessage, now_unix_s: float) -> list[Event]:
        """What is new: a tag entered or left a zone, an alarm came to something, a tag or an anchor came or went."""
        if isinstance(message, ZoneEvent):
            text = f"{message.tag} {'entered' if message.kind == 'enter' else 'left'} {message.name}"
            return self._new(message.unix_s, message.kind, tag=message.tag, zone=message.zone, text=text)
        if isinstance(message, AlarmMessage):
            about = {"zone": message.zone, "subject": message.subject, "alarm": message.id}
            about["tag"] = message.tags[0] if message.tags else None
            return [
                *self._new(message.unix_s, "alarm-raised", text=message.sentence, **about),
                *self._new(message.ended_unix_s, "alarm-ended", text=message.sentence, **about),
                *self._new(message.acknowledged_unix_s, "alarm-acknowledged", text=message.acknowledged_by, **about),
            ]
        kind: EventKind = "online" if message.online else "offline"
        who = {"tag": message.name} if message.kind == "tag" else {"subject": f"{message.kind}-{message.name}"}
        unix_s = message.unix_s if message.online and message.unix_s else now_unix_s
        return self._new(unix_s, kind, text=f"{message.kind} {message.name} is {kind}", **who)

    def _new(self, unix_s: float | None, kind: EventKind, **about: Any) -> list[Event]:  # noqa: ANN401 - Event's fields
        if unix_s is None or not 0.0 <= unix_s <= LIMITS.last_unix_s:
            return []
        event = Event(datetime.fromtimestamp(round(1000 * unix_s) / 1000, UTC), kind, **about)
        return [event] if self._is_new(event) else []

    def _is_new(self, event: Event) -> bool:
        """Remember an event, unless it is a copy; False also where it says what is known."""
        if event.alarm:
            is_new = (event.kind, event.alarm) not in self._alarms
        else:
            before, since = self._last.get(_about(event), (None, None))
            if event.kind != "offline" and event.t == since and event.kind in ("online", before):
                return False  # of "online" perhaps a late copy, which was sent before the node went offline
            is_new = not (event.kind == before and event.kind in ("online", "offline"))
        self._remember(event)
        return is_new

    def _remember(self, event: Event) -> None:
        if event.alarm:
            self._alarms.add((event.kind, event.alarm))
        elif event.kind == "offline":
            self._last[_about(event)] = ("offline", self._last.get(_about(event), (None, None))[1])
        else:
            self._last[_about(event)] = (event.kind, event.t)


def _about(event: Event) -> tuple[str | None, ...]:
    return event.tag, event.zone, event.subject
