"""The live site: messages from MQTT update its state and zones, and open pages get what is new, 20 times a second.

Everything here belongs to one event loop. From the same messages ``condition`` finds faults of the site, and
``events.py`` lists events.
"""

import asyncio
import platform
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec
from msgspec import UNSET
from starlette.exceptions import HTTPException

from skyless.core.version import installed_version
from skyless.page._alarms import SiteAlarms
from skyless.page.events import EventList, EventLog, EventQueue, Kept, SiteLink, publisher_rank
from skyless.page.site_assets import AssetsFile, SiteAssets
from skyless.page.state import PageRequest, Sent, SiteState, SiteSurvey, encode
from skyless.run.condition.evidence import Evidence
from skyless.run.condition.monitor import EVALUATION_S, Condition, ConditionMonitor, offline_anchors
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import Role
from skyless.run.mqtt.messages import (
    AcknowledgeMessage,
    AnchorHealth,
    EtherHealth,
    FixMessage,
    SiteMessage,
    StatusMessage,
    SurveyFactsMessage,
    SurveySaveMessage,
    TagHealth,
    TruthMessage,
    WrongMessageError,
    Zone,
    ZoneEvent,
    ZonesMessage,
)
from skyless.run.site_feed import Channel, SiteFeed
from skyless.run.site_table import THRESHOLDS, Health, Presence, SiteTable
from skyless.run.web import PAGE as LIMITS
from skyless.run.zones import ZoneMonitor, check_zones, read_zones, zones_of
from skyless.site.file.check import check_site

_STATE_PERIOD_S: Final = 0.05
_HEALTH_PERIOD_S: Final = 1.0
_EVALUATION_SHARE: Final = 5.0  # evaluations take at most a sixth of the time

IDLE_S: Final = 12.0
"""A page that has sent nothing for this long may be closed for another one. A visible page sends a ping every 2 s."""

GONE_S: Final = 180.0
"""A page that has sent nothing for this long is disconnected. Browsers let a hidden one send once a minute."""


class TooManyPagesError(Exception):
    """No further page can be opened now."""


class PageQueue:
    """Messages that wait for one page: the newest of each kind, so that a slow page's queue stays short."""

    def __init__(self, hello: bytes, events: EventList, address: str = "", now_s: float = 0.0) -> None:
        """``address``: of its computer. Of ``events`` the page gets those that are new."""
        self.closed, self.reason = False, ""
        """Whether to close its connection, and why."""
        self.address, self.active_s = address, now_s
        """Address of its computer, and time of the last message from it."""
        self._latest: dict[str, bytes] = {"hello": hello}
        self._events, self._event = events, events.last
        self._sent = Sent()
        self._state_due = self._health_due = True
        self._wake = asyncio.Event()
        self._wake.set()

    def replace(self, kind: str, message: bytes) -> None:
        """Add a message, replacing a waiting one of its kind."""
        self._latest[kind] = message
        self._wake.set()

    def request_state(self, *, health: bool = False) -> None:
        """Send new events and the state, with ``health`` also health messages."""
        self._state_due = True
        self._health_due |= health
        self._wake.set()

    @property
    def named(self) -> tuple[str, ...]:
        """Tags that the page has selected, or shows in a list."""
        return self._sent.wanted.tags

    def ask(self, wanted: PageRequest) -> None:
        """Change what the page wants to be sent."""
        self._sent.wanted = wanted
        self.request_state(health=True)

    def close(self, reason: str = "") -> None:
        """Close the page's connection."""
        self.closed, self.reason = True, reason
        self._wake.set()

    async def drain(self, state: SiteState) -> list[bytes]:
        """Wait for messages and return them all, in the order in which the page needs them."""
        await self._wake.wait()
        self._wake.clear()
        messages = [*self._latest.values(), *(message for _, message in self._events.since(self._event))]
        self._event = self._events.last
        self._latest.clear()
        if self._health_due:
            messages.append(state.new_health(self._sent))
        new = state.new_state(self._sent) if self._state_due else None
        if new is not None:
            messages.append(new)
        self._state_due = self._health_due = False
        return messages


