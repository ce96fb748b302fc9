"""Programs on the loop whose time is the timeline's, and programs that take simulated time."""

import asyncio
import os
import time
import tty

import pytest
from emulator.site.host_programs import Process
from emulator.site.virtual_time import UNIX_S, run_on, wake

from skyless.core.ticks import TICK_S, from_seconds, to_seconds
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


def test_bytes_reach_a_program_at_their_instant_and_what_it_writes_is_there_at_once():
    async def program(timeline):
        inner, outer = os.openpty()
        tty.setraw(outer)
        came, sent, loop = [], [], asyncio.get_running_loop()

        def write(into, number):
            os.write(into, bytes([number]))
            sent.append((bytes([number]), timeline.now_ticks))
            wake(timeline)

        for end in (inner, outer):
            loop.add_reader(end, lambda end=end: came.append((os.read(end, 100), timeline.now_ticks)))
        for ms in range(1, 100):
            timeline.at(from_seconds(1e-3 * ms), lambda ms=ms: write(inner, ms))
        await asyncio.sleep(0.2)
        for number in range(100, 200):
            write(outer, number)
            await asyncio.sleep(1e-3)
        for end in (inner, outer):
            loop.remove_reader(end)
            os.close(end)
        return came, sent

    came, sent = play(program)
    assert came == sent
    assert came[:99] == [(bytes([ms]), from_seconds(1e-3 * ms)) for ms in range(1, 100)]


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


def test_programs_take_turns_in_the_order_of_true_time():
    timeline, said = Timeline(), []

    def program(name, step_s):
        def run():
            for number in range(3):
                processes[name].sleep(step_s)
                said.append((round(to_seconds(timeline.now_ticks), 6), name, number))

        return run

    processes = {name: Process(timeline, program(name, step_s)) for name, step_s in (("a", 0.2), ("b", 0.3))}
    assert list(timeline.run(from_seconds(10.0))) == []
    assert said == [(0.2, "a", 0), (0.3, "b", 0), (0.4, "a", 1), (0.6, "b", 1), (0.6, "a", 2), (0.9, "b", 2)]
    for process in processes.values():
        process.close()


def test_a_program_waits_until_it_is_notified_or_its_time_is_over_and_forgets_nothing():
    timeline, woken = Timeline(), []

    def run():
        for _ in range(4):
            process.wait(1.0)
            woken.append(round(to_seconds(timeline.now_ticks), 6))
            if len(woken) == 2:
                process.sleep(0.5)

    process = Process(timeline, run)
    for at_s in (0.25, 1.5, 1.6):  # the last two while it sleeps: they count once
        timeline.at(from_seconds(at_s), process.notify)
    list(timeline.run(from_seconds(10.0)))
    assert woken == [0.25, 1.25, 1.75, 2.75]
    process.close()


def test_what_a_program_raises_reaches_whoever_runs_the_world_and_a_closed_one_ends_where_it_stands():
    timeline, ended = Timeline(), []

    def broken():
        raise KeyError("broken")

    def endless():
        try:
            while True:
                process.sleep(0.1)
        finally:
            ended.append(timeline.now_ticks)

    process = Process(timeline, endless)
    list(timeline.run(from_seconds(1.05)))
    process.close()
    assert len(ended) == 1
    Process(timeline, broken)
    with pytest.raises(KeyError, match="broken"):
        list(timeline.run(from_seconds(2.0)))
