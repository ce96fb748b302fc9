"""What Foxglove shows without configuration: poses, a scene, and positions on the Earth.

Schemas as documented at https://docs.foxglove.dev/docs/sdk/schemas.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final

import msgspec

from skyless.foxglove.schemas import PRIMITIVES, Schema
from skyless.mqtt.messages import FixMessage, Vector, Zone
from skyless.site.earth import geodetic, rotated
from skyless.site.model import GeoreferenceSite, WallSite
from skyless.uncertainty.ellipse import horizontal_ellipse

FRAME: Final = "site"
SCENE_TOPIC: Final = "/site/scene"
KNOWN_COVARIANCE: Final = 3
ELLIPSE_SIGMAS: Final = 2.0
"""How many standard deviations an ellipse shows."""

WALL_HEIGHT_M: Final = 2.5
_LINE_LOOP: Final = 1
"""A line that returns to its first point."""


def pose_in_frame(fix: FixMessage, *, facing: bool) -> bytes:
    """``foxglove.PoseInFrame``: where the tag is; ``facing``: turned to where it goes, which nobody has measured."""
    yaw = math.atan2(fix.velocity_mps[1], fix.velocity_mps[0]) if facing and fix.velocity_mps is not None else 0.0
    return msgspec.json.encode({"timestamp": _time(fix.unix_s), "frame_id": FRAME, "pose": _pose(fix.position_m, yaw)})


def frame_transform(fix: FixMessage) -> bytes:
    """``foxglove.FrameTransform``: a frame named as the tag, at its position, with the site's axes."""
    pose = _pose(fix.position_m, 0.0)
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
    """``foxglove.SceneUpdate`` in the stead of whatever was there before: anchors, walls, outlines of zones."""
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


def _pose(position_m: tuple[float, float, float], yaw: float) -> Schema:
    half = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2.0), "w": math.cos(yaw / 2.0)}
    return {"position": _xyz(*position_m), "orientation": half}


def _xyz(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def _colour(r: float, g: float, b: float, a: float) -> dict[str, float]:
    return {"r": r, "g": g, "b": b, "a": a}
