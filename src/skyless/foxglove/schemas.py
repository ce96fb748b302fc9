"""JSON schemas as Foxglove understands them: of its own messages, and of ours.

Its own are documented at https://docs.foxglove.dev/docs/sdk/schemas.
"""

from functools import cache, lru_cache
from typing import Any, Final

import msgspec
from msgspec import Struct

Schema = dict[str, Any]

_NUMBER: Final[Schema] = {"type": "number"}
_INTEGER: Final[Schema] = {"type": "integer"}
_TEXT: Final[Schema] = {"type": "string"}
_FLAG: Final[Schema] = {"type": "boolean"}


def _object(title: str, **properties: Schema) -> Schema:
    return {"title": title, "type": "object", "properties": properties}


def _array(items: Schema) -> Schema:
    return {"type": "array", "items": items}


_TIME: Final = _object("time", sec=_INTEGER, nsec=_INTEGER)
_DURATION: Final = _object("duration", sec=_INTEGER, nsec=_INTEGER)
_VECTOR: Final = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POINT: Final = _object("foxglove.Point3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION: Final = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE: Final = _object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_COLOUR: Final = _object("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_SOLID: Final = {"pose": _POSE, "size": _VECTOR, "color": _COLOUR}
_MESH: Final = {"points": _array(_POINT), "color": _COLOUR, "colors": _array(_COLOUR), "indices": _array(_INTEGER)}
PRIMITIVES: Final = {
    "arrows": _object(
        "foxglove.ArrowPrimitive",
        pose=_POSE,
        shaft_length=_NUMBER,
        shaft_diameter=_NUMBER,
        head_length=_NUMBER,
        head_diameter=_NUMBER,
        color=_COLOUR,
    ),
    "cubes": _object("foxglove.CubePrimitive", **_SOLID),
    "spheres": _object("foxglove.SpherePrimitive", **_SOLID),
    "cylinders": _object("foxglove.CylinderPrimitive", **_SOLID, bottom_scale=_NUMBER, top_scale=_NUMBER),
    "lines": _object(
        "foxglove.LinePrimitive", type=_INTEGER, pose=_POSE, thickness=_NUMBER, scale_invariant=_FLAG, **_MESH
    ),
    "triangles": _object("foxglove.TriangleListPrimitive", pose=_POSE, **_MESH),
    "texts": _object(
        "foxglove.TextPrimitive",
        pose=_POSE,
        billboard=_FLAG,
        font_size=_NUMBER,
        scale_invariant=_FLAG,
        color=_COLOUR,
        text=_TEXT,
    ),
    "models": _object(
        "foxglove.ModelPrimitive",
        pose=_POSE,
        scale=_VECTOR,
        color=_COLOUR,
        override_color=_FLAG,
        url=_TEXT,
        media_type=_TEXT,
        data={"type": "string", "contentEncoding": "base64"},
    ),
}
"""Shapes that an entity of a scene may consist of."""

_ENTITY: Final = _object(
    "foxglove.SceneEntity",
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_DURATION,
    frame_locked=_FLAG,
    metadata=_array(_object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
    **{name: _array(primitive) for name, primitive in PRIMITIVES.items()},
)
_DELETION: Final = _object("foxglove.SceneEntityDeletion", timestamp=_TIME, type=_INTEGER, id=_TEXT)
_SCHEMAS: Final = {
    schema["title"]: schema
    for schema in (
        _object("foxglove.PoseInFrame", timestamp=_TIME, frame_id=_TEXT, pose=_POSE),
        _object(
            "foxglove.FrameTransform",
            timestamp=_TIME,
            parent_frame_id=_TEXT,
            child_frame_id=_TEXT,
            translation=_VECTOR,
            rotation=_QUATERNION,
        ),
        _object("foxglove.SceneUpdate", deletions=_array(_DELETION), entities=_array(_ENTITY)),
        _object(
            "foxglove.LocationFix",
            timestamp=_TIME,
            frame_id=_TEXT,
            latitude=_NUMBER,
            longitude=_NUMBER,
            altitude=_NUMBER,
            position_covariance={**_array(_NUMBER), "minItems": 9, "maxItems": 9},
            position_covariance_type=_INTEGER,
        ),
    )
}


@cache
def foxglove_schema(name: str) -> tuple[str, bytes]:
    """Name and JSON schema of one of Foxglove's messages."""
    return name, msgspec.json.encode(_SCHEMAS[name])


@lru_cache(maxsize=64)
def schema_of(payload: type[Struct]) -> tuple[str, bytes]:
    """Name and JSON schema of a payload, as far as viewers of MCAP understand one.

    Foxglove accepts objects, plain types and arrays of those, without references, alternatives or free keys; anything
    else is left out, and a type that may be null is given without the null.
    """
    name = f"skyless.{payload.__name__.removesuffix('Message')}"
    schema = msgspec.json.schema(payload)
    root = _viewable(schema["$defs"][payload.__name__], schema["$defs"])
    return name, msgspec.json.encode({**(root or {}), "title": name})


def _viewable(schema: Schema, definitions: Schema) -> Schema | None:
    """A schema without what viewers do not accept; None if nothing is left."""
    schema = _resolved(schema, definitions)
    match schema.get("type"):
        case "boolean" | "integer" | "number" as kind:
            return {"type": kind}
        case "string":
            return {key: schema[key] for key in ("type", "contentEncoding") if key in schema}
        case "object" if "properties" in schema:
            parts = {name: _viewable(part, definitions) for name, part in schema["properties"].items()}
            return {"type": "object", "properties": {name: part for name, part in parts.items() if part is not None}}
        case "array":
            items = [_viewable(part, definitions) for part in schema.get("prefixItems") or [schema["items"]]]
            plain = items[0] is not None and items[0]["type"] != "array" and "contentEncoding" not in items[0]
            return {"type": "array", "items": items[0]} if plain and all(one == items[0] for one in items) else None
    return {"type": "string"} if "enum" in schema else None


def _resolved(schema: Schema, definitions: Schema) -> Schema:
    """What a reference means, and what may be null otherwise is; empty if that is more than one thing."""
    if "$ref" in schema:
        return _resolved(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in schema:
        kinds = [kind for kind in schema["anyOf"] if kind.get("type") != "null"]
        return _resolved(kinds[0], definitions) if len(kinds) == 1 else {}
    return schema
