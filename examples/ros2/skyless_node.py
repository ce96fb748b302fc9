#!/usr/bin/env python3
"""A node of ROS 2 that publishes a Skyless site's fixes; needs rclpy and nothing of Skyless.

Skyless gives JSON lines, from the broker of a site or from the tag's own program:

    skyless bridge jsonl+tcp://:7010
    skyless tag tag1 --mqtt none --to jsonl+tcp://:7010

and this file runs wherever ROS 2 is sourced, Humble or later, on any processor:

    python3 skyless_node.py --ros-args -p host:=127.0.0.1 -p port:=7010 -p frame_id:=site -p publish_tf:=false

For each tag it publishes

    /skyless/TAG/pose      geometry_msgs/PoseWithCovarianceStamped, in frame_id; the angles are unknown (variance 1e6)
    /skyless/TAG/velocity  geometry_msgs/TwistWithCovarianceStamped, in frame_id
    /skyless/TAG/fix       sensor_msgs/NavSatFix, if the site file has a georeference
    /tf                    frame_id to TAG, if publish_tf is true

and for the site /skyless/anchors (visualization_msgs/MarkerArray) and /diagnostics. While a tag has no fix, nothing
comes on pose and velocity, and NavSatFix says so once a second. More: docs/tools/ros2.md of
https://github.com/skyless-uwb/skyless.
"""

import json
import math
import re
import socket
import threading
import time
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped, TwistWithCovarianceStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import NavSatFix, NavSatStatus
from visualization_msgs.msg import Marker, MarkerArray

UNKNOWN_VARIANCE = 1e6
MIN_STD_M = 0.01
RECONNECT_S = 1.0
SILENT_S = 5.0  # after which a connection is taken for lost; a site without any tag that has a fix is silent, too
LONGEST_LINE = 1 << 16
ANCHOR_SIZE_M = 0.15
EARTH_A_M, EARTH_E2 = 6378137.0, 6.694379990141e-3  # WGS 84

