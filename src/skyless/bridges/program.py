"""``skyless bridge`` and ``skyless tag --to``: fixes for other programs and devices.

A bridge gets a site's fixes from its broker; a tag's program passes on its own without a broker.
"""

import asyncio
import platform
import re
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final
from zlib import crc32

from msgspec import UNSET, Struct, structs

from skyless.bridges.target import SILENCE_CHECK_S, BridgedSite, Hub, Route, bridged_site
from skyless.core.air.almanac import GeoreferencePage
from skyless.core.air.masterless_packets import Point
from skyless.core.errors import SkylessError
from skyless.core.site import GeoreferenceSite
from skyless.run.assets import assets_at
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import (
    AlarmMessage,
    AnchorHealth,
    AssetsMessage,
    FixMessage,
    SiteMessage,
    StatusMessage,
    TagHealth,
    ZonesMessage,
)
from skyless.run.process import HEALTH_S, Log, every, keep, together
from skyless.run.site_feed import SiteFeed
from skyless.run.site_table import THRESHOLDS
from skyless.run.zones import zones_of

if TYPE_CHECKING:  # it compiles kernels, which a bridge of a broker does not need
    from skyless.core.tag.receiver import SiteListener

_GEOREFERENCE_S: Final = 5.0
"""If the site sends a georeference, a tag has it this long after the other pages, which come in turn."""


class BridgeState(Struct, frozen=True):
    """What a bridge has done so far."""

    seconds: float
    fixes: int
    """Usable fixes of all tags."""
    dropped: dict[str, dict[str, int]]
    """By target and reason: messages that its readers missed."""
    malformed: int
    """Unreadable messages from the broker."""


class BridgeNode:
    """Bridges one site until cancelled."""

    def __init__(self, hub: Hub, address: MqttAddress, site: int, log: Log) -> None:
        self.hub = hub
        self.link = Link(address, _name(hub), site=site, kind="bridge")
        self._log = log
        self._started_s = time.monotonic()
        self._last_fix_s = self._started_s
        self._is_silent = False
        self._site: SiteMessage | None = None
        self._zones = ZonesMessage(())
        self._assets = AssetsMessage(())
        self._refused: asyncio.Future[None] | None = None
        self.feed = feed = SiteFeed()
        feed.on(SiteMessage, lambda message, _: self._update_site(site=message) if message else None)
        feed.on(ZonesMessage, lambda message, _: self._update_site(zones=message or ZonesMessage(())))
        feed.on(AssetsMessage, lambda message, _: self._update_site(assets=message or AssetsMessage(())))
        feed.on(FixMessage, lambda fix, _: self._on_fix(fix))
        for kind in (TagHealth, AnchorHealth):
            feed.on(kind, lambda health, _: self.hub.on_health(health, time.monotonic()))
        feed.on(StatusMessage, lambda status, _: self._on_status(status))
        feed.on(AlarmMessage, lambda alarm, _: self.hub.on_alarm(alarm) if alarm else None)
        feed.attach(self.link, site)
        self.link.on_state.append(self._on_state)

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError: a target cannot begin, or the site lacks what they need."""
        self._refused = asyncio.get_running_loop().create_future()
        targets = (run_route(route, self._log) for route in self.hub.routes)
        await together(keep(self.link, self._log), self._refused, *targets, every(SILENCE_CHECK_S, self._on_tick))

    def state(self) -> BridgeState:
        """What it has done so far."""
        return BridgeState(
            seconds=time.monotonic() - self._started_s,
            fixes=self.hub.fixes,
            dropped={route.target.text: dict(route.target.dropped) for route in self.hub.routes},
            malformed=self.feed.drops.total(),
        )

    def _on_state(self, connected: bool) -> None:
        self.hub.table.set_connected(connected=connected, now_s=time.monotonic())

    def _on_status(self, status: StatusMessage | None) -> None:
        if status is not None and status.kind in ("tag", "anchor"):
            self.hub.on_status(status, time.monotonic(), time.time())

    def _update_site(
        self, site: SiteMessage | None = None, zones: ZonesMessage | None = None, assets: AssetsMessage | None = None
    ) -> None:
        """Give the hub the site after a message that says a part of it."""
        self._site, self._zones, self._assets = site or self._site, zones or self._zones, assets or self._assets
        if self._site is None:
            return
        whole = self._site.whole_site
        by_tag = assets_at(self._assets, whole.name)
        self.hub.table.set_site(whole, time.monotonic(), addresses=self._site.system == "dl-tdoa")
        self.hub.table.set_assets(by_tag)
        try:
            inside = zones_of(self._zones, whole.name).zones
            bridged = bridged_site(whole, inside, simulated=self._site.simulated, assets=by_tag)
            self.hub.on_site(bridged if self._site.system is UNSET else structs.replace(bridged, master=None))
        except SkylessError as error:
            if self._refused is not None and not self._refused.done():
                self._refused.set_exception(error)

    def _on_fix(self, fix: FixMessage) -> None:
        self._last_fix_s, self._is_silent = time.monotonic(), False
        self.hub.on_fix(fix, self._last_fix_s)

    def _on_tick(self) -> None:
        now_s = time.monotonic()
        self.hub.on_tick(now_s, time.time())
        if not self.link.connected:
            self._last_fix_s = now_s  # tags, too, need a moment to find a broker that is back
        table, silent_s = self.hub.table, now_s - self._last_fix_s
        if self._is_silent or silent_s < THRESHOLDS.grace_s:
            return
        presences = Counter(table.presence(tag, now_s) for tag in table.fixed.values())
        if presences["late"] >= presences["fresh"] + presences["asleep"]:
            self._is_silent = True
            known = "no tag publishes fixes" if self._site is not None else "the site itself is not on the broker"
            self._log(f"no fix for {silent_s:.0f} s: {known}; skyless dashboard shows why")


def _name(hub: Hub) -> str:
    """The bridge's name on MQTT: constant for its targets, as the broker keeps the status of each name."""
    targets = " ".join(route.target.text for route in hub.routes).encode()
    return f"{re.sub(r'[^A-Za-z0-9_-]', '-', platform.node())}-{crc32(targets):08x}"


