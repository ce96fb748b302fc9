"""A recording of a running site as a ROS 2 bag: a folder with an MCAP of CDR messages and ``metadata.yaml``.

Definitions of the messages and the meaning of their fields: the packages ``common_interfaces`` and ``geometry2`` of
ROS 2; names of topics: REP 144 and https://design.ros2.org/articles/topic_and_service_names.html. The node of
``ros2/skyless_ros2`` publishes the same messages of a running site.
"""

import importlib
import re
import secrets
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial
from math import floor, isfinite
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, cast

import numpy as np
from msgspec import Struct

from skyless.bridges.target import BridgedSite, bridged_site, floored, is_usable
from skyless.bridges.vehicle import known_velocity
from skyless.core.arrays import Array
from skyless.core.earth import geodetic, rotated
from skyless.core.errors import ConfigurationError, SkylessError, writing
from skyless.machine import extra_module
from skyless.run.mqtt.messages import (
    LEVEL_VARIANCE,
    AnchorHealth,
    FixMessage,
    Matrix,
    SiteMessage,
    TagHealth,
    TruthMessage,
    Vector,
)
from skyless.run.recordings.recording import NS, McapRecording

if TYPE_CHECKING:
    from rosbags.interfaces import Connection, Qos
    from rosbags.rosbag2 import Writer
    from rosbags.typesys.store import Typestore

FRAME_NAME: Final = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_/-]{0,63}")
"""What users may call the site's frame; tf2 refuses names that begin with a /."""

FRAME_RULE: Final = "a frame's name: letters, digits, _, - and /, not a / first"
"""In words, for messages."""

UNKNOWN_VARIANCE: Final = 1e6
"""Variance of each angle [rad²] and of its rate, where a tag does not know its orientation."""

_STATUS_FIX: Final = 0
_SERVICE_UNKNOWN: Final = 0
"""No satellite system: a figure that ROS gave a name after Humble."""

_COVARIANCE_KNOWN: Final = 3
_OK, _WARN, _ERROR = 0, 1, 2
_CUBE, _TEXT_VIEW_FACING = 1, 9
_ADD: Final = 0
_ANCHOR_SIZE_M: Final = 0.15


# Types of messages, ``package/msg/Name``.
POSE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRUE_POSE: Final = "geometry_msgs/msg/PoseStamped"
TWIST: Final = "geometry_msgs/msg/TwistWithCovarianceStamped"
NAV_SAT_FIX: Final = "sensor_msgs/msg/NavSatFix"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"
MARKERS: Final = "visualization_msgs/msg/MarkerArray"


class RosMessage(Struct, frozen=True):
    """One message on its topic."""

    topic: str
    type: str
    data: bytes
    """CDR with its header of four bytes."""
    lasting: bool = False
    """Whether a subscriber that comes later gets it, too (transient local)."""


class RosEncoder:
    """Creates the messages of a site; no I/O, reads no clock."""

    def __init__(self, frame: str, *, transforms: bool) -> None:
        """``frame``: ``frame_id`` of poses and velocities, the site's frame, with x, y, z as in the site file.

        ``transforms``: whether ``/tf`` gets a transform from it to each tag's.
        """
        self._frame, self._transforms = frame, transforms
        self._site: BridgedSite | None = None
        self._names: dict[str, str] = {}

    def on_site(self, site: BridgedSite) -> list[RosMessage]:
        """The anchors for RViz, at stamp 0, which means at any time. Nothing if unchanged."""
        if site == self._site:
            return []
        self._site = site
        return [RosMessage("/skyless/anchors", MARKERS, _markers(site, self._frame), lasting=True)]

    def on_fix(self, fix: FixMessage) -> list[RosMessage]:
        """Pose, velocity, and position on the Earth, of a usable fix."""
        frame = self._frame
        covariance_m2 = floored(fix.covariance_m2)
        found = [RosMessage(self._topic(fix.tag, "pose"), POSE, _pose(fix, covariance_m2, frame))]
        velocity = _velocity(fix, frame)
        if velocity is not None:
            found.append(RosMessage(self._topic(fix.tag, "velocity"), TWIST, velocity))
        if self._site is not None and self._site.georeference is not None:
            origin = self._site.georeference
            covariance_enu_m2 = rotated(covariance_m2, origin.heading_deg)
            data = _nav_sat_fix(self._name(fix.tag), fix.unix_s, geodetic(fix.position_m, origin), covariance_enu_m2)
            found.append(RosMessage(self._topic(fix.tag, "fix"), NAV_SAT_FIX, data))
        if self._transforms:
            moved = _made("geometry_msgs/msg/Transform", _vector(*fix.position_m), _turn(fix.orientation))
            header, child = _header(fix.unix_s, frame), self._name(fix.tag)
            stamped = _made("geometry_msgs/msg/TransformStamped", header, child, moved)
            found.append(RosMessage("/tf", TRANSFORMS, _cdr(TRANSFORMS, [stamped])))
        return found

    def on_health(self, health: TagHealth | AnchorHealth) -> list[RosMessage]:
        """Diagnostics of a tag or an anchor."""
        return [RosMessage("/diagnostics", DIAGNOSTICS, _diagnostics(health))]

    def on_truth(self, tag: str, unix_s: float, position_m: Vector) -> list[RosMessage]:
        """True pose of a simulated tag."""
        data = _cdr(TRUE_POSE, _header(unix_s, self._frame), _pose_at(position_m))
        return [RosMessage(self._topic(tag, "truth"), TRUE_POSE, data)]

    def _topic(self, tag: str, what: str) -> str:
        return f"/skyless/{self._name(tag)}/{what}"

    def _name(self, tag: str) -> str:
        """A tag's name in ROS's alphabet; equal results are numbered in order of appearance."""
        if tag not in self._names:
            plain = ros_name(tag)
            taken, number = set(self._names.values()), 2
            name = plain
            while name in taken:
                name, number = f"{plain}_{number}", number + 1
            self._names[tag] = name
        return self._names[tag]


