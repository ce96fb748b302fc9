"""Which events a site's messages tell of; a message that comes again, as retained ones do, tells of none. No I/O."""

from collections.abc import Iterable
from typing import Final

from skyless.run.history.layout import EventKind
from skyless.run.history.sink import Event
from skyless.run.mqtt.messages import AlarmMessage, StatusMessage, ZoneEvent

REMEMBERED_KINDS: Final = ("alarm-raised", "alarm-ended", "alarm-acknowledged", "offline", "online")
"""Events that retained messages tell of: those of the past must be known."""

_MAX_REMEMBERED: Final = 100_000
MAX_UNIX_S: Final = 8e9
"""Times beyond, in more than 200 years, are no times."""


class EventLog:
    """Tells new events from those that are known."""

    def __init__(self, past: Iterable[Event] = ()) -> None:
        """``past``: the events of ``REMEMBERED_KINDS`` that the history has, in order."""
        self._known: dict[tuple[object, ...], EventKind] = {}
        self._came_ms: dict[tuple[object, ...], int] = {}
        for event in past:
            self._is_new(event)

    def of_zone(self, message: ZoneEvent) -> list[Event]:
        """The event of a tag that has entered or left a zone."""
        text = f"{message.tag} {'entered' if message.kind == 'enter' else 'left'} {message.name}"
        return self._new([(message.unix_s, Event(0, message.kind, message.tag, message.zone, None, None, text))])

    def of_alarm(self, message: AlarmMessage) -> list[Event]:
        """What an alarm has come to."""
        about = (message.tags[0] if message.tags else None, message.zone, message.subject, message.id)
        return self._new(
            [
                (message.unix_s, Event(0, "alarm-raised", *about, message.sentence)),
                (message.ended_unix_s, Event(0, "alarm-ended", *about, message.sentence)),
                (message.acknowledged_unix_s, Event(0, "alarm-acknowledged", *about, message.acknowledged_by)),
            ]
        )

    def of_status(self, message: StatusMessage, now_unix_s: float) -> list[Event]:
        """Whether a tag or an anchor has come or gone."""
        tag = message.name if message.kind == "tag" else None
        subject = None if tag is not None else f"{message.kind}-{message.name}"
        kind: EventKind = "online" if message.online else "offline"
        text = f"{message.kind} {message.name} is {kind}"
        unix_s = message.unix_s if message.online and message.unix_s else now_unix_s
        return self._new([(unix_s, Event(0, kind, tag, None, subject, None, text))])

    def _new(self, found: list[tuple[float | None, Event]]) -> list[Event]:
        timed = [
            Event(round(1000 * unix_s), event.kind, event.tag, event.zone, event.subject, event.alarm, event.text)
            for unix_s, event in found
            if unix_s is not None and 0.0 <= unix_s <= MAX_UNIX_S
        ]
        return [event for event in timed if self._is_new(event)]

    def _is_new(self, event: Event) -> bool:
        """Remember an event; False where it is known."""
        key: tuple[object, ...] = (event.kind, event.tag, event.zone, event.unix_ms)
        if event.kind in ("online", "offline"):
            key = (event.tag, event.subject)
            if event.kind == "online" and self._came_ms.get(key) == event.unix_ms:
                return False  # a late copy, perhaps of before it went
            if event.kind == "online":
                self._came_ms[key] = event.unix_ms
        elif event.alarm:
            key = (event.kind, event.alarm)
        before = self._known.pop(key, None)
        self._known[key] = event.kind
        if len(self._known) > _MAX_REMEMBERED:
            oldest = next(iter(self._known))
            del self._known[oldest]
            self._came_ms.pop(oldest, None)
        return before != event.kind