async def run_route(route: Route, log: Log) -> None:
    """Run a route's target until cancelled. A fault is logged, and costs neither fixes nor other targets.

    Raises SkylessError: it cannot start.
    """
    try:
        while True:
            try:
                await route.target.run()
            except SkylessError:
                raise
            except Exception as error:  # noqa: BLE001 - whatever it is, the others go on
                log(f"{route.target.text} failed ({error!r}); started again")
            await asyncio.sleep(HEALTH_S)
    finally:
        route.has_ended = True


class TagBridge:
    """Passes on the fixes of one process's tags."""

    def __init__(self, hub: Hub, is_simulated: Callable[[], bool], log: Log) -> None:
        self._hub, self._is_simulated, self._log = hub, is_simulated, log
        self._sites: dict[str, _HeardSite] = {}
        self._receivers: dict[str, SiteListener] = {}
        self._refusal = ""  # why no target can serve the site, as it was logged

    def on_fix(self, fix: FixMessage) -> None:
        """Process a fix; dropped if its tag is at another site than the targets."""
        if self._is_here(fix.tag):
            self._hub.on_fix(fix, time.monotonic())

    def on_health(self, health: TagHealth, receiver: "SiteListener | None" = None) -> None:
        """Process a tag's state, once a second, and its knowledge of the site; None at another system."""
        now_s = time.monotonic()
        if receiver is not None:
            self._receivers[health.tag] = receiver
            heard = self._sites.setdefault(health.tag, _HeardSite())
            site = heard.update(receiver, now_s, simulated=self._is_simulated())
            if site is not None and (self._is_here(health.tag) or not any(map(self._is_here, self._receivers))):
                self.on_site(site)
        self._hub.on_health(health, now_s)

    def on_site(self, site: BridgedSite) -> None:
        """Add the site as one tag knows it: at a large site no tag receives all anchors."""
        known = self._hub.site
        if known is not None and known.id == site.id:
            anchors_m, georeference = known.anchors_m | site.anchors_m, site.georeference or known.georeference
            site = structs.replace(site, anchors_m=anchors_m, georeference=georeference)
        try:
            self._hub.on_site(site)
        except SkylessError as error:  # positioning goes on
            if str(error) != self._refusal:
                self._refusal = str(error)
                self._log(self._refusal)

    def _is_here(self, tag: str) -> bool:
        """Whether a tag is at the site known to the targets, if any. A sniffer's tag always is."""
        receiver, known = self._receivers.get(tag), self._hub.site
        return receiver is None or known is None or receiver.site == known.id

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError: a target cannot begin."""
        targets = (run_route(route, self._log) for route in self._hub.routes)
        await together(*targets, every(SILENCE_CHECK_S, lambda: self._hub.on_tick(time.monotonic(), time.time())))


class _HeardSite:
    """A receiver's site, once complete."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._complete_s: float | None = None  # since when the rest is known

    def update(self, receiver: "SiteListener", now_s: float, *, simulated: bool) -> BridgedSite | None:
        """The site, or None while incomplete. ``now_s``: the host's monotonic clock."""
        number, heard = receiver.site, receiver.heard_site
        if number != self._number:
            self._number, self._complete_s = number, None
        if number is None or heard is None:
            self._complete_s = None
            return None
        if self._complete_s is None:
            self._complete_s = now_s
        if not heard.is_complete and now_s - self._complete_s < _GEOREFERENCE_S:
            return None
        return heard_site(number, heard.anchors_m, heard.georeference, simulated=simulated)


def heard_site(
    number: int, anchors_m: Mapping[int, Point], page: GeoreferencePage | None = None, *, simulated: bool
) -> BridgedSite:
    """A site from the air, where it has no name."""
    earth = None
    if page is not None:
        earth = GeoreferenceSite(page.latitude_deg, page.longitude_deg, page.height_m, page.heading_deg)
    return BridgedSite(number, f"site {number}", simulated, dict(sorted(anchors_m.items())), earth)
