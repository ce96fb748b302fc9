"""All routes of the HTTP interface, and its stream of fixes over a WebSocket."""

import asyncio
import inspect
import time
from collections.abc import Awaitable, Callable
from typing import Any, Final, Literal, get_origin

import msgspec
from msgspec import Struct
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket

from skyless.core.version import installed_version
from skyless.page.api import questions
from skyless.page.api.questions import (
    CSV,
    GEOJSON,
    RENAMED,
    ROOT,
    MapQuery,
    Past,
    SiteQuery,
    TagNames,
    document,
    names,
    read_query,
    usable,
)
from skyless.page.connections import JSON, POLICY_VIOLATION, TRY_LATER, json_answer, send, serve_socket
from skyless.page.live import LiveSite
from skyless.page.sites import Sites
from skyless.run.assets import MAX_BYTES
from skyless.run.mqtt.messages import AlarmMessage
from skyless.run.web import PAGE as LIMITS

# The stream of a site over a WebSocket: the newest fix of each tag, and events (``docs/http.md``).
#
# Each stream polls the site ten times a second and keeps no queue: after a pause, its reader gets the newest state.

PERIOD_S: Final = 0.1
_PAUSES: Final = 9.0  # with very many tags a stream is sent less often, to use at most a tenth of a processor
_MAX_REASON_BYTES: Final = 120  # of the 123 that the protocol allows


class StreamQuery(SiteQuery, frozen=True):
    """Parameters of a stream."""

    tags: TagNames = ""


class SiteStream:
    """Messages to one reader, which contain only what it has not been sent yet."""

    def __init__(self, live: LiveSite, tags: frozenset[str]) -> None:
        """An empty set of tags means all."""
        self._live, self._tags = live, tags
        self._fixes = 0  # serial of the last fix
        self._event = live.event_list.last
        self._alarms: dict[tuple[str, str], AlarmMessage] = {}  # by rule and subject

    def hello(self) -> bytes:
        """The first message."""
        live = self._live
        name = None if live.site is None else live.site.site.name
        fields = {"version": installed_version(), "site": live.number, "name": name, "history": live.has_history}
        return msgspec.json.encode({"type": "hello", **fields})

    def new(self) -> list[bytes]:
        """Messages with everything that is new to the reader."""
        return [*self._new_fixes(), *self._new_zone_events(), *self._new_alarms()]

    def _carries(self, *tags: str) -> bool:
        return not (self._tags and self._tags.isdisjoint(tags))

    def _new_fixes(self) -> list[bytes]:
        serial, self._fixes = self._fixes, self._live.table.fixes_serial
        if serial == self._fixes:
            return []
        fixes = usable(given for given in self._live.recent_fixes(after=serial) if self._carries(given[0].tag))
        return [msgspec.json.encode({"type": "fixes", "fixes": fixes})] if fixes else []

    def _new_zone_events(self) -> list[bytes]:
        number, self._event = self._event, self._live.event_list.last
        events = (event.zone_event for event, _ in self._live.event_list.since(number))
        return [_message("zone_event", event) for event in events if event is not None and self._carries(event.tag)]

    def _new_alarms(self) -> list[bytes]:
        now = {(alarm.rule, alarm.subject): alarm for alarm in self._live.alarms.messages}
        before, self._alarms = self._alarms, now
        changed = [(alarm, False) for key, alarm in now.items() if before.get(key) != alarm]
        changed += [(alarm, True) for key, alarm in before.items() if key not in now]
        return [
            _message("alarm", alarm, over=over)
            for alarm, over in changed
            if not alarm.tags or self._carries(*alarm.tags)
        ]


def _message(kind: str, value: Struct, **more: object) -> bytes:
    return msgspec.json.encode({"type": kind, **more, **msgspec.structs.asdict(value)})


def endpoint(sites: Sites) -> Callable[[WebSocket], Awaitable[None]]:
    """Create the WebSocket's handler."""
    open_streams: set[WebSocket] = set()

    async def serve(socket: WebSocket) -> None:
        await socket.accept()
        try:
            query = read_query(socket.query_params, StreamQuery)
            live = sites.of(query.site_text)
        except HTTPException as error:
            await socket.close(POLICY_VIOLATION, error.detail.encode()[:_MAX_REASON_BYTES].decode(errors="ignore"))
            return
        if len(open_streams) >= LIMITS.streams:
            await socket.close(TRY_LATER, f"{LIMITS.streams} streams are open")
            return
        open_streams.add(socket)
        live.streams += 1
        try:
            await serve_socket(socket, _send_news(socket, SiteStream(live, frozenset(names(query.tags)))))
        finally:
            open_streams.discard(socket)
            live.streams -= 1

    return serve


async def _send_news(socket: WebSocket, stream: SiteStream) -> None:
    messages, spent_s = [stream.hello()], 0.0
    while True:
        await send(socket, messages)
        await asyncio.sleep(max(PERIOD_S, _PAUSES * spent_s))
        begin_s = time.monotonic()
        messages = stream.new()
        spent_s = time.monotonic() - begin_s


MAX_BODY_BYTES: Final = 2 * MAX_BYTES


