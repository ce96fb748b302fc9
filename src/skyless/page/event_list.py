"""What has happened at a site since the server's start, with a number for each event: programs read it in pages."""

from collections import deque
from itertools import islice, takewhile
from typing import Final, Literal

from msgspec import Struct
from msgspec.structs import asdict

from skyless.page import _events
from skyless.page._state import encode
from skyless.run.mqtt.messages import ZoneEvent

MAX_KEPT: Final = 2_000
"""Events that are kept. The oldest are dropped."""


class SiteEvent(Struct, frozen=True):
    """One event: a tag entered or left a zone, or a line of the page's list of events."""

    id: int
    """Counts from 1 since the server's start."""
    unix_s: float
    kind: _events.Kind | Literal["zone"]
    level: _events.Severity
    subject: str
    """What it is about, such as ``tag/t1`` or ``anchor/3``; empty for the site."""
    text: str
    """For people."""
    zone_event: ZoneEvent | None = None
    """Of the kind ``zone``."""


class EventList:
    """The newest events, and what pages are sent of each. Readers ask for what is before or since a number."""

    def __init__(self) -> None:
        self.last = 0
        """Number of the newest event."""
        self._events: deque[tuple[SiteEvent, bytes]] = deque(maxlen=MAX_KEPT)

    def add_zone_event(self, event: ZoneEvent) -> None:
        """A tag has entered or left a zone."""
        self.last += 1
        text = f"tag {event.tag} {'entered' if event.kind == 'enter' else 'left'} {event.name or event.zone}"
        found = SiteEvent(self.last, event.unix_s, "zone", "note", f"tag/{event.tag}", text, event)
        self._events.append((found, encode("zone_event", asdict(event))))

    def add_logged(self, event: _events.Event) -> None:
        """A line of the page's list."""
        self.last += 1
        found = SiteEvent(self.last, event.unix_s, event.kind, event.level, event.name, event.text)
        self._events.append((found, encode("log", {"events": [event]})))

    def before(self, number: int, limit: int) -> list[SiteEvent]:
        """At most ``limit`` events before a number, the newest first."""
        return list(islice((event for event, _ in reversed(self._events) if event.id < number), limit))

    def since(self, number: int) -> list[tuple[SiteEvent, bytes]]:
        """Events after a number with their messages, the oldest first."""
        return list(takewhile(lambda kept: kept[0].id > number, reversed(self._events)))[::-1]
