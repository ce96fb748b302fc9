"""The table of routes: from it come what the server answers and the OpenAPI document."""

import inspect
from collections.abc import Awaitable, Callable
from typing import Any, Final, Literal

import msgspec
from msgspec import Struct
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute

from skyless.core.errors import SkylessError
from skyless.page.api import answers, present, stream
from skyless.page.api.answers import Anchor, TagFix, ZoneTags, listed
from skyless.page.api.call import ApiServices, Call, names, read_body, read_query, site_of
from skyless.page.api.openapi import document
from skyless.page.api.past import read_span
from skyless.run.assets import MAX_BYTES
from skyless.run.history.answers import AlarmRow, Contact, Dwell, Heatmap, Occupancy, Span, Track
from skyless.run.mqtt.messages import AlarmMessage, AlarmRulesMessage, AssetsMessage

ROOT: Final = "/api/v1"
JSON: Final = "application/json"
GEOJSON: Final = "application/geo+json"
CSV: Final = "text/csv"
_MAX_BODY_BYTES: Final = 2 * MAX_BYTES

Role = Literal["reader", "operator"]


class ApiRoute(Struct, frozen=True):
    """One thing that programs can ask for."""

    method: Literal["GET", "PUT", "POST"]
    path: str
    """Below ``ROOT``."""
    summary: str
    respond: Callable[[Call], Any]
    answer: type[Struct] | type[str]
    """The struct of the answer, or a text of ``media_type``."""
    query: type[answers.SiteQuery] = answers.SiteQuery
    body: type[Struct] | type[bytes] | None = None
    media_type: str = JSON

    @property
    def role(self) -> Role:
        """Whose token is needed where the server has tokens."""
        return "reader" if self.method == "GET" else "operator"

    @property
    def media_types(self) -> tuple[str, ...]:
        """Those of the answer."""
        return (JSON, GEOJSON) if issubclass(self.query, answers.FormatQuery) else (self.media_type,)

    @property
    def body_type(self) -> str:
        """That of the body."""
        return CSV if self.body is bytes else JSON


def _past(
    path: str,
    summary: str,
    answer: type[Struct],
    query: type[answers.SpanQuery],
    question: Callable[[Any, Span, Any], object],
) -> ApiRoute:
    """A question to the history, of a time range and the parameters; it is asked in the history's thread."""

    async def respond(call: Call) -> object:
        asked, number = call.query, call.live.number
        return await call.past.ask(number, lambda history: question(history, read_span(asked.begin, asked.end), asked))

    return ApiRoute("GET", f"/history/{path}", summary, respond, answer, query)


async def _past_tags(call: Call) -> object:
    return {"tags": await call.past.ask(call.live.number, lambda history: history.tags())}


ROUTES: Final = (
    ApiRoute("GET", "/site", "The site, and how it is", present.site, answers.SiteAnswer),
    ApiRoute("GET", "/anchors", "Its anchors", present.anchors, listed("anchors", Anchor), answers.FormatQuery),
    ApiRoute("GET", "/tags", "Tags by name, in pages", present.tags, answers.TagsAnswer, answers.TagsQuery),
    ApiRoute("GET", "/tags/{tag}", "One tag", present.tag, answers.Tag, answers.TagQuery),
    ApiRoute("GET", "/fixes", "The newest fixes", present.fixes, listed("fixes", TagFix), answers.FormatQuery),
    ApiRoute(
        "GET", "/zones", "Zones, and who is in them", present.zones, listed("zones", ZoneTags), answers.FormatQuery
    ),
    ApiRoute("GET", "/events", "What has happened", present.events, answers.EventsAnswer, answers.EventsQuery),
    ApiRoute("GET", "/assets", "What tags are attached to", present.assets, AssetsMessage),
    ApiRoute("PUT", "/assets", "Replace all assets", present.put_assets, AssetsMessage, body=AssetsMessage),
    ApiRoute("GET", "/assets.csv", "The assets as a table", present.assets_csv, str, media_type=CSV),
    ApiRoute("PUT", "/assets.csv", "Replace all by a table", present.put_assets_csv, AssetsMessage, body=bytes),
    ApiRoute("GET", "/alarms", "Alarms that are not over", present.alarms, listed("alarms", AlarmMessage)),
    ApiRoute(
        *("POST", "/alarms/{rule}/{subject}/acknowledge", "Acknowledge an alarm", present.acknowledge),
        *(answers.Acknowledgement, answers.AlarmQuery, answers.Acknowledgement),
    ),
    ApiRoute("GET", "/alarm_rules", "The rules of alarms", present.alarm_rules, answers.AlarmRulesAnswer),
    ApiRoute(
        *("PUT", "/alarm_rules", "Replace the rules that were made on the page", present.put_alarm_rules),
        *(answers.AlarmRulesAnswer, answers.SiteQuery, AlarmRulesMessage),
    ),
    ApiRoute("GET", "/history/tags", "Tags that it has", _past_tags, listed("tags", str)),
    _past(
        *("track", "The way of a tag", Track, answers.TrackQuery),
        lambda history, span, asked: history.track(asked.tag, span, asked.points),
    ),
    _past(
        *("heatmap", "How long tags were where", Heatmap, answers.HeatmapQuery),
        lambda history, span, asked: history.heatmap(span, asked.cell_m, names(asked.tag)),
    ),
    _past(
        *("dwell", "How long tags were in zones", listed("dwell", Dwell), answers.DwellQuery),
        lambda history, span, asked: {"dwell": history.dwell(span, names(asked.tag), asked.zone or None)},
    ),
    _past(
        *("occupancy", "How many tags were in zones", listed("occupancy", Occupancy), answers.OccupancyQuery),
        lambda history, span, asked: {"occupancy": history.occupancy(span, asked.zone or None, asked.step_s)},
    ),
    _past(
        *("contacts", "Whom a tag was near to", listed("contacts", Contact), answers.ContactsQuery),
        lambda history, span, asked: {"contacts": history.contacts(asked.tag, span, asked.distance_m)},
    ),
    _past(
        *("alarms", "Alarms of the past", listed("alarms", AlarmRow), answers.SpanQuery),
        lambda history, span, _asked: {"alarms": history.alarms(span)},
    ),
)


def api_routes(services: ApiServices) -> list[BaseRoute]:
    """The routes of the server."""
    whole = msgspec.json.encode(document(ROUTES))

    async def openapi(_request: Request) -> Response:
        return Response(whole, media_type=JSON)

    return [
        Route(f"{ROOT}/openapi.json", openapi),
        *(Route(ROOT + route.path, _endpoint(route, services), methods=[route.method]) for route in ROUTES),
        WebSocketRoute(f"{ROOT}/stream", stream.endpoint(services)),
    ]


def _endpoint(route: ApiRoute, services: ApiServices) -> Callable[[Request], Awaitable[Response]]:
    async def respond(request: Request) -> Response:
        query = read_query(request.query_params, request.path_params, route.query)
        live = site_of(services.sites, query)
        body = None if route.body is None else read_body(await _body(request), route.body)
        try:
            answer = route.respond(Call(live, services.past, query, body))
            answer = await answer if inspect.isawaitable(answer) else answer
        except SkylessError as error:  # what is asked for needs a georeference
            return JSONResponse({"error": str(error)}, status_code=409)
        if isinstance(answer, bytes):
            return Response(answer, media_type=route.media_types[-1])
        return Response(msgspec.json.encode(answer), media_type=JSON)

    return respond


async def _body(request: Request) -> bytes:
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MAX_BODY_BYTES:
            raise HTTPException(413, f"the body should have {_MAX_BODY_BYTES} bytes at most")
    return bytes(body)
