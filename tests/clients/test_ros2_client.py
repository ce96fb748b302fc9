"""ROS 2 itself (Kilted, from its wheels) reads what Skyless gives: by ``ros2://``, its package, and in a bag."""

import asyncio
import contextlib
import json
import math
import os
import random
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from msgspec import structs

from skyless.bridges.rosbag import POSE
from skyless.bridges.target import BridgeContext, floored, open_hub
from skyless.bridges.targets import open_route
from skyless.cli.main import main
from skyless.run.recordings.recording import McapRecording
from support import live_site
from support.bridged_values import SITE, a_fix
from support.processes import free_port

pytestmark = pytest.mark.live

ROOT = Path(__file__).parents[2]
PROGRAM = Path(__file__).with_name("ros2_program.py")
SCRIPT = ROOT / "scripts" / "ros2"
RATE_HZ = 50.0
PATIENCE_S = 60.0
"""As long as discovery and a busy machine may take."""

FEW = 100

TOPICS = [f"/skyless/{name}" for name in ("tag1/pose", "tag1/velocity", "anchors")]
POSE_HASH = "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
"""Of POSE, as ROS states it."""


class Ros:
    """An environment with ROS 2 and the packages of ``ros2/``, in a domain of its own."""

    def __init__(self):
        self.choose_domain()

    def choose_domain(self):
        """Choose another domain."""
        self.domain = random.Random().randint(100, 200)
        without = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
        self.environment = without | {"ROS_DOMAIN_ID": str(self.domain)}

    def start(self, *arguments):
        """A command in it."""
        command, pipe = [str(one) for one in (SCRIPT, *arguments)], subprocess.PIPE
        return subprocess.Popen(command, env=self.environment, stdout=pipe, stderr=pipe, text=True)

    def program(self, *arguments):
        """The program beside this file."""
        return self.start("python", PROGRAM, *arguments)

    def listener(self, count):
        """One that listens already."""
        process = self.program("listen", count, PATIENCE_S, *TOPICS)
        assert "listening" in process.stderr.readline()
        return process


def found_by(process, patience_s=2 * PATIENCE_S):
    """What a program writes when it has ended."""
    out, said = process.communicate(timeout=patience_s)
    assert process.returncode == 0, said
    return json.loads(out)


@pytest.fixture(scope="module")
def ros():
    """ROS 2 from PyPI and our packages, installed and built once."""
    found = Ros()
    environment = found.environment | {"PYTHON": sys.executable}
    done = subprocess.run([SCRIPT], env=environment, capture_output=True, text=True, check=False)
    if done.returncode == 3:
        pytest.skip(f"ROS 2's wheels (x86-64 Linux, Python 3.11) cannot be installed: {done.stderr.strip()[-200:]}")
    assert done.returncode == 0, done.stdout + done.stderr
    return found


class Feed:
    """A hub in a thread, with fixes at a rate that each say in their position which they are."""

    def __init__(self, target, log):
        self.sent = {}
        self.dropped = {}
        self._target, self._log = target, log
        self._stop = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()))

    async def _run(self):
        hub = open_hub([open_route(self._target, BridgeContext(self._log))], self._log)
        target = hub.routes[0].target
        task = asyncio.create_task(target.run())
        hub.on_site(SITE)
        serial = 0
        while not self._stop.is_set():
            serial += 1
            fix = a_fix(serial=serial, unix_s=time.time(), position_m=(serial * 1e-3, 2.0 + 1.0 / serial, 1.5))
            self.sent[round(fix.position_m[0] * 1e3)] = fix
            hub.on_fix(fix, time.monotonic())
            await asyncio.sleep(1.0 / RATE_HZ)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        self.dropped = dict(target.dropped)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


@pytest.fixture
def target(ros, tmp_path, monkeypatch):
    """``ros2://`` in a domain that nothing else uses; it finds the node as a user's shell knows it."""
    ros.choose_domain()
    node = tmp_path / "lib" / "skyless_ros2" / "node"
    node.parent.mkdir(parents=True)
    node.write_text(f'#!/bin/sh\nexec {SCRIPT} node "$@"\n')
    node.chmod(0o755)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    return f"ros2://?domain={ros.domain}&hz=1000"


def exact(unix_s):
    whole = int(unix_s)
    return [whole, round((unix_s - whole) * 1e9)]


def stamp_of(message):
    return [message["header"]["stamp"][key] for key in ("sec", "nanosec")]


def xyz(vector):
    return tuple(vector[axis] for axis in "xyz")


