"""What has happened at a site since the server's start, with a number for each event: programs read it in pages."""

from collections import deque
from typing import Final, Literal

from msgspec import Struct

from skyless.run.mqtt.messages import ZoneEvent

MAX_KEPT: Final = 2_000
"""Events that are kept. The oldest are dropped."""

Kind = Literal["zone", "alarm", "anchor", "master", "watch", "alert", "tag", "program", "survey", "condition"]
Level = Literal["good", "note", "warning", "bad"]


class SiteEvent(Struct, frozen=True):
    """One event: a tag entered or left a zone, or a line of the page's list of events."""

    id: int
    """Counts from 1 since the server's start."""
    unix_s: float
    kind: Kind
    level: Level
    subject: str
    """What it is about, such as ``tag/t1`` or ``anchor/3``; empty for the site."""
    text: str
    """For people."""
    zone_event: ZoneEvent | None
    """Of the kind ``zone``."""


class EventList:
    """The newest events. Readers ask for a page before a number, or for what is new since one."""

    def __init__(self) -> None:
        self.last = 0
        """Number of the newest event."""
        self._events: deque[SiteEvent] = deque(maxlen=MAX_KEPT)

    def add_zone_event(self, event: ZoneEvent) -> None:
        """A tag has entered or left a zone."""
        verb = "entered" if event.kind == "enter" else "left"
        text = f"tag {event.tag} {verb} {event.name or event.zone}"
        self.add(event.unix_s, "zone", "note", f"tag/{event.tag}", text, event)

    def add(
        self, unix_s: float, kind: Kind, level: Level, subject: str, text: str, event: ZoneEvent | None = None
    ) -> None:
        """Add an event; the fields are those of ``SiteEvent``."""
        self.last += 1
        self._events.append(SiteEvent(self.last, unix_s, kind, level, subject, text, event))

    def before(self, number: int | None, limit: int) -> list[SiteEvent]:
        """At most ``limit`` events before a number, or the newest; the newest first."""
        first = self.last + 1 - len(self._events)
        end = len(self._events) if number is None else min(max(number - first, 0), len(self._events))
        return list(self._events)[max(end - limit, 0) : end][::-1]

    def since(self, number: int) -> list[SiteEvent]:
        """Events after a number, the oldest first."""
        return self.before(None, max(self.last - number, 0))[::-1]
