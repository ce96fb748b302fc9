"""The HTTP interface's requests, answers (state, map as GeoJSON, history) and OpenAPI document."""

import asyncio
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from math import hypot, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeVar

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType
from msgspec.structs import asdict, replace
from starlette.exceptions import HTTPException
from starlette.responses import Response

from skyless.bridges.target import bridged_site, is_usable, require_georeference
from skyless.core.earth import coordinates, feature
from skyless.core.errors import SkylessError
from skyless.core.site import AlarmRule, GeoreferenceSite
from skyless.core.version import installed_version
from skyless.page.connections import JSON, json_answer
from skyless.page.events import SiteEvent
from skyless.page.live import LiveSite
from skyless.page.tasks import TaskProcess, serve_tasks
from skyless.run.assets import read_csv, write_csv
from skyless.run.condition.monitor import Condition
from skyless.run.history.answers import Contact, Dwell, Heatmap, Span, Track
from skyless.run.history.layout import site_folder
from skyless.run.mqtt.messages import (
    AlarmMessage,
    AlarmRulesMessage,
    Asset,
    AssetsMessage,
    FixMessage,
    SiteMessage,
    Vector,
    Zone,
)
from skyless.run.site_table import Presence
from skyless.run.web import PAGE as LIMITS
from skyless.run.zones import signed_area_m2

if TYPE_CHECKING:
    from skyless.page.api.routes import ApiRoute
    from skyless.run.history.queries import History

_Text = Annotated[str, Meta(max_length=200)]


class ErrorAnswer(Struct, frozen=True):
    """Every answer with a status of 400 or more."""

    error: str
    """A sentence for people."""


class SiteAnswer(SiteMessage, frozen=True, kw_only=True):
    """The site as on MQTT, and how it is."""

    condition: Condition
    connected: bool
    """Whether the page's server is connected to the broker."""
    history: bool
    """Whether the page's server has a history."""
    version: str


class Anchor(Struct, frozen=True):
    """One anchor."""

    id: int
    position_m: Vector
    online: bool | None
    """None if the anchor has not reported."""


class Tag(Asset, frozen=True, kw_only=True):
    """One tag, with its asset."""

    online: bool | None
    """None if the tag has not reported."""
    presence: Presence
    """``fresh``; ``late``, when its newest fix is older than usual; ``asleep`` by its own statement; or ``gone``."""
    zones: tuple[str, ...]
    """Identifiers of the zones that contain the tag."""
    fix: FixMessage | None
    """None without a fresh usable fix."""


class TagsAnswer(Struct, frozen=True):
    """Tags by name."""

    tags: tuple[Tag, ...]
    next: str | None
    """Value of ``after`` for the next page; None for the last page."""


class ZoneTags(Zone, frozen=True, kw_only=True):
    """A zone, and who is in it."""

    tags: tuple[str, ...]


class EventsAnswer(Struct, frozen=True):
    """Events, the newest first."""

    events: tuple[SiteEvent, ...]
    before: int | None
    """Value of ``before`` for the next page; None for the last page."""


class AlarmRulesAnswer(AlarmRulesMessage, frozen=True, kw_only=True):
    """The rules of alarms."""

    file_rules: tuple[AlarmRule, ...]
    """Rules of the site's file."""


class Acknowledgement(Struct, frozen=True):
    """Somebody has seen an alarm."""

    id: _Text
    """Identifier of the occurrence that was seen."""
    by: _Text


# Parameters of requests: types that check and describe them, for the signatures of functions.

_Query = TypeVar("_Query", bound=Struct)
_KEY: Final = re.compile(r"`\$\.([^`.\[]+)`")
_MAX_SHOWN: Final = 60

TagName = Annotated[str, Meta(min_length=1, max_length=200, description="The tag's name.")]
TagNames = Annotated[str, Meta(max_length=20_000, description="Names of tags, separated by commas; empty means all.")]
Group = Annotated[str, Meta(max_length=200, description="Only tags whose asset is in this group.")]
ZoneId = Annotated[str, Meta(max_length=200, description="Only the zone with this identifier.")]
Find = Annotated[str, Meta(max_length=200, description="Only tags with this in their name or their asset's.")]
After = Annotated[str, Meta(max_length=200, description="Only names after this one: next of the last answer.")]
Before = Annotated[int, Meta(ge=1, le=2**53, description="Only events with a smaller id: before of the last answer.")]
Limit = Annotated[int, Meta(ge=1, le=1000, description="How many at most.")]
RuleId = Annotated[str, Meta(max_length=200, description="The rule's identifier.")]
Subject = Annotated[str, Meta(max_length=200, description="What the alarm is about.")]
Begin = Annotated[
    str, Meta(min_length=1, max_length=100, description="What people type (yesterday, 14:00), ISO 8601, or Unix s.")
]
End = Annotated[str, Meta(max_length=100, description="The same; by default what follows from the other.")]
Points = Annotated[int, Meta(ge=2, le=20_000, description="How many points at most.")]
CellSize = Annotated[float, Meta(ge=0.05, le=50.0, description="Side of a cell in m.")]
Distance = Annotated[float, Meta(ge=0.1, le=100.0, description="Tags that are nearer, in m, were in contact.")]

