"""The target ``ros2://``: a site's fixes as topics of ROS 2 over Cyclone DDS, where ROS itself need not be installed.

    ros2://?domain=0&frame=site&namespace=skyless&tf=no

Names and qualities of service: https://design.ros2.org/articles/topic_and_service_names.html and REP 2011 (hashes of
types). The definitions of the types come from rosbags. A thread writes, because DDS may wait and a tag's program must
not. What it cannot keep up with is dropped, the oldest first.
"""

import asyncio
import os
import queue
import re
import threading
from functools import cache, partial
from importlib import import_module
from math import floor, isfinite, nan
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec import Struct

from skyless.bridges.target import BridgeContext, BridgedSite, Target, TargetUrl, floored
from skyless.core.arrays import Array
from skyless.core.earth import geodetic, rotated
from skyless.core.errors import SkylessError
from skyless.machine import what_to_install
from skyless.run.mqtt.messages import LEVEL_VARIANCE, AnchorHealth, FixMessage, Matrix, TagHealth, Vector

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

# From fixes to messages of ROS 2: names of topics, types, and the bytes of each message.
#
# Definitions of the messages and the meaning of their fields: the packages ``common_interfaces`` and ``geometry2`` of
# ROS 2; names of topics: REP 144 and https://design.ros2.org/articles/topic_and_service_names.html. The bytes are the
# same in DDS and in a bag.

SITE_FRAME: Final = "site"
NAMESPACE: Final = "skyless"

FRAME_NAME: Final = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_/-]{0,63}")
"""What users may call the site's frame; tf2 refuses names that begin with a /."""

FRAME_RULE: Final = "a frame's name: letters, digits, _, - and /, not a / first"
"""In words, for messages."""

UNKNOWN_VARIANCE: Final = 1e6
"""Variance of each angle [rad²] and of its rate, where a tag does not know its orientation."""

_STATUS_NO_FIX, _STATUS_FIX = -1, 0
_SERVICE_UNKNOWN: Final = 0
"""No satellite system: a figure that ROS gave a name after Humble."""

_COVARIANCE_UNKNOWN, _COVARIANCE_KNOWN = 0, 3
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


class RosSettings(Struct, frozen=True):
    """What a user may choose."""

    frame: str = SITE_FRAME
    """``frame_id`` of poses and velocities: the site's frame, x, y, z as in the site file."""
    namespace: str = NAMESPACE
    transforms: bool = False
    """Whether ``/tf`` gets a transform from the site's frame to each tag's."""


