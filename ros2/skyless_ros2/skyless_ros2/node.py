"""The lifecycle node ``skyless``: a Skyless site's fixes in ROS 2, and ``map → odom`` of a robot that has odometry.

It reads ``skyless bridge jsonl+tcp://:7010``, or ``skyless tag TAG --mqtt none --to jsonl+tcp://:7010``, and needs
nothing of Skyless where it runs. Topics and parameters: docs/tools/ros2.md of https://github.com/skyless-uwb/skyless.
"""

import contextlib
import json
import math
import queue
import re
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleState, Node, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import Imu
from tf2_msgs.msg import TFMessage
from uwb_msgs.msg import Anchors
from visualization_msgs.msg import MarkerArray

from skyless_ros2 import messages
from skyless_ros2.map_odom import MapOdom

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
RECONNECT_S = 1.0
SILENT_S = 5.0  # after which a connection is taken for lost; a site without any tag that has a fix is silent, too
STOPPED_S = 0.5  # odometry that has not come for so long has stopped
LONGEST_LINE = 1 << 16
LASTING = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

PARAMETERS: dict[str, tuple[Any, tuple[Any, Any] | None, str]] = {  # default, range, description
    "host": ("127.0.0.1", None, "host of the JSON lines"),
    "port": (7010, (1, 65535), "port of the JSON lines"),
    "map_frame": ("map", None, "frame of the site's axes: frame_id of poses, velocities and anchors"),
    "odom_frame": ("odom", None, "frame in which odometry gives poses"),
    "tag": ("", None, "the robot's tag, whose fixes make map -> odom; empty: the only one"),
    "publish_map_to_odom": (True, None, "whether /tf gets map -> odom"),
    "publish_tag_tf": (False, None, "whether /tf gets a transform from map_frame to each tag"),
    "antenna_x_m": (0.0, (-10.0, 10.0), "the tag's antenna on the robot's base, forward [m]"),
    "antenna_y_m": (0.0, (-10.0, 10.0), "the tag's antenna on the robot's base, to the left [m]"),
    "antenna_std_m": (
        0.25,
        (0.001, 5.0),
        "standard deviation of each of these two [m]: 0.25 where nobody measured them",
    ),
    "heading_limit_deg": (2.0, (0.1, 20.0), "standard deviation of the heading up to which map -> odom is given"),
    "base_limit_m": (0.2, (0.01, 5.0), "standard deviation of the base's place up to which map -> odom is given"),
    "motion_host": ("", None, "host of skyless tag --motion, which gets imu and odom; empty: nobody"),
    "motion_port": (7011, (1, 65535), "its port"),
    "best_effort": (False, None, "publish poses as sensors do; reliable publishers serve both kinds of subscribers"),
    "autostart": (False, None, "configure and activate at the start, where nothing manages the node"),
}


