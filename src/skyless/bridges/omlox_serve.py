"""``omlox+serve://:8081``: the reading half of an omlox hub, Hub 2.0: one site for clients of REST and WebSocket."""

import asyncio
import contextlib
import socket
import time
from collections.abc import Mapping
from itertools import count
from typing import Final

import msgspec
import uvicorn
from msgspec import Struct
from starlette.datastructures import QueryParams
from starlette.responses import Response
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from skyless.bridges import _omlox as omlox
from skyless.bridges.target import BridgeContext, BridgedSite, Target, TargetUrl, cannot_listen
from skyless.run.mqtt.messages import FixMessage, ZoneEvent
from skyless.run.process import together
from skyless.run.zones.monitor import ZoneMonitor

TOPICS: Final = ("location_updates", "fence_events", "trackable_motions")
ERRORS: Final = {
    10000: "the events are subscribe and unsubscribe",
    10001: f"the topics are {', '.join(TOPICS)}",
    10002: "the only parameter is crs, which is the site's",
    10003: "there is no such subscription_id",
    10004: "this hub shows one site and accepts nothing",
    10005: "this is no message of the protocol",
}

_PORT: Final = 8081
MAX_CLIENTS: Final = 32
_MAX_WAITING: Final = 500
_MAX_REQUEST_BYTES: Final = 1 << 16
_STUCK_S: Final = 10.0
"""A client that accepts no message for so long is disconnected."""


class Ask(Struct, frozen=True):
    """What a client sends."""

    event: str
    topic: str = ""
    subscription_id: int = 0
    params: dict[str, str] = {}


