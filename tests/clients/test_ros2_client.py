"""ROS 2 itself (Kilted, from its wheels) reads what Skyless gives: by DDS, through the one-file node, and in a bag.

The wheels have no command ``ros2``; where one is found, in this environment or in PATH, it is asked, too.
"""

import asyncio
import contextlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from msgspec import structs

from skyless.bridges.ros2 import POSE
from skyless.bridges.target import BridgeContext, floored, open_hub
from skyless.bridges.targets import open_route
from skyless.cli.main import main
from skyless.core.earth import geodetic, rotated
from skyless.run.recordings.recording import McapRecording
from support import live_site
from support.bridged_values import SITE, a_fix
from support.processes import free_port

ROOT = Path(__file__).parents[2]
PROGRAM = Path(__file__).with_name("ros2_program.py")
FOLDER = ROOT / ".venv-clients" / "ros2"
PYTHON = FOLDER / "bin" / "python"
MESSAGES = ("diagnostic-msgs", "geometry-msgs", "sensor-msgs", "std-msgs", "visualization-msgs")
PACKAGES = [
    "ros-kilted-rclpy==9.1.2",
    "ros-kilted-rmw-fastrtps-cpp==9.3.3",
    *(f"ros-kilted-{name}==5.5.1" for name in MESSAGES),
    "mcap==1.3.0",
]
RATE_HZ = 50.0
PATIENCE_S = 60.0
"""As long as discovery and a busy machine may take."""

FEW = 100

POSE_HASH = "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
"""Of POSE, as ROS states it."""


class Ros:
    """An environment with ROS 2 in a domain of its own."""

    def __init__(self):
        self.domain = random.Random().randint(100, 200)
        path = os.pathsep.join([str(FOLDER / "bin"), os.environ.get("PATH", "")])
        without = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
        self.environment = without | {"ROS_DOMAIN_ID": str(self.domain), "PATH": path}

    def start(self, *arguments):
        """Its Python with arguments."""
        command, pipe = [str(one) for one in (PYTHON, *arguments)], subprocess.PIPE
        return subprocess.Popen(command, env=self.environment, stdout=pipe, stderr=pipe, text=True)

    def listener(self, count):
        """One that listens already."""
        process = self.start(PROGRAM, "listen", count, PATIENCE_S)
        assert "listening" in process.stderr.readline()
        return process


def found_by(process, patience_s=2 * PATIENCE_S):
    """What a program writes when it has ended."""
    out, said = process.communicate(timeout=patience_s)
    assert process.returncode == 0, said
    return json.loads(out)


@pytest.fixture(scope="module")
def ros():
    """ROS 2 from PyPI, installed once."""
    found, probe = Ros(), "import rclpy, mcap, diagnostic_msgs.msg, geometry_msgs.msg, sensor_msgs.msg"
    if not PYTHON.exists():
        subprocess.run([sys.executable, "-m", "venv", FOLDER], check=True)
    for install in ([], ["-m", "pip", "install", "--quiet", *PACKAGES]):
        for arguments in filter(None, (install, ["-c", f"{probe}, visualization_msgs.msg"])):
            done = found.start(*arguments)
            _, said = done.communicate()
        if done.returncode == 0:
            return found
    pytest.skip(f"ROS 2's wheels (x86-64 Linux only) are not installed or do not run here: {said.strip()[-200:]}")


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


@pytest.fixture(params=["dds", "node"])
def door(request, ros, capfd):
    """A feed that comes out in ROS: by ros2://, or by jsonl+tcp:// and the node."""
    if request.param == "dds":
        pytest.importorskip("cyclonedds", reason="Cyclone DDS has no wheel here")
        with Feed(f"ros2://?domain={ros.domain}&hz=1000", print) as feed:
            yield feed
        return
    port = free_port()
    node = ros.start(ROOT / "examples/ros2/skyless_node.py", "--ros-args", "-p", f"port:={port}")
    try:
        with Feed(f"jsonl+tcp://:{port}?hz=1000", print) as feed:
            while "reading" not in (line := node.stderr.readline()):
                assert line, "the node has ended"
            yield feed
    finally:
        node.send_signal(signal.SIGINT)
        _, said = node.communicate(timeout=PATIENCE_S)
        assert node.returncode == 0, said
        assert "Traceback" not in said


def exact(unix_s):
    whole = int(unix_s)
    return [whole, round((unix_s - whole) * 1e9)]


def stamp_of(message):
    return [message["header"]["stamp"][key] for key in ("sec", "nanosec")]


def xyz(vector):
    return tuple(vector[axis] for axis in "xyz")


