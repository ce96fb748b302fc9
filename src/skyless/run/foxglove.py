"""Messages that Foxglove shows without configuration (poses, a scene, positions on the Earth), and JSON schemas.

Foxglove's own schemas are documented at https://docs.foxglove.dev/docs/sdk/schemas.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import Any, Final

import msgspec
from msgspec import Struct

from skyless.core.earth import geodetic, horizontal_ellipse, rotated
from skyless.core.site import GeoreferenceSite, WallSite
from skyless.run.mqtt.messages import FixMessage, Vector, Zone

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
PRIMITIVES: Final = {
    "arrows": _object("foxglove.ArrowPrimitive"),
    "cubes": _object("foxglove.CubePrimitive", **_SOLID),
    "spheres": _object("foxglove.SpherePrimitive", **_SOLID),
    "cylinders": _object("foxglove.CylinderPrimitive"),
    "lines": _object(
        "foxglove.LinePrimitive",
        type=_INTEGER,
        pose=_POSE,
        thickness=_NUMBER,
        scale_invariant=_FLAG,
        points=_array(_POINT),
        color=_COLOUR,
        colors=_array(_COLOUR),
        indices=_array(_INTEGER),
    ),
    "triangles": _object("foxglove.TriangleListPrimitive"),
    "texts": _object(
        "foxglove.TextPrimitive",
        pose=_POSE,
        billboard=_FLAG,
        font_size=_NUMBER,
        scale_invariant=_FLAG,
        color=_COLOUR,
        text=_TEXT,
    ),
    "models": _object("foxglove.ModelPrimitive"),
}
"""Shapes of a scene's entity. All of them must be present; those without fields are never used."""

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
    """Name and JSON schema of a payload, reduced to what viewers of MCAP understand.

    Foxglove accepts objects, plain types and arrays of those, without references, alternatives or free keys; anything
    else is left out, and a nullable type is given without the null.
    """
    name = f"skyless.{payload.__name__.removesuffix('Message')}"
    schema = msgspec.json.schema(payload)
    root = _viewable(schema["$defs"][payload.__name__], schema["$defs"])
    return name, msgspec.json.encode({**(root or {}), "title": name})


