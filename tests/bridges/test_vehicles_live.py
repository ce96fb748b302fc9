"""Targets for vehicles on the real system: MAVSDK and pymavlink get what was given."""

import asyncio
import contextlib
import json
import math
import socket
import struct

import pytest
from msgspec import structs

from skyless.bridges.mavlink import gps_input, odometry, vision_position_estimate
from skyless.bridges.target import BridgeContext
from skyless.bridges.targets import open_route
from skyless.radio.serial.serial_port import Pty
from support.bridged_values import SITE, a_fix
from support.waiting import running

pymavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
HEADING_DEG = SITE.georeference.heading_deg


@contextlib.asynccontextmanager
async def serving(address, logged=()):
    """A target that runs for a minute at most and knows its site; ``logged``: what each line that it logs contains."""
    said = []
    target = open_route(address, BridgeContext(said.append)).target
    async with asyncio.timeout(60), running(target.run()):
        target.on_site(SITE)
        yield target
    assert len(said) == len(logged)
    assert all(words in line for words, line in zip(logged, said, strict=True))


def bound():
    """A UDP socket that receives at a port of its own, and that port."""
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", 0))
    receiver.setblocking(False)
    return receiver, receiver.getsockname()[1]


# MAVSDK as the vehicle


class Vehicle:
    """MAVSDK, which is system 3 with an autopilot: the target's messages as it decodes them."""

    def __init__(self):
        mavsdk = pytest.importorskip("mavsdk")
        self._kind = pytest.importorskip("mavsdk.plugins.mavlink_direct").MavlinkDirect
        free, self.port = bound()
        free.close()
        self._sdk = mavsdk.Mavsdk(mavsdk.Configuration.create_manual(3, 1, True))
        assert self._sdk.add_any_connection(f"udpin://127.0.0.1:{self.port}") == 0
        self._direct = None
        self.messages = {}

    def connect(self):
        """Once it knows of a system, get its messages."""
        if self._direct is None and self._sdk.get_systems():
            self._direct = self._kind(self._sdk.get_systems()[0])
            self._direct.subscribe_message("", self._on_message)

    def _on_message(self, message, _):
        sender = {"from": (message.system_id, message.component_id)}
        self.messages[message.message_name] = json.loads(message.fields_json) | sender

    def close(self):
        self._sdk.destroy()


@pytest.fixture
def vehicle():
    made = Vehicle()
    yield made
    made.close()


NAMES = {"ardupilot": "VISION_POSITION_ESTIMATE", "px4": "ODOMETRY", "gps": "GPS_INPUT"}
RENAMED = {
    "time_us": "time_usec",
    "latitude_1e7": "lat",
    "longitude_1e7": "lon",
    "altitude": "alt",
    "horizontal_accuracy": "horiz_accuracy",
    "vertical_accuracy": "vert_accuracy",
    "yaw_cdeg": "yaw",
}
SEVERAL = {"position": "xyz", "velocity": ("vx", "vy", "vz"), "rates": ("rollspeed", "pitchspeed", "yawspeed")}


def expected_of(profile, fix):
    """The fields that the vehicle should decode, by MAVLink's names; NaN is None in JSON."""
    if profile == "ardupilot":
        message = vision_position_estimate(fix, HEADING_DEG, 0)
    elif profile == "px4":
        message = odometry(fix, HEADING_DEG, 0)
    else:
        message = gps_input(fix, SITE.georeference)
    fields = {}
    for name, value in structs.asdict(message).items():
        if profile == "gps" and name == "velocity":
            fields |= dict(zip(("vn", "ve", "vd"), value, strict=True))
        elif name in SEVERAL:
            fields |= dict(zip(SEVERAL[name], value, strict=True))
        else:
            fields[RENAMED.get(name, name)] = value
    if profile == "ardupilot":
        fields["usec"] = fields.pop("time_usec")
    return fields


def as_float32(value):
    """As it comes out of a 32-bit float and JSON."""
    if isinstance(value, tuple):
        return [as_float32(one) for one in value]
    if isinstance(value, float):
        return None if math.isnan(value) else struct.unpack("<f", struct.pack("<f", value))[0]
    return value


