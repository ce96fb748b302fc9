"""Runs where ROS 2 is: gives the one-file node lines that nobody should send, as many as its argument says."""

import json
import random
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "ros2"))

import rclpy
from skyless_node import SkylessNode

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


class Connection:
    """In the place of a socket: gives what it has in pieces of any length."""

    def __init__(self, data):
        self.data = data

    def recv(self, _most):
        length = random.randint(1, 5000)
        piece, self.data = self.data[:length], self.data[length:]
        return piece


def garbage():
    """One line: a fix or a site with wrong values, missing ones or wrong bytes."""
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


def main():
    random.seed(int(sys.argv[2]))
    rclpy.init(args=["--ros-args", "--log-level", "fatal", "-p", "port:=1"])
    node = SkylessNode()
    left = int(sys.argv[1])
    while left > 0:
        count = min(left, 1000)
        node.read(Connection(b"\n".join(garbage() for _ in range(count)) + b"\n"))
        if len(node.names) > 50:  # broken names of tags are names: each has publishers
            for publisher in node.topics.values():
                node.destroy_publisher(publisher)
            node.topics.clear()
            node.names.clear()
        left -= count
    before = len(node.fixes)
    node.fixes.clear()
    for velocity_mps in ([1.0, 0.0, 0.0], [None, 0.0, 0.0]):  # null is what JSON makes of NaN
        node.read(Connection(json.dumps(FIX | {"velocity_mps": velocity_mps}).encode() + b"\n"))
    print(json.dumps({"tags": before, "last": node.fixes}))
    rclpy.shutdown()


if __name__ == "__main__":
    main()
