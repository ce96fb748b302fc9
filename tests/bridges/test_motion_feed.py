"""Motion of a robot or vehicle as a tag receives it: lines of JSON, and MAVLink as pymavlink writes it."""

import asyncio
import json
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from skyless.bridges.motion_feed import MotionFeed
from skyless.core.errors import SkylessError
from support.processes import free_port
from support.waiting import running, until

pytestmark = pytest.mark.site


def feed(address="jsonl+tcp://127.0.0.1:7480", clock=time.monotonic):
    samples = []
    return MotionFeed(address, samples.append, clock), samples


def test_lines_become_samples_on_the_hosts_clock():
    motion, samples = feed("jsonl+tcp://:7480?arm=0.1,0,0.2")
    imu = {"t_s": time.time() - 0.5, "rate_rps": [0.1, 0.2, 0.3], "force_mps2": [0, 0, 9.8]}
    motion.feed_line(json.dumps({"imu": imu}).encode())
    motion.feed_line(b'{"wheels": {"speed_mps": 1.5, "rate_rps": -0.2}}\n')
    first, second = samples
    assert abs(time.monotonic() - 0.5 - first.time_s) < 0.2
    assert (first.rate_rps, first.force_mps2, first.arm_m) == ((0.1, 0.2, 0.3), (0.0, 0.0, 9.8), (0.1, 0.0, 0.2))
    assert (second.rate_rps, second.speed_mps, second.force_mps2) == ((0.0, 0.0, -0.2), 1.5, None)


@given(st.one_of(st.binary(max_size=80), st.from_regex(rb'\{"imu": \{"rate_rps": [-0-9,eE.na]{0,9}', fullmatch=True)))
def test_lines_that_nobody_should_send_are_counted(line):
    motion, samples = feed()
    motion.feed_line(line)
    assert samples == []
    assert motion.counters.total() <= 1


def test_numbers_that_are_not_finite_are_counted():
    motion, samples = feed()
    motion.feed_line(b'{"wheels": {"speed_mps": 1e400, "rate_rps": 0}}')
    assert samples == []
    assert motion.counters.total() == 1


def test_mavlink_turns_into_forward_left_up():
    """As pymavlink writes it, with times since the vehicle's start and latencies of up to 40 ms."""
    now = [1000.0]
    motion, samples = feed("mavlink+udp://127.0.0.1:14551", lambda: now[0])
    writer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for number in range(50):
        time_s, now[0] = 0.02 * number, 1000.0 + 0.02 * number + 0.04 * (number % 5 > 0)
        message = mavlink.MAVLink_highres_imu_message(
            round(5e6 + 1e6 * time_s), 1.0, 2.0, -9.8, 0.1, 0.2, 0.3, 0, 0, 0, 0, 0, 0, 0, 63
        )
        motion.feed_mavlink(message.pack(writer))
        assert abs(samples[-1].time_s - 1000.0 - time_s) < 1e-3
    assert samples[0].force_mps2 == pytest.approx((1.0, -2.0, 9.8), rel=1e-6)
    assert samples[0].rate_rps == pytest.approx((0.1, -0.2, -0.3), rel=1e-6)


@pytest.mark.parametrize("address", ["tcp://:1", "jsonl+tcp://:7480?arm=1,2", "mavlink+udp://:7480/path"])
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(SkylessError, match="should be"):
        feed(address)


async def test_a_program_connects_and_goes_and_another_comes():
    motion, samples = feed(f"jsonl+tcp://127.0.0.1:{free_port()}")
    async with running(motion.run()):
        await until(lambda: motion.server is not None)
        for _ in range(2):
            _, writer = await asyncio.open_connection("127.0.0.1", motion.port)
            writer.write(b'{"wheels": {"speed_mps": 1.5, "rate_rps": 0}}\n' * 3)
            await writer.drain()
            writer.close()
        await until(lambda: len(samples) == 6)