def ros_name(text: str) -> str:
    """Text as one part of a topic's name: letters, digits and single _, a letter first."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")
    return plain if plain[:1].isalpha() else f"tag_{plain}".strip("_")


def stamp_of(unix_s: float) -> tuple[int, int]:
    """``builtin_interfaces/Time``: whole seconds and nanoseconds, rounded; 0 if out of range."""
    if not isfinite(unix_s) or not 0.0 <= unix_s < 2**31 - 1:
        return 0, 0
    seconds = floor(unix_s)
    nanoseconds = round((unix_s - seconds) * 1e9)  # the difference is exact
    return seconds + nanoseconds // 1_000_000_000, nanoseconds % 1_000_000_000


@cache
def type_store() -> "Typestore":
    """Definitions of ROS 2's messages, the same in all releases served. Raises ImportError without rosbags."""
    typesys = importlib.import_module("rosbags.typesys")
    store: Typestore = typesys.get_typestore(typesys.Stores.ROS2_KILTED)
    return store


def _made(name: str, *fields: object) -> object:
    """A message or a part of one, from its fields in order."""
    kind: Any = type_store().types[name]
    made: object = kind(*fields)
    return made


def _cdr(name: str, *fields: object) -> bytes:
    """A whole message as CDR."""
    return bytes(type_store().serialize_cdr(_made(name, *fields), name))


_point: Final = partial(_made, "geometry_msgs/msg/Point")
_vector: Final = partial(_made, "geometry_msgs/msg/Vector3")


def _header(unix_s: float, frame: str) -> object:
    return _made("std_msgs/msg/Header", _made("builtin_interfaces/msg/Time", *stamp_of(unix_s)), frame)


def _turn(orientation: tuple[float, float, float, float] | None = None) -> object:
    """A quaternion given as w, x, y, z; the unit if it is unknown."""
    w, x, y, z = orientation or (1.0, 0.0, 0.0, 0.0)
    return _made("geometry_msgs/msg/Quaternion", x, y, z, w)


def _pose_at(position_m: Vector, orientation: tuple[float, float, float, float] | None = None) -> object:
    return _made("geometry_msgs/msg/Pose", _point(*position_m), _turn(orientation))


def _pose(fix: FixMessage, covariance_m2: Matrix, frame: str) -> bytes:
    """``geometry_msgs/PoseWithCovarianceStamped``: 36 entries in the order x, y, z and rotations about them."""
    covariance = _with_angles(covariance_m2)
    if fix.heading_std_rad is not None:
        covariance[[21, 28, 35]] = LEVEL_VARIANCE, LEVEL_VARIANCE, fix.heading_std_rad**2
    pose = _made("geometry_msgs/msg/PoseWithCovariance", _pose_at(fix.position_m, fix.orientation), covariance)
    return _cdr(POSE, _header(fix.unix_s, frame), pose)


def _velocity(fix: FixMessage, frame: str) -> bytes | None:
    """``geometry_msgs/TwistWithCovarianceStamped`` in the site's frame; None where it is not known."""
    if (moving := known_velocity(fix)) is None:
        return None
    twist = _made("geometry_msgs/msg/Twist", _vector(*moving[0]), _vector(0.0, 0.0, 0.0))
    covariance = _with_angles(moving[1])
    return _cdr(TWIST, _header(fix.unix_s, frame), _made("geometry_msgs/msg/TwistWithCovariance", twist, covariance))


