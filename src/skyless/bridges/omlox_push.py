"""``omlox+ws://HOST/v2/ws/socket``: sends each fix as a location to an omlox hub, Hub 2.0."""

import asyncio
import contextlib
import re
import time
from collections import deque
from collections.abc import Callable
from typing import Final
from urllib.parse import quote

import msgspec
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

from skyless.bridges._deliveries import read_secret
from skyless.bridges._omlox import Object, foreign_id, location
from skyless.bridges.target import BridgeContext, BridgedSite, Target, TargetUrl
from skyless.run.mqtt.address import is_loopback
from skyless.run.mqtt.messages import FixMessage
from skyless.run.process import together
from skyless.run.rate_limit import RateLimit

MAX_BATCH: Final = 100
"""Locations in one message."""

MAX_WAITING: Final = 10_000
"""Locations that wait for the hub. Beyond it the oldest is dropped."""

_GATHER_S: Final = 0.05
_PAUSE_S: Final = 2.0
_COMPLAINTS_HZ: Final = 1.0 / 60.0
_UUID: Final = re.compile(r"[0-9A-Fa-f]{8}(-[0-9A-Fa-f]{4}){3}-[0-9A-Fa-f]{12}")


class OmloxPush(Target):
    """Sends to one hub."""

    def __init__(self, url: TargetUrl, log: Callable[[str], None]) -> None:
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
            log(f"{url.text}: positions leave this computer unencrypted; omlox+wss: encrypts")
        self._log, self._complaints = log, RateLimit(_COMPLAINTS_HZ)
        self._site: BridgedSite | None = None
        self._waiting: deque[Object] = deque()

    def on_site(self, site: BridgedSite) -> None:
        """Keep it."""
        self._site = site

    def on_fix(self, fix: FixMessage) -> None:
        """Let it wait for the hub."""
        assert self._site is not None
        self._waiting.append(location(fix, self._site, self._zone or foreign_id(self._site)))
        if len(self._waiting) > MAX_WAITING:
            self._waiting.popleft()
            self.dropped["not-sent"] += 1

    async def run(self) -> None:
        """Send until cancelled. A hub that is away is tried again for ever."""
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
                await asyncio.sleep(_GATHER_S)

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


def make_target(url: TargetUrl, context: BridgeContext) -> OmloxPush:
    """The target of an address. Raises SkylessError."""
    return OmloxPush(url, context.log)
