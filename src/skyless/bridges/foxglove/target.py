"""``foxglove://``: a server that Foxglove, Lichtblick and other clients of its protocol open."""

import asyncio
import contextlib
import logging
import secrets
import socket
import time
from collections.abc import Callable
from typing import Final

import msgspec
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.typing import Subprotocol

from skyless.bridges.feed import BridgedSite, floored
from skyless.bridges.foxglove.protocol import SUBPROTOCOLS, Channel, advertise, server_info
from skyless.bridges.foxglove.session import Session
from skyless.bridges.target import BridgeContext, Target, cannot_listen
from skyless.bridges.target_url import TargetUrl
from skyless.foxglove.messages import SCENE_TOPIC, ellipse, frame_transform, location_fix, pose_in_frame, scene
from skyless.foxglove.schemas import foxglove_schema, schema_of
from skyless.mqtt.messages import AnchorHealth, FixMessage, TagHealth

_PORT: Final = 8765
MOST_CLIENTS: Final = 32
MOST_CHANNELS: Final = 2000

_MOST_REQUEST_BYTES: Final = 1 << 16
_SEND_BUFFER_BYTES: Final = 1 << 16
"""In the system, for each client: what is there is sent before anything newer."""

_GOODBYE_S: Final = 0.5
"""For clients to close their connections when the program ends."""

_quiet = logging.getLogger("skyless.bridges.foxglove")
_quiet.addHandler(logging.NullHandler())
_quiet.propagate = False
"""Clients that speak another protocol are no news."""


class FoxgloveTarget(Target):
    """Serves one site to any number of clients. A channel costs nothing while nobody has subscribed it."""

    def __init__(self, text: str, host: str, port: int, unix_time: Callable[[], float] = time.time) -> None:
        super().__init__(text)
        self.port = port
        """The one that is used, where 0 was asked for and the server runs."""
        self._host, self._unix_time = host, unix_time
        self._run = secrets.token_hex(4)
        self._site: BridgedSite | None = None
        self._channels: dict[int, Channel] = {}
        self._numbers: dict[str, int] = {}
        """Of channels, by topic."""
        self._sessions: set[Session] = set()

    def on_site(self, site: BridgedSite) -> None:
        """Show its anchors, walls and zones."""
        self._site = site
        self._give(SCENE_TOPIC, foxglove_schema("foxglove.SceneUpdate"), self._unix_time(), self._scene)

    def on_fix(self, fix: FixMessage) -> None:
        """Give a fix in each of the forms that somebody has subscribed."""
        site = self._site
        if site is None:
            return
        shown = msgspec.structs.replace(fix, covariance_m2=floored(fix.covariance_m2))
        topic = f"/tag/{fix.tag}"
        self._give_fix(f"{topic}/fix", schema_of(FixMessage), fix, msgspec.json.encode)
        self._give_foxglove("/tf", "foxglove.FrameTransform", fix, frame_transform)
        self._give_foxglove(f"{topic}/pose", "foxglove.PoseInFrame", fix, lambda fix: pose_in_frame(fix, facing=False))
        self._give_foxglove(f"{topic}/ellipse", "foxglove.SceneUpdate", shown, ellipse)
        origin = site.georeference
        if origin is not None:
            self._give_foxglove(
                f"{topic}/location", "foxglove.LocationFix", shown, lambda fix: location_fix(fix, origin)
            )

    def on_health(self, health: TagHealth | AnchorHealth) -> None:
        """Give a tag's state, for its rates and reasons."""
        if isinstance(health, TagHealth):
            topic = f"/tag/{health.tag}/health"
            self._give(topic, schema_of(TagHealth), health.unix_s, lambda: msgspec.json.encode(health))

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError: it cannot listen there."""
        try:
            server = await serve(
                self._serve,
                self._host,
                self.port,
                subprotocols=[Subprotocol(name) for name in SUBPROTOCOLS],
                compression=None,
                max_size=_MOST_REQUEST_BYTES,
                write_limit=_SEND_BUFFER_BYTES,
                close_timeout=_GOODBYE_S,
                logger=_quiet,
            )
        except OSError as error:
            raise cannot_listen(self.text, self._host, self.port, error) from None
        async with server:
            self.port = next(iter(server.sockets)).getsockname()[1]
            await server.serve_forever()

    async def _serve(self, connection: ServerConnection) -> None:
        """Serve one client until it goes."""
        if len(self._sessions) >= MOST_CLIENTS:
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
        self._give_fix(topic, foxglove_schema(schema), fix, encode)

    def _give_fix(
        self, topic: str, schema: tuple[str, bytes], fix: FixMessage, encode: Callable[[FixMessage], bytes]
    ) -> None:
        self._give(topic, schema, fix.unix_s, lambda: encode(fix))

    def _give(self, topic: str, schema: tuple[str, bytes], unix_s: float, encode: Callable[[], bytes]) -> None:
        """Send a message to all who want its channel, which is advertised with its first message."""
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
        if len(self._channels) >= MOST_CHANNELS:
            self.dropped["too-many-channels"] += 1
            return
        number = len(self._channels) + 1
        name, text = schema
        self._numbers[topic] = number
        self._channels[number] = channel = Channel(number, topic, name, text.decode())
        for session in self._sessions:
            session.send_text(advertise((channel,)))


def make_target(url: TargetUrl, _context: BridgeContext) -> FoxgloveTarget:
    """Of ``foxglove://HOST:PORT``."""
    return FoxgloveTarget(url.text, url.host(), url.port(_PORT))
