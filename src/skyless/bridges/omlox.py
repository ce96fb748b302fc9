"""``omlox+ws://HOST/v2/ws/socket``: sends each fix as a location to an omlox hub, Hub 2.0.

Names and types of fields: https://omlox.com/fileadmin/api/omlox_Hub_API_2.0.0.json. Coordinates are longitude and
latitude on a georeferenced site, otherwise metres in the site's frame.
"""

import asyncio
import contextlib
import re
import time
from collections import deque
from datetime import UTC, datetime
from typing import Any, Final
from urllib.parse import quote
from uuid import NAMESPACE_URL, uuid5

import msgspec
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

from skyless.bridges._deliveries import read_secret
from skyless.bridges.nmea import over_ground
from skyless.bridges.target import BridgeContext, BridgedSite, Target, TargetUrl, floored
from skyless.core.earth import coordinates, horizontal_ellipse
from skyless.run.mqtt.address import is_loopback
from skyless.run.mqtt.messages import FixMessage
from skyless.run.process import RateLimit, together
from skyless.run.zones import floor_at

Object = dict[str, Any]

MAX_BATCH: Final = 100
"""Most locations in one message."""

MAX_WAITING: Final = 10_000
"""Most locations waiting for the hub; beyond it the oldest is dropped."""

_PAUSE_S: Final = 2.0
_UUID: Final = re.compile(r"[0-9A-Fa-f]{8}(-[0-9A-Fa-f]{4}){3}-[0-9A-Fa-f]{12}")


def _foreign_id(site: BridgedSite) -> str:
    """Name of a site among a hub's zones."""
    return f"skyless-{site.id}"


def location(fix: FixMessage, site: BridgedSite, source: str) -> Object:
    """Location of a tag at the time of a usable fix; ``source``: id or foreign id of the hub's zone.

    The accuracy is one horizontal standard deviation in the worst direction. Local heights count from the floor.
    """
    earth, (x_m, y_m, z_m) = site.georeference, fix.position_m
    floor = None if fix.height_known else floor_at(site.floors, z_m, 0.0, None)
    ground_m = next((one.low_m for one in site.floors if one.number == floor), 0.0)
    local_m = [round(value, 4) for value in (x_m, y_m, z_m - ground_m)]
    asset = site.assets.get(fix.tag)
    named = asset is not None and asset.name
    speed_mps, course_deg = over_ground(fix, 0.0 if earth is None else earth.heading_deg)
    return _known(
        position={"type": "Point", "coordinates": local_m if earth is None else coordinates(fix.position_m, earth)},
        source=source,
        provider_type="uwb",
        provider_id=f"{_foreign_id(site)}-{fix.tag}",
        timestamp_generated=datetime.fromtimestamp(fix.unix_s, UTC),
        crs="local" if earth is None else "EPSG:4326",
        elevation_ref="floor" if earth is None else "wgs84",
        accuracy=round(horizontal_ellipse(floored(fix.covariance_m2))[0], 4),
        floor=floor,
        speed=speed_mps,
        course=None if earth is None or course_deg is None else round(course_deg, 2) % 360.0,
        trackables=[uuid5(NAMESPACE_URL, f"skyless:{site.id}/trackable/{fix.tag}")] if named else None,
        properties={"simulated": True} if site.simulated else None,
    )


def _known(**fields: object) -> Object:
    return {key: value for key, value in fields.items() if value is not None}


class OmloxPush(Target):
    """Sends to one hub."""

    def __init__(self, url: TargetUrl, context: BridgeContext) -> None:
        """Raises SkylessError."""
        super().__init__(url.text)
        scheme, host, path = url.scheme.removeprefix("omlox+"), url.host(""), url.path()
        self._zone, self._token_file = url.text_option("zone"), url.text_option("token_file")
        if not host or path in ("", "/"):
            raise url.wrong(f"{url.scheme}://HOST/v2/ws/socket")
        if url.has("zone") and not _UUID.fullmatch(self._zone):
            raise url.wrong("with a UUID as zone=, as a8c01d4c-333a-4406-b2e9-a174ad295cb1")
        port = url.port(443 if scheme == "wss" else 80)
        self._address = f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}{quote(path)}"
        self._token()
        if scheme == "ws" and not is_loopback(host):
            context.log(f"{url.text}: positions leave this computer unencrypted; omlox+wss: encrypts")
        self._log, self._complaints = context.log, RateLimit(1.0 / 60.0)
        self._site: BridgedSite | None = None
        self._waiting: deque[Object] = deque()

    def on_site(self, site: BridgedSite) -> None:
        """Keep the site."""
        self._site = site

    def on_fix(self, fix: FixMessage) -> None:
        """Queue a fix for the hub."""
        assert self._site is not None
        self._waiting.append(location(fix, self._site, self._zone or _foreign_id(self._site)))
        if len(self._waiting) > MAX_WAITING:
            self._waiting.popleft()
            self.dropped["not-sent"] += 1

    async def run(self) -> None:
        """Send until cancelled; an unreachable hub is retried for ever."""
        while True:
            try:
                async with connect(self._address) as hub:
                    await together(self._send(hub), self._receive(hub))
            except (OSError, WebSocketException) as error:
                self._complain(f"no connection, tried again: {error or type(error).__name__}")
            await asyncio.sleep(_PAUSE_S)

    async def _send(self, hub: ClientConnection) -> None:
        while True:
            batch = [self._waiting.popleft() for _ in range(min(MAX_BATCH, len(self._waiting)))]
            if batch:
                message = {"event": "message", "topic": "location_updates", "payload": batch, **self._token()}
                try:
                    await hub.send(msgspec.json.encode(message).decode())
                except WebSocketException:
                    self.dropped["not-sent"] += len(batch)
                    raise
            if not self._waiting:
                await asyncio.sleep(0.05)

    async def _receive(self, hub: ClientConnection) -> None:
        async for answer in hub:
            with contextlib.suppress(msgspec.MsgspecError, UnicodeError):
                fields = msgspec.json.decode(answer, type=Object)
                if fields.get("event") == "error":
                    self.dropped["refused-by-hub"] += 1
                    self._complain(f"the hub answers with error {fields.get('code')}: {fields.get('description')}")
        raise ConnectionError("the hub has closed it")

    def _complain(self, text: str) -> None:
        if self._complaints.is_due(time.monotonic()):
            self._log(f"{self.text}: {text[:240]}")

    def _token(self) -> Object:
        if not self._token_file:
            return {}
        return {"params": {"token": read_secret(self.text, "token_file", self._token_file)}}


make_target: Final = OmloxPush
