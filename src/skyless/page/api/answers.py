"""Requests and answers of the HTTP interface: parameters, structs, and the OpenAPI document."""

import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeVar

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType
from starlette.exceptions import HTTPException

from skyless.core.site import AlarmRule
from skyless.core.version import installed_version
from skyless.page.connections import JSON
from skyless.page.events import SiteEvent
from skyless.run.condition.monitor import Condition
from skyless.run.mqtt.messages import AlarmRulesMessage, Asset, FixMessage, SiteMessage, Vector, Zone
from skyless.run.site_table import Presence

if TYPE_CHECKING:
    from skyless.page.api.routes import ApiRoute

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