def expect(topics, feed, count):
    """What came is what was given, in order, without holes."""
    poses, velocities, (anchors, *_) = topics.values()
    assert len(poses) >= count
    serials = [round(1e3 * one["pose"]["pose"]["position"]["x"]) for one in poses]
    assert serials == list(range(serials[0], serials[0] + len(serials))), "one is missing, or the order is wrong"
    for serial, one in zip(serials, poses, strict=True):
        fix, covariance = feed.sent[serial], one["pose"]["covariance"]
        assert (stamp_of(one), one["header"]["frame_id"]) == (exact(fix.unix_s), "site")
        assert xyz(one["pose"]["pose"]["position"]) == pytest.approx(fix.position_m, abs=1e-9)
        assert len(covariance) == 36
        of_position = [covariance[6 * row + column] for row in range(3) for column in range(3)]
        assert of_position == list(floored(fix.covariance_m2))
        assert [covariance[7 * row] for row in (3, 4, 5)] == [1e6] * 3
    by_stamp = {tuple(exact(fix.unix_s)): fix for fix in list(feed.sent.values())}
    assert velocities
    for one in velocities:
        fix = by_stamp[tuple(stamp_of(one))]
        assert xyz(one["twist"]["twist"]["linear"]) == fix.velocity_mps
        assert one["twist"]["covariance"][:3] == list(fix.velocity_covariance[:3])
    cubes = {one["id"]: xyz(one["pose"]["position"]) for one in anchors["markers"] if one["type"] == 1}
    assert cubes == SITE.anchors_m


def test_subscribers_read_the_fixes_and_one_that_is_killed_costs_nothing(ros, target):
    victim, other = (ros.listener(count) for count in (10_000, 6 * FEW))
    said = []
    with Feed(target, said.append) as feed:
        assert "a pose" in victim.stderr.readline()
        victim.kill()
        victim.communicate()
        found = found_by(other)
    expect(found["topics"], feed, 6 * FEW)
    assert not feed.dropped
    (publisher,) = found["publishers"]
    assert publisher == {"hash": POSE_HASH, "type": POSE, "reliability": "RELIABLE"}
    assert not any("Traceback" in line or "started again" in line for line in said), said


def test_ros_reads_the_bag(ros, tmp_path):
    recording = tmp_path / "walk.mcap"
    live_site.record(recording, live_site.messages(1.0, tags=("a", "b")))
    assert main(["export", str(recording), "--to", str(tmp_path / "bag")]) == 0
    read = found_by(ros.program("bag", tmp_path / "bag" / "bag.mcap"))
    assert read["profile"] == "ros2"
    assert {coding for _, coding, _ in read["messages"]} == {"cdr/ros2msg"}
    with McapRecording(recording) as source:
        fixes = list(source.fixes())
    for tag in ("a", "b"):
        poses = [message for topic, _, message in read["messages"] if topic == f"/skyless/{tag}/pose"]
        assert [stamp_of(one) for one in poses] == [exact(fix.unix_s) for fix in fixes if fix.tag == tag]
        assert [xyz(one["pose"]["pose"]["position"]) for one in poses] == [
            fix.position_m for fix in fixes if fix.tag == tag
        ]
    assert len(structs.asdict(fixes[0])["covariance_m2"]) == 9


def test_lines_that_nobody_should_send_do_not_end_the_node(ros):
    found = found_by(ros.program("garbage", 5000, random.randrange(10**6)), 4 * PATIENCE_S)
    assert found["last"] == {"tag1": [2, ""]}, "a fix whose velocity is not finite is a fix"


def test_a_robot_gets_map_to_odom_in_simulated_time_while_the_node_is_active(ros):
    process = ros.program("robot", free_port(), free_port())
    found = found_by(process, 4 * PATIENCE_S)
    states, transforms = zip(*found["states"], strict=True)
    assert states == ("unconfigured", "inactive", "active", "inactive", "active", "unconfigured", "active", "finalized")
    assert transforms[2] == 0 < transforms[3] == transforms[4] < transforms[5] == transforms[6], (
        "inactive, it is silent"
    )
    for (one,) in (message["transforms"] for message in found["/tf"]):
        assert (one["header"]["frame_id"], one["child_frame_id"]) == ("map", "odom")
        x, y, yaw = found["place"]
        place, turn = one["transform"]["translation"], one["transform"]["rotation"]
        assert (place["x"], place["y"], 2.0 * math.asin(turn["z"])) == pytest.approx((x, y, yaw), abs=0.1)
    assert len(found["/skyless/base"]) == len(found["/tf"])
    assert all(0.0 < one["pose"]["covariance"][35] < math.radians(2.5) ** 2 for one in found["/skyless/base"])
    stamps_s = [one["header"]["stamp"]["sec"] for one in found["/skyless/tag1/pose"]]
    assert stamps_s == sorted(stamps_s)
    assert (stamps_s[0], len(stamps_s)) == (pytest.approx(12, abs=1), pytest.approx(800, abs=60))
    said = {(one["name"], one["message"]) for message in found["/diagnostics"] for one in message["status"]}
    for name, text in {
        "connection": "the node is not active", "map_odom": "the robot has moved", "tag1": "fixes in a second",
        "motion": "given to skyless tag",
    }.items() | {("map_odom", "map -> odom is given"), ("map_odom", "no odometry for")}:  # fmt: skip
        assert any(one == f"skyless: {name}" and text in words for one, words in said), (name, text, said)
    assert [one["position"] for one in found["/skyless/anchor_positions"][0]["anchors"]] == [
        {"x": 0.0, "y": 1.0, "z": 2.0}
    ]
    imu, wheels = ([line[kind] for line in found["motion"] if kind in line] for kind in ("imu", "wheels"))
    assert len(imu) == pytest.approx(len(wheels), abs=20)
    assert {"rate_rps", "force_mps2"} == set(imu[0]) and {"speed_mps", "rate_rps"} == set(wheels[0]), (
        "simulated time is no Unix time"
    )
