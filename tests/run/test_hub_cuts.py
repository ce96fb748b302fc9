"""A whole hub of three servers, a site and a history, while servers end and lines are cut: nothing is missing."""

import asyncio
import contextlib
import signal
from urllib.request import urlopen

import pytest

from skyless.run.history.program import HubHistory
from skyless.run.history.writer import Keep
from skyless.run.hub_files import MONITOR_PORT
from support.hub_stage import RECORDS, Stage, at_random
from support.processes import free_node_port, free_port

pytestmark = pytest.mark.statistical


def node_ports():
    return [free_node_port() for _ in range(3)]


async def test_every_fix_is_in_the_history_once_after_kills_and_cuts(tmp_path):
    async with Stage(tmp_path, node_ports(), free_port()) as stage:
        assert await at_random(stage, seed=1, actions=8)


async def until_healthy(port):
    """Wait as docs/hub_operation.md says: until a server has all of its streams again."""
    while True:
        with contextlib.suppress(OSError):
            await asyncio.to_thread(urlopen, f"http://127.0.0.1:{port + MONITOR_PORT}/healthz")
            return
        await asyncio.sleep(0.2)


async def test_servers_are_upgraded_one_after_the_other_and_the_history_has_all(tmp_path):
    ports = node_ports()
    async with Stage(tmp_path, ports, free_port()) as stage:
        history = HubHistory(tmp_path / "history", stage.address, None, Keep(), print)
        keeping = asyncio.ensure_future(history.run())
        async with asyncio.timeout(300):
            for port, server in zip(ports, stage.servers, strict=True):
                await until_healthy(port)
                server.kill(signal.SIGTERM)
                server.start()
                await until_healthy(port)
            await stage.stop_sending()
            while (state := history.state()).fixes < stage.acknowledged * RECORDS:
                await asyncio.sleep(0.2)
        found = await stage.sequences()
        keeping.cancel()
        await asyncio.gather(keeping, return_exceptions=True)
    assert found == list(range(1, stage.acknowledged + 1))
    assert (state.fixes, state.drops) == (stage.acknowledged * RECORDS, {})
