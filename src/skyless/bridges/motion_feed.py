"""What a robot or a vehicle tells a tag of its motion: lines of JSON by TCP, or MAVLink by UDP.

A line is ``{"imu": {"t_s": …, "rate_rps": [x, y, z], "force_mps2": [x, y, z]}}`` or ``{"wheels": {"t_s": …,
"speed_mps": …, "rate_rps": …}}``, in a frame with x forward, y to the left and z up. ``t_s`` is Unix time; without it
a line counts as of its arrival. Of MAVLink, HIGHRES_IMU is used, which has all that ATTITUDE has but for the angles,
which the filter finds itself; its time since the vehicle's start is put on this computer's clock by the shortest
latency.
"""

import asyncio
import time
from asyncio import StreamReader, StreamWriter
from collections import Counter
from collections.abc import Callable
from typing import Final, cast

import msgspec
from msgspec import Struct

from skyless.bridges.mavlink import CRC_EXTRAS, HIGHRES_IMU, FrameReader, decoded
from skyless.bridges.target import TargetUrl
from skyless.core.errors import SkylessError
from skyless.core.motion_sample import MotionSample, ShortestLatency

PORT: Final = 7011
MAVLINK_PORT: Final = 14_551

_OTHER_TIME_S: Final = 5.0
"""Samples farther from the present are of a clock that is not set, or simulated."""

OnSample = Callable[[MotionSample], None]


class _Imu(Struct):
    rate_rps: tuple[float, float, float]
    force_mps2: tuple[float, float, float]
    t_s: float | None = None


class _Wheels(Struct):
    speed_mps: float
    rate_rps: float
    t_s: float | None = None


class _Line(Struct):
    imu: _Imu | None = None
    wheels: _Wheels | None = None


class MotionFeed:
    """Receives the samples of one vehicle."""

    def __init__(self, address: str, on_sample: OnSample, clock: Callable[[], float] = time.monotonic) -> None:
        """``address``: jsonl+tcp://HOST:PORT or mavlink+udp://HOST:PORT, with ?arm=x,y,z for the antenna's position.

        ``clock``: the host's monotonic clock, as in ``host_s`` of receptions.

        Raises SkylessError: the address is none of these.
        """
        url = TargetUrl(address)
        if url.scheme not in {"jsonl+tcp", "mavlink+udp"}:
            raise url.wrong("jsonl+tcp://HOST:PORT or mavlink+udp://HOST:PORT, where this computer waits for samples")
        self._is_mavlink = url.scheme == "mavlink+udp"
        self._host, self.port = url.host("127.0.0.1"), url.port(MAVLINK_PORT if self._is_mavlink else PORT)
        self.address = f"{self._host}:{self.port}"
        try:
            x, y, z = map(float, url.text_option("arm", "0,0,0").split(","))
        except ValueError:
            raise url.wrong("with arm=x,y,z in metres: the antenna seen from the sensor") from None
        url.check_all_read()
        self._arm_m, self._on_sample, self._clock = (x, y, z), on_sample, clock
        self._frames = FrameReader({HIGHRES_IMU: CRC_EXTRAS[HIGHRES_IMU]})
        self._vehicle = ShortestLatency()
        self._writer: StreamWriter | None = None
        self.server: asyncio.Server | None = None
        """What accepts connections, once it does."""
        self.counters: Counter[str] = Counter()
        """What could not be used, by reason."""

    async def run(self) -> None:
        """Receive until cancelled. Raises SkylessError if it cannot listen there."""
        transport: asyncio.BaseTransport | None = None
        try:
            if self._is_mavlink:
                loop = asyncio.get_running_loop()
                transport, _ = await loop.create_datagram_endpoint(
                    lambda: _Datagrams(self.feed_mavlink), (self._host, self.port)
                )
            else:
                self.server = await asyncio.start_server(self._serve, self._host, self.port, limit=1 << 12)
        except (OSError, UnicodeError) as error:
            raise SkylessError(f"--motion cannot listen on {self._host}:{self.port}: {error}") from None
        try:
            await asyncio.Event().wait()
        finally:
            if transport is not None:
                transport.close()
            if self.server is not None:
                self.server.close()
            self._end_connection()

    def _end_connection(self) -> None:
        if self._writer is not None:
            self._writer.transport.abort()

    async def _serve(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Read one connection, which ends the one before it."""
        self._end_connection()
        self._writer = writer
        try:
            while line := await reader.readline():
                self.feed_line(line)
        except (OSError, ValueError):  # it broke, or a line was too long
            self.counters["motion-connection-ended"] += 1
        finally:
            writer.close()

    def feed_line(self, line: bytes) -> None:
        """Process a line of JSON."""
        try:
            found = msgspec.json.decode(line, type=_Line)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            self.counters["motion-malformed"] += 1
            return
        if (imu := found.imu) is not None:
            self._pass(MotionSample(self._host_s(imu.t_s), imu.rate_rps, imu.force_mps2, arm_m=self._arm_m))
        if (wheels := found.wheels) is not None:
            turning = 0.0, 0.0, wheels.rate_rps
            self._pass(MotionSample(self._host_s(wheels.t_s), turning, None, wheels.speed_mps, self._arm_m))

    def feed_mavlink(self, data: bytes) -> None:
        """Process a datagram of frames."""
        for frame in self._frames.frames(data):
            when_us, x, y, z, p, q, r = cast(tuple[float, ...], decoded(frame))  # forward, right, down
            time_s = when_us * 1e-6 - self._vehicle.ahead_s(self._clock(), when_us * 1e-6)
            self._pass(MotionSample(time_s, (p, -q, -r), (x, -y, -z), arm_m=self._arm_m))

    def _host_s(self, unix_s: float | None) -> float:
        """A time on the host's clock; without one the present."""
        return self._clock() if unix_s is None else unix_s - time.time() + self._clock()

    def _pass(self, sample: MotionSample) -> None:
        """Pass on a sample if it is possible and of now."""
        try:
            sample.check()
        except ValueError:
            self.counters["motion-impossible"] += 1
            return
        if abs(sample.time_s - self._clock()) > _OTHER_TIME_S:
            self.counters["motion-of-another-time"] += 1
            return
        self._on_sample(sample)


class _Datagrams(asyncio.DatagramProtocol):
    def __init__(self, on_data: Callable[[bytes], None]) -> None:
        self._on_data = on_data

    def datagram_received(self, data: bytes, _address: object) -> None:
        self._on_data(data)