def _with_angles(covariance: Matrix) -> Array:
    """A 6 × 6 covariance row by row: the given 3 × 3 and unknown angles."""
    whole = np.diag((0.0, 0.0, 0.0, *(UNKNOWN_VARIANCE,) * 3))
    whole[:3, :3] = np.reshape(covariance, (3, 3))
    return whole.ravel()


def _nav_sat_fix(frame: str, unix_s: float, earth: Vector, covariance_m2: Matrix) -> bytes:
    """``sensor_msgs/NavSatFix``: latitude, longitude, height on WGS 84; covariance towards east, north, up."""
    status = _made("sensor_msgs/msg/NavSatStatus", _STATUS_FIX, _SERVICE_UNKNOWN)
    header, covariance = _header(unix_s, frame), np.array(covariance_m2)
    return _cdr(NAV_SAT_FIX, header, status, *earth, covariance, _COVARIANCE_KNOWN)


def _diagnostics(health: TagHealth | AnchorHealth) -> bytes:
    """``diagnostic_msgs/DiagnosticArray`` with one status."""
    values: dict[str, object]
    if isinstance(health, TagHealth):
        name = f"tag {health.tag}"
        level = _OK if health.reason is None else _ERROR
        message = f"{health.updates_per_s:.1f} fixes/s" if health.reason is None else f"no fix: {health.reason}"
        values = {
            "method": health.method,
            "fixes": health.fixes,
            "updates_per_s": health.updates_per_s,
            "latency_p50_s": health.latency_p50_s,
            "latency_p99_s": health.latency_p99_s,
        }
    else:
        name = f"anchor {health.anchor}"
        level = _OK if health.synchronised else _WARN
        message = health.role if health.synchronised else "not synchronised"
        values = {"master": health.master, "offset_std_m": health.offset_std_m, "sent": health.sent}
    values |= {f"dropped {reason}": count for reason, count in sorted(health.counters.items())}
    pairs = [
        _made("diagnostic_msgs/msg/KeyValue", _text(key), "" if value is None else _text(str(value)))
        for key, value in values.items()
    ]
    texts = map(_text, (f"skyless: {name}", message, name))
    status = _made("diagnostic_msgs/msg/DiagnosticStatus", level, *texts, pairs)
    return _cdr(DIAGNOSTICS, _header(health.unix_s, ""), [status])


def _text(text: str) -> str:
    """Text without NULs, which end a string."""
    return text.replace("\0", "")


def _markers(site: BridgedSite, frame: str) -> bytes:
    """``visualization_msgs/MarkerArray``: a cube and its number for each anchor."""
    markers = []
    for number, (x, y, z) in sorted(site.anchors_m.items()):
        above = (x, y, z + 2.0 * _ANCHOR_SIZE_M)
        markers.append(_marker(frame, "anchors", number, _CUBE, (x, y, z), ""))
        markers.append(_marker(frame, "anchor_numbers", number, _TEXT_VIEW_FACING, above, str(number)))
    return _cdr(MARKERS, markers)


def _marker(frame: str, kind: str, number: int, shape: int, position_m: Vector, text: str) -> object:
    """One that lasts for ever and follows its frame."""
    size = _vector(*(_ANCHOR_SIZE_M,) * 3)
    colour = _made("std_msgs/msg/ColorRGBA", 1.0, 0.6, 0.0, 1.0)
    lifetime = _made("builtin_interfaces/msg/Duration", 0, 0)
    texture = _made("sensor_msgs/msg/CompressedImage", _header(0.0, ""), "", np.zeros(0, np.uint8))
    mesh = _made("visualization_msgs/msg/MeshFile", "", np.zeros(0, np.uint8))
    at = _header(0.0, frame), kind, number, shape, _ADD, _pose_at(position_m), size, colour, lifetime, True
    return _made("visualization_msgs/msg/Marker", *at, [], [], "", texture, [], text, "", mesh, False)


BagVersion = Literal[8, 9]
"""Version of the folder's metadata: 8 for Humble and Iron, 9 from Jazzy on."""

_KINDS: Final = {"site", "fix", "health", "truth"}
_KEPT: Final = 10
"""Depth of the queues of ``ros2 bag play``."""


class Bag(Struct, frozen=True):
    """Summary of a written bag."""

    path: str
    start_s: float
    end_s: float
    """Unix times of the first and last message."""
    topics: dict[str, int]
    """Messages on each."""
    types: dict[str, str]
    """Type of each topic."""
    fixes: int
    unusable: int
    """Fixes omitted because an alert forbids their use, or they are not finite."""
    drops: dict[str, int]
    """Unreadable parts of the recording."""
    finished: bool
    """False if the recording was cut off or is still being written."""


