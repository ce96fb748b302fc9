"""Runs where ROS 2 is; the first argument names what it does. It writes what it found as one JSON object.

ros2_program.py listen COUNT PATIENCE_S TOPIC...  listens to topics of TOPICS
ros2_program.py bag FILE.mcap              reads a bag, each message by ROS's own type support
ros2_program.py garbage COUNT SEED         gives the package's node lines that nobody should send
ros2_program.py robot FEED_PORT MOTION_PORT  takes the package's node through its states on a robot in simulated time
"""

import cmath
import io
import json
import math
import random
import socket
import sys
import threading
import time
from importlib import import_module
from pathlib import Path

import rclpy

POSE = "/skyless/tag1/pose"
TOPICS = {
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/skyless/tag1/velocity": "geometry_msgs/msg/TwistWithCovarianceStamped",
    "/skyless/anchors": "visualization_msgs/msg/MarkerArray",
}
FIX = {
    "type": "fix",
    "tag": "tag1",
    "unix_s": 1.8e9,
    "position_m": [1.0, 2.0, 3.0],
    "covariance_m2": [0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01],
    "velocity_mps": [1.0, 0.0, 0.0],
    "velocity_covariance": [0.01] * 9,
}
PLACE = {"latitude_deg": 52.0, "longitude_deg": 13.0, "height_m": 34.0, "heading_deg": 30.0}
SITE = {"type": "site", "anchors_m": {"1": [0.0, 1.0, 2.0]}, "georeference": PLACE}
WORDS = [None, True, -1, 1e308, 2**80, "", "x" * 300, "\u0000", [], {}, [[]], "fix", "NaN", -1e-300]


def type_of(name):
    package, kind, message = name.split("/")
    return getattr(import_module(f"{package}.{kind}"), message)


