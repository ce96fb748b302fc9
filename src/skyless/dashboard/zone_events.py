"""Who says that a tag has entered or left: one of the dashboards that watch the same zones, and the next if it is dead.

No I/O; the time is passed in.
"""

from collections import deque
from typing import Final

from skyless.mqtt.messages import StatusMessage, ZoneEvent

MOST_EVENTS: Final = 50
PATIENCE_S: Final = 1.0
"""So long a dashboard waits for each one before it in the line to say what both have seen."""

_SAME_S: Final = 2.0


def place_in_line(name: str, dashboards: list[StatusMessage]) -> int:
    """How many of the dashboards that are online have been so for longer than this one."""
    online = sorted((status.unix_s, status.name) for status in dashboards if status.online)
    names = [other for _, other in online]
    return names.index(name) if name in names else 0


class EventDesk:
    """Events that wait to be published, and the last that were."""

    def __init__(self) -> None:
        self.recent: deque[ZoneEvent] = deque(maxlen=MOST_EVENTS)
        self._held: list[tuple[float, ZoneEvent]] = []

    def hold(self, events: list[ZoneEvent], place: int, now_s: float) -> None:
        """Take what was seen here."""
        self._held += [(now_s + place * PATIENCE_S, event) for event in events]

    def due(self, now_s: float) -> list[ZoneEvent]:
        """What nobody else has said in time; it counts as published."""
        due = [event for at_s, event in self._held if at_s <= now_s]
        if due:
            self._held = [(at_s, event) for at_s, event in self._held if at_s > now_s]
            self.recent.extend(due)
        return due

    def heard(self, event: ZoneEvent) -> bool:
        """Take an event that was published; whether it is new, and not the own one or one that came twice."""
        if event in self.recent:
            return False
        for place, (_, held) in enumerate(self._held):
            if _same(event, held):
                del self._held[place]
                break
        self.recent.append(event)
        return True


def _same(a: ZoneEvent, b: ZoneEvent) -> bool:
    return (a.zone, a.tag, a.kind) == (b.zone, b.tag, b.kind) and abs(a.unix_s - b.unix_s) < _SAME_S
