"""What Foxglove shows without configuration: poses, a scene, and positions on the Earth.

Schemas as documented at https://docs.foxglove.dev/docs/sdk/schemas.
"""

import math
from functools import cache
from typing import Any, Final

import msgspec
import numpy as np

from skyless.mqtt.messages import FixMessage
from skyless.site.georeference import to_wgs84
from skyless.site.model import GeoreferenceSite, Site

FRAME: Final = "site"
KNOWN_COVARIANCE: Final = 3
ELLIPSE_SIGMAS: Final = 2.0
"""How many standard deviations an ellipse shows."""

WALL_HEIGHT_M: Final = 2.5

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
_PRIMITIVES: Final = {
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
_ENTITY: Final = _object(
    "foxglove.SceneEntity",
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_DURATION,
    frame_locked=_FLAG,
    metadata=_array(_object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
    **{name: _array(primitive) for name, primitive in _PRIMITIVES.items()},
)
_DELETION: Final = _object("foxglove.SceneEntityDeletion", timestamp=_TIME, type=_INTEGER, id=_TEXT)
_SCHEMAS: Final = {
    schema["title"]: schema
    for schema in (
        _object("foxglove.PoseInFrame", timestamp=_TIME, frame_id=_TEXT, pose=_POSE),
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


def pose_in_frame(fix: FixMessage) -> bytes:
    """``foxglove.PoseInFrame``: where the tag is; facing where it goes."""
    yaw = 0.0 if fix.velocity_mps is None else math.atan2(fix.velocity_mps[1], fix.velocity_mps[0])
    return msgspec.json.encode({"timestamp": _time(fix.unix_s), "frame_id": FRAME, "pose": _pose(fix.position_m, yaw)})


def ellipse(fix: FixMessage) -> bytes:
    """``foxglove.SceneUpdate``: the tag's name and its ellipse of two standard deviations on the floor."""
    axes_m, yaw = ellipse_of(fix)
    x, y, z = fix.position_m
    disc = {"pose": _pose(fix.position_m, yaw), "size": _xyz(*axes_m, 0.02), "color": _colour(0.1, 0.5, 1.0, 0.35)}
    entity = _entity(fix.unix_s, f"tag {fix.tag}", spheres=[disc], texts=[_label(fix.tag, (x, y, z + 0.3))])
    return msgspec.json.encode({"deletions": [], "entities": [{**entity, "lifetime": {"sec": 2, "nsec": 0}}]})


def ellipse_of(fix: FixMessage) -> tuple[tuple[float, float], float]:
    """Diameters of the ellipse of ``ELLIPSE_SIGMAS``, the longer first, and its direction in rad."""
    xx, xy, _, _, yy = fix.covariance_m2[:5]
    values, vectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    short_m, long_m = (2.0 * ELLIPSE_SIGMAS * math.sqrt(max(float(value), 0.0)) for value in values)
    return (long_m, short_m), math.atan2(float(vectors[1, 1]), float(vectors[0, 1]))


def scene(site: Site, unix_s: float) -> bytes:
    """``foxglove.SceneUpdate``: anchors and walls."""
    entities = [
        _entity(
            unix_s,
            f"anchor {anchor.id}",
            cubes=[
                {
                    "pose": _pose((anchor.x_m, anchor.y_m, anchor.z_m), 0.0),
                    "size": _xyz(0.15, 0.15, 0.15),
                    "color": _colour(1.0, 0.6, 0.0, 1.0) if anchor.id == site.master else _colour(0.5, 0.5, 0.5, 1.0),
                }
            ],
            texts=[_label(str(anchor.id), (anchor.x_m, anchor.y_m, anchor.z_m + 0.3))],
        )
        for anchor in site.anchors
    ]
    for number, wall in enumerate(site.walls):
        middle = ((wall.x1_m + wall.x2_m) / 2.0, (wall.y1_m + wall.y2_m) / 2.0, WALL_HEIGHT_M / 2.0)
        dx, dy = wall.x2_m - wall.x1_m, wall.y2_m - wall.y1_m
        size, colour = _xyz(math.hypot(dx, dy), 0.1, WALL_HEIGHT_M), _colour(0.6, 0.6, 0.6, 0.4)
        cube = {"pose": _pose(middle, math.atan2(dy, dx)), "size": size, "color": colour}
        entities.append(_entity(unix_s, f"wall {number}", cubes=[cube]))
    deletions = [{"timestamp": _time(unix_s), "type": 1, "id": ""}]
    return msgspec.json.encode({"deletions": deletions, "entities": entities})


def location_fix(fix: FixMessage, origin: GeoreferenceSite) -> bytes:
    """``foxglove.LocationFix``: where the tag is on the Earth, with its covariance towards east, north and up."""
    longitude, latitude, altitude = to_wgs84(np.array([fix.position_m]), origin)[0].tolist()
    heading = math.radians(origin.heading_deg)
    cos, sin = math.cos(heading), math.sin(heading)
    to_enu = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    covariance = to_enu @ np.array(fix.covariance_m2).reshape(3, 3) @ to_enu.T
    return msgspec.json.encode(
        {
            "timestamp": _time(fix.unix_s),
            "frame_id": FRAME,
            "latitude": latitude,
            "longitude": longitude,
            "altitude": altitude,
            "position_covariance": covariance.ravel().tolist(),
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
        **{kind: primitives.get(kind, []) for kind in _PRIMITIVES},
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


def _pose(position_m: tuple[float, float, float], yaw: float) -> Schema:
    half = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2.0), "w": math.cos(yaw / 2.0)}
    return {"position": _xyz(*position_m), "orientation": half}


def _xyz(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def _colour(r: float, g: float, b: float, a: float) -> dict[str, float]:
    return {"r": r, "g": g, "b": b, "a": a}