class OmloxServer(Target):
    """Serves one site."""

    def __init__(self, text: str, host: str, port: int) -> None:
        super().__init__(text)
        self.port = port
        """The one that is used, where 0 was asked for and the server runs."""
        self._host = host
        self._site: BridgedSite | None = None
        self._locations: dict[str, omlox.Object] = {}
        """The last of each provider."""
        self._monitor = ZoneMonitor()
        self._clients: dict[asyncio.Queue[str], dict[int, str]] = {}
        """Topics of subscriptions by number, by the messages that wait for a client."""
        self._numbers = count(1)

    def on_site(self, site: BridgedSite) -> None:
        """Show it."""
        self._site, self._monitor.floors = site, site.floors
        self._publish_events(self._monitor.set_zones(site.zones, time.time()))

    def on_fix(self, fix: FixMessage) -> None:
        """Give its location, and what follows from it, to those who want it."""
        assert self._site is not None
        found = omlox.location(fix, self._site, str(omlox.object_id(self._site, "zone")))
        self._locations[found["provider_id"]] = found
        self._publish("location_updates", found)
        owner = omlox.trackable(self._site, fix.tag)
        if owner is not None:
            self._publish("trackable_motions", {"id": owner["id"], "name": owner["name"], "location": found})
        self._publish_events(self._monitor.update(fix, time.monotonic()))

    def on_second(self, unix_s: float) -> None:
        """Let silent tags leave their zones."""
        self._publish_events(self._monitor.expire_tags(time.monotonic(), unix_s))

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError: it cannot listen there."""
        try:
            family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
            listening = socket.create_server((self._host, self.port), family=family)
        except OSError as error:
            raise cannot_listen(self.text, self._host, self.port, error) from None
        self.port = listening.getsockname()[1]
        config = uvicorn.Config(
            self._app,
            interface="asgi3",
            lifespan="off",
            log_config=None,
            ws="websockets-sansio",
            ws_max_size=_MAX_REQUEST_BYTES,
            timeout_graceful_shutdown=1,
        )
        server = uvicorn.Server(config)
        server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign,assignment] # its owner has them
        try:
            await server.serve(sockets=[listening])
        finally:
            server.force_exit = True
            await server.shutdown(sockets=[listening])

    async def _app(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await self._serve(WebSocket(scope, receive, send))
            return
        status, found = self.read(scope["path"], QueryParams(scope["query_string"]))
        if scope["method"] != "GET":
            status, found = 405, "only GET is answered here"
        body = found if status == 200 else {"type": "error", "code": status, "message": found}
        await Response(msgspec.json.encode(body), status, media_type="application/json")(scope, receive, send)

    def read(self, path: str, query: Mapping[str, str]) -> tuple[int, object]:
        """What is at a path, or what is wrong, after the status of HTTP."""
        site = self._site
        if site is None or not self._is_served(query):
            return 400, f"the site is not known yet, or {ERRORS[10002]}"
        paths: dict[str, object] = {"/v2/providers/locations": list(self._locations.values())}
        for kind, objects in {
            "zones": [omlox.hub_zone(site)],
            "fences": [omlox.fence(zone, site) for zone in site.zones],
            "providers": [{"id": name, "type": "uwb"} for name in self._locations],
            "trackables": [*filter(None, (omlox.trackable(site, tag) for tag in site.assets))],
        }.items():
            paths |= {f"/v2/{kind}": [one["id"] for one in objects], f"/v2/{kind}/summary": objects}
            paths |= {f"/v2/{kind}/{one['id']}": one for one in objects}
        for one in self._locations.values():
            paths[f"/v2/providers/{one['provider_id']}/location"] = one
            for owner in one.get("trackables", ()):
                paths |= {f"/v2/trackables/{owner}/location": one, f"/v2/trackables/{owner}/locations": [one]}
        return (200, paths[path]) if path in paths else (404, "there is nothing of this name")

    async def _serve(self, client: WebSocket) -> None:
        if client.url.path != "/v2/ws/socket" or len(self._clients) >= MAX_CLIENTS:
            self.dropped["refused-client"] += 1
            await client.close()
            return
        await client.accept()
        waiting: asyncio.Queue[str] = asyncio.Queue(_MAX_WAITING)
        topics: dict[int, str] = {}
        self._clients[waiting] = topics

        async def receive() -> None:
            while (message := await client.receive())["type"] != "websocket.disconnect":
                self._send(waiting, self.answer(topics, message.get("text") or ""))
            raise WebSocketDisconnect

        async def send() -> None:
            while True:
                message = await waiting.get()
                async with asyncio.timeout(_STUCK_S):
                    await client.send_text(message)

        try:
            with contextlib.suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
                await together(receive(), send())
        finally:
            del self._clients[waiting]

    def answer(self, topics: dict[int, str], text: str) -> omlox.Object:
        """Do what a client asks for, and what to answer; ``topics`` are those that it has subscribed."""
        try:
            ask = msgspec.json.decode(text, type=Ask)
        except (msgspec.MsgspecError, UnicodeError, RecursionError):
            ask = Ask("")
        topic, number, code = ask.topic, ask.subscription_id, 0
        match ask.event:
            case "subscribe" | "message" if topic not in TOPICS:
                code = 10001
            case "subscribe" if not self._is_served(ask.params):
                code = 10002
            case "subscribe":
                number = next(self._numbers)
                topics[number] = topic
            case "unsubscribe":
                topic = topics.pop(number, "")
                code = 0 if topic else 10003
            case event:
                code = {"message": 10004, "": 10005}.get(event, 10000)
        if code:
            return {"event": "error", "code": code, "description": ERRORS[code]}
        return {"event": f"{ask.event}d", "topic": topic, "subscription_id": number}

    def _is_served(self, params: Mapping[str, str]) -> bool:
        frame = params.get("crs") if self._site is None else omlox.crs(self._site)
        return params.keys() <= {"crs", "token"} and params.get("crs", frame) == frame

    def _publish(self, topic: str, item: omlox.Object) -> None:
        """Give an object to all who want it. Messages carry no ``subscription_id``: omlox-client-go drops those."""
        for waiting, topics in self._clients.items():
            if topic in topics.values():
                self._send(waiting, {"event": "message", "topic": topic, "payload": [item]})

    def _publish_events(self, events: list[ZoneEvent]) -> None:
        for event in events:
            assert self._site is not None
            self._publish("fence_events", omlox.fence_event(event, self._site))

    def _send(self, waiting: asyncio.Queue[str], message: omlox.Object) -> None:
        if waiting.full():
            waiting.get_nowait()
            self.dropped["slow-client"] += 1
        waiting.put_nowait(msgspec.json.encode(message).decode())


def make_target(url: TargetUrl, _context: BridgeContext) -> OmloxServer:
    """The target of ``omlox+serve://HOST:PORT``."""
    return OmloxServer(url.text, url.host(), url.port(_PORT))
