"""The parameters of requests: a type for each, which checks and describes it; signatures of functions name them."""

import re
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Final, Literal, TypeVar

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType
from starlette.exceptions import HTTPException

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
Step = Annotated[float, Meta(ge=1.0, le=86_400.0, description="Length of a step in s.")]
Distance = Annotated[float, Meta(ge=0.1, le=100.0, description="Tags that are nearer, in m, were in contact.")]

RENAMED: Final = {"begin": "from", "end": "to"}
"""Names of parameters that Python does not allow."""


class SiteQuery(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What every route takes."""

    site: (
        Annotated[int, Meta(ge=0, le=65_535, description="The site's number; by default one that is alive.")]
        | UnsetType
    ) = UNSET

    @property
    def site_text(self) -> str | None:
        """The number as it was asked for."""
        return None if self.site is UNSET else str(self.site)


class MapQuery(SiteQuery, frozen=True, kw_only=True):
    """What routes take whose answer a map can show."""

    format: Annotated[
        Literal["json", "geojson"], Meta(description="geojson: WGS 84; status 409 where the site is not georeferenced.")
    ] = "json"


def read_query(given: Mapping[str, str], kind: type[_Query]) -> _Query:
    """The parameters of a request. Raises HTTPException, which names key, value and what would be right."""
    values = {key: value for key, value in given.items() if key != "token"}
    schema = parameters_schema(kind)
    try:
        return msgspec.convert(values, kind, strict=False)
    except msgspec.ValidationError as error:
        found = _KEY.search(str(error))
        if found is None:  # one that is unknown or missing
            raise HTTPException(400, f"{error}; the parameters here are {', '.join(schema)}") from None
        key = found[1]
        shown = values[key] if len(values[key]) <= _MAX_SHOWN else values[key][: _MAX_SHOWN - 1] + "…"
        raise HTTPException(400, f"{key} is {shown!r}; it should be {_expected(schema[key])}") from None


@cache
def parameters_schema(kind: type[Struct]) -> dict[str, dict[str, Any]]:
    """JSON schemas of a struct's fields by the names of the parameters."""
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
    """Names that are separated by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())