@pytest.mark.site
@pytest.mark.parametrize("profile", NAMES)
@pytest.mark.parametrize("moving", [True, False])
async def test_mavsdk_decodes_every_field(profile, moving, vehicle):
    fix = a_fix() if moving else a_fix(velocity_mps=None, velocity_covariance=None, hdop=None, height_known=True)

    logged = ["EK3_SRC1_POSZ 1"] if fix.height_known and profile == "ardupilot" else []

    async with serving(f"mavlink+udpout://127.0.0.1:{vehicle.port}?profile={profile}&system=3", logged) as target:
        serial = 0
        while not {"HEARTBEAT", NAMES[profile]} <= set(vehicle.messages):
            serial += 1
            target.on_second(fix.unix_s)
            target.on_fix(structs.replace(fix, serial=serial))
            await asyncio.sleep(0.02)
            vehicle.connect()
    fields = vehicle.messages[NAMES[profile]]
    assert fields.pop("from") == (3, 197)
    assert fields.pop("message_name") == NAMES[profile]
    fields.pop("message_id")
    expected = expected_of(profile, fix)
    assert set(fields) == set(expected)
    for name, value in expected.items():
        assert fields[name] == as_float32(value), name
    heartbeat = vehicle.messages["HEARTBEAT"]
    assert (heartbeat["type"], heartbeat["autopilot"]) == (18, 8)
    if profile == "gps":
        assert "SET_GPS_GLOBAL_ORIGIN" not in vehicle.messages
    else:
        origin = vehicle.messages["SET_GPS_GLOBAL_ORIGIN"]
        assert (origin["latitude"], origin["longitude"], origin["altitude"]) == (525_123_457, 133_260_000, 34_500)
        assert origin["target_system"] == 3


# A vehicle that pymavlink plays, over UDP and a serial line


class Played:
    """A vehicle's side of a link: what it has received, and what it says."""

    def __init__(self, send):
        self._send = send
        self._link = pymavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.received = asyncio.Queue()

    def on_data(self, data):
        for message in self._link.parse_buffer(data) or []:
            self.received.put_nowait(message)

    def say(self, message):
        self._send(message.pack(self._link))

    async def next(self, kind):
        while (message := await self.received.get()).get_type() != kind:
            pass
        return message


async def converse(vehicle, target):
    """The vehicle gets fixes, an origin until it has one, and answers when it asks for the time."""
    target.on_second(1_795_000_000.0)
    assert (await vehicle.next("SET_GPS_GLOBAL_ORIGIN")).latitude == 525_123_457
    target.on_fix(a_fix())
    found = await vehicle.next("VISION_POSITION_ESTIMATE")
    assert (found.x, found.z) == pytest.approx((1.2320508, -1.5))
    vehicle.say(pymavlink.MAVLink_timesync_message(0, 4711))
    answer = await vehicle.next("TIMESYNC")
    assert answer.ts1 == 4711
    assert answer.tc1 > 1_700_000_000_000_000_000  # ns since 1970
    vehicle.say(pymavlink.MAVLink_gps_global_origin_message(525_123_457, 133_260_000, 34_500))
    vehicle.say(pymavlink.MAVLink_timesync_message(0, 4712))
    assert (await vehicle.next("TIMESYNC")).ts1 == 4712  # so that it has read the origin as well
    target.on_second(1_795_000_001.0)
    target.on_fix(a_fix(serial=2))
    assert (await vehicle.received.get()).get_type() == "HEARTBEAT"
    assert (await vehicle.received.get()).get_type() == "VISION_POSITION_ESTIMATE"


@pytest.mark.site
async def test_a_vehicle_on_udp():
    receiver, port = bound()
    with receiver:
        peers = []
        vehicle = Played(lambda data: receiver.sendto(data, peers[-1]))

        def read():
            data, peer = receiver.recvfrom(1 << 16)
            peers.append(peer)
            vehicle.on_data(data)

        loop = asyncio.get_running_loop()
        loop.add_reader(receiver, read)
        async with serving(f"mavlink+udpout://127.0.0.1:{port}?profile=ardupilot") as target:
            await converse(vehicle, target)
        assert target.dropped.total() == 0
        loop.remove_reader(receiver)


async def test_a_vehicle_on_a_serial_line():
    line = Pty()
    vehicle = Played(line.send)
    line.start(vehicle.on_data)
    async with serving(f"mavlink+serial:{line.path}@57600?profile=ardupilot") as target:
        while vehicle.received.empty():  # until the port is open
            target.on_second(0.0)
            await asyncio.sleep(0.01)
        await converse(vehicle, target)
    line.close()
