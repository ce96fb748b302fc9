"""``homeassistant:``: the link to Home Assistant's broker, which may be the site's or another one."""

import asyncio
import platform
import re
import time
from typing import Final

from msgspec import Struct

from skyless.bridges.feed import BridgedSite
from skyless.bridges.home_assistant.announcer import MOST_ANNOUNCED, NODE_KIND, Announcer
from skyless.bridges.target import BridgeContext, Target
from skyless.bridges.target_url import TargetUrl
from skyless.errors import SkylessError
from skyless.mqtt.address import MqttAddress, mqtt_address
from skyless.mqtt.link import Link
from skyless.mqtt.messages import FixMessage, StatusMessage
from skyless.mqtt.outbox import Limits

_PREFIX: Final = re.compile(r"[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*")

_LIMITS: Final = Limits(topics=4 * MOST_ANNOUNCED + 1, topic_bytes=64_000_000)
"""Three topics of each tag, one of each that was there before, and the status; 100 zones make a document of 50 kB."""

SETTLE_S: Final = 3
"""The site is known for so long before tags are announced, as its zones come after it: Home Assistant would forget what
a user has set for sensors of zones that are missing."""


class Settings(Struct, frozen=True):
    """How tags are announced."""

    address: MqttAddress
    prefix: str
    move_m: float


class HomeAssistant(Target):
    """Connects when the first tag has a fix, and the site has been known for ``SETTLE_S``.

    The bridge's name on MQTT has that tag's name in it, so that bridges on one computer are distinct.
    """

    def __init__(self, context: BridgeContext, text: str, settings: Settings) -> None:
        super().__init__(text)
        self._context, self._settings = context, settings
        self._site: BridgedSite | None = None
        self._announcer: Announcer | None = None
        self._link: Link | None = None
        self._begun = asyncio.Event()
        self._known_s = 0
        """For how many seconds the site has been known."""

    def on_site(self, site: BridgedSite) -> None:
        """Announce what has changed. Raises SkylessError: it is another site."""
        if self._site is not None and site.id != self._site.id:
            if self._announcer is not None:
                self._announcer.on_site_left(time.time())
            raise SkylessError(f"{self.text} serves site {self._site.id}, not site {site.id}; start the bridge again")
        if site.georeference is None and (self._site is None or self._site.georeference is not None):
            self._context.log(
                f"{self.text} gives rooms, but no position on the map: site {site.id} ({site.name}) does not say where "
                "it is; its site file should have [georeference] with latitude_deg and longitude_deg"
            )
        self._site = site
        if self._announcer is not None:
            self._announcer.on_site(site)

    def on_fix(self, fix: FixMessage) -> None:
        """Its rooms and its position."""
        if self._announcer is None and self._site is not None and self._known_s >= SETTLE_S:
            self._begin(self._site, fix.tag)
        if self._announcer is not None:
            self._announcer.on_fix(fix)

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> None:  # noqa: ARG002 - Home Assistant has no field for it
        """It becomes unavailable."""
        if self._announcer is not None:
            self._announcer.on_no_fix(tag, unix_s)

    def on_second(self, unix_s: float) -> None:
        """Positions that have changed."""
        self._known_s += self._site is not None
        if self._announcer is not None:
            self._announcer.on_second(unix_s)

    def on_status(self, status: StatusMessage) -> None:
        """A tag that has gone becomes unavailable at once."""
        if self._announcer is not None and status.kind == "tag" and not status.online:
            self._announcer.on_no_fix(status.name, time.time())  # a last will has no time

    async def run(self) -> None:
        """Keep the link from the first fix until cancelled."""
        await self._begun.wait()
        assert self._link is not None
        await self._link.run()

    def _begin(self, site: BridgedSite, tag: str) -> None:
        name = re.sub(r"[^A-Za-z0-9_-]", "-", f"{platform.node()}-{tag}")
        self._link = Link(self._settings.address, name, site=site.id, kind=NODE_KIND, limits=_LIMITS)
        self._announcer = Announcer(self._link, site, name, self._settings.prefix, self._settings.move_m)
        self._announcer.dropped = self.dropped
        self._begun.set()


def make_target(url: TargetUrl, context: BridgeContext) -> HomeAssistant:
    """``homeassistant:`` or ``homeassistant://[USER[:PASSWORD]@]HOST[:PORT]``.

    Keys: ``tls=yes|no`` of a broker that the address names, ``prefix`` of discovery, ``move_m``.
    Raises SkylessError.
    """
    tls = url.choice("tls", ("no", "yes"), "no") == "yes"
    prefix = url.text_option("prefix", "homeassistant")
    if not _PREFIX.fullmatch(prefix):
        raise SkylessError(
            f"the target {url.text!r} has prefix={prefix}; it should be letters, digits, -, _ and / between them"
        )
    move_m = url.number("move_m", 0.25, 0.0, 100.0)
    return HomeAssistant(context, url.text, Settings(_broker(url, context, tls=tls), prefix, move_m))


def _broker(url: TargetUrl, context: BridgeContext, *, tls: bool) -> MqttAddress:
    expected = url.wrong("homeassistant: with --mqtt, or homeassistant://[USER[:PASSWORD]@]HOST[:PORT]")
    netloc = url.netloc()
    if netloc:
        try:
            return mqtt_address(f"mqtt{'s' if tls else ''}://{netloc}")
        except SkylessError:
            raise expected from None
    if context.mqtt is None:
        raise expected
    return context.mqtt
