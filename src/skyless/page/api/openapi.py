"""The OpenAPI document (version 3.1) of the table of routes."""

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import Struct

from skyless.core.version import installed_version
from skyless.page.api.answers import ErrorAnswer
from skyless.page.api.json_answer import JSON
from skyless.page.api.parameters import parameters_schema

if TYPE_CHECKING:
    from skyless.page.api.routes import ApiRoute

ROOT: Final = "/api/v1"
GEOJSON: Final = "application/geo+json"
CSV: Final = "text/csv"

_NOTES: Final = (
    "Positions are in metres in the site's own frame, times in seconds since 1970. Where the server has tokens, GET "
    "needs one of them, and PUT and POST need the operator's."
)


def document(routes: "Sequence[ApiRoute]") -> dict[str, Any]:
    """The document; its schemas are those of the structs."""
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
    """The same schema without ``prefixItems`` where all are equal: generators of clients do not know them."""
    if isinstance(schema, list):
        return [_plain(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    items = schema.get("prefixItems")
    if items and all(item == items[0] for item in items):
        schema = {key: part for key, part in schema.items() if key != "prefixItems"} | {"items": items[0]}
    return {key: _plain(part) for key, part in schema.items()}