class RosEncoder:
    """Creates the messages of a site; no I/O, reads no clock."""

    def __init__(self, settings: RosSettings) -> None:
        self._settings = settings
        self._site: BridgedSite | None = None
        self._names: dict[str, str] = {}

    def on_site(self, site: BridgedSite) -> list[RosMessage]:
        """The anchors for RViz, at stamp 0, which means at any time. Nothing if unchanged."""
        if site == self._site:
            return []
        self._site = site
        topic = f"/{self._settings.namespace}/anchors"
        return [RosMessage(topic, MARKERS, _markers(site, self._settings.frame), lasting=True)]

    def on_fix(self, fix: FixMessage) -> list[RosMessage]:
        """Pose, velocity, and position on the Earth, of a usable fix."""
        frame = self._settings.frame
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
        if self._settings.transforms:
            moved = _made("geometry_msgs/msg/Transform", _vector(*fix.position_m), _turn(fix.orientation))
            header, child = _header(fix.unix_s, frame), self._name(fix.tag)
            stamped = _made("geometry_msgs/msg/TransformStamped", header, child, moved)
            found.append(RosMessage("/tf", TRANSFORMS, _cdr(TRANSFORMS, [stamped])))
        return found

    def on_no_fix(self, tag: str, unix_s: float) -> list[RosMessage]:
        """A message without a fix, on the topic whose type can express it."""
        if self._site is None or self._site.georeference is None:
            return []
        return [RosMessage(self._topic(tag, "fix"), NAV_SAT_FIX, _nav_sat_fix(self._name(tag), unix_s, None, None))]

    def on_health(self, health: TagHealth | AnchorHealth) -> list[RosMessage]:
        """Diagnostics of a tag or an anchor."""
        return [RosMessage("/diagnostics", DIAGNOSTICS, _diagnostics(health))]

    def on_truth(self, tag: str, unix_s: float, position_m: Vector) -> list[RosMessage]:
        """True pose of a simulated tag."""
        data = _cdr(TRUE_POSE, _header(unix_s, self._settings.frame), _pose_at(position_m))
        return [RosMessage(self._topic(tag, "truth"), TRUE_POSE, data)]

    def _topic(self, tag: str, what: str) -> str:
        return f"/{self._settings.namespace}/{self._name(tag)}/{what}"

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
    typesys = import_module("rosbags.typesys")
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
    if fix.velocity_mps is None or fix.velocity_covariance is None:
        return None
    if not all(map(isfinite, (*fix.velocity_mps, *fix.velocity_covariance))):
        return None
    twist = _made("geometry_msgs/msg/Twist", _vector(*fix.velocity_mps), _vector(0.0, 0.0, 0.0))
    covariance = _with_angles(fix.velocity_covariance)
    return _cdr(TWIST, _header(fix.unix_s, frame), _made("geometry_msgs/msg/TwistWithCovariance", twist, covariance))


def _with_angles(covariance: Matrix) -> Array:
    """A 6 × 6 covariance row by row: the given 3 × 3 and unknown angles."""
    whole = np.diag((0.0, 0.0, 0.0, *(UNKNOWN_VARIANCE,) * 3))
    whole[:3, :3] = np.reshape(covariance, (3, 3))
    return whole.ravel()


def _nav_sat_fix(frame: str, unix_s: float, earth: Vector | None, covariance_m2: Matrix | None) -> bytes:
    """``sensor_msgs/NavSatFix``: latitude, longitude, height on WGS 84; covariance towards east, north, up.

    Without a position: status no fix, NaN, unknown covariance.
    """
    status = _made("sensor_msgs/msg/NavSatStatus", _STATUS_NO_FIX if earth is None else _STATUS_FIX, _SERVICE_UNKNOWN)
    place = (nan, nan, nan) if earth is None else earth
    covariance = np.zeros(9) if covariance_m2 is None else np.array(covariance_m2)
    kind = _COVARIANCE_UNKNOWN if covariance_m2 is None else _COVARIANCE_KNOWN
    return _cdr(NAV_SAT_FIX, _header(unix_s, frame), status, *place, covariance, kind)


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


DEPTH: Final = 10
"""Messages of a topic kept for readers that have not confirmed them."""

_MAX_BLOCKING_NS: Final = 10_000_000

_SETTINGS: Final = (
    "<CycloneDDS><Domain Id='any'><Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
    "</Domain></CycloneDDS>"
)
"""1.15 is Fast DDS's vendor number, whose type descriptions Cyclone DDS cannot read: without this setting, its
subscribers see the topics but get no data."""


class DdsTypes:
    """Types of ROS 2's messages as announced by Cyclone DDS. Raises ImportError if a package is missing."""

    def __init__(self) -> None:
        self._idl: Any = import_module("cyclonedds.idl")
        self._kinds: Any = import_module("cyclonedds.idl.types")
        self._node = import_module("rosbags.interfaces").Nodetype
        self._store: Any = type_store()
        self._made: dict[str, Any] = {}

    def hash(self, name: str) -> str:
        """The type hash that ROS compares since Iron (REP 2011)."""
        return str(self._store.hash_rihs01(name))

    def type(self, name: str) -> Any:  # noqa: ANN401 - a class whose fields only DDS sees
        """The type ``package/msg/Name``, called ``package::msg::dds_::Name_`` in DDS."""
        if name not in self._made:
            fields = {field: self._field(*given) for field, given in self._store.get_msgdef(name).fields}
            package, kind, last = name.split("/")
            self._made[name] = self._idl.make_idl_struct(last, f"{package}.{kind}.dds_.{last}_", fields)
        return self._made[name]

    def _field(self, node: object, details: Any) -> Any:  # noqa: ANN401 - see above
        if node is self._node.NAME:
            return self.type(details)
        if node is self._node.BASE:
            plain = {"string": str, "bool": bool, "byte": self._kinds.uint8}
            return plain.get(details[0]) or getattr(self._kinds, details[0])
        inner = self._field(*details[0])
        return self._kinds.array[inner, details[1]] if node is self._node.ARRAY else self._kinds.sequence[inner]