USUAL = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
LASTING = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class SkylessNode(Node):
    """Reads lines in a thread, and publishes each when it comes."""

    def __init__(self) -> None:
        super().__init__("skyless")
        self.host = self.declare_parameter("host", "127.0.0.1").value
        self.port = self.declare_parameter("port", 7010).value
        self.frame = self.declare_parameter("frame_id", "site").value
        self.transforms = None
        if self.declare_parameter("publish_tf", False).value:
            from tf2_msgs.msg import TFMessage

            self.transform_message = TFMessage
            self.transforms = self.create_publisher(TFMessage, "/tf", QoSProfile(depth=100))
        if self.get_parameter("use_sim_time").value:
            self.get_logger().warning("stamps are Unix time of the tag's host; use_sim_time changes nothing here")
        self.anchors = self.create_publisher(MarkerArray, "~/anchors", LASTING)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", USUAL)
        self.topics: dict[tuple[str, str], Any] = {}
        self.names: dict[str, str] = {}
        self.origin: dict[str, float] | None = None
        self.fixes: dict[str, int] = {}
        self.connected = False
        self.create_timer(1.0, self.report)
        threading.Thread(target=self.read_for_ever, daemon=True).start()

    def read_for_ever(self) -> None:
        """Connect again and again."""
        trouble = ""
        while rclpy.ok():
            try:
                with socket.create_connection((self.host, self.port), SILENT_S) as connection:
                    self.connected = True
                    self.get_logger().info(f"reading {self.host}:{self.port}")
                    trouble = ""
                    self.read(connection)
            except OSError as error:
                if str(error) != trouble and not isinstance(error, TimeoutError):
                    trouble = str(error)
                    self.get_logger().warning(f"no Skyless at {self.host}:{self.port}: {error}")
            self.connected = False
            time.sleep(RECONNECT_S)

    def read(self, connection: socket.socket) -> None:
        """Publish what one connection gives, until it ends. Raises OSError."""
        waiting = b""
        while rclpy.ok() and (data := connection.recv(LONGEST_LINE)):
            *lines, waiting = (waiting + data).split(b"\n")
            for line in lines:
                try:
                    self.publish(json.loads(line))
                except Exception as error:  # noqa: BLE001 - a line from the network ends nothing
                    self.get_logger().warning(f"a line was not understood: {error!r}", throttle_duration_sec=10.0)
            if len(waiting) > LONGEST_LINE:
                waiting = b""

    def publish(self, line: dict[str, Any]) -> None:
        """Publish one line. Raises many things where it is not as it should be."""
        if line["type"] == "site":
            markers, origin = anchor_markers(line["anchors_m"], self.frame), origin_of(line["georeference"])
            self.anchors.publish(markers)
            self.origin = origin
        elif line["type"] == "fix":
            self.publish_fix(line)
        elif line["type"] == "no_fix":
            name = self.name(line["tag"])
            self.fixes.pop(name, None)
            if self.origin is not None:
                self.topic(name, "fix", NavSatFix).publish(no_nav_sat_fix(name, line["unix_s"]))
            self.diagnose(name, DiagnosticStatus.ERROR, f"no fix: {line['reason']}")

    def publish_fix(self, fix: dict[str, Any]) -> None:
        """Publish a fix on each of the tag's topics."""
        name = self.name(fix["tag"])
        covariance_m2 = floored(fix["covariance_m2"])
        messages: list[tuple[str, Any]] = [("pose", pose(fix, covariance_m2))]
        if fix["velocity_mps"] is not None and None not in fix["velocity_mps"] + fix["velocity_covariance"]:
            messages.append(("velocity", velocity(fix)))
        if self.origin is not None:
            messages.append(("fix", nav_sat_fix(name, fix, covariance_m2, self.origin)))
        for what, message in messages:
            if what != "fix":
                message.header.frame_id = self.frame
            self.topic(name, what, type(message)).publish(message)
        if self.transforms is not None:
            self.transforms.publish(self.transform_message(transforms=[transform(fix, self.frame, name)]))
        self.fixes[name] = self.fixes.get(name, 0) + 1

    def report(self) -> None:
        """Once a second: which tags have fixes, or that there is no connection."""
        for name, count in list(self.fixes.items()):
            if count:
                self.diagnose(name, DiagnosticStatus.OK, f"{count} fixes in a second")
            self.fixes[name] = 0
        if not self.connected:
            self.diagnose("connection", DiagnosticStatus.ERROR, f"no Skyless at {self.host}:{self.port}")

    def diagnose(self, name: str, level: bytes, text: str) -> None:
        """Publish the state of a tag, or of the connection."""
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status = [DiagnosticStatus(level=level, name=f"skyless: {name}", message=text, hardware_id=name)]
        self.diagnostics.publish(message)

    def topic(self, name: str, what: str, kind: type) -> Any:
        """The publisher of a tag's topic."""
        if (name, what) not in self.topics:
            self.topics[name, what] = self.create_publisher(kind, f"~/{name}/{what}", USUAL)
        return self.topics[name, what]

    def name(self, tag: str) -> str:
        """A tag's name as ROS allows it; tags whose names become equal are numbered as they come."""
        if tag not in self.names:
            plain = re.sub(r"[^A-Za-z0-9]+", "_", tag).strip("_")
            plain = plain if plain[:1].isalpha() else f"tag_{plain}".strip("_")
            name, number = plain, 2
            while name in self.names.values():
                name, number = f"{plain}_{number}", number + 1
            self.names[tag] = name
        return self.names[tag]


def set_stamp(message: Any, unix_s: float) -> None:
    """Set the header's stamp to a Unix time, to the nearest nanosecond."""
    seconds = math.floor(unix_s)
    nanoseconds = round((unix_s - seconds) * 1e9)
    message.header.stamp.sec = seconds + nanoseconds // 1_000_000_000
    message.header.stamp.nanosec = nanoseconds % 1_000_000_000


def set_xyz(point: Any, values: list[float]) -> None:
    """Set a point or vector."""
    point.x, point.y, point.z = map(float, values)


def floored(covariance: list[float]) -> list[float]:
    """With a variance of at least MIN_STD_M squared in each axis: the gates of filters reject honest millimetres."""
    return [
        max(float(value), MIN_STD_M**2) if place % 4 == 0 else float(value) for place, value in enumerate(covariance)
    ]


def with_angles(covariance: list[float]) -> list[float]:
    """Six by six of three by three: nothing is known of the angles."""
    whole = [0.0] * 36
    for row in range(3):
        whole[6 * row : 6 * row + 3] = map(float, covariance[3 * row : 3 * row + 3])
        whole[7 * (row + 3)] = UNKNOWN_VARIANCE
    return whole


def pose(fix: dict[str, Any], covariance_m2: list[float]) -> PoseWithCovarianceStamped:
    """Where the tag is, in the site's frame."""
    message = PoseWithCovarianceStamped()
    set_stamp(message, fix["unix_s"])
    set_xyz(message.pose.pose.position, fix["position_m"])
    message.pose.covariance = with_angles(covariance_m2)
    return message


def velocity(fix: dict[str, Any]) -> TwistWithCovarianceStamped:
    """How the tag moves, in the site's frame."""
    message = TwistWithCovarianceStamped()
    set_stamp(message, fix["unix_s"])
    set_xyz(message.twist.twist.linear, fix["velocity_mps"])
    message.twist.covariance = with_angles(fix["velocity_covariance"])
    return message