def plain(value):
    """A message as JSON has it."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, bytes):
        return list(value)
    return [plain(one) for one in value] if isinstance(value, (list, tuple)) else value


def listen(count, patience_s, *topics):
    from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data

    rclpy.init()
    node, found = rclpy.create_node("listener"), {topic: [] for topic in topics}
    qualities = {
        "/skyless/tag1/fix": qos_profile_sensor_data,
        "/skyless/anchors": QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    }

    def take(topic, message):
        found[topic].append(plain(message))
        if topic == POSE and len(found[POSE]) % 25 == 1:
            print("a pose", file=sys.stderr, flush=True)

    for topic in topics:
        quality = qualities.get(topic, QoSProfile(depth=100))
        node.create_subscription(
            type_of(TOPICS[topic]), topic, lambda message, topic=topic: take(topic, message), quality
        )
    print("listening", file=sys.stderr, flush=True)
    end_s = time.monotonic() + float(patience_s)
    while time.monotonic() < end_s and not (len(found[POSE]) >= int(count) and all(found.values())):
        rclpy.spin_once(node, timeout_sec=0.2)
    publishers = [
        {"type": one.topic_type, "hash": str(one.topic_type_hash), "reliability": one.qos_profile.reliability.name}
        for one in node.get_publishers_info_by_topic(POSE)
    ]
    rclpy.shutdown()
    return {"topics": found, "publishers": publishers}


def bag(path):
    from mcap.reader import make_reader
    from rclpy.serialization import deserialize_message

    with Path(path).open("rb") as file:
        reader = make_reader(file)
        profile = reader.get_header().profile
        found = [
            [channel.topic, f"{channel.message_encoding}/{schema.encoding}",
             plain(deserialize_message(message.data, type_of(schema.name)))]
            for schema, channel, message in reader.iter_messages()
        ]  # fmt: skip
        return {"profile": profile, "messages": found}


def broken_line():
    """A fix or a site with wrong values, missing ones or wrong bytes."""
    line = dict(random.choice((FIX, SITE)))
    for key in random.sample(list(line), random.randint(0, 2)):
        if key == "tag" or random.random() < 0.3:
            del line[key]
        else:
            line[key] = random.choice(WORDS)
    data = bytearray(json.dumps(line).encode())
    if random.random() < 0.5:
        for _ in range(random.randint(1, 8)):
            data[random.randrange(len(data))] = random.randrange(256)
    return bytes(data) if random.random() < 0.95 else b"[" * random.randint(1, 5000)


class Connection:
    """In the place of a socket."""

    def __init__(self, *lines):
        self.lines = lines

    def makefile(self, _mode):
        return io.BytesIO(b"".join(line + b"\n" for line in self.lines))


def garbage(count, seed):
    from skyless_ros2.node import SkylessNode

    random.seed(int(seed))
    rclpy.init(args=["--ros-args", "--log-level", "fatal", "-p", "port:=1"])
    node = SkylessNode()
    node.trigger_configure()
    for _ in range(0, int(count), 1000):
        node.read(Connection(*(broken_line() for _ in range(1000))))
        if len(node.names) > 50:  # broken names of tags are names: each has publishers
            node.trigger_cleanup()
            node.trigger_configure()
    node.tags.clear()
    for velocity_mps in ([1.0, 0.0, 0.0], [None, 0.0, 0.0]):  # null is what JSON makes of NaN
        node.read(Connection(json.dumps(FIX | {"velocity_mps": velocity_mps}).encode()))
    rclpy.shutdown()
    return {"last": node.tags}


def serve(port, lines, got):
    """Sends the first of ``lines`` to who connects, and those that are appended; appends what comes to ``got``."""
    with socket.create_server(("127.0.0.1", int(port))) as server:
        while True:
            connection, _ = server.accept()
            threading.Thread(target=lambda one=connection: got.extend(one.makefile()), daemon=True).start()
            waiting, sent = lines[:1], len(lines)
            while waiting is not None:
                try:
                    connection.sendall(b"".join(json.dumps(line).encode() + b"\n" for line in waiting))
                    waiting, sent = lines[sent:], len(lines)
                    time.sleep(1e-3)
                except OSError:
                    waiting = None


def robot(feed_port, motion_port):
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from skyless_ros2.node import SkylessNode

    lines, motion = [SITE], []
    for served in ((feed_port, lines, []), (motion_port, [], motion)):
        threading.Thread(target=serve, args=served, daemon=True).start()
    given = ("use_sim_time:=true", f"port:={feed_port}", "motion_host:=127.0.0.1", f"motion_port:={motion_port}")
    rclpy.init(args=["--ros-args", *(word for one in given for word in ("-p", one))])
    node, other, executor = SkylessNode(), rclpy.create_node("robot"), SingleThreadedExecutor()
    executor.add_node(node)
    executor.add_node(other)
    found = {
        "states": [],
        "/tf": [],
        "/skyless/base": [],
        POSE: [],
        "/skyless/anchor_positions": [],
        "/diagnostics": [],
    }
    kinds = (
        "tf2_msgs/msg/TFMessage",
        TOPICS[POSE],
        TOPICS[POSE],
        "uwb_msgs/msg/Anchors",
        "diagnostic_msgs/msg/DiagnosticArray",
    )
    for (topic, got), kind in zip(list(found.items())[1:], kinds, strict=True):
        lasting = DurabilityPolicy.TRANSIENT_LOCAL if "anchor" in topic else DurabilityPolicy.VOLATILE
        quality = QoSProfile(depth=100, durability=lasting)
        other.create_subscription(type_of(kind), topic, lambda one, got=got: got.append(plain(one)), quality)
    Odometry, Imu, Clock = map(type_of, ("nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu", "rosgraph_msgs/msg/Clock"))
    sent = {kind: other.create_publisher(kind, f"/{kind.__name__.lower()[:4]}", 10) for kind in (Odometry, Imu)}
    sent[Clock] = other.create_publisher(Clock, "/clock", 10)

    def drive(seconds):
        """An eight on the map, by odometry that begins at (6, 2) and 1 rad; the antenna is .2 m in front."""
        for _ in range(int(seconds / 0.05)):
            drive.t_s += 0.05
            a = 0.4 * drive.t_s
            base, yaw = complex(5 + 2 * math.sin(a), 5 + math.sin(2 * a)), math.atan2(math.cos(2 * a), math.cos(a))
            moved, sample = Odometry(), Imu()
            stamp = sample.header.stamp = moved.header.stamp
            stamp.sec, stamp.nanosec = int(drive.t_s), round(drive.t_s % 1 * 1e9)
            at, place = moved.pose.pose, (base - (6 + 2j)) * cmath.rect(1, -1)
            at.position.x, at.position.y = place.real, place.imag
            at.orientation.z, at.orientation.w = math.sin((yaw - 1) / 2), math.cos((yaw - 1) / 2)
            for one in (Clock(clock=stamp), moved, sample):
                sent[type(one)].publish(one)
            for _ in range(8):
                executor.spin_once(0.002)
            tag, before, end_s = base + cmath.rect(0.2, yaw), node.tags.get("tag1"), time.monotonic() + 1.0
            place = {"position_m": [tag.real, tag.imag, 1.0], "covariance_m2": [4e-4, 0, 0, 0, 4e-4, 0, 0, 0, 4e-4]}
            lines.append(FIX | place | {"unix_s": 1.0, "latency_s": 0.0})
            while node.threads and node.tags.get("tag1") == before and time.monotonic() < end_s:
                time.sleep(1e-3)

    def reach(seconds, *names):
        for name in names:
            getattr(node, f"trigger_{name}")()
        end_s = time.monotonic() + 5.0
        while node.threads and len(node.links) < 2 and time.monotonic() < end_s:
            time.sleep(1e-3)
        found["states"].append([node._state_machine.current_state[1], len(found["/tf"])])
        drive(seconds)

    def wait(seconds):
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            executor.spin_once(0.1)

    drive.t_s = 10.0
    reach(0.0)
    reach(1.0, "configure")
    reach(20.0, "activate")
    broken = Odometry()
    broken.header.stamp.sec, broken.pose.pose.position.x = int(drive.t_s) + 1, math.nan
    sent[Odometry].publish(broken)
    reach(2.0, "deactivate")
    wait(1.2)
    reach(20.0, "activate")
    wait(2.5)
    reach(0.5, "deactivate", "cleanup")
    reach(0.5, "configure", "activate")
    reach(0.0, "shutdown")
    rclpy.shutdown()
    return found | {"motion": [json.loads(line) for line in motion], "place": [6.0, 2.0, 1.0]}


if __name__ == "__main__":
    print(json.dumps({"listen": listen, "bag": bag, "garbage": garbage, "robot": robot}[sys.argv[1]](*sys.argv[2:])))