class DdsPublisher:
    """A participant of a DDS domain; its methods may block for some milliseconds."""

    def __init__(self, text: str, domain: int) -> None:
        """``text``: the target's address. Raises SkylessError if DDS is not installed or cannot start."""
        try:
            self._dds: Any = import_module("cyclonedds")
            for name in ("core", "domain", "pub", "qos", "topic"):
                import_module(f"cyclonedds.{name}")
            self._types = DdsTypes()
        except ImportError as error:
            raise SkylessError(
                f"{what_to_install(error, f'the target {text!r}')}; it is made for x86-64 up to Python 3.13: elsewhere "
                "use jsonl+tcp: and the ROS 2 package ros2/skyless_ros2"
            ) from None
        given = os.environ.get("CYCLONEDDS_URI", "")
        try:
            _domain(domain, given)
            self._participant = self._dds.domain.DomainParticipant(domain)
        except (self._dds.core.DDSException, UnicodeError) as error:
            hint = f"; CYCLONEDDS_URI is {given!r}" if given else ""
            raise SkylessError(f"the target {text!r} cannot start DDS in domain {domain}: {error}{hint}") from None
        self._writers: dict[str, Any] = {}

    def write(self, message: RosMessage) -> None:
        """Publish a message. Errors of DDS pass through."""
        writer = self._writers.get(message.topic)
        if writer is None:
            writer = self._writers[message.topic] = self._writer(message)
        writer.write(writer.data_type.deserialize(message.data))

    def close(self) -> None:
        """Leave the domain, so that subscribers need not wait for a timeout. Nothing can be written afterwards."""
        self._writers.clear()
        del self._participant  # Cyclone's objects end when nothing refers to them

    def _writer(self, message: RosMessage) -> Any:  # noqa: ANN401 - a DataWriter, where the package is
        policy = self._dds.qos.Policy
        quality = self._dds.qos.Qos(
            policy.Reliability.Reliable(max_blocking_time=_MAX_BLOCKING_NS),
            policy.Durability.TransientLocal if message.lasting else policy.Durability.Volatile,
            policy.History.KeepLast(depth=DEPTH),
            policy.DataRepresentation(use_cdrv0_representation=True),
        )
        # ROS reads the type's hash from the writer.
        digest = self._types.hash(message.type)
        hashed = self._dds.qos.Qos(policy.Userdata(data=f"typehash={digest};".encode()), base=quality)
        kind = self._types.type(message.type)
        topic = self._dds.topic.Topic(self._participant, f"rt{message.topic}", kind, qos=quality)
        return self._dds.pub.DataWriter(self._participant, topic, qos=hashed)


@cache
def _domain(number: int, given: str) -> Any:  # noqa: ANN401 - a Domain, where the package is
    """A domain with our settings, then those of CYCLONEDDS_URI. Cached, as its settings end with the object."""
    return import_module("cyclonedds.domain").Domain(number, f"{_SETTINGS},{given}" if given else _SETTINGS)


_MAX_DOMAIN: Final = 232
"""Ports would exceed 65535 beyond it."""