def expect(topics, feed, count):
    """What came is what was given, in order, without holes."""
    poses, velocities, fixes, (anchors, *_) = topics.values()
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
    for one in fixes:
        fix = by_stamp[tuple(stamp_of(one))]
        assert one["status"]["status"] == 0
        latitude_deg, longitude_deg, height_m = geodetic(fix.position_m, SITE.georeference)
        expected = pytest.approx((latitude_deg, longitude_deg), abs=1e-11)  # a micrometre
        assert (one["latitude"], one["longitude"]) == expected
        assert one["altitude"] == pytest.approx(height_m, abs=1e-9)
        turned = rotated(floored(fix.covariance_m2), SITE.georeference.heading_deg)
        assert one["position_covariance"] == pytest.approx(turned, abs=1e-12)
    cubes = {one["id"]: xyz(one["pose"]["position"]) for one in anchors["markers"] if one["type"] == 1}
    assert cubes == SITE.anchors_m


def test_a_subscriber_reads_the_fixes_and_the_hash_of_their_type_and_one_that_is_killed_costs_it_nothing(ros, door):
    victim, other = ros.listener(10_000), ros.listener(6 * FEW)
    assert "a pose" in victim.stderr.readline()
    victim.kill()
    victim.communicate()
    found = found_by(other)
    expect(found["topics"], door, 6 * FEW)
    assert not door.dropped
    (publisher,) = found["publishers"]
    assert publisher == {"hash": POSE_HASH, "type": POSE, "reliability": "RELIABLE"}


def test_a_subscriber_that_was_there_before(ros):
    pytest.importorskip("cyclonedds", reason="Cyclone DDS has no wheel here")
    listener = ros.listener(FEW)
    with Feed(f"ros2://?domain={ros.domain}&hz=1000", print) as feed:
        found = found_by(listener)
    expect(found["topics"], feed, FEW)


def test_the_command_ros2_shows_type_rate_and_position(ros, door):
    command = shutil.which("ros2", path=ros.environment["PATH"])
    if command is None:
        pytest.skip("the command ros2 is not installed: the wheels have none (apt-get install ros-kilted-ros2topic)")
    pose = "/skyless/tag1/pose"

    def ask(*arguments, seconds=30):
        """Until it has discovered the topic, for which it waits half a second each time."""
        asked = ["timeout", "--signal=INT", str(seconds), command, "topic", *arguments]
        end_s = time.monotonic() + PATIENCE_S
        while True:
            said = subprocess.run(asked, env=ros.environment, capture_output=True, text=True, check=False).stdout
            if (said and "Unknown" not in said and "WARNING" not in said) or time.monotonic() > end_s:
                return said

    assert POSE_HASH in ask("info", "-v", pose)
    field = ask("echo", "--once", "--field", "pose.pose.position", pose)
    values = {name: float(value) for name, value in re.findall(r"([xyz]): (\S+)", field)}
    fix = door.sent[round(values["x"] * 1e3)]
    assert (values["x"], values["y"], values["z"]) == pytest.approx(fix.position_m, abs=1e-9)
    rates = re.findall(r"average rate: (\S+)", ask("hz", pose, seconds=15))
    last = max(list(door.sent))
    assert float(rates[-1]) == pytest.approx((last - 1) / (door.sent[last].unix_s - door.sent[1].unix_s), rel=0.1)


def test_ros_reads_the_bag(ros, tmp_path):
    recording = tmp_path / "walk.mcap"
    live_site.record(recording, live_site.messages(1.0, tags=("a", "b")))
    assert main(["export", str(recording), "--to", str(tmp_path / "bag")]) == 0
    read = found_by(ros.start(PROGRAM, "bag", tmp_path / "bag" / "bag.mcap"))
    assert read["profile"] == "ros2"
    assert {coding for _, coding, _, _ in read["messages"]} == {"cdr/ros2msg"}
    with McapRecording(recording) as source:
        fixes = list(source.fixes())
    for tag in ("a", "b"):
        poses = [message for topic, _, _, message in read["messages"] if topic == f"/skyless/{tag}/pose"]
        assert [stamp_of(one) for one in poses] == [exact(fix.unix_s) for fix in fixes if fix.tag == tag]
        assert [xyz(one["pose"]["pose"]["position"]) for one in poses] == [
            fix.position_m for fix in fixes if fix.tag == tag
        ]
    assert len(structs.asdict(fixes[0])["covariance_m2"]) == 9


def test_lines_that_nobody_should_send_do_not_end_the_node(ros):
    found = found_by(ros.start(PROGRAM, "garbage", 5000, random.randrange(10**6)), 4 * PATIENCE_S)
    assert found["last"] == {"tag1": 2}, "a fix whose velocity is not finite is a fix"
