"""``foxglove://``: a server for Foxglove, Lichtblick and other clients of the Foxglove WebSocket protocol, version 1.

Source: https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md
"""

import asyncio
import contextlib
import logging
import re
import secrets
import socket
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from http import HTTPStatus
from struct import Struct as Format
from typing import Annotated, Final

import msgspec
from msgspec import Meta, Struct
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response
from websockets.typing import Subprotocol

from skyless.bridges.target import BridgeContext, BridgedSite, Target, TargetUrl, cannot_listen, floored
from skyless.run.foxglove import (
    SCENE_TOPIC,
    ellipse,
    foxglove_schema,
    frame_transform,
    location_fix,
    pose_in_frame,
    scene,
    schema_of,
)
from skyless.run.mqtt.address import is_loopback
from skyless.run.mqtt.messages import AnchorHealth, FixMessage, TagHealth
from skyless.run.web import BRIDGES as LIMITS
from skyless.run.web import is_local_origin, is_own_host, own_names, same_origin

SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Names of the protocol, the newer first; only their common part is used here."""

_APPLICATIONS: Final = ("https://app.foxglove.dev", "file://")
"""Origins of Foxglove's own applications, in a browser and on the desktop."""

_ORIGIN: Final = re.compile(r"[a-z+-]+://[^/\s,]*")

WARNING: Final = 1
"""Level of a status."""

_MESSAGE_DATA: Final = Format("<BIQ")
"""Operation 1, subscription, time in ns; the payload follows."""

_LAST_NS: Final = 2**64 - 1

_MAX_IDS: Final = 1000
"""Most channels in one request."""

Identifier = Annotated[int, Meta(ge=0, le=0xFFFFFFFF)]


class Channel(Struct, frozen=True, rename="camel"):
    """A topic to which clients can subscribe."""

    id: int
    topic: str
    schema_name: str
    schema: str
    encoding: str = "json"
    schema_encoding: str = "jsonschema"


class Subscription(Struct, frozen=True, rename="camel"):
    """A client's own number for a channel."""

    id: Identifier
    channel_id: Identifier


class Subscribe(Struct, frozen=True, tag_field="op", tag="subscribe"):
    """The client subscribes to these channels."""

    subscriptions: Annotated[tuple[Subscription, ...], Meta(max_length=_MAX_IDS)]


class Unsubscribe(Struct, frozen=True, tag_field="op", tag="unsubscribe", rename="camel"):
    """The client ends these subscriptions."""

    subscription_ids: Annotated[tuple[Identifier, ...], Meta(max_length=_MAX_IDS)]


Request = Subscribe | Unsubscribe

_decoder: Final[msgspec.json.Decoder[Subscribe | Unsubscribe]] = msgspec.json.Decoder(Request)


def decode_request(data: str | bytes) -> Request | None:
    """Decode a client's request; None for anything that this server does not support."""
    if isinstance(data, bytes):  # published data and calls of services
        return None
    try:
        return _decoder.decode(data)
    except (msgspec.MsgspecError, UnicodeError, RecursionError):
        return None


def server_info(name: str, session: str) -> str:
    """The first message to a client; with another ``session`` it discards what it had from this server."""
    return _text("serverInfo", name=name, capabilities=[], supportedEncodings=[], metadata={}, sessionId=session)


def advertise(channels: Sequence[Channel]) -> str:
    """Announce channels."""
    return _text("advertise", channels=channels)


def status(level: int, message: str) -> str:
    """A line for the client's user."""
    return _text("status", level=level, message=message)


def message_data(subscription: int, unix_s: float, payload: bytes) -> bytes:
    """A message of a subscribed channel. Raises ValueError or OverflowError if the time cannot be encoded."""
    time_ns = round(unix_s * 1e9)
    if not 0 <= time_ns <= _LAST_NS:
        raise OverflowError("the time is before 1970, or after what 64 bits can state")
    return _MESSAGE_DATA.pack(1, subscription, time_ns) + payload


def _text(op: str, **fields: object) -> str:
    return msgspec.json.encode({"op": op, **fields}).decode()


STUCK_S: Final = 10.0
"""A client that has accepted nothing for this time, while its messages were dropped, is disconnected."""

_MAX_TEXTS: Final = 2000
"""Most waiting texts, which are never dropped; beyond it the client is disconnected."""