_MAX_WAITING: Final = 500
_CLOSE_S: Final = 1.0
_NAMESPACE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}(/[A-Za-z][A-Za-z0-9_]{0,31}){0,3}")


def make_target(url: TargetUrl, context: BridgeContext) -> Target:
    """Create the target of an address. Raises SkylessError."""
    frame, namespace = url.text_option("frame", SITE_FRAME), url.text_option("namespace", NAMESPACE)
    if not FRAME_NAME.fullmatch(frame):
        raise url.wrong(f"with frame= {FRAME_RULE}")
    if not _NAMESPACE.fullmatch(namespace):
        raise url.wrong("with namespace= as topics of ROS begin: letters, digits and _, not a digit first")
    transforms = url.choice("tf", ("no", "yes"), "no") == "yes"
    domain = url.whole_number("domain", 0, 0, _MAX_DOMAIN)
    if not url.text_option("domain"):
        domain = _usual_domain(url.text)
    url.check_all_read()
    settings = RosSettings(frame=frame, namespace=namespace, transforms=transforms)
    return Ros2Target(url.text, DdsPublisher(url.text, domain), settings, context)


def _usual_domain(target: str) -> int:
    """The domain that ROS programs would use. Raises SkylessError."""
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > _MAX_DOMAIN:
        raise SkylessError(
            f"the target {target!r} uses the domain of ROS_DOMAIN_ID, which is {text!r}; it should be a whole number "
            f"from 0 to {_MAX_DOMAIN}"
        )
    return int(text)


class Ros2Target(Target):
    """Publishes poses, velocities, positions on the Earth, anchors and diagnostics."""

    def __init__(self, text: str, publisher: DdsPublisher, settings: RosSettings, context: BridgeContext) -> None:
        super().__init__(text)
        self._publisher, self._encoder, self._log = publisher, RosEncoder(settings), context.log
        self._waiting: queue.Queue[list[RosMessage] | None] = queue.Queue(_MAX_WAITING)
        self._troubles: set[str] = set()
        self._knows_no_earth = False
        """Whether the missing georeference was logged."""

    def on_site(self, site: BridgedSite) -> None:
        """Publish its anchors."""
        if site.georeference is None and not self._knows_no_earth:
            self._knows_no_earth = True
            self._log(f"{self.text}: no topic fix (NavSatFix), as the site file has no [georeference]")
        self._give(self._encoder.on_site(site))

    def on_fix(self, fix: FixMessage) -> None:
        """Publish it."""
        self._give(self._encoder.on_fix(fix))

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> None:  # noqa: ARG002 - NavSatFix has no text
        """Publish that there is no fix; the reason is in the diagnostics."""
        self._give(self._encoder.on_no_fix(tag, unix_s))

    def on_health(self, health: TagHealth | AnchorHealth) -> None:
        """Publish diagnostics."""
        self._give(self._encoder.on_health(health))

    async def run(self) -> None:
        """Publish until cancelled."""
        thread = threading.Thread(target=self._publish_all, daemon=True)
        thread.start()
        try:
            await asyncio.Event().wait()
        finally:
            self._give(None)
            await asyncio.to_thread(thread.join, _CLOSE_S)

    def _give(self, messages: list[RosMessage] | None) -> None:
        """Queue messages for the thread; if too many wait, the oldest are dropped."""
        while True:
            try:
                self._waiting.put_nowait(messages)
            except queue.Full:
                try:
                    self.dropped["slow-dds"] += len(self._waiting.get_nowait() or ())
                except queue.Empty:
                    continue
            else:
                return

    def _publish_all(self) -> None:
        while (messages := self._waiting.get()) is not None:
            for message in messages:
                try:
                    self._publisher.write(message)
                except Exception as error:  # noqa: BLE001 - whatever it is, later messages may go
                    self.dropped["not-sent"] += 1
                    if message.topic not in self._troubles:
                        self._troubles.add(message.topic)
                        self._log(f"{self.text}: {message.topic} cannot be published: {error}")
        self._publisher.close()
