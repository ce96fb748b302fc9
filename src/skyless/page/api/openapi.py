"""The OpenAPI document (version 3.1) of the table of routes."""

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeGuard

import msgspec
from msgspec import Struct

from skyless.core.version import installed_version
from skyless.page.api.answers import ErrorAnswer
from skyless.page.api.call import parameters_schema

if TYPE_CHECKING:
    from skyless.page.api.routes import ApiRoute

_NOTES = (
    "Positions are in metres in the site's own frame, times in seconds since 1970. Where the server has tokens, GET "
    "needs one of them, and PUT and POST need the operator's."
)


def document(routes: "Sequence[ApiRoute]") -> dict[str, Any]:
    """The document; its schemas are those of the structs."""
    kinds = [ErrorAnswer, *(kind for route in routes for kind in (route.answer, route.body) if _is_struct(kind))]
    _, components = msgspec.json.schema_components(kinds, ref_template="#/components/schemas/{name}")
    paths: dict[str, dict[str, Any]] = {}
    for route in routes:
        paths.setdefault("/api/v1" + route.path, {})[route.method.lower()] = _operation(route)
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


def _is_struct(kind: object) -> TypeGuard[type[Struct]]:
    return isinstance(kind, type) and issubclass(kind, Struct)


def _operation(route: "ApiRoute") -> dict[str, Any]:
    name = re.sub(r"\W+", "_", f"{route.method.lower()}{route.path}").strip("_")
    operation: dict[str, Any] = {
        "operationId": name,
        "summary": route.summary,
        "description": f"Role: {route.role}.",
        "tags": ["history" if route.path.startswith("/history") else "site"],
        "parameters": _parameters(route),
        "responses": {
            "200": {
                "description": route.summary,
                "content": {kind: {"schema": _answer_schema(route, kind)} for kind in route.media_types},
            },
            "default": {
                "description": "An error.",
                "content": {"application/json": {"schema": {"$ref": "#/components/schemas/ErrorAnswer"}}},
            },
        },
    }
    if route.body is not None:
        operation["requestBody"] = {"required": True, "content": {route.body_type: {"schema": _schema(route.body)}}}
    return operation


def _parameters(route: "ApiRoute") -> list[dict[str, Any]]:
    required = {field.encode_name for field in msgspec.structs.fields(route.query) if field.required}
    found = []
    for name, schema in parameters_schema(route.query).items():
        place = "path" if f"{{{name}}}" in route.path else "query"
        value = {key: part for key, part in schema.items() if key != "description"}
        found.append(
            {
                "name": name,
                "in": place,
                "required": name in required,
                "description": schema["description"],
                "schema": value,
            }
        )
    return found


def _answer_schema(route: "ApiRoute", media_type: str) -> dict[str, Any]:
    return {"type": "object"} if media_type.endswith("geo+json") else _schema(route.answer)


def _schema(kind: object) -> dict[str, Any]:
    return {"$ref": f"#/components/schemas/{kind.__name__}"} if _is_struct(kind) else {"type": "string"}


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
