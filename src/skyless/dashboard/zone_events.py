"""Which of several dashboards publishes that a tag has entered or left a zone. No I/O; the time is passed in."""

from collections import deque
from typing import Final

from skyless.mqtt.messages import StatusMessage, ZoneEvent

MAX_EVENTS: Final = 50
"""Events that are kept for pages."""

TAKEOVER_S: Final = 1.0
"""A dashboard waits this long for each one of a lower rank to publish an event that both have detected."""

_SAME_EVENT_S: Final = 2.0


def publisher_rank(name: str, dashboards: list[StatusMessage]) -> int:
    """How many of the dashboards that are online came online before this one; the first publishes the events."""
    online = sorted((status.unix_s, status.name) for status in dashboards if status.online)
    names = [other for _, other in online]
    return names.index(name) if name in names else 0


class EventQueue:
    """Events that wait to be published, and the last that were."""

    def __init__(self) -> None:
        self.recent: deque[ZoneEvent] = deque(maxlen=MAX_EVENTS)
        self._waiting: list[tuple[float, ZoneEvent]] = []

    def schedule(self, events: list[ZoneEvent], rank: int, now_s: float) -> None:
        """Add events detected here, by a dashboard with this rank."""
        self._waiting += [(now_s + rank * TAKEOVER_S, event) for event in events]

    def pop_due(self, now_s: float) -> list[ZoneEvent]:
        """Events that no other dashboard has published in time; they count as published."""
        due = [event for at_s, event in self._waiting if at_s <= now_s]
        if due:
            self._waiting = [(at_s, event) for at_s, event in self._waiting if at_s > now_s]
            self.recent.extend(due)
        return due

    def add_published(self, event: ZoneEvent) -> bool:
        """Add an event from MQTT; whether it is new, neither an own one nor a repetition."""
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
