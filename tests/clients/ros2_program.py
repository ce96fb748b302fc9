"""Runs where ROS 2 is; the first argument names what it does. It writes what it found as one JSON object.

ros2_program.py listen COUNT PATIENCE_S    listens to a tag's topics
ros2_program.py bag FILE.mcap              reads a bag, each message by ROS's own type support
ros2_program.py garbage COUNT SEED         gives the one-file node lines that nobody should send
"""

import json
import random
import sys
import time
from importlib import import_module
from pathlib import Path

import rclpy

POSE = "/skyless/tag1/pose"
TOPICS = {
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/skyless/tag1/velocity": "geometry_msgs/msg/TwistWithCovarianceStamped",
    "/skyless/tag1/fix": "sensor_msgs/msg/NavSatFix",
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


def listen(count, patience_s):
    from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data

    rclpy.init()
    node, found = rclpy.create_node("listener"), {topic: [] for topic in TOPICS}
    qualities = {
        "/skyless/tag1/fix": qos_profile_sensor_data,
        "/skyless/anchors": QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    }

    def take(topic, message):
        found[topic].append(plain(message))
        if topic == POSE and len(found[POSE]) % 25 == 1:
            print("a pose", file=sys.stderr, flush=True)

    for topic, kind in TOPICS.items():
        quality = qualities.get(topic, QoSProfile(depth=100))
        node.create_subscription(type_of(kind), topic, lambda message, topic=topic: take(topic, message), quality)
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


class Connection:
    """In the place of a socket: gives what it has in pieces of any length."""

    def __init__(self, *lines):
        self.data = b"".join(line + b"\n" for line in lines)

    def recv(self, _most):
        length = random.randint(1, 5000)
        piece, self.data = self.data[:length], self.data[length:]
        return piece


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


def garbage(count, seed):
    sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "ros2"))
    from skyless_node import SkylessNode

    random.seed(int(seed))
    rclpy.init(args=["--ros-args", "--log-level", "fatal", "-p", "port:=1"])
    node = SkylessNode()
    for begin in range(0, int(count), 1000):
        node.read(Connection(*(broken_line() for _ in range(min(1000, int(count) - begin)))))
        if len(node.names) > 50:  # broken names of tags are names: each has publishers
            for publisher in node.topics.values():
                node.destroy_publisher(publisher)
            node.topics.clear()
            node.names.clear()
    node.fixes.clear()
    for velocity_mps in ([1.0, 0.0, 0.0], [None, 0.0, 0.0]):  # null is what JSON makes of NaN
        node.read(Connection(json.dumps(FIX | {"velocity_mps": velocity_mps}).encode()))
    rclpy.shutdown()
    return {"last": node.fixes}


if __name__ == "__main__":
    print(json.dumps({"listen": listen, "bag": bag, "garbage": garbage}[sys.argv[1]](*sys.argv[2:])))
