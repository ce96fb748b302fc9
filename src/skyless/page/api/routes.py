"""All routes: what the server answers, and its OpenAPI document, come from it and the functions' signatures."""

import inspect
from collections.abc import Awaitable, Callable
from typing import Any, Final, Literal, get_origin

import msgspec
from msgspec import Struct
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route, WebSocketRoute

from skyless.page.api import geojson, past, present, stream
from skyless.page.api.json_answer import JSON, json_answer
from skyless.page.api.openapi import CSV, GEOJSON, ROOT, document
from skyless.page.api.parameters import RENAMED, MapQuery, SiteQuery, read_query
from skyless.page.api.past import Past
from skyless.page.sites import Sites
from skyless.run.assets import MAX_BYTES

MAX_BODY_BYTES: Final = 2 * MAX_BYTES


class ApiRoute:
    """One thing that programs can ask for.

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
        """``path`` is below ``ROOT``; ``media_type`` is that of bytes."""
        self.method, self.path, self.is_map, self.function = method, path, is_map, answer
        self.is_past = path.startswith("/history/")
        self.key = path.rsplit("/", 1)[-1]
        self.summary = (answer.__doc__ or "").rstrip(".")
        self.media_types = (JSON, GEOJSON) if is_map else (media_type,)
        self.role: Final = "reader" if method == "GET" else "operator"
        """Whose token is needed where the server has tokens."""
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
    ApiRoute("GET", "/site", present.site),
    ApiRoute("GET", "/anchors", present.anchors, is_map=True),
    ApiRoute("GET", "/tags", present.tags),
    ApiRoute("GET", "/tags/{tag}", present.tag),
    ApiRoute("GET", "/fixes", present.fixes, is_map=True),
    ApiRoute("GET", "/zones", present.zones, is_map=True),
    ApiRoute("GET", "/events", present.events),
    ApiRoute("GET", "/assets", present.assets),
    ApiRoute("PUT", "/assets", present.put_assets),
    ApiRoute("GET", "/assets.csv", present.assets_csv, CSV),
    ApiRoute("PUT", "/assets.csv", present.put_assets_csv),
    ApiRoute("GET", "/alarms", present.alarms),
    ApiRoute("POST", "/alarms/{rule}/{subject}/acknowledge", present.acknowledge),
    ApiRoute("GET", "/alarm_rules", present.alarm_rules),
    ApiRoute("PUT", "/alarm_rules", present.put_alarm_rules),
    ApiRoute("GET", "/history/tags", past.tags),
    ApiRoute("GET", "/history/track", past.track),
    ApiRoute("GET", "/history/heatmap", past.heatmap),
    ApiRoute("GET", "/history/dwell", past.dwell),
    ApiRoute("GET", "/history/occupancy", past.occupancy),
    ApiRoute("GET", "/history/contacts", past.contacts),
    ApiRoute("GET", "/history/alarms", past.alarms),
)


def api_routes(sites: Sites, history: Past) -> list[BaseRoute]:
    """The routes of the server."""
    whole = document(ROUTES)

    async def openapi(_request: Request) -> Response:
        return json_answer(whole)

    return [
        Route(f"{ROOT}/openapi.json", openapi),
        *(Route(ROOT + route.path, _endpoint(route, sites, history), methods=[route.method]) for route in ROUTES),
        WebSocketRoute(f"{ROOT}/stream", stream.endpoint(sites)),
    ]


def _endpoint(route: ApiRoute, sites: Sites, history: Past) -> Callable[[Request], Awaitable[Response]]:
    async def respond(request: Request) -> Response:
        query = read_query({**request.query_params, **request.path_params}, route.query)
        live = sites.of(query.site_text)
        given = {name: getattr(query, name) for name in route.parameters}
        if isinstance(query, MapQuery) and query.format == "geojson":
            return geojson.collection(live, route.key)
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
    """The request's body. One that is too long is answered with status 413 and the given words."""
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