class Session:
    """One client. Only ``run`` waits."""

    def __init__(self, connection: ServerConnection) -> None:
        self._connection = connection
        self._numbers: dict[int, int] = {}
        """The client's subscription numbers by channel."""
        self._texts: deque[str] = deque()
        self._data: deque[bytes] = deque(maxlen=LIMITS.waiting_messages)
        self._ready = asyncio.Event()
        self._sent_s = asyncio.get_running_loop().time()

    def wants(self, channel: int) -> bool:
        """Whether the client has subscribed to a channel."""
        return channel in self._numbers

    def send_text(self, text: str) -> None:
        """Queue a message that must not be dropped."""
        self._texts.append(text)
        self._ready.set()
        if len(self._texts) > _MAX_TEXTS:
            self.end()

    def send_data(self, channel: int, unix_s: float, payload: bytes) -> bool:
        """Queue a message of a subscribed channel. Returns False if an older one was dropped for it."""
        full = len(self._data) == self._data.maxlen
        if not self._data and not self._texts:
            self._sent_s = asyncio.get_running_loop().time()
        elif full and asyncio.get_running_loop().time() - self._sent_s > STUCK_S:
            self.end()
        self._data.append(message_data(self._numbers[channel], unix_s, payload))
        self._ready.set()
        return not full

    def on_request(self, data: str | bytes, channels: dict[int, Channel]) -> tuple[tuple[int, ...], int]:
        """Process a request. Returns the newly subscribed channels, and the number of faults."""
        request = decode_request(data)
        if request is None:
            self.send_text(status(WARNING, "skyless bridge offers subscriptions only; this request does nothing"))
            return (), 1
        added: list[int] = []
        wrong = 0
        if isinstance(request, Subscribe):
            for asked in request.subscriptions:
                channel, number = asked.channel_id, asked.id
                if channel not in channels or self.wants(channel) or number in self._numbers.values():
                    wrong += 1
                    self.send_text(status(WARNING, f"channel {channel} cannot be subscribed as {number}"))
                    continue
                self._numbers[channel] = number
                added.append(channel)
        else:
            gone = set(request.subscription_ids)
            self._numbers = {channel: number for channel, number in self._numbers.items() if number not in gone}
        return tuple(added), wrong

    async def run(self) -> None:
        """Send queued messages until the connection closes."""
        loop = asyncio.get_running_loop()
        while True:
            await self._ready.wait()
            self._ready.clear()
            while self._texts or self._data:
                await self._connection.send(self._texts.popleft() if self._texts else self._data.popleft())
                self._sent_s = loop.time()

    def end(self) -> None:
        """Close the connection at once; queued messages are dropped."""
        self._connection.transport.abort()


_PORT: Final = 8765
_SEND_BUFFER_BYTES: Final = 1 << 16
"""System buffer per client: its contents are sent before anything newer."""

_GOODBYE_S: Final = 0.5
"""Time for clients to close their connections when the program ends."""

_quiet = logging.getLogger("skyless.bridges.foxglove")
_quiet.addHandler(logging.NullHandler())
_quiet.propagate = False
"""Clients that speak another protocol are no news."""


