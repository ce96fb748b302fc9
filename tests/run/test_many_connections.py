"""The ether with more connections than select() can watch, and with one more than there is room for."""

import asyncio
import contextlib
import resource
import selectors
import socket
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st
from node_stage import LAB

from skyless.radio.emulated import ClockShift, Join, Joined, Refused, Unpacker, from_ether, pack
from skyless.run import process
from skyless.run.ether import Ether
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.trajectory import Static
from support import waiting

pytestmark = pytest.mark.site

until = partial(waiting.until, limit_s=60.0)

MANY = 1150
HOST = "127.0.0.1"


def in_program_loop(main):
    with asyncio.Runner(loop_factory=process._new_loop) as runner:
        runner.run(main)


@contextlib.asynccontextmanager
async def air(most=None):
    """An ether, the port where it listens, and what it logs."""
    logged = []
    ether = Ether(LAB, {"tag1": Static(2.0, 3.0)}, impairments_of(Request(LAB), LAB), 1, most_connections=most)
    async with await ether.serve(HOST, 0, logged.append) as server:
        yield ether, server.sockets[0].getsockname()[1], logged


async def answer(port, *, joins=True):
    """What the ether answers to a tag that joins; the connection stays open."""
    reader, writer = await asyncio.open_connection(HOST, port)
    if joins:
        writer.write(pack(Join("tag", ("tag1",))))
    async with asyncio.timeout(60):
        data = await reader.read(65_536)
    (body, *_) = Unpacker().feed(data)
    return from_ether.decode(body), writer


def test_beyond_a_thousand_connections_processes_are_served_as_before():
    if process.most_files() < 2 * MANY + 300:
        pytest.skip("the system lets a process have too few files")

    async def main():
        async with air() as (ether, port, logged):
            with contextlib.ExitStack() as idle:
                for _ in range(MANY):
                    one = idle.enter_context(socket.socket())
                    one.setblocking(False)
                    await asyncio.get_running_loop().sock_connect(one, (HOST, port))
                await until(lambda: ether.connections == MANY)
                message, writer = await answer(port)
                assert isinstance(message, Joined)
                writer.close()
            await until(lambda: not ether.connections)
            assert logged == []
            ether._timer.cancel()

    in_program_loop(main())


async def test_when_no_connection_is_left_others_are_refused_with_the_reason_and_those_that_stand_go_on():
    async with air(most=2) as (ether, port, logged):
        message, first = await answer(port)
        assert isinstance(message, Joined)
        _, idle = await asyncio.open_connection(HOST, port)
        await until(lambda: ether.connections == 2)
        for _ in range(3):
            message, writer = await answer(port, joins=False)
            assert message == Refused("all 2 connections of the ether are in use")
            writer.close()
        assert logged == ["all 2 connections are in use (limit: ulimit -n); others are refused, these go on"]
        assert len(ether._owners) == 1
        idle.close()
        await until(lambda: ether.connections == 1)
        first.close()
        await until(lambda: not ether.connections)
        message, again = await answer(port)  # there is room again
        assert isinstance(message, Joined)
        again.close()
        await until(lambda: not ether.connections)
        ether._timer.cancel()


def test_a_program_asks_for_as_many_files_as_it_may_have_and_not_for_billions(monkeypatch):
    limits = [(1024, resource.RLIM_INFINITY)]
    monkeypatch.setattr(process.resource, "getrlimit", lambda _: limits[-1])
    monkeypatch.setattr(process.resource, "setrlimit", lambda _, asked: limits.append(asked))
    assert process.most_files() == 65_536
    for soft, hard, most in ((1024, 4096, 4096), (256, 1_000_000_000, 65_536), (100_000, 1_000_000, 100_000)):
        limits[:] = [(soft, hard)]
        assert process.most_files() == most
        assert limits[-1] == (most, hard)
    limits[:] = [(1024, 4096)]
    monkeypatch.setattr(process.resource, "setrlimit", refuse)
    assert process.most_files() == 1024


def refuse(*_):
    raise ValueError


@pytest.mark.skipif(not hasattr(selectors, "EpollSelector"), reason="Linux only")
def test_the_loop_of_programs_finds_what_is_ready_and_waits_no_longer_than_asked():
    one, other = socket.socketpair()
    with process.PunctualSelector() as selector, one, other:
        selector.register(one, selectors.EVENT_READ)
        assert selector.select(0) == selector.select(-1.0) == selector.select(0.01) == []
        other.send(b"x")
        for timeout in (0, 60.0, None):
            ((key, events),) = selector.select(timeout)
            assert (key.fileobj, events) == (one, selectors.EVENT_READ)


@given(st.floats(-1e6, 1e6), st.floats(-2e-4, 2e-4), st.randoms())
def test_another_machine_s_clock_is_followed_by_its_quickest_messages(shift_s, drift, draw):
    """Every fifth message is quick; the shift is that of a message of the last half minute."""
    delays_s = [0.001 if number % 5 == 0 else draw.uniform(0.001, 0.5) for number in range(200)]
    followed = None
    for number, delay_s in enumerate(delays_s):
        sent_s = 0.5 * number
        now_s = sent_s * (1.0 + drift) + shift_s + delay_s
        if followed is None:
            followed = ClockShift(now_s - sent_s)
        else:
            followed.note(sent_s, now_s)
        error_s = followed.shift_s - (shift_s + drift * sent_s)
        assert -1e-6 - 35.0 * abs(drift) <= error_s <= 0.001 + 1e-6 + 35.0 * abs(drift)
