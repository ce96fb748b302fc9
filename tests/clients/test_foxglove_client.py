"""Foxglove's own client for programs (npm) gets every channel of ``foxglove://``, and the fixes in them."""

import asyncio
import json
import shutil
import subprocess
from pathlib import Path

import msgspec
import pytest

from skyless.bridges.foxglove import FoxgloveTarget
from skyless.bridges.target import BridgedSite, Hub, Route
from skyless.core.earth import geodetic
from skyless.core.site import GeoreferenceSite, WallSite
from skyless.run.mqtt.messages import Counters, FixMessage, TagHealth
from support.processes import running_program
from support.waiting import running, until

ROOT = Path(__file__).parents[2]
CLIENT = Path(__file__).with_name("foxglove_client.cjs")
PACKAGES = ("@foxglove/ws-protocol@0.8.0", "@foxglove/schemas@2.1.0", "ws@8.18.3", "ajv@8.17.1")
HALL = GeoreferenceSite(latitude_deg=52.5, longitude_deg=13.4, height_m=40.0, heading_deg=30.0)
SITE = BridgedSite(
    1, "hall", simulated=True, anchors_m={1: (0.0, 0.0, 2.5), 2: (8.0, 0.0, 2.5), 3: (8.0, 6.0, 2.5)},
    georeference=HALL, master=1, walls=(WallSite(0.0, 0.0, 8.0, 0.0),),
)  # fmt: skip
HZ, FIXES = 50, 250
OF_A_TAG = ("fix", "health", "pose", "ellipse", "location")
TOPICS = {"/site/scene", "/tf", *(f"/tag/tag1/{name}" for name in OF_A_TAG)}
HEALTH = TagHealth(
    tag="tag1", unix_s=1.79e9, uptime_s=5.0, method="joint", receptions=1000, fixes=900, updates_per_s=180.0,
    reason=None, first_fix_s=1.2, latency_p50_s=0.001, latency_p99_s=0.003, counters={}, mqtt=Counters(10, 0, 0),
    cpu=0.1, memory_bytes=10**8, phases=(),
)  # fmt: skip
ANSWER_S = 30.0


@pytest.fixture(scope="session")
def modules():
    """Folder with Foxglove's packages, installed once."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("Node.js is not installed: apt-get install nodejs npm")
    folder = ROOT / ".venv-clients" / "foxglove"
    if not all((folder / "node_modules" / package.rpartition("@")[0]).is_dir() for package in PACKAGES):
        folder.mkdir(parents=True, exist_ok=True)
        command = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(folder), *PACKAGES]
        installed = subprocess.run(command, check=False, capture_output=True, text=True, cwd=folder)
        if installed.returncode != 0:
            pytest.skip(f"npm cannot install Foxglove's client: {installed.stderr.strip()[-300:]}")
    return folder


def fix(number):
    covariance = (0.0009, 0.0002, 0.0, 0.0002, 0.0004, 0.0, 0.0, 0.0, 0.0025)
    return FixMessage(
        tag="tag1", serial=number, unix_s=1.79e9 + number / HZ, time_s=number / HZ,
        position_m=(1.0 + 0.02 * number, 2.0, 1.2), covariance_m2=covariance, velocity_mps=(1.0, 0.0, 0.0),
        velocity_covariance=covariance, std_m=0.06, gdop=1.4, pdop=1.3, hdop=1.1, vdop=0.7, anchors=(1, 2, 3), chi2=3.0,
        dof=2, residual_rms_m=0.03, method="joint", height_known=False, latency_s=0.001,
    )  # fmt: skip


@pytest.mark.parametrize("subprotocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
async def test_foxgloves_client_gets_every_channel_and_fix(modules, subprotocol):
    lines, target = [], FoxgloveTarget("foxglove://:0", "127.0.0.1", 0)
    hub = Hub([Route(target, None, float(HZ))], lambda line: None)

    def of(event):
        return [line for line in lines if line["event"] == event]

    async def receive(enough):
        while not enough():
            line = await asyncio.wait_for(client.stdout.readline(), ANSWER_S)
            assert line, f"the client ended after {lines[-3:]}"
            lines.append(json.loads(line))

    async with running(target.run()):
        await until(lambda: target.port != 0)
        hub.on_site(SITE)
        hub.on_fix(fix(0), 0.0)
        hub.on_health(HEALTH, 0.0)
        words = [str(one) for one in (CLIENT, modules, f"ws://127.0.0.1:{target.port}", subprotocol)]
        async with running_program("node", *words, stdout=asyncio.subprocess.PIPE, limit=1 << 20) as client:
            await receive(lambda: len({line["topic"] for line in of("channel")}) == len(TOPICS))
            await receive(lambda: any(line["topic"] == "/site/scene" for line in of("message")))
            numbers = range(1, len(TOPICS) + 1)
            await until(lambda: all(one.wants(number) for one in target._sessions for number in numbers), ANSWER_S)
            for number in range(1, FIXES + 1):
                hub.on_fix(fix(number), number / HZ)
                await asyncio.sleep(1 / HZ)
            hub.on_health(HEALTH, FIXES / HZ)
            await receive(lambda: any(line["topic"] == "/tag/tag1/health" for line in of("message")))
    messages = of("message")
    assert {line["topic"] for line in of("channel")} == {message["topic"] for message in messages} == TOPICS
    assert not of("error")
    assert not of("status")
    own = ("/tag/tag1/fix", "/tag/tag1/health")
    assert all(message["valid"] for message in messages if message["topic"] not in own)
    for topic in sorted(TOPICS - {"/site/scene", "/tag/tag1/health"}):
        stamps = [int(message["ns"]) for message in messages if message["topic"] == topic]
        assert len(stamps) >= 0.98 * FIXES
        assert stamps == sorted(stamps)
    for message in messages:
        number = round((int(message["ns"]) / 1e9 - 1.79e9) * HZ)
        if message["topic"] == "/tag/tag1/fix":
            assert msgspec.convert(message["value"], FixMessage) == fix(number)
        elif message["topic"] == "/tag/tag1/location":
            value = message["value"]
            assert (value["latitude"], value["longitude"], value["altitude"]) == geodetic(fix(number).position_m, HALL)
        elif message["topic"] == "/tf":
            assert message["value"]["translation"]["x"] == fix(number).position_m[0]
