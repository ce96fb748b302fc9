"""``skyless bridge``: gives a site's fixes, from its broker, to programs and devices of other kinds."""

import asyncio
import platform
import re
import time
from collections import Counter
from collections.abc import Callable
from typing import Final, TypeVar
from zlib import crc32

import msgspec
from msgspec import Struct

from skyless.bridges.feed import bridged_site
from skyless.bridges.hub import SILENCE_CHECK_S, Hub, Route
from skyless.errors import SkylessError
from skyless.mqtt.address import MqttAddress
from skyless.mqtt.link import Handler, Link
from skyless.mqtt.messages import AnchorHealth, FixMessage, SiteMessage, StatusMessage, TagHealth, ZonesMessage
from skyless.mqtt.topics import EVERY_NODE, fix_topic, health_topic, site_topic, status_topic, zones_topic
from skyless.nodes.process import HEALTH_S, Log, every, keep, together
from skyless.zones.zone_list import BadZonesError, read_zones, zones_of

_SILENT_S: Final = 5.0
"""After so long without a fix a line says where to look."""

_Message = TypeVar("_Message", bound=Struct)

_STATUS_KINDS: Final = ("tag", "anchor")


class BridgeState(Struct, frozen=True):
    """What a bridge has done so far."""

    seconds: float
    fixes: int
    """Usable fixes of all tags."""
    dropped: dict[str, dict[str, int]]
    """By target and reason: what its readers missed."""
    malformed: int
    """Messages of the broker that could not be read."""


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
        self._drops: Counter[str] = Counter()
        self._refused: asyncio.Future[None] | None = None
        subscribe = self.link.subscribe
        subscribe(site_topic(site), self._reader(SiteMessage, self._on_site))
        subscribe(zones_topic(site), self._on_zones)
        subscribe(fix_topic(site, EVERY_NODE), self._reader(FixMessage, self._on_fix))
        subscribe(health_topic(site, "tag", EVERY_NODE), self._reader(TagHealth, self._on_health))
        subscribe(health_topic(site, "anchor", EVERY_NODE), self._reader(AnchorHealth, self._on_health))
        for kind in _STATUS_KINDS:
            subscribe(status_topic(site, kind, EVERY_NODE), self._reader(StatusMessage, self.hub.on_status))

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError: a target cannot begin, or the site lacks what they need."""
        self._refused = asyncio.get_running_loop().create_future()
        targets = (run_route(route, self._log) for route in self.hub.routes)
        await together(
            keep(self.link, self._log), _await(self._refused), *targets, every(SILENCE_CHECK_S, self._on_tick)
        )

    def state(self) -> BridgeState:
        """What it has done so far."""
        return BridgeState(
            seconds=time.monotonic() - self._started_s,
            fixes=self.hub.fixes,
            dropped={route.target.text: dict(route.target.dropped) for route in self.hub.routes},
            malformed=sum(self._drops.values()),
        )

    def _reader(self, kind: type[_Message], act: Callable[[_Message], None]) -> Handler:
        """Decodes the messages of a topic; what cannot be read is counted."""
        decode = msgspec.json.Decoder(kind).decode

        def read(_topic: str, payload: bytes) -> None:
            if not payload:  # a retained message that was withdrawn
                return
            try:
                message = decode(payload)
            except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                self._drops[kind.__name__] += 1
            else:
                act(message)

        return read

    def _on_site(self, message: SiteMessage) -> None:
        self._site = message
        self._update_site()

    def _on_zones(self, _topic: str, payload: bytes) -> None:
        if not payload:
            return
        try:
            self._zones = read_zones(payload)
        except BadZonesError:
            self._drops["zones"] += 1
        else:
            self._update_site()

    def _update_site(self) -> None:
        if self._site is None:
            return
        site = self._site.site
        zones = zones_of(self._zones, site.name).zones
        try:
            self.hub.on_site(bridged_site(site, zones, simulated=self._site.simulated))
        except SkylessError as error:
            if self._refused is not None and not self._refused.done():
                self._refused.set_exception(error)

    def _on_fix(self, fix: FixMessage) -> None:
        self._last_fix_s, self._is_silent = time.monotonic(), False
        self.hub.on_fix(fix, self._last_fix_s)

    def _on_health(self, health: TagHealth | AnchorHealth) -> None:
        self.hub.on_health(health, time.monotonic())

    def _on_tick(self) -> None:
        now_s = time.monotonic()
        self.hub.on_tick(now_s, time.time())
        if not self.link.connected:
            self._last_fix_s = now_s  # tags, too, need a moment to find a broker that is back
        if not self._is_silent and now_s - self._last_fix_s > _SILENT_S:
            self._is_silent = True
            known = "no tag publishes fixes" if self._site is not None else "the site itself is not on the broker"
            self._log(f"no fix for {_SILENT_S:g} s: {known}; skyless dashboard shows why")


def _name(hub: Hub) -> str:
    """The bridge's name on MQTT: always the same for its targets, as the broker keeps the status of each name."""
    targets = " ".join(route.target.text for route in hub.routes).encode()
    return f"{re.sub(r'[^A-Za-z0-9_-]', '-', platform.node())}-{crc32(targets):08x}"


async def run_route(route: Route, log: Log) -> None:
    """Run a route's target until cancelled; a fault in it is logged, and costs neither a fix nor another target.

    Raises:
        SkylessError: it cannot begin.
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


async def _await(future: asyncio.Future[None]) -> None:
    await future