class LiveSite:
    """The live site: its state, its zones, and the open pages."""

    def __init__(
        self,
        name: str,
        broker: str,
        site: SiteMessage | None = None,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
        used_share: Callable[[float], float | None] | None = None,
        assets_file: AssetsFile | None = None,
        has_history: bool = False,
        at_hub: bool = False,
    ) -> None:
        """``name``: of the dashboard on MQTT; ``broker``: address without a password.

        ``at_hub``: zone events and alarms come from the site's own dashboards, and nothing is changed here.

        ``used_share`` gives the share of processors in use at a time of ``clock``: ``ProcessorUse.share``.
        """
        self.name, self.broker = name, broker
        self.site: SiteMessage | None = None
        self.plans: dict[int | None, bytes] = {}
        """Images of the floors by number; None for the image of the whole site."""
        self.connected = False
        self.feed = SiteFeed(clock)
        self.table = SiteTable(clock(), platform.node(), connected=False, drops=self.feed.drops)
        self.state = SiteState(self.table)
        self.monitor = ZoneMonitor()
        self.events = EventQueue()
        self.pages: set[PageQueue] = set()
        self.streams = 0
        """Number of programs that read the site's stream."""
        self.survey = SiteSurvey(name, self._broadcast, clock, wall_clock)
        self.assets = SiteAssets(self._broadcast, assets_file)
        self.event_list = EventList()
        self.has_history, self._at_hub = has_history, at_hub
        self._clock, self.wall_clock = clock, wall_clock
        self._link: SiteLink | None = None
        self._site_id: int | None = None
        self._zones = Kept(ZonesMessage(()), self._read_zones)
        """Zones, including those of other sites with the same number."""
        self._sent_serials = 0, 0  # of the newest fix and event sent to pages
        self._health_due_s = self._condition_due_s = 0.0
        self.evidence = Evidence(self.table)
        self.evidence.hub_trouble = "" if at_hub else None
        self.log = EventLog(self.table, wall_clock() - clock(), self.event_list.add_logged)
        self.alarms = SiteAlarms(name, self.monitor, self.table, self._broadcast, self.log.on_alarm)
        if site is not None:
            self._use_site(site)
        self._condition_monitor = ConditionMonitor(self.evidence)
        self.condition: Condition = self._condition_monitor.evaluate(clock())
        self._lag_s = 0.0
        self._used_share = used_share
        self._sites: bytes | None = None

    def require_site(self) -> SiteMessage:
        """The site. Raises HTTPException while none is known."""
        if self.site is None:
            raise HTTPException(404, "no site is known yet")
        return self.site

    # MQTT

    def attach(self, link: SiteLink, site_id: int) -> None:
        """Subscribe to a site's topics."""
        self._link, self._site_id = link, site_id
        feed = self.feed
        feed.on(SiteMessage, self._on_site)
        feed.on_bytes("floor_plan", self._on_floor_plan)
        feed.on(FixMessage, lambda fix, _: self.add_fix(fix, self._clock()))
        feed.on(StatusMessage, lambda status, _: self._on_status(status))
        for kind in (TagHealth, AnchorHealth, EtherHealth):
            feed.on(kind, self._on_health)
        feed.on(TruthMessage, lambda truth, _: self.state.add_truth(truth))
        feed.on_bytes("zones", lambda payload, _: self._on_zones(payload))
        feed.on(ZoneEvent, lambda event, _: self._on_zone_event(event))
        feed.on_bytes("assets", lambda payload, _: self.assets.on_message(payload))
        self.survey.follow(feed)
        self.alarms.follow(feed, link, site_id)
        feed.attach(link, site_id)
        self._zones.attach(link, topics.zones_topic(site_id))
        self.assets.kept.attach(link, topics.assets_topic(site_id))

    @property
    def number(self) -> int | None:
        """The site's number, or None while none is known."""
        return self._site_id if self.site is None else self.site.site.id

    def on_connection(self, connected: bool) -> None:
        """Update whether the broker is connected."""
        if connected != self.connected:
            self.connected = connected
            self.table.set_connected(connected=connected, now_s=self._clock())
            self._evaluate(self._clock())
            self.survey.expect_kept()
            if not self._at_hub:  # a hub keeps alarms, which are complete after every cut
                self.alarms.on_connection(connected, self._clock())
            self.assets.on_connection(connected, self._clock())
            self._broadcast("mqtt", self._connection())

    def set_sites(self, sites: list[tuple[int, str, bool]]) -> None:
        """Update the broker's sites: number, name, and whether programs are online."""
        message = encode("sites", {"shown": self._site_id, "sites": sites})
        if message != self._sites:
            self._sites = message
            self._broadcast("sites", message)

    def _on_site(self, message: SiteMessage | None, _channel: Channel) -> None:
        if message is None:
            return
        check_site(message.whole_site, Path("the site on MQTT"))
        if message.site.id != self._site_id:
            raise WrongMessageError(f"it is of site {message.site.id}")
        self._use_site(message)
        self._broadcast("site", encode("site", {"site": message}))
        self._assign_zones()

    def _use_site(self, message: SiteMessage) -> None:
        self.site = message
        self.monitor.floors = () if message.floors is UNSET else message.floors
        self.table.set_site(message.site, self._clock(), addresses=message.system == "dl-tdoa")
        self.alarms.on_site(message)
        self.assets.on_site(message.site.name)

    def _on_floor_plan(self, payload: bytes, channel: Channel) -> None:
        if channel.name and not channel.name.removeprefix("-").isdecimal():
            raise WrongMessageError(f"it is of the floor {channel.name[:20]!r}")
        image, floor = payload or None, int(channel.name) if channel.name else None
        if image != self.plans.get(floor):
            if self._link is not None and floor is None:  # an image stored here must not be repeated after a reconnect
                self._link.forget(topics.floor_plan_topic(channel.site))
            self._show_floor_plan(floor, image)

    def _show_floor_plan(self, floor: int | None, image: bytes | None) -> None:
        self.plans.pop(floor, None)
        if image is not None:
            self.plans[floor] = image
        self._broadcast("floor_plan", self._floor_plan_message())

    def _floor_plan_message(self) -> bytes:
        """Message with digests, so that pages reload images that have changed."""
        digests = {floor: f"{zlib.crc32(image):08x}" for floor, image in self.plans.items()}
        return encode("floor_plan", {"digest": digests.pop(None, None), "floors": digests})

    def add_fix(self, fix: FixMessage, now_s: float, *, batched: bool = False) -> None:
        """Process a fix that arrived at this time, perhaps in a batch."""
        unix_s = self.wall_clock() - self._clock() + now_s
        if self.evidence.add_fix(fix, now_s, unix_s, batched=batched) is not None:
            self.log.on_fix(fix, now_s)
            self.alarms.engine.on_fix(fix.tag)
            self._schedule(self.monitor.update(fix))

    def _on_status(self, status: StatusMessage | None) -> None:
        if status is None:
            return  # a retained status was cleared
        node, now_s = self.table.add(status.kind, status.name, sends=True), self._clock()
        if node is None:
            return  # there are too many
        self.log.on_status(status, node.status, now_s)
        if self.evidence.add_status(status, now_s) and status.kind == "tag":
            self._schedule(self.monitor.remove_tag(status.name, self.wall_clock()))

    def _on_health(self, health: Health, channel: Channel) -> None:
        now_s, kind, name = self._clock(), channel.who, channel.name
        self.evidence.add_health(kind, name, health, now_s, self.wall_clock())
        if self.table.get(kind, name) is None:
            return  # there are too many
        self.log.on_health(kind, name, health, now_s)
        if isinstance(health, TagHealth):
            self.alarms.engine.on_health(health)

    @property
    def _dashboards(self) -> list[StatusMessage]:
        return [node.status for node in self.table.all("dashboard").values() if node.status is not None]

    def _read_zones(self, payload: bytes) -> ZonesMessage:
        message = read_zones(payload)
        if not message.site and not message.others:  # of an older program, which does not know other sites
            message = msgspec.structs.replace(message, others=self._zones.message.others)
        return message

    def _on_zones(self, payload: bytes) -> None:
        fault = self._zones.fault
        try:
            if self._zones.receive(payload):
                self._assign_zones()
        finally:
            if self._zones.fault != fault:
                self._broadcast("zones", encode("zones", self._zone_fields()))

    def _on_zone_event(self, event: ZoneEvent) -> None:
        if self.events.add_published(event):
            self.event_list.add_zone_event(event)

    # Zones

    def store_zones(self, zones: tuple[Zone, ...], site: str = "") -> None:
        """Store zones from a page that shows the site with this name. Raises WrongMessageError."""
        check_zones(zones)
        shown = self._site_name
        self._zones.check_store(site, shown)
        self._zones.store(ZonesMessage(zones, shown, zones_of(self._zones.message, shown).others))
        self._assign_zones()

    @property
    def _site_name(self) -> str:
        return "" if self.site is None else self.site.site.name

    def _assign_zones(self) -> None:
        """Show the zones of the current site. Zones without a site are permanently assigned to it."""
        name, kept = self._site_name, self._zones.message
        if name and not kept.site and kept.zones and not self._at_hub:
            self._zones.store(zones_of(kept, name))
        is_foreign = not name and kept.site  # the zones' site is known, but not yet the site shown
        zones = () if is_foreign else zones_of(kept, name).zones
        if zones != self.monitor.zones:
            self._schedule(self.monitor.set_zones(zones, self.wall_clock()))
            self.alarms.engine.set_zones(zones, self._clock())
            self._broadcast("zones", encode("zones", self._zone_fields()))

    def _zone_fields(self) -> dict[str, object]:
        """Zones of the current site, zones of others with its number, and why zones cannot be read."""
        others = zones_of(self._zones.message, self._site_name).others
        return {"zones": self.monitor.zones, "other_zones": others, "zones_fault": self._zones.fault}

    def _schedule(self, events: list[ZoneEvent]) -> None:
        if events and not self._at_hub:
            self.alarms.engine.on_zone_events(events, self._clock())
            self.events.schedule(events, publisher_rank(self.name, self._dashboards), self._clock())

    # Alarms

    def acknowledge(self, rule: str, subject: str, occurrence: str, by: str) -> None:
        """Ask the leading dashboard to acknowledge an alarm. Raises NoAlarmError and HTTPException."""
        link, site_id = self._connected()
        self.alarms.check_is_kept(rule, subject, occurrence)
        message = AcknowledgeMessage(occurrence, by[:100], self.wall_clock())
        link.publish(topics.acknowledge_topic(site_id, rule, subject), message, qos=1)

    # Survey

    def publish_survey(self, message: SurveyFactsMessage | SurveySaveMessage) -> None:
        """Send facts, or the request to save, to the survey program. Raises HTTPException."""
        link, site_id = self._connected()
        if link.address.user == Role.PAGE:  # the broker would drop it without an answer
            raise HTTPException(
                403, "the role page may not set up a site; start this page with the user survey instead"
            )
        is_facts = isinstance(message, SurveyFactsMessage)
        topic = topics.survey_facts_topic(site_id) if is_facts else topics.survey_save_topic(site_id)
        link.publish(topic, message, qos=1)

    def store_floor_plan(self, image: bytes) -> None:
        """Store the image of the floor, a PNG or JPEG, at the broker. Raises HTTPException."""
        link, site_id = self._connected()
        link.publish(topics.floor_plan_topic(site_id), image, qos=1, retain=True)
        self._show_floor_plan(None, image)

    def _connected(self) -> tuple[SiteLink, int]:
        if self._link is None or self._site_id is None or not self.connected:
            raise HTTPException(503, f"the broker {self.broker} is not connected; try again when it is")
        return self._link, self._site_id

    def recent_fixes(self, after: int = 0) -> list[tuple[FixMessage, float]]:
        """The newest fix of each tag that is fresh and after a serial, with the end time of its last frame."""
        now_s, table = self._clock(), self.table
        newer = [tag for tag in table.fixed.values() if tag.serial > after and table.is_fresh(tag, now_s)]
        return [(tag.fix, tag.ended_unix_s) for tag in newer if tag.fix is not None]

    def presence(self, tag: str) -> Presence:
        """Whether a known tag is there, in a word."""
        return self.table.presence(self.table.all("tag")[tag], self._clock())

    # Pages

    def open_page(self, address: str = "", *, live2: bool = False) -> PageQueue:
        """Create the queue of a new page, filled with its first messages. Raises TooManyPagesError."""
        self._make_room(address)
        hello = {
            "version": installed_version(),
            "site": self.site,
            "thresholds": THRESHOLDS,
            **self._zone_fields(),
            "events": list(self.events.recent),
            "mqtt": self.connected,
            "history": self.has_history,
            "live2": live2,
            "hub": self._at_hub,
        }
        page = PageQueue(encode("hello", hello), self.event_list, address, self._clock())
        page.replace("mqtt", self._connection())
        self.state.now_s = self._clock()
        page.replace("condition", self._condition_message())
        page.replace("log", encode("log", {"events": list(self.log.events)}))
        page.replace("assets", self.assets.encoded())
        if self.plans:
            page.replace("floor_plan", self._floor_plan_message())
        if self._sites is not None:
            page.replace("sites", self._sites)
        for kind, message in (self.survey.messages() | self.alarms.encoded()).items():
            page.replace(kind, message)
        self.pages.add(page)
        return page

    def _make_room(self, address: str) -> None:
        """If there are too many pages, close the one idle for longest. Raises TooManyPagesError."""
        mine = [page for page in self.pages if page.address == address]
        if len(mine) < LIMITS.pages_per_address and len(self.pages) < LIMITS.pages:
            return
        oldest = min(mine if len(mine) >= LIMITS.pages_per_address else self.pages, key=lambda page: page.active_s)
        if self._clock() - oldest.active_s < IDLE_S:
            raise TooManyPagesError(f"too many pages are open: {len(mine)} of this computer, {len(self.pages)} in all")
        self._close_idle(oldest)

    def _close_idle(self, page: PageQueue) -> None:
        self.pages.discard(page)
        page.close("this page was idle")

    def keep_page(self, page: PageQueue) -> None:
        """Note that a page has sent something."""
        page.active_s = self._clock()

    def close(self) -> None:
        """Close all pages."""
        for page in self.pages:
            page.close()

    def tick(self, lag_s: float = 0.0) -> None:
        """Do due work; to be called 20 times a second. ``lag_s``: delay of this call."""
        self._lag_s = max(self._lag_s, lag_s)
        now_s, unix_s = self._clock(), self.wall_clock()
        self.state.now_s, self.state.unix_s = now_s, unix_s
        self.log.unix_offset_s = unix_s - now_s
        if now_s >= self._health_due_s:
            self._health_due_s = now_s + _HEALTH_PERIOD_S
            self.state.forget_encoded()
            for name in self.table.tick(now_s):
                self._schedule(self.monitor.remove_tag(name, unix_s))
            for page in self.pages:
                page.request_state(health=True)
            for page in [page for page in self.pages if now_s - page.active_s > GONE_S]:
                self._close_idle(page)
        for event in self.events.pop_due(now_s):
            self.event_list.add_zone_event(event)
            if self._link is not None and self._site_id is not None:
                self._link.publish(topics.zone_event_topic(self._site_id, event.zone), event, qos=1)
        self.alarms.tick(now_s, unix_s, self._dashboards, blind=self._condition_monitor.is_blind(now_s))
        self.assets.tick(now_s)
        if now_s >= self._condition_due_s:
            self._evaluate(now_s)
        serials = self.table.fixes_serial, self.event_list.last
        if serials != self._sent_serials:
            self._sent_serials = serials
            for page in self.pages:
                page.request_state()

    def _evaluate(self, now_s: float) -> None:
        watch, age_s = self.survey.watch.message, self.survey.watch.age_s()
        unread_s, refused = (0.0, ()) if self._link is None else (self._link.unread_s, self._link.refused)
        used_share = None if self._used_share is None else self._used_share(now_s)
        if self._at_hub and self._link is not None:
            self.evidence.hub_trouble = self._link.trouble
        self.condition = self._condition_monitor.evaluate(
            now_s, self._lag_s, watch, age_s, used_share, unread_s, refused
        )
        self._lag_s = 0.0
        blind = self._condition_monitor.is_blind(now_s)
        self.state.judge(now_s, blind=blind)
        offline = None if blind else offline_anchors(self.evidence, now_s)
        fresh = watch if age_s is not None and age_s < THRESHOLDS.watch_s else None
        self.alarms.engine.on_anchors(offline, fresh)
        self.alarms.engine.set_assets(self.assets.by_tag)
        self.table.set_assets(self.assets.by_tag)
        self.log.on_watch(watch, now_s)
        self.log.on_survey(self.survey.survey.message, now_s)
        self.log.on_condition(self.condition, now_s)
        (self.log.pause if blind else self.log.tick)(now_s)
        self._broadcast("condition", self._condition_message())
        # With very many tags this takes longer, and messages must be read, too.
        self._condition_due_s = now_s + max(EVALUATION_S, _EVALUATION_SHARE * (self._clock() - now_s))

    def _condition_message(self) -> bytes:
        """Message of the condition; its time gives pages the server's clock when no tag moves."""
        return encode("condition", {"unix_s": self.wall_clock(), **msgspec.structs.asdict(self.condition)})

    async def run(self) -> None:
        """Tick until cancelled."""
        due_s = self._clock()
        while True:
            self.tick(self._clock() - due_s)
            due_s = max(due_s + _STATE_PERIOD_S, self._clock())
            await asyncio.sleep(due_s - self._clock())

    def _connection(self) -> bytes:
        return encode("mqtt", {"connected": self.connected, "broker": self.broker})

    def _broadcast(self, kind: str, message: bytes) -> None:
        for page in self.pages:
            page.replace(kind, message)