def nav_sat_fix(name: str, fix: dict[str, Any], covariance_m2: list[float], origin: dict[str, float]) -> NavSatFix:
    """Where the tag is on the Earth, with its covariance towards east, north and up."""
    message = NavSatFix()
    set_stamp(message, fix["unix_s"])
    message.header.frame_id = name
    message.status.status = NavSatStatus.STATUS_FIX
    message.latitude, message.longitude, message.altitude = on_the_earth(fix["position_m"], origin)
    message.position_covariance = towards_east(covariance_m2, origin)
    message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_KNOWN
    return message


def no_nav_sat_fix(name: str, unix_s: float) -> NavSatFix:
    """That there is no position."""
    message = NavSatFix()
    set_stamp(message, unix_s)
    message.header.frame_id = name
    message.status.status = NavSatStatus.STATUS_NO_FIX
    message.latitude = message.longitude = message.altitude = math.nan
    return message


def transform(fix: dict[str, Any], frame: str, name: str) -> TransformStamped:
    """From the site's frame to the tag's, which is not turned."""
    message = TransformStamped(child_frame_id=name)
    set_stamp(message, fix["unix_s"])
    message.header.frame_id = frame
    set_xyz(message.transform.translation, fix["position_m"])
    return message


def anchor_markers(anchors_m: dict[str, list[float]], frame: str) -> MarkerArray:
    """A cube and its number for each anchor, at any time."""
    found = []
    for number, (x, y, z) in anchors_m.items():
        for kind, shape, height in (("anchors", Marker.CUBE, z), ("anchor_numbers", Marker.TEXT_VIEW_FACING, z + 0.3)):
            marker = Marker(ns=kind, id=int(number), type=shape, frame_locked=True)
            marker.header.frame_id = frame
            set_xyz(marker.pose.position, [x, y, height])
            set_xyz(marker.scale, [ANCHOR_SIZE_M] * 3)
            marker.color.r, marker.color.g, marker.color.a = 1.0, 0.6, 1.0
            marker.text = number if shape == Marker.TEXT_VIEW_FACING else ""
            found.append(marker)
    return MarkerArray(markers=found)


def origin_of(georeference: dict[str, Any] | None) -> dict[str, float] | None:
    """Where the site's origin is on the Earth, if that is known. Raises ValueError, KeyError, TypeError."""
    if georeference is None:
        return None
    origin = {key: float(georeference[key]) for key in ("latitude_deg", "longitude_deg", "height_m", "heading_deg")}
    if not all(map(math.isfinite, origin.values())):
        raise ValueError(f"the site is at {georeference}")
    return origin


def towards_east(covariance: list[float], origin: dict[str, float]) -> list[float]:
    """A covariance of the site's axes as one of east, north and up."""
    heading = math.radians(origin["heading_deg"])
    cos, sin = math.cos(heading), math.sin(heading)
    turn = [[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]
    axes = range(3)
    return [
        sum(turn[i][k] * covariance[3 * k + m] * turn[j][m] for k in axes for m in axes) for i in axes for j in axes
    ]


def on_the_earth(point_m: list[float], origin: dict[str, float]) -> tuple[float, float, float]:
    """Latitude and longitude in degrees and height in metres, on WGS 84, of a point of the site.

    The plane of x and y touches the Earth at the origin; heights follow its curvature, as surveyed anchors do.
    """
    heading = math.radians(origin["heading_deg"])
    x, y, z = point_m
    east = x * math.cos(heading) + y * math.sin(heading)
    north = y * math.cos(heading) - x * math.sin(heading)
    latitude = math.radians(origin["latitude_deg"])
    height_m = origin["height_m"] + z
    prime_m = EARTH_A_M / math.sqrt(1.0 - EARTH_E2 * math.sin(latitude) ** 2)
    polar_m = (prime_m * (1.0 - EARTH_E2) + height_m) * math.sin(latitude) + north * math.cos(latitude)
    outward_m = (prime_m + height_m) * math.cos(latitude) - north * math.sin(latitude)
    radius_m = math.hypot(outward_m, east)
    longitude_deg = origin["longitude_deg"] + math.degrees(math.atan2(east, outward_m))
    for _ in range(20):  # each round makes the error three hundred times smaller
        prime_m = EARTH_A_M / math.sqrt(1.0 - EARTH_E2 * math.sin(latitude) ** 2)
        latitude = math.atan2(polar_m + EARTH_E2 * prime_m * math.sin(latitude), radius_m)
    return math.degrees(latitude), (longitude_deg + 180.0) % 360.0 - 180.0, height_m


def main() -> None:
    """Run until Ctrl-C."""
    rclpy.init()
    node = SkylessNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
