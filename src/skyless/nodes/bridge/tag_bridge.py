"""``skyless tag --to``: the fixes of a process's tags for programs and devices of other kinds, without a broker."""

import time
from collections.abc import Callable, Mapping
from typing import Final

from msgspec import structs

from skyless.air.almanac import GeoreferencePage
from skyless.air.masterless_packets import Point
from skyless.bridges.feed import BridgedSite
from skyless.bridges.hub import SILENCE_CHECK_S, Hub
from skyless.errors import SkylessError
from skyless.mqtt.messages import FixMessage, TagHealth
from skyless.nodes.bridge.broker_bridge import run_route
from skyless.nodes.process import Log, every, together
from skyless.receiver import Receiver
from skyless.site.model import GeoreferenceSite

_PAGE_S: Final = 5.0
"""Where a site sends its georeference, a tag has it this long after the rest: pages come in turn, and some are lost."""


class TagBridge:
    """What the tags of one process give away."""

    def __init__(self, hub: Hub, is_simulated: Callable[[], bool], log: Log) -> None:
        self._hub, self._is_simulated, self._log = hub, is_simulated, log
        self._sites: dict[str, _HeardSite] = {}
        self._receivers: dict[str, Receiver] = {}
        self._refusal = ""
        """Why no target can serve the site, as it was logged."""

    def on_fix(self, fix: FixMessage) -> None:
        """A fix of one of them; not given where the tag is in another site than the one that targets know."""
        if self._is_here(fix.tag):
            self._hub.on_fix(fix, time.monotonic())

    def on_health(self, health: TagHealth, receiver: Receiver) -> None:
        """State of one of them, once a second, and what it has learned of the site."""
        now_s = time.monotonic()
        self._receivers[health.tag] = receiver
        heard = self._sites.setdefault(health.tag, _HeardSite())
        site = heard.update(receiver, now_s, simulated=self._is_simulated())
        if site is not None and (self._is_here(health.tag) or not any(map(self._is_here, self._receivers))):
            self.on_site(site)
        self._hub.on_health(health, now_s)

    def on_system_health(self, health: TagHealth) -> None:
        """State of a tag of another system, whose anchors are configured."""
        self._hub.on_health(health, time.monotonic())

    def on_site(self, site: BridgedSite) -> None:
        """The site as one of them knows it: in a large one no tag receives all anchors."""
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
        """Whether a tag is in the site that targets know, if they know one; a sniffer's is always."""
        receiver, known = self._receivers.get(tag), self._hub.site
        return receiver is None or known is None or receiver.site == known.id

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError: a target cannot begin."""
        targets = (run_route(route, self._log) for route in self._hub.routes)
        await together(*targets, every(SILENCE_CHECK_S, lambda: self._hub.on_tick(time.monotonic(), time.time())))


class _HeardSite:
    """The site of a receiver, once all of it is known."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._complete_s: float | None = None
        """Since when the rest is known."""

    def update(self, receiver: Receiver, now_s: float, *, simulated: bool) -> BridgedSite | None:
        """The site; None while it is not complete. ``now_s`` is the host's monotonic clock."""
        number, common = receiver.site, receiver.local_almanac.pages
        if number != self._number:
            self._number, self._complete_s = number, None
        if number is None or (common is None and not receiver.almanac.complete):
            self._complete_s = None
            return None
        if self._complete_s is None:
            self._complete_s = now_s
        if common is None:
            anchors_m, page = receiver.almanac.anchors_m, receiver.almanac.georeference
        else:
            positions_m = receiver.local_almanac.positions_m
            anchors_m = {anchor: _point(position_m.tolist()) for anchor, position_m in positions_m.items()}
            page = common.georeference
        if page is None and common is None and now_s - self._complete_s < _PAGE_S:
            return None
        return heard_site(number, anchors_m, page, simulated=simulated)


def heard_site(
    number: int, anchors_m: Mapping[int, Point], page: GeoreferencePage | None = None, *, simulated: bool
) -> BridgedSite:
    """A site whose name is not on the air."""
    earth = None
    if page is not None:
        earth = GeoreferenceSite(page.latitude_deg, page.longitude_deg, page.height_m, page.heading_deg)
    return BridgedSite(number, f"site {number}", simulated, dict(sorted(anchors_m.items())), earth)


def _point(values: list[float]) -> Point:
    x, y, z = values
    return x, y, z
