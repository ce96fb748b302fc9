"""What a handler gets of a request, and reading it: parameters and bodies are checked by their structs."""

import re
from functools import cache
from typing import Any, Final, TypeVar

import msgspec
from msgspec import UNSET, Struct
from starlette.datastructures import QueryParams
from starlette.exceptions import HTTPException

from skyless.page.api.answers import SiteQuery
from skyless.page.api.past import Past
from skyless.page.live import LiveSite
from skyless.page.sites import LiveSites

_Query = TypeVar("_Query", bound=Struct)
_KEY: Final = re.compile(r"`\$\.([^`.\[]+)`")
_MAX_SHOWN: Final = 60


class ApiServices(Struct, frozen=True):
    """What the interface needs of the server."""

    sites: LiveSites
    past: Past


class Call(Struct, frozen=True):
    """One request."""

    live: LiveSite
    past: Past
    query: Any
    """The parameters, of the route's struct."""
    body: Any
    """The body, of the route's struct, or bytes."""


def site_of(sites: LiveSites, query: SiteQuery) -> LiveSite:
    """The site that is asked for. Raises NoSiteError."""
    return sites.of(None if query.site is UNSET else str(query.site))


def read_query(given: QueryParams, path: dict[str, str], kind: type[_Query]) -> _Query:
    """The parameters of a request. Raises HTTPException, which names key, value and what would be right."""
    values = {key: value for key, value in given.multi_items() if key != "token"} | path
    schema = parameters_schema(kind)
    for key in given:
        if key not in schema and key != "token":
            raise HTTPException(400, f"{key[:_MAX_SHOWN]!r} is no parameter here; there are {', '.join(schema)}")
    required = [field.encode_name for field in msgspec.structs.fields(kind) if field.required]
    missing = [key for key in required if key not in values]
    if missing:
        raise HTTPException(400, f"{missing[0]} is missing; it should be {expected(schema[missing[0]])}")
    try:
        return msgspec.convert(values, kind, strict=False)
    except msgspec.ValidationError as error:
        found = _KEY.search(str(error))
        key = found[1] if found is not None else ""
        if key not in schema:
            raise HTTPException(400, f"the parameters cannot be read: {error}") from None
        shown = values[key] if len(values[key]) <= _MAX_SHOWN else values[key][: _MAX_SHOWN - 1] + "…"
        raise HTTPException(400, f"{key} is {shown!r}; it should be {expected(schema[key])}") from None


def names(text: str) -> tuple[str, ...]:
    """Names that are separated by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


@cache
def parameters_schema(kind: type[Struct]) -> dict[str, dict[str, Any]]:
    """JSON schemas of a struct's fields by the names of the parameters."""
    _, components = msgspec.json.schema_components([kind])
    properties: dict[str, dict[str, Any]] = components[kind.__name__]["properties"]
    return properties


def expected(schema: dict[str, Any]) -> str:
    """What a value should be, in words."""
    if "enum" in schema:
        return " or ".join(schema["enum"])
    if schema["type"] == "string":
        least, most = schema.get("minLength", 0), schema["maxLength"]
        return f"{least} to {most} characters" if least else f"{most} characters at most"
    kind = "a whole number" if schema["type"] == "integer" else "a number"
    return f"{kind} from {schema['minimum']:g} to {schema['maximum']:g}"


def read_body(body: bytes, kind: type[Struct] | type[bytes]) -> Struct | bytes:
    """The body of a request, of this struct, or as it is. Raises HTTPException."""
    if issubclass(kind, bytes):
        return body
    try:
        return msgspec.json.decode(body, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise HTTPException(400, f"the body cannot be read as {kind.__name__}: {error}") from None