def write_bag(
    recording: str | PathLike[str],
    folder: str | PathLike[str],
    encoder: RosEncoder,
    tag: str | None = None,
    version: BagVersion = 9,
) -> Bag:
    """Write a recording of ``skyless record`` as a bag: the whole folder or nothing. ``tag``: only this one.

    Raises:
        ConfigurationError: the recording cannot be read, or the folder exists.
        SkylessError: it has no site; the folder cannot be written; the package rosbags is missing.
    """
    with McapRecording(recording) as source:
        site = source.site
        if site is None:
            raise SkylessError(f"{source.summary().path} holds no site; it should be a recording of skyless record")
        with writing(folder), _new_folder(Path(folder)) as scratch, _BagWriter(scratch, version) as writer:
            waiting = encoder.on_site(bridged_site(site.site, simulated=site.simulated))
            fixes: Counter[bool] = Counter()
            start_s = end_s = 0.0
            for found in source.messages(_KINDS):
                start_s, end_s = start_s or found.time_s, found.time_s
                if isinstance(found.message, FixMessage) and tag in (None, found.message.tag):
                    fixes[is_usable(found.message)] += 1
                for message in (*waiting, *_messages_of(found.message, encoder, tag)):
                    writer.write(message, found.time_s)
                waiting = []
            summary, topics = source.summary(), dict(sorted(writer.topics.items()))
            return Bag(
                path=str(folder),
                start_s=start_s,
                end_s=end_s,
                topics={name: writer.count(topic) for name, topic in topics.items()},
                types={name: topic.msgtype for name, topic in topics.items()},
                fixes=fixes[True],
                unusable=fixes[False],
                drops={reason: count for reason, count in summary.drops.items() if count},
                finished=summary.finished,
            )


def _messages_of(message: Struct, encoder: RosEncoder, tag: str | None) -> list[RosMessage]:
    if isinstance(message, SiteMessage):
        return encoder.on_site(bridged_site(message.site, simulated=message.simulated))
    if isinstance(message, FixMessage) and tag in (None, message.tag) and is_usable(message):
        return encoder.on_fix(message)
    if isinstance(message, AnchorHealth) or (isinstance(message, TagHealth) and tag in (None, message.tag)):
        return encoder.on_health(message)
    if isinstance(message, TruthMessage):
        wanted = [(name, motion) for name, motion in message.tags.items() if tag in (None, name)]
        return [one for name, motion in wanted for one in encoder.on_truth(name, message.unix_s, motion.position_m)]
    return []


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """A folder created in the block, which gets its final name if the block ends without an error."""
    if folder.exists():
        raise ConfigurationError(folder, "", None, "a new folder; this one exists and is not overwritten")
    outer = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}")
    try:
        outer.mkdir(parents=True)
        yield outer / folder.name  # the bag's file is called as its folder
        (outer / folder.name).rename(folder)
    finally:
        shutil.rmtree(outer, ignore_errors=True)


class _BagWriter:
    """Writes messages into a bag; a topic starts with its first message."""

    def __init__(self, folder: Path, version: BagVersion) -> None:
        """Raises SkylessError if the package that writes bags is missing."""
        rosbag2 = extra_module("rosbags.rosbag2", "a bag of ROS 2")
        self._writer: Writer = rosbag2.Writer(folder, version=version, storage_plugin=rosbag2.StoragePlugin.MCAP)
        self._writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
        self.topics: dict[str, Connection] = {}

    def __enter__(self) -> "_BagWriter":
        self._writer.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._writer.close()
        else:
            self._writer.abort()

    def write(self, message: RosMessage, time_s: float) -> None:
        topic = self.topics.get(message.topic)
        if topic is None:
            topic = self.topics[message.topic] = self._writer.add_connection(
                message.topic,
                message.type,
                typestore=type_store(),
                offered_qos_profiles=[_quality(lasting=message.lasting)],
            )
        self._writer.write(topic, round(time_s * NS), message.data)

    def count(self, topic: "Connection") -> int:
        """Messages that were written on a topic."""
        return self._writer.counts[topic.id]


def _quality(*, lasting: bool) -> "Qos":
    """Quality of service of ``ros2 bag play`` for a topic."""
    of = importlib.import_module("rosbags.interfaces")
    never = of.QosTime(0, 0)
    return cast(
        "Qos",
        of.Qos(
            history=of.QosHistory.KEEP_LAST,
            depth=_KEPT,
            reliability=of.QosReliability.RELIABLE,
            durability=of.QosDurability.TRANSIENT_LOCAL if lasting else of.QosDurability.VOLATILE,
            deadline=never,
            lifespan=never,
            liveliness=of.QosLiveliness.AUTOMATIC,
            liveliness_lease_duration=never,
            avoid_ros_namespace_conventions=False,
        ),
    )