RENAMED: Final = {"begin": "from", "end": "to"}
"""Names of parameters that Python does not allow."""


class SiteQuery(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of every route."""

    site: (
        Annotated[int, Meta(ge=0, le=65_535, description="The site's number; by default one that is alive.")]
        | UnsetType
    ) = UNSET

    @property
    def site_text(self) -> str | None:
        """The requested number as text."""
        return None if self.site is UNSET else str(self.site)


class MapQuery(SiteQuery, frozen=True, kw_only=True):
    """Parameters of routes whose answer a map can show."""

    format: Annotated[
        Literal["json", "geojson"], Meta(description="geojson: WGS 84; status 409 where the site is not georeferenced.")
    ] = "json"


def read_query(given: Mapping[str, str], kind: type[_Query]) -> _Query:
    """Parse the parameters of a request. Raises HTTPException, which names key, value and what would be right."""
    values = {key: value for key, value in given.items() if key != "token"}
    schema = parameters_schema(kind)
    try:
        return msgspec.convert(values, kind, strict=False)
    except msgspec.ValidationError as error:
        found = _KEY.search(str(error))
        if found is None:  # an unknown or missing parameter
            raise HTTPException(400, f"{error}; the parameters here are {', '.join(schema)}") from None
        key = found[1]
        shown = values[key] if len(values[key]) <= _MAX_SHOWN else values[key][: _MAX_SHOWN - 1] + "…"
        raise HTTPException(400, f"{key} is {shown!r}; it should be {_expected(schema[key])}") from None


@cache
def parameters_schema(kind: type[Struct]) -> dict[str, dict[str, Any]]:
    """JSON schemas of a struct's fields, by parameter name."""
    _, components = msgspec.json.schema_components([kind])
    properties: dict[str, dict[str, Any]] = components[kind.__name__]["properties"]
    return properties


def _expected(schema: dict[str, Any]) -> str:
    if "enum" in schema:
        return " or ".join(schema["enum"])
    if schema["type"] == "string":
        least, most = schema.get("minLength", 0), schema["maxLength"]
        return f"{least} to {most} characters" if least else f"{most} characters at most"
    kind = "a whole number" if schema["type"] == "integer" else "a number"
    return f"{kind} from {schema['minimum']:g} to {schema['maximum']:g}"


def names(text: str) -> tuple[str, ...]:
    """Split names separated by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


ROOT: Final = "/api/v1"
GEOJSON: Final = "application/geo+json"
CSV: Final = "text/csv"

_NOTES: Final = (
    "Positions are in metres in the site's own frame, times in seconds since 1970. Where the server has tokens, GET "
    "needs one of them, and PUT and POST need the operator's."
)


def document(routes: "Sequence[ApiRoute]") -> dict[str, Any]:
    """The OpenAPI document, with the schemas of the structs."""
    kinds = [ErrorAnswer, *(kind for route in routes for kind in (route.answer, route.body) if _is_struct(kind))]
    _, components = msgspec.json.schema_components(kinds, ref_template="#/components/schemas/{name}")
    paths: dict[str, dict[str, Any]] = {}
    for route in routes:
        paths.setdefault(ROOT + route.path, {})[route.method.lower()] = _operation(route)
    return {
        "openapi": "3.1.0",
        "info": {"title": "Skyless", "version": installed_version(), "summary": "A site's tags", "description": _NOTES},
        "servers": [{"url": "/"}],
        "paths": paths,
        "security": [{}, {"token": []}],
        "components": {
            "schemas": {name: _plain(schema) for name, schema in components.items()},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
    }


def _operation(route: "ApiRoute") -> dict[str, Any]:
    answers = {kind: {"type": "object"} if kind == GEOJSON else _schema(route.answer) for kind in route.media_types}
    operation: dict[str, Any] = {
        "operationId": re.sub(r"\W+", "_", f"{route.method.lower()}{route.path}").strip("_"),
        "summary": route.summary,
        "description": f"Role: {route.role}.",
        "tags": ["history" if route.is_past else "site"],
        "parameters": _parameters(route),
        "responses": {
            "200": {"description": route.summary, **_content(answers)},
            "default": {"description": "An error.", **_content({JSON: _schema(ErrorAnswer)})},
        },
    }
    if route.body is not None:
        kind = CSV if route.body is bytes else JSON
        operation["requestBody"] = {"required": True, **_content({kind: _schema(route.body)})}
    return operation


def _content(schemas: dict[str, dict[str, Any]]) -> dict[str, Any]:
    return {"content": {kind: {"schema": schema} for kind, schema in schemas.items()}}


def _parameters(route: "ApiRoute") -> list[dict[str, Any]]:
    required = {field.encode_name for field in msgspec.structs.fields(route.query) if field.required}
    return [
        {
            "name": name,
            "in": "path" if f"{{{name}}}" in route.path else "query",
            "required": name in required,
            "description": schema["description"],
            "schema": {key: part for key, part in schema.items() if key != "description"},
        }
        for name, schema in parameters_schema(route.query).items()
    ]


def _schema(kind: type) -> dict[str, Any]:
    return {"$ref": f"#/components/schemas/{kind.__name__}"} if _is_struct(kind) else {"type": "string"}


def _is_struct(kind: type | None) -> bool:
    return kind is not None and issubclass(kind, Struct)


def _plain(schema: object) -> object:
    """Replace ``prefixItems`` that are all equal by ``items``, as client generators do not support them."""
    if isinstance(schema, list):
        return [_plain(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    items = schema.get("prefixItems")
    if items and all(item == items[0] for item in items):
        schema = {key: part for key, part in schema.items() if key != "prefixItems"} | {"items": items[0]}
    return {key: _plain(part) for key, part in schema.items()}


_ALL: Final = 2**53
_POLL_S: Final = 0.02


def site(live: LiveSite) -> SiteAnswer:
    """The site, and how it is."""
    return SiteAnswer(
        **asdict(live.require_site()),
        condition=live.condition,
        connected=live.connected,
        history=live.has_history,
        version=installed_version(),
    )


def anchors(live: LiveSite) -> tuple[Anchor, ...]:
    """Its anchors."""
    return tuple(
        Anchor(anchor.id, (anchor.x_m, anchor.y_m, anchor.z_m), _online(live, "anchor", str(anchor.id)))
        for anchor in live.require_site().site.anchors
    )


def _online(live: LiveSite, kind: str, name: str) -> bool | None:
    node = live.table.get(kind, name)
    return None if node is None else node.online


def tags(
    live: LiveSite, *, group: Group = "", zone: ZoneId = "", find: Find = "", limit: Limit = 100, after: After = ""
) -> TagsAnswer:
    """Tags by name, in pages."""
    find = find.casefold()
    found: list[str] = []
    for name in sorted(name for name in _names(live) if name > after):
        asset = live.assets.by_tag.get(name, Asset(name))
        if group and asset.group != group:
            continue
        if find not in name.casefold() and find not in asset.name.casefold():
            continue
        if zone and zone not in _zones(live, name):
            continue
        found.append(name)
        if len(found) > limit:
            break
    shown = found[:limit]
    return TagsAnswer(_tags(live, shown), shown[-1] if len(found) > limit else None)


def _names(live: LiveSite) -> set[str]:
    return {name for name, tag in live.table.all("tag").items() if tag.status is not None or tag.fix is not None}


def tag(live: LiveSite, *, tag: TagName) -> Tag:
    """One tag."""
    if tag not in _names(live):
        raise HTTPException(404, f"tag is {tag[:60]!r}; no tag of this name has reported at this site")
    return _tags(live, [tag])[0]


def _tags(live: LiveSite, names: list[str]) -> tuple[Tag, ...]:
    fixes = {fix.tag: fix for fix in usable(given for given in live.recent_fixes() if given[0].tag in names)}
    return tuple(
        Tag(
            **asdict(live.assets.by_tag.get(name, Asset(name))),
            online=_online(live, "tag", name),
            presence=live.presence(name),
            zones=_zones(live, name),
            fix=fixes.get(name),
        )
        for name in names
    )


def _zones(live: LiveSite, tag: str) -> tuple[str, ...]:
    return tuple(zone.id for zone in live.monitor.zones_with(tag))


def fixes(live: LiveSite) -> tuple[FixMessage, ...]:
    """The newest usable fix of each tag."""
    return tuple(sorted(usable(live.recent_fixes()), key=lambda fix: fix.tag))


def usable(given: Iterable[tuple[FixMessage, float]]) -> list[FixMessage]:
    """Select usable fixes, with their times replaced by those of the server's clock, which are given with them."""
    return [replace(fix, unix_s=round(ended_unix_s, 4)) for fix, ended_unix_s in given if is_usable(fix)]


def zones(live: LiveSite) -> tuple[ZoneTags, ...]:
    """Zones, and who is in them."""
    inside = {name: _zones(live, name) for name in sorted(live.table.fixed)}
    return tuple(
        ZoneTags(**asdict(zone), tags=tuple(name for name, zones in inside.items() if zone.id in zones))
        for zone in live.monitor.zones
    )


def events(live: LiveSite, *, limit: Limit = 100, before: Before = _ALL) -> EventsAnswer:
    """What has happened, the newest first, in pages."""
    found = live.event_list.before(before, limit + 1)
    return EventsAnswer(tuple(found[:limit]), found[limit - 1].id if len(found) > limit else None)


def assets(live: LiveSite) -> AssetsMessage:
    """What tags are attached to."""
    return live.assets.message


def put_assets(live: LiveSite, *, body: AssetsMessage) -> AssetsMessage:
    """Replace all assets."""
    live.require_site()
    live.assets.store(body.assets, body.site)
    return live.assets.message


def assets_csv(live: LiveSite) -> bytes:
    """The assets as a table."""
    return write_csv(live.assets.message.assets)


def put_assets_csv(live: LiveSite, *, body: bytes) -> AssetsMessage:
    """Replace all assets by a table."""
    return put_assets(live, body=AssetsMessage(read_csv(body)))


def alarms(live: LiveSite) -> tuple[AlarmMessage, ...]:
    """Alarms that are not over."""
    return live.alarms.messages


def alarm_rules(live: LiveSite) -> AlarmRulesAnswer:
    """The rules of alarms."""
    name = "" if live.site is None else live.site.site.name
    return AlarmRulesAnswer(live.alarms.rules, name, file_rules=live.alarms.file_rules)


def put_alarm_rules(live: LiveSite, *, body: AlarmRulesMessage) -> AlarmRulesAnswer:
    """Replace the rules that were made on the page."""
    live.require_site()
    live.alarms.store_rules(body.rules, body.site)
    return replace(alarm_rules(live), rules=body.rules)  # in effect from the next tick on


async def acknowledge(live: LiveSite, *, rule: RuleId, subject: Subject, body: Acknowledgement) -> Acknowledgement:
    """Acknowledge an alarm: answered when the broker has it."""
    live.acknowledge(rule, subject, body.id, body.by)
    try:
        async with asyncio.timeout(5.0):
            while not live.alarms.is_acknowledged(rule, subject, body.id):
                await asyncio.sleep(_POLL_S)
    except TimeoutError:
        raise HTTPException(503, "the broker has not taken it yet; look whether the alarm is acknowledged") from None
    return body


# Questions to the history: a separate process answers them one after the other.
#
# A long one thus takes neither memory nor time from the server, which also raises alarms, and can be ended.


class _Question(Struct, frozen=True):
    folder: str
    site: int
    name: str
    given: dict[str, Any]


class Past:
    """The history of the sites that the server shows."""

    def __init__(self, folder: Path | None) -> None:
        """``folder``: of the history; None without one."""
        self._folder = folder
        self._process = TaskProcess("skyless.page.api.questions", fault=400)
        self._waiting = 0

    async def ask(self, site: int | None, name: str, given: dict[str, Any]) -> bytes:
        """Answer a question to a site's history by a function of this file, as JSON. Raises HTTPException."""
        if self._folder is None:
            raise HTTPException(404, "this server has no history: start the page's server with --history FOLDER")
        if site is None:
            raise HTTPException(404, "no site is known yet")
        if not site_folder(self._folder, site).is_dir():
            raise HTTPException(404, f"{self._folder} holds no history of site {site}; skyless history run writes one")
        if self._waiting >= LIMITS.questions:
            raise HTTPException(503, f"{LIMITS.questions} questions to the history are waiting; ask again later")
        self._waiting += 1
        try:
            async with asyncio.timeout(LIMITS.question_s):
                return await self._process.run(_Question(str(self._folder), site, name, given))
        except TimeoutError:
            fault = f"the history has not answered within {LIMITS.question_s:g} s; ask for a shorter time"
            raise HTTPException(503, fault) from None
        finally:
            self._waiting -= 1

    def stop(self) -> None:
        """End the current question, and start no further one."""
        self._process.stop()


def _span(begin: str, end: str) -> Span:
    from skyless.run.history.answers import span_of  # noqa: PLC0415 - of the extra history

    return span_of(begin, end or None, time.time())


def past_tags(history: "History") -> tuple[str, ...]:
    """Tags that it has."""
    return history.tags()


def track(history: "History", *, tag: TagName, begin: Begin, end: End = "", points: Points = 2000) -> Track:
    """The way of a tag."""
    return history.track(tag, _span(begin, end), points)


def heatmap(history: "History", *, begin: Begin, end: End = "", cell_m: CellSize = 0.25, tag: TagNames = "") -> Heatmap:
    """How long tags were where."""
    return history.heatmap(_span(begin, end), cell_m, names(tag))


def dwell(
    history: "History", *, begin: Begin, end: End = "", tag: TagNames = "", zone: ZoneId = ""
) -> tuple[Dwell, ...]:
    """How long tags were in zones."""
    return history.dwell(_span(begin, end), names(tag), zone or None)


def contacts(
    history: "History", *, tag: TagName, begin: Begin, end: End = "", distance_m: Distance = 2.0
) -> tuple[Contact, ...]:
    """Whom a tag was near to."""
    return history.contacts(tag, _span(begin, end), distance_m)


def _answer(question: _Question) -> object:
    """Answer a question in the process; a tuple becomes an object with one key. Raises SkylessError."""
    from skyless.run.history.queries import History  # noqa: PLC0415 - of the extra history

    functions = (past_tags, track, heatmap, dwell, contacts)
    function = {one.__name__.removeprefix("past_"): one for one in functions}[question.name]
    found = function(History(Path(question.folder), question.site), **question.given)
    return {question.name: found} if isinstance(found, tuple) else found


if __name__ == "__main__":
    serve_tasks(_Question, _answer)


# Tags, anchors and zones of a site as GeoJSON (RFC 7946), for programs that draw maps.


def collection(live: LiveSite, kind: str) -> Response:
    """Tags with fixes, anchors or zones as GeoJSON: longitude, latitude (WGS 84), height above the ellipsoid.

    Raises HTTPException: no site is known yet, or it is not georeferenced.
    """
    site = live.require_site()
    try:
        origin = require_georeference(bridged_site(site.site, simulated=site.simulated), "GeoJSON")
    except SkylessError as error:
        raise HTTPException(409, str(error)) from None
    found = {"type": "FeatureCollection", "features": list(_FEATURES[kind](live, origin))}
    return json_answer(found, media_type=GEOJSON)


def _fixes(live: LiveSite, origin: GeoreferenceSite) -> Iterator[dict[str, Any]]:
    """Points of the fixes that no alert makes unusable."""
    for fix, ended_unix_s in live.recent_fixes():
        if not is_usable(fix):
            continue
        asset = live.assets.by_tag.get(fix.tag, Asset(fix.tag))
        properties = {
            "tag": fix.tag,
            "name": asset.name or None,
            "group": asset.group or None,
            "colour": asset.colour or None,
            "unix_s": round(ended_unix_s, 3),
            "age_s": round(max(live.wall_clock() - ended_unix_s, 0.0), 3),
            "std_m": round(fix.std_m, 4),
            "horizontal_std_m": round(sqrt(max(fix.covariance_m2[0] + fix.covariance_m2[4], 0.0)), 4),
            "speed_mps": None if fix.velocity_mps is None else round(hypot(*fix.velocity_mps), 3),
            "method": fix.method,
            "alert": fix.alert,
        }
        yield feature("Point", coordinates(fix.position_m, origin), properties, id=fix.tag)


def _anchors(live: LiveSite, origin: GeoreferenceSite) -> Iterator[dict[str, Any]]:
    for anchor in live.require_site().site.anchors:
        position_m = anchor.x_m, anchor.y_m, anchor.z_m
        properties = {"anchor": anchor.id, "position_m": position_m}
        yield feature("Point", coordinates(position_m, origin), properties, id=anchor.id)


def _zone_features(live: LiveSite, origin: GeoreferenceSite) -> Iterator[dict[str, Any]]:
    for zone in live.monitor.zones:
        corners = zone.polygon_m if signed_area_m2(zone.polygon_m) >= 0.0 else zone.polygon_m[::-1]
        ring = [coordinates((x, y, 0.0), origin)[:2] for x, y in (*corners, corners[0])]
        properties = {"zone": zone.id, "name": zone.name, "colour": zone.colour}
        yield feature("Polygon", [ring], properties, id=zone.id)


_FEATURES: Final = {"fixes": _fixes, "anchors": _anchors, "zones": _zone_features}