def _viewable(schema: Schema, definitions: Schema) -> Schema | None:
    """Reduce a schema to what viewers accept; None if nothing is left."""
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
    """Resolve a reference, and reduce a nullable type to the type; empty if several types remain."""
    if "$ref" in schema:
        return _resolved(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in schema:
        kinds = [kind for kind in schema["anyOf"] if kind.get("type") != "null"]
        return _resolved(kinds[0], definitions) if len(kinds) == 1 else {}
    return schema


FRAME: Final = "site"
SCENE_TOPIC: Final = "/site/scene"
KNOWN_COVARIANCE: Final = 3
ELLIPSE_SIGMAS: Final = 2.0
"""Number of standard deviations that an ellipse shows."""

WALL_HEIGHT_M: Final = 2.5
_LINE_LOOP: Final = 1
"""A line that returns to its first point."""


def pose_in_frame(fix: FixMessage, *, facing: bool) -> bytes:
    """``foxglove.PoseInFrame``: the tag's pose; ``facing`` turns it to its direction of travel if that is unknown."""
    yaw = math.atan2(fix.velocity_mps[1], fix.velocity_mps[0]) if facing and fix.velocity_mps is not None else 0.0
    return msgspec.json.encode({"timestamp": _time(fix.unix_s), "frame_id": FRAME, "pose": _pose_of(fix, yaw)})


def frame_transform(fix: FixMessage) -> bytes:
    """``foxglove.FrameTransform``: a frame named as the tag, at its position, with its axes, or else the site's."""
    pose = _pose_of(fix, 0.0)
    return msgspec.json.encode(
        {
            "timestamp": _time(fix.unix_s),
            "parent_frame_id": FRAME,
            "child_frame_id": fix.tag,
            "translation": pose["position"],
            "rotation": pose["orientation"],
        }
    )


def ellipse(fix: FixMessage) -> bytes:
    """``foxglove.SceneUpdate``: the tag's name and its ellipse of two standard deviations on the floor."""
    axes_m, yaw = ellipse_of(fix)
    x, y, z = fix.position_m
    disc = {"pose": _pose(fix.position_m, yaw), "size": _xyz(*axes_m, 0.02), "color": _colour(0.1, 0.5, 1.0, 0.35)}
    entity = _entity(fix.unix_s, f"tag {fix.tag}", spheres=[disc], texts=[_label(fix.tag, (x, y, z + 0.3))])
    return msgspec.json.encode({"deletions": [], "entities": [{**entity, "lifetime": {"sec": 2, "nsec": 0}}]})


def ellipse_of(fix: FixMessage) -> tuple[tuple[float, float], float]:
    """Diameters of the ellipse of ``ELLIPSE_SIGMAS``, the longer first, and its direction in rad."""
    long_m, short_m, direction = horizontal_ellipse(fix.covariance_m2)
    return (2.0 * ELLIPSE_SIGMAS * long_m, 2.0 * ELLIPSE_SIGMAS * short_m), direction


def scene(
    unix_s: float,
    anchors_m: Mapping[int, Vector],
    master: int | None,
    walls: Sequence[WallSite] = (),
    zones: Sequence[Zone] = (),
) -> bytes:
    """``foxglove.SceneUpdate`` that replaces the earlier one: anchors, walls, outlines of zones."""
    entities = [
        *(_anchor(unix_s, number, position_m, number == master) for number, position_m in anchors_m.items()),
        *(_wall(unix_s, number, wall) for number, wall in enumerate(walls)),
        *(_outline(unix_s, zone) for zone in zones),
    ]
    deletions = [{"timestamp": _time(unix_s), "type": 1, "id": ""}]
    return msgspec.json.encode({"deletions": deletions, "entities": entities})


def _anchor(unix_s: float, number: int, position_m: Vector, is_master: bool) -> Schema:
    x, y, z = position_m
    colour = _colour(1.0, 0.6, 0.0, 1.0) if is_master else _colour(0.5, 0.5, 0.5, 1.0)
    cube = {"pose": _pose(position_m, 0.0), "size": _xyz(0.15, 0.15, 0.15), "color": colour}
    return _entity(unix_s, f"anchor {number}", cubes=[cube], texts=[_label(str(number), (x, y, z + 0.3))])


def _wall(unix_s: float, number: int, wall: WallSite) -> Schema:
    middle = ((wall.x1_m + wall.x2_m) / 2.0, (wall.y1_m + wall.y2_m) / 2.0, WALL_HEIGHT_M / 2.0)
    dx, dy = wall.x2_m - wall.x1_m, wall.y2_m - wall.y1_m
    size, colour = _xyz(math.hypot(dx, dy), 0.1, WALL_HEIGHT_M), _colour(0.6, 0.6, 0.6, 0.4)
    cube = {"pose": _pose(middle, math.atan2(dy, dx)), "size": size, "color": colour}
    return _entity(unix_s, f"wall {number}", cubes=[cube])


def _outline(unix_s: float, zone: Zone) -> Schema:
    line = {
        "type": _LINE_LOOP,
        "pose": _pose((0.0, 0.0, 0.0), 0.0),
        "thickness": 0.05,
        "scale_invariant": False,
        "points": [_xyz(x, y, 0.0) for x, y in zone.polygon_m],
        "color": _colour(0.0, 0.6, 0.4, 1.0),
        "colors": [],
        "indices": [],
    }
    count = max(len(zone.polygon_m), 1)
    middle = (sum(x for x, _ in zone.polygon_m) / count, sum(y for _, y in zone.polygon_m) / count, 0.1)
    return _entity(unix_s, f"zone {zone.id}", lines=[line], texts=[_label(zone.name, middle)])


def location_fix(fix: FixMessage, origin: GeoreferenceSite) -> bytes:
    """``foxglove.LocationFix``: where the tag is on the Earth, with its covariance towards east, north and up."""
    latitude, longitude, altitude = geodetic(fix.position_m, origin)
    return msgspec.json.encode(
        {
            "timestamp": _time(fix.unix_s),
            "frame_id": FRAME,
            "latitude": latitude,
            "longitude": longitude,
            "altitude": altitude,
            "position_covariance": rotated(fix.covariance_m2, origin.heading_deg),
            "position_covariance_type": KNOWN_COVARIANCE,
        }
    )


def _entity(unix_s: float, name: str, **primitives: list[Schema]) -> Schema:
    return {
        "timestamp": _time(unix_s),
        "frame_id": FRAME,
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": True,
        "metadata": [],
        **{kind: primitives.get(kind, []) for kind in PRIMITIVES},
    }


def _label(text: str, position_m: tuple[float, float, float]) -> Schema:
    return {
        "pose": _pose(position_m, 0.0),
        "billboard": True,
        "font_size": 0.25,
        "scale_invariant": False,
        "color": _colour(0.2, 0.2, 0.2, 1.0),
        "text": text,
    }


def _time(unix_s: float) -> dict[str, int]:
    sec, nsec = divmod(max(round(unix_s * 1e9), 0), 1_000_000_000)
    return {"sec": sec, "nsec": nsec}


def _pose_of(fix: FixMessage, yaw: float) -> Schema:
    """The pose of a fix, turned by ``yaw`` if its orientation is unknown."""
    pose = _pose(fix.position_m, yaw)
    if fix.orientation is not None:
        pose["orientation"] = dict(zip("wxyz", fix.orientation, strict=True))
    return pose


def _pose(position_m: tuple[float, float, float], yaw: float) -> Schema:
    half = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2.0), "w": math.cos(yaw / 2.0)}
    return {"position": _xyz(*position_m), "orientation": half}


def _xyz(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def _colour(r: float, g: float, b: float, a: float) -> dict[str, float]:
    return {"r": r, "g": g, "b": b, "a": a}
