"""A whole hub of three servers and a site, with its history, while servers end and lines are cut: nothing is missing."""

import asyncio
import signal

import pytest
from hub_cuts import Stage, at_random

from skyless.run.hub.files import CLUSTER_PORT, LEAF_PORT, MONITOR_PORT
from support.processes import free_port, is_free_port

pytestmark = pytest.mark.statistical


def node_ports():
    """Three ports of nodes, each with those that belong to it."""
    found = []
    while len(found) < 3:
        port = free_port()
        others = [port + added for added in (CLUSTER_PORT, LEAF_PORT, MONITOR_PORT)]
        if port + MONITOR_PORT < 32768 and all(map(is_free_port, others)):
            found.append(port)
    return found


def test_every_fix_is_in_the_history_once_after_kills_and_cuts(tmp_path):
    async def run():
        async with Stage(tmp_path, node_ports(), free_port()) as stage:
            return await at_random(stage, seed=1, actions=8)

    assert asyncio.run(run())


def test_servers_are_upgraded_one_after_the_other(tmp_path):
    async def run():
        async with Stage(tmp_path, node_ports(), free_port()) as stage:
            for server in stage.servers:
                server.kill(signal.SIGTERM)
                server.start()
                before = stage.acknowledged
                assert await stage.complete() < float("inf")
                assert stage.acknowledged > before
            return await stage.sequences(), stage.acknowledged

    found, sent = asyncio.run(run())
    assert found == list(range(1, len(found) + 1))
    assert len(found) <= sent