class SkylessNode(Node):
    """Reads lines in a thread while it is active, and publishes each when it comes."""

    def __init__(self) -> None:
        super().__init__("skyless")
        for name, (value, limits, text) in PARAMETERS.items():
            described = ParameterDescriptor(description=f"{text}; read at configure")
            if limits is not None and isinstance(value, int):
                described.integer_range = [IntegerRange(from_value=limits[0], to_value=limits[1], step=1)]
            elif limits is not None:
                described.floating_point_range = [FloatingPointRange(from_value=limits[0], to_value=limits[1])]
            self.declare_parameter(name, value, described)
        self.lock = threading.Lock()  # of the estimator, which callbacks and the reading thread use
        self.stop = threading.Event()
        self.links: dict[str, socket.socket] = {}
        self.threads: list[threading.Thread] = []
        self.topics: dict[str, Any] = {}
        self.made: list[Callable[[], Any]] = []

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, and create what is published and subscribed to."""
        self.of = of = {name: self.get_parameter(name).value for name in PARAMETERS}
        antenna_m = complex(of["antenna_x_m"], of["antenna_y_m"])
        self.estimator = MapOdom(antenna_m, of["antenna_std_m"], of["heading_limit_deg"], of["base_limit_m"])
        self.names: dict[str, str] = {}
        self.tags: dict[str, tuple[int, str]] = {}  # fixes since the last report, and why there is none
        self.motion: queue.Queue[bytes] = queue.Queue(500)
        self.motion_dropped = 0
        self.odometry_s = 0.0
        reliability = ReliabilityPolicy.BEST_EFFORT if of["best_effort"] else ReliabilityPolicy.RELIABLE
        self.usual = QoSProfile(depth=10, reliability=reliability)
        if of["publish_map_to_odom"] or of["publish_tag_tf"]:
            self.publisher("/tf", TFMessage, QoSProfile(depth=100))
        self.publisher("~/anchors", MarkerArray, LASTING)
        self.publisher("~/anchor_positions", Anchors, LASTING)
        self.publisher("~/base", PoseWithCovarianceStamped, self.usual)
        self.publisher("/diagnostics", DiagnosticArray, QoSProfile(depth=10))
        for kind, topic, callback in ((Odometry, "odom", self.on_odometry), (Imu, "imu", self.pass_on)):
            made = self.create_subscription(kind, topic, callback, qos_profile_sensor_data)
            self.made.append(lambda made=made: self.destroy_subscription(made))
        clock = Clock(clock_type=ClockType.STEADY_TIME)  # reports go on where simulated time stands still
        timer = self.create_timer(1.0, self.report, clock=clock)
        self.made.append(lambda: self.destroy_timer(timer))
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to read."""
        self.stop.clear()
        links = [("Skyless", self.of["host"], self.of["port"], self.read)]
        if self.of["motion_host"]:
            links.append(("motion", self.of["motion_host"], self.of["motion_port"], self.write_motion))
        self.threads = [threading.Thread(target=self.keep_connected, args=link, daemon=True) for link in links]
        for thread in self.threads:
            thread.start()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop reading, and forget map → odom: the robot may be carried meanwhile."""
        self.end_threads()
        self.estimator.restart("the node was not active")
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Destroy what was created; likewise at the node's shutdown and after an error."""
        self.end_threads()
        while self.made:
            self.made.pop()()
        while self.topics:
            self.destroy_publisher(self.topics.popitem()[1])
        return super().on_cleanup(state)

    on_shutdown = on_error = on_cleanup

    def end_threads(self) -> None:
        """Stop reading and writing."""
        self.stop.set()
        for link in list(self.links.values()):
            with contextlib.suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
        for thread in self.threads:
            thread.join()
        self.threads = []

    def publisher(self, topic: str, kind: type, quality: QoSProfile) -> Any:
        """The publisher of a topic, which is destroyed at clean-up."""
        if topic not in self.topics:
            self.topics[topic] = self.create_publisher(kind, topic, quality)
        return self.topics[topic]

    def keep_connected(self, name: str, host: str, port: int, use: Callable[[Any], None]) -> None:
        """Connect again and again, until the node is not active any more."""
        while not self.stop.is_set():
            try:
                with socket.create_connection((host, port), RECONNECT_S) as link:
                    link.settimeout(SILENT_S)
                    self.links[name] = link
                    self.get_logger().info(f"{name}: connected to {host}:{port}")
                    use(link)
            except OSError as error:
                if not self.stop.is_set():
                    self.get_logger().warning(f"{name}: {host}:{port}: {error}", throttle_duration_sec=60.0)
            self.links.pop(name, None)
            self.stop.wait(RECONNECT_S)

    def read(self, link: Any) -> None:
        """Publish what one connection gives, until it ends. Raises OSError."""
        with link.makefile("rb") as file:
            while (line := file.readline(LONGEST_LINE)) and not self.stop.is_set():
                try:
                    self.publish(json.loads(line))
                except Exception as error:  # noqa: BLE001 - a line from the network ends nothing
                    self.get_logger().warning(f"a line was not understood: {error!r}", throttle_duration_sec=10.0)

    def write_motion(self, link: Any) -> None:
        """Give motion to the tag. Raises OSError."""
        while not self.stop.is_set():
            with contextlib.suppress(queue.Empty):
                link.sendall(self.motion.get(timeout=0.2))

    def publish(self, line: dict[str, Any]) -> None:
        """Publish one line. Raises many things where it is not as it should be."""
        if line["type"] == "site":
            found, markers = messages.anchors(line["anchors_m"], self.of["map_frame"])
            self.topics["~/anchor_positions"].publish(found)
            self.topics["~/anchors"].publish(markers)
        elif line["type"] == "fix":
            self.publish_fix(line)
        elif line["type"] == "no_fix":
            self.tags[self.name(line["tag"])] = 0, f"no fix: {line['reason']}"

    def publish_fix(self, fix: dict[str, Any]) -> None:
        """Publish a fix on the tag's topics, stamped with the time of its measurement; give it to the estimator."""
        name, frame, unix_s = self.name(fix["tag"]), self.of["map_frame"], float(fix["unix_s"])
        if self.get_parameter("use_sim_time").value:  # then no other node knows Unix time
            unix_s = self.get_clock().now().nanoseconds * 1e-9 - float(fix["latency_s"])
            if unix_s <= 0.0:
                self.tags[name] = 0, "no time yet: use_sim_time is set, and nothing came on /clock"
                return
        covariance_m2 = messages.floored(fix["covariance_m2"])
        pose = messages.pose(unix_s, frame, fix["position_m"], covariance_m2, [0, 1, 2])
        messages.set_orientation(pose, fix)
        velocity = messages.velocity(fix, unix_s, frame)
        self.publisher(f"~/{name}/pose", PoseWithCovarianceStamped, self.usual).publish(pose)
        if velocity is not None:
            self.publisher(f"~/{name}/velocity", TwistWithCovarianceStamped, self.usual).publish(velocity)
        if self.of["publish_tag_tf"]:
            self.give_transform(unix_s, frame, name, fix["position_m"], 0.0)
        self.tags[name] = self.tags.get(name, (0, ""))[0] + 1, ""
        if fix["tag"] == self.of["tag"] or not (self.of["tag"] or len(self.tags) > 1):
            with self.lock:
                xx, xy, _, _, yy, *_ = covariance_m2
                self.estimator.add_fix(unix_s, complex(*fix["position_m"][:2]), (xx, xy, yy))

    def give_transform(self, unix_s: float, frame: str, child: str, place_m: Any, yaw_rad: float) -> None:
        """Publish a transform."""
        made = messages.transform(unix_s, frame, child, place_m, yaw_rad)
        self.topics["/tf"].publish(TFMessage(transforms=[made]))

    def on_odometry(self, message: Odometry) -> None:
        """Take odometry, and publish map → odom at its time."""
        if not self.threads:
            return
        self.odometry_s = time.monotonic()
        self.pass_on(message)
        at, frame = message.pose.pose, self.of["map_frame"]
        place_m, yaw_rad = complex(at.position.x, at.position.y), messages.yaw_of(at.orientation)
        with self.lock:
            before = self.estimator.pose
            self.estimator.add_odometry(messages.seconds_of(message), place_m, yaw_rad)
            found = self.estimator.pose
        if found is not None and found is not before:
            base_m, odom_m = ((one.real, one.imag, 0.0) for one in (found.base_m, found.odom_m))
            pose = messages.pose(found.unix_s, frame, base_m, found.covariance, [0, 1, 5], found.base_yaw_rad)
            self.topics["~/base"].publish(pose)
            if self.of["publish_map_to_odom"]:
                self.give_transform(found.unix_s, frame, self.of["odom_frame"], odom_m, found.odom_yaw_rad)

    def pass_on(self, message: Imu | Odometry) -> None:
        """Queue motion for the tag; what is not finite, and the oldest where too much waits, is dropped and counted."""
        if self.of["motion_host"] and self.threads:
            try:
                if self.motion.full():
                    self.motion_dropped += 1
                    self.motion.get_nowait()
                has_unix_time = not self.get_parameter("use_sim_time").value
                self.motion.put_nowait(messages.motion_line(message, has_unix_time=has_unix_time))
            except (ValueError, queue.Empty):
                self.motion_dropped += 1

    def report(self) -> None:
        """Once a second: which tags have fixes, what is missing, and why."""
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        found = [self.map_odom_state()] if self.threads else [("connection", WARN, "the node is not active", {})]
        for name, (count, reason) in list(self.tags.items()):
            self.tags[name] = 0, reason
            text = reason or (f"{count} fixes in a second" if count else "nothing came in the last second")
            found.append((name, ERROR if reason else OK if count else WARN, text, {}))
        if self.threads and "Skyless" not in self.links:
            found.append(("connection", ERROR, f"no Skyless at {self.of['host']}:{self.of['port']}", {}))
        if self.of["motion_host"]:
            there, counts = "motion" in self.links, {"dropped": self.motion_dropped}
            text = f"{'given to' if there else 'no'} skyless tag --motion at {self.of['motion_host']}"
            found.append(("motion", OK if there else ERROR, text, counts))
        for name, level, text, values in found:
            pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
            state = DiagnosticStatus(level=level, name=f"skyless: {name}", message=text, hardware_id=name, values=pairs)
            message.status.append(state)
        self.topics["/diagnostics"].publish(message)

    def map_odom_state(self) -> tuple[str, bytes, str, dict[str, Any]]:
        """Whether map → odom is given, and if not why."""
        with self.lock:
            reason, values = self.estimator.reason(), dict[str, Any](self.estimator.counts)
            values |= {"heading_std_deg": f"{math.degrees(self.estimator.heading()[1]):.2f}"}
        silent_s = time.monotonic() - self.odometry_s
        if not self.of["tag"] and len(self.tags) > 1:
            reason = f"several tags ({', '.join(self.tags)}): the parameter tag should say which is the robot's"
        elif self.odometry_s and silent_s > STOPPED_S:
            reason = f"no odometry for {silent_s:.1f} s"
        return "map_odom", WARN if reason else OK, reason or "map -> odom is given", values

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


def main() -> None:
    """Run until Ctrl-C."""
    rclpy.init()
    node = SkylessNode()
    try:
        if node.get_parameter("autostart").value and node.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            node.trigger_activate()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.end_threads()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