class ApiRoute:
    """One route of the HTTP interface.

    Keyword-only arguments of its function are the parameters, ``body`` is the body, and the docstring is the summary.
    A tuple is answered as an object with one key, the last part of the path.
    """

    def __init__(
        self,
        method: Literal["GET", "PUT", "POST"],
        path: str,
        answer: Callable[..., Any],
        media_type: str = JSON,
        *,
        is_map: bool = False,
    ) -> None:
        """``path``: below ``ROOT``; ``media_type``: of an answer that is bytes."""
        self.method, self.path, self.function = method, path, answer
        self.is_past = path.startswith("/history/")
        self.key = path.rsplit("/", 1)[-1]
        self.summary = (answer.__doc__ or "").rstrip(".")
        self.media_types = (JSON, GEOJSON) if is_map else (media_type,)
        self.role: Final = "reader" if method == "GET" else "operator"
        """Role whose token is needed if the server has tokens."""
        signature = inspect.signature(answer)
        given = {name: one for name, one in signature.parameters.items() if one.kind is one.KEYWORD_ONLY}
        self.body: type | None = given.pop("body").annotation if "body" in given else None
        fields = [
            (name, one.annotation) if one.default is one.empty else (name, one.annotation, one.default)
            for name, one in given.items()
        ]
        base = MapQuery if is_map else SiteQuery
        self.query: type[SiteQuery] = msgspec.defstruct(  # type: ignore[assignment]
            "Query", fields, bases=(base,), rename=RENAMED, frozen=True, kw_only=True, forbid_unknown_fields=True
        )
        self.parameters = tuple(given)
        self.answer = kind = signature.return_annotation
        if get_origin(kind) is tuple:
            name = "".join(part.title() for part in path.split("/")) + "Answer"
            self.answer = msgspec.defstruct(name, [(self.key, kind)], frozen=True)


ROUTES: Final = (
    ApiRoute("GET", "/site", questions.site),
    ApiRoute("GET", "/anchors", questions.anchors, is_map=True),
    ApiRoute("GET", "/tags", questions.tags),
    ApiRoute("GET", "/tags/{tag}", questions.tag),
    ApiRoute("GET", "/fixes", questions.fixes, is_map=True),
    ApiRoute("GET", "/zones", questions.zones, is_map=True),
    ApiRoute("GET", "/events", questions.events),
    ApiRoute("GET", "/assets", questions.assets),
    ApiRoute("PUT", "/assets", questions.put_assets),
    ApiRoute("GET", "/assets.csv", questions.assets_csv, CSV),
    ApiRoute("PUT", "/assets.csv", questions.put_assets_csv),
    ApiRoute("GET", "/alarms", questions.alarms),
    ApiRoute("POST", "/alarms/{rule}/{subject}/acknowledge", questions.acknowledge),
    ApiRoute("GET", "/alarm_rules", questions.alarm_rules),
    ApiRoute("PUT", "/alarm_rules", questions.put_alarm_rules),
    ApiRoute("GET", "/history/tags", questions.past_tags),
    ApiRoute("GET", "/history/track", questions.track),
    ApiRoute("GET", "/history/heatmap", questions.heatmap),
    ApiRoute("GET", "/history/dwell", questions.dwell),
    ApiRoute("GET", "/history/contacts", questions.contacts),
)


def api_routes(sites: Sites, history: Past) -> list[BaseRoute]:
    """Create the server's routes of the interface."""
    whole = document(ROUTES)

    async def openapi(_request: Request) -> Response:
        return json_answer(whole)

    return [
        Route(f"{ROOT}/openapi.json", openapi),
        *(Route(ROOT + route.path, _endpoint(route, sites, history), methods=[route.method]) for route in ROUTES),
        WebSocketRoute(f"{ROOT}/stream", endpoint(sites)),
    ]


def _endpoint(route: ApiRoute, sites: Sites, history: Past) -> Callable[[Request], Awaitable[Response]]:
    async def respond(request: Request) -> Response:
        query = read_query({**request.query_params, **request.path_params}, route.query)
        live = sites.of(query.site_text)
        given = {name: getattr(query, name) for name in route.parameters}
        if isinstance(query, MapQuery) and query.format == "geojson":
            return questions.collection(live, route.key)
        if route.body is not None:
            given["body"] = _read_body(await read_bytes(request, MAX_BODY_BYTES), route.body)
        if route.is_past:
            return json_answer(await history.ask(live.number, route.key, given))
        answer = route.function(live, **given)
        answer = await answer if inspect.isawaitable(answer) else answer
        if isinstance(answer, bytes):
            return Response(answer, media_type=route.media_types[0])
        return json_answer({route.key: answer} if isinstance(answer, tuple) else answer)

    return respond


async def read_bytes(request: Request, most_bytes: int, fault: str = "") -> bytes:
    """Read the request's body; if it is too long, answer with status 413 and ``fault``."""
    body = bytearray()
    try:
        async for chunk in request.stream():
            body += chunk
            if len(body) > most_bytes:
                raise HTTPException(413, fault or f"the body should have {most_bytes} bytes at most")
    except ClientDisconnect:
        raise HTTPException(400, "the client has left in the middle of the body") from None
    return bytes(body)


def _read_body(body: bytes, kind: type) -> Struct | bytes:
    if kind is bytes:
        return body
    try:
        read: Struct = msgspec.json.decode(body, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise HTTPException(400, f"the body cannot be read as {kind.__name__}: {error}") from None
    return read