class FoxgloveTarget(Target):
    """Serves one site to any number of clients. A channel costs nothing without subscribers."""

    def __init__(
        self, text: str, host: str, port: int, origins: Collection[str] = (), unix_time: Callable[[], float] = time.time
    ) -> None:
        """``origins``: web applications that may connect, besides Foxglove's and those of this computer."""
        super().__init__(text)
        self._origins = {*_APPLICATIONS, *origins}
        self.port = port
        """The port in use; with 0 configured, known once the server runs."""
        self._host, self._unix_time = host, unix_time
        self._run = secrets.token_hex(4)
        self._site: BridgedSite | None = None
        self._channels: dict[int, Channel] = {}
        self._numbers: dict[str, int] = {}
        """Numbers of channels by topic."""
        self._sessions: set[Session] = set()

    def on_site(self, site: BridgedSite) -> None:
        """Send its anchors, walls and zones."""
        self._site = site
        self._give(SCENE_TOPIC, foxglove_schema("foxglove.SceneUpdate"), self._unix_time(), self._scene)

    def on_fix(self, fix: FixMessage) -> None:
        """Send a fix in each subscribed form."""
        site = self._site
        if site is None:
            return
        shown = msgspec.structs.replace(fix, covariance_m2=floored(fix.covariance_m2))
        topic = f"/tag/{fix.tag}"
        self._give(f"{topic}/fix", schema_of(FixMessage), fix.unix_s, lambda: msgspec.json.encode(fix))
        self._give_foxglove("/tf", "foxglove.FrameTransform", fix, frame_transform)
        self._give_foxglove(f"{topic}/pose", "foxglove.PoseInFrame", fix, lambda fix: pose_in_frame(fix, facing=False))
        self._give_foxglove(f"{topic}/ellipse", "foxglove.SceneUpdate", shown, ellipse)
        origin = site.georeference
        if origin is not None:
            self._give_foxglove(
                f"{topic}/location", "foxglove.LocationFix", shown, lambda fix: location_fix(fix, origin)
            )

    def on_health(self, health: TagHealth | AnchorHealth) -> None:
        """Send a tag's state, for its rates and reasons."""
        if isinstance(health, TagHealth):
            topic = f"/tag/{health.tag}/health"
            self._give(topic, schema_of(TagHealth), health.unix_s, lambda: msgspec.json.encode(health))

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError if it cannot listen there."""
        try:
            server = await serve(
                self._serve,
                self._host,
                self.port,
                process_request=self._refusal,
                subprotocols=[Subprotocol(name) for name in SUBPROTOCOLS],
                compression=None,
                max_size=LIMITS.request_bytes,
                write_limit=_SEND_BUFFER_BYTES,
                close_timeout=_GOODBYE_S,
                logger=_quiet,
            )
        except OSError as error:
            raise cannot_listen(self.text, self._host, self.port, error) from None
        async with server:
            self.port = next(iter(server.sockets)).getsockname()[1]
            await server.serve_forever()

    def _refusal(self, connection: ServerConnection, request: HttpRequest) -> Response | None:
        """The answer to a page of another site; None if the client may connect."""
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        if not is_own_host(host, own_names(self._host), remote=not is_loopback(self._host)):
            self.dropped["host"] += 1
            return connection.respond(HTTPStatus.MISDIRECTED_REQUEST, "unknown host name: use the address\n")
        if origin is None or origin in self._origins or is_local_origin(origin) or same_origin(origin, host):
            return None
        self.dropped["origin"] += 1
        text = f"pages of {origin} may not connect; ?origins={origin} lets them\n"
        return connection.respond(HTTPStatus.FORBIDDEN, text)

    async def _serve(self, connection: ServerConnection) -> None:
        if len(self._sessions) >= LIMITS.clients:
            self.dropped["too-many-clients"] += 1
            return
        connection.transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES
        )
        session = Session(connection)
        session.send_text(server_info("skyless", self._run))
        if self._channels:
            session.send_text(advertise(tuple(self._channels.values())))
        self._sessions.add(session)
        sending = asyncio.create_task(session.run())
        try:
            with contextlib.suppress(ConnectionClosed):
                async for data in connection:
                    self._on_request(session, data)
        finally:
            self._sessions.discard(session)
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                await sending

    def _on_request(self, session: Session, data: str | bytes) -> None:
        added, wrong = session.on_request(data, self._channels)
        if wrong:
            self.dropped["request-not-understood"] += wrong
        scene_channel = self._numbers.get(SCENE_TOPIC)
        if scene_channel in added and scene_channel is not None:  # it does not change by itself
            session.send_data(scene_channel, self._unix_time(), self._scene())

    def _scene(self) -> bytes:
        assert self._site is not None
        site = self._site
        return scene(self._unix_time(), site.anchors_m, site.master, site.walls, site.zones)

    def _give_foxglove(self, topic: str, schema: str, fix: FixMessage, encode: Callable[[FixMessage], bytes]) -> None:
        self._give(topic, foxglove_schema(schema), fix.unix_s, lambda: encode(fix))

    def _give(self, topic: str, schema: tuple[str, bytes], unix_s: float, encode: Callable[[], bytes]) -> None:
        """Send a message to all subscribers of its channel, which is advertised with its first message."""
        channel = self._numbers.get(topic)
        if channel is None:
            self._advertise(topic, schema)
            return
        wanting = [session for session in self._sessions if session.wants(channel)]
        if not wanting:
            return
        try:
            payload = encode()
            for session in wanting:
                if not session.send_data(channel, unix_s, payload):
                    self.dropped["slow-client"] += 1
        except (ValueError, ArithmeticError):  # figures that no tag publishes
            self.dropped["out-of-range"] += 1

    def _advertise(self, topic: str, schema: tuple[str, bytes]) -> None:
        if len(self._channels) >= LIMITS.channels:
            self.dropped["too-many-channels"] += 1
            return
        number = len(self._channels) + 1
        name, text = schema
        self._numbers[topic] = number
        self._channels[number] = channel = Channel(number, topic, name, text.decode())
        for session in self._sessions:
            session.send_text(advertise((channel,)))


def make_target(url: TargetUrl, _context: BridgeContext) -> FoxgloveTarget:
    """The target of ``foxglove://HOST:PORT``; ``origins=`` lists web applications that may connect, with commas."""
    origins = tuple(filter(None, url.text_option("origins").split(",")))
    for origin in origins:
        if not _ORIGIN.fullmatch(origin):
            raise url.wrong(f"with origins= as https://HOST, several with commas; {origin!r} is none")
    return FoxgloveTarget(url.text, url.host(), url.port(_PORT), origins)
