"""Programs on the loop whose time is the timeline's."""

import asyncio
import os
import time
import tty

import pytest
from emulator.site.virtual_time import UNIX_S, run_on, wake

from skyless.core.ticks import TICK_S, from_seconds
from skyless.sim.medium import Timeline


def play(program):
    """Run what a function makes of a new timeline."""
    timeline = Timeline()
    return run_on(timeline, program(timeline))


def test_an_hour_of_sleep_ends_at_its_time_and_every_clock_shows_it():
    async def program(timeline):
        await asyncio.sleep(3600.0)
        loop_s, host_s = asyncio.get_running_loop().time(), time.monotonic()
        return timeline.now_ticks * TICK_S, loop_s, host_s, time.monotonic_ns(), time.time() - UNIX_S

    now_s, loop_s, host_s, host_ns, unix_s = play(program)
    assert now_s == pytest.approx(3600.0, abs=1e-10)
    assert loop_s == host_s == now_s
    assert host_ns == pytest.approx(now_s * 1e9, abs=1)
    assert unix_s == pytest.approx(now_s, abs=1e-6)


def test_the_real_clocks_are_back_afterwards_even_after_an_error():
    async def program(_):
        raise KeyError

    clocks = time.monotonic, time.time
    with pytest.raises(KeyError):
        play(program)
    assert (time.monotonic, time.time) == clocks


def test_events_and_timers_come_in_the_order_of_time():
    async def program(timeline):
        order = []
        for ms in (5, 1, 3):
            timeline.at(from_seconds(1e-3 * ms), lambda ms=ms: order.append(ms))
        for ms in (4, 2, 0):
            asyncio.get_running_loop().call_later(1e-3 * ms, order.append, ms)
        await asyncio.sleep(6e-3)
        return order

    assert play(program) == [0, 1, 2, 3, 4, 5]


def test_bytes_for_a_program_reach_it_at_their_instant_and_not_at_its_next_timer():
    async def program(timeline):
        inner, outer = os.openpty()
        tty.setraw(outer)
        came = []
        loop = asyncio.get_running_loop()
        loop.add_reader(outer, lambda: came.append((os.read(outer, 100), timeline.now_ticks)))

        def send(ms):
            os.write(inner, bytes([ms]))
            wake(timeline)

        for ms in range(1, 200):
            timeline.at(from_seconds(1e-3 * ms), lambda ms=ms: send(ms))
        await asyncio.sleep(0.5)
        loop.remove_reader(outer)
        os.close(inner)
        os.close(outer)
        return came

    assert play(program) == [(bytes([ms]), from_seconds(1e-3 * ms)) for ms in range(1, 200)]


def test_what_a_program_writes_is_there_at_once():
    async def program(timeline):
        inner, outer = os.openpty()
        tty.setraw(outer)
        came = []
        loop = asyncio.get_running_loop()
        loop.add_reader(inner, lambda: came.append((os.read(inner, 100), timeline.now_ticks)))
        wrote = []
        for number in range(100):
            os.write(outer, bytes([number]))
            wrote.append((bytes([number]), timeline.now_ticks))
            await asyncio.sleep(1e-3)
        loop.remove_reader(inner)
        os.close(inner)
        os.close(outer)
        return came, wrote

    came, wrote = play(program)
    assert came == wrote


def test_a_wait_without_a_limit_ends_with_the_event_that_ends_it():
    async def program(timeline):
        done = asyncio.get_running_loop().create_future()

        def finish():
            done.set_result(timeline.now_ticks)
            return True

        timeline.at(1000, lambda: None)
        timeline.at(from_seconds(7.0), finish)
        return await done

    assert play(program) == from_seconds(7.0)


def test_programs_that_wait_for_nothing_are_an_error_and_no_standstill():
    async def program(_):
        await asyncio.get_running_loop().create_future()

    with pytest.raises(RuntimeError, match="never happen"):
        play(program)


def test_work_for_threads_is_done_here_and_takes_no_time():
    async def program(timeline):
        value = await asyncio.to_thread(lambda: 7)
        with pytest.raises(ZeroDivisionError):
            await asyncio.to_thread(lambda: 1 / 0)
        return value, timeline.now_ticks

    assert play(program) == (7, 0)
