"""From MQTT to the pages: every message finds its place, and every page hears what is new, twenty times a second."""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Struct

import skyless
from skyless.dashboard.incoming import Bus, WrongMessageError, expect_name, read_message
from skyless.dashboard.mailbox import Mailbox
from skyless.dashboard.state import Board, encode
from skyless.dashboard.zone_events import EventDesk, place_in_line
from skyless.dashboard.zones import BadZonesError, ZoneWatch, check_zones, read_zones
from skyless.errors import ConfigurationError
from skyless.mqtt import topics
from skyless.mqtt.messages import (
    AnchorHealth,
    EtherHealth,
    FixMessage,
    SiteMessage,
    StatusMessage,
    TagHealth,
    TruthMessage,
    Zone,
    ZoneEvent,
    ZonesMessage,
)
from skyless.site.check import check_site

TICK_S: Final = 0.05
HEALTH_S: Final = 1.0

_HEALTHS: Final[dict[str, type[Struct]]] = {"tag": TagHealth, "anchor": AnchorHealth, "ether": EtherHealth}
_log = logging.getLogger("skyless.dashboard")


class Live:
    """The live site: what is known of it, its zones, and the pages that watch. All of it belongs to one event loop."""

    def __init__(
        self,
        name: str,
        broker: str,
        site: SiteMessage | None = None,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        """``name`` is the dashboard's on MQTT; ``broker`` its address without a password."""
        self.name, self.broker = name, broker
        self.site = site
        self.floor_plan: bytes | None = None
        self.connected = False
        self.board = Board()
        self.watch = ZoneWatch()
        self.desk = EventDesk()
        self.pages: set[Mailbox] = set()
        self.wrong: Counter[str] = Counter()
        """Messages that were dropped, by kind."""
        self._clock, self._wall_clock = clock, wall_clock
        self._bus: Bus | None = None
        self._site_id: int | None = None
        self._drawn: ZonesMessage | None = None
        """Zones drawn here that have not come back from the broker."""
        self._told_serial = 0
        self._health_due_s = 0.0

    # MQTT

    def attach(self, bus: Bus, site_id: int) -> None:
        """Listen to a site from now on."""
        self._bus, self._site_id = bus, site_id
        handlers: dict[str, Callable[[str, bytes], None]] = {
            topics.site_topic(site_id): self._take_site,
            topics.floor_plan_topic(site_id): self._take_floor_plan,
            topics.fix_topic(site_id, "+"): self._take_fix,
            topics.status_topic(site_id, "+", "+"): self._take_status,
            topics.health_topic(site_id, "+", "+"): self._take_health,
            topics.truth_topic(site_id): self._take_truth,
            topics.zones_topic(site_id): self._take_zones,
            topics.zone_event_topic(site_id, "+"): self._take_zone_event,
        }
        for topic, handler in handlers.items():
            bus.subscribe(topic, self._counting(topic.rsplit("/", 1)[-1], handler), 1 if "zone" in topic else 0)
        if self._drawn is not None:
            bus.publish(topics.zones_topic(site_id), self._drawn, qos=1, retain=True)

    def connection(self, connected: bool) -> None:
        """Take whether the broker is there."""
        if connected != self.connected:
            self.connected = connected
            self._tell("mqtt", self._connection())

    def _counting(self, kind: str, handler: Callable[[str, bytes], None]) -> Callable[[str, bytes], None]:
        def handle(topic: str, payload: bytes) -> None:
            try:
                handler(topic, payload)
            except (WrongMessageError, BadZonesError, ConfigurationError) as error:
                self.wrong[kind] += 1
                if self.wrong[kind] == 1:
                    _log.warning("dropped a wrong message of %s: %s; there may be more", topic, error)

        return handle

    def _take_site(self, _topic: str, payload: bytes) -> None:
        message = read_message(payload, SiteMessage)
        check_site(message.site, Path("the site on MQTT"))
        if message.site.id != self._site_id:
            raise WrongMessageError(f"it is of site {message.site.id}")
        self.site = message
        self._tell("site", encode("site", {"site": message}))

    def _take_floor_plan(self, _topic: str, payload: bytes) -> None:
        self.floor_plan = payload or None

    def _take_fix(self, topic: str, payload: bytes) -> None:
        fix = read_message(payload, FixMessage)
        expect_name(fix.tag, topic)
        now_s = self._clock()
        self.board.fix(fix, now_s)
        self._hold(self.watch.observe(fix, now_s))

    def _take_status(self, topic: str, payload: bytes) -> None:
        if not payload:
            return  # somebody has cleared a retained status
        status = read_message(payload, StatusMessage)
        expect_name(status.name, topic)
        self.board.status(status)
        if status.kind == "tag" and not status.online:
            self._hold(self.watch.gone(status.name, self._wall_clock()))

    def _take_health(self, topic: str, payload: bytes) -> None:
        _, kind, name, _ = topic.rsplit("/", 3)
        if kind in _HEALTHS:
            self.board.health(name, read_message(payload, _HEALTHS[kind]), self._clock())  # type: ignore[arg-type]

    def _take_truth(self, _topic: str, payload: bytes) -> None:
        self.board.truth(read_message(payload, TruthMessage))

    def _take_zones(self, topic: str, payload: bytes) -> None:
        zones = read_zones(payload) if payload else ()
        if self._drawn is not None:
            if zones != self._drawn.zones:
                return  # older than what was drawn here, which is on its way
            self._drawn = None
        elif zones != self.watch.zones and self._bus is not None:
            self._bus.forget(topic)
        self._set_zones(zones)

    def _take_zone_event(self, topic: str, payload: bytes) -> None:
        event = read_message(payload, ZoneEvent)
        expect_name(event.zone, topic)
        if self.desk.heard(event):
            self._tell_event(event)

    # Zones

    def draw_zones(self, zones: tuple[Zone, ...]) -> None:
        """Take the zones that a page has drawn. Raises BadZonesError."""
        check_zones(zones)
        self._drawn = ZonesMessage(zones)
        self._set_zones(zones)
        if self._bus is not None and self._site_id is not None:
            self._bus.publish(topics.zones_topic(self._site_id), self._drawn, qos=1, retain=True)

    def _set_zones(self, zones: tuple[Zone, ...]) -> None:
        if zones != self.watch.zones:
            self._hold(self.watch.set_zones(zones, self._wall_clock()))
            self._tell("zones", encode("zones", {"zones": zones}))

    def _hold(self, events: list[ZoneEvent]) -> None:
        if events:
            dashboards = [status for (kind, _), status in self.board.statuses.items() if kind == "dashboard"]
            self.desk.hold(events, place_in_line(self.name, dashboards), self._clock())

    def _publish_events(self, now_s: float) -> None:
        for event in self.desk.due(now_s):
            self._tell_event(event)
            if self._bus is not None and self._site_id is not None:
                self._bus.publish(topics.zone_event_topic(self._site_id, event.zone), event, qos=1)

    # Pages

    def join(self) -> Mailbox:
        """A new page's mailbox, with what it must know first."""
        hello = {
            "version": skyless.__version__,
            "site": self.site,
            "zones": self.watch.zones,
            "events": list(self.desk.recent),
            "mqtt": self.connected,
        }
        page = Mailbox(encode("hello", hello))
        page.put("mqtt", self._connection())
        page.put("health", self._health())
        self.pages.add(page)
        return page

    def leave(self, page: Mailbox) -> None:
        """Forget a page."""
        self.pages.discard(page)

    def close(self) -> None:
        """Let all pages go."""
        for page in self.pages:
            page.close()

    def tick(self) -> None:
        """Do what is due; to be called every ``TICK_S``."""
        now_s, unix_s = self._clock(), self._wall_clock()
        self.board.unix_s = unix_s
        self._hold(self.watch.silent(now_s, unix_s))
        self._publish_events(now_s)
        if self.board.serial != self._told_serial:
            self._told_serial = self.board.serial
            for page in self.pages:
                page.state_due()
        if now_s >= self._health_due_s:
            self._health_due_s = now_s + HEALTH_S
            self.board.forget(now_s)
            if self.pages:
                self._tell("health", self._health())

    async def run(self) -> None:
        """Tick until cancelled."""
        due_s = self._clock()
        while True:
            self.tick()
            due_s = max(due_s + TICK_S, self._clock())
            await asyncio.sleep(due_s - self._clock())

    def _connection(self) -> bytes:
        return encode("mqtt", {"connected": self.connected, "broker": self.broker})

    def _health(self) -> bytes:
        return self.board.health_message(self.wrong)

    def _tell(self, kind: str, message: bytes) -> None:
        for page in self.pages:
            page.put(kind, message)

    def _tell_event(self, event: ZoneEvent) -> None:
        message = encode("zone_event", msgspec.structs.asdict(event))
        for page in self.pages:
            page.event(message)
