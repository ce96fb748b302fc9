"""A hub of one server on loopback, and sites there: the server is real, a site's gather runs in the test."""

import asyncio
import contextlib

import nats

from skyless.cli.main import main
from skyless.run.broker import BrokerSettings, _program, start_broker
from skyless.run.gather.node import Gather
from skyless.run.gather.subjects import EVENT_STREAM, at
from skyless.run.hub_files import Hub, read_json
from support.processes import free_node_port, free_port, started
from support.waiting import running


@contextlib.contextmanager
def running_hub(folder, fixes_gb=0.1):
    port = free_node_port()
    for words in (("--sites", "7,8"), ("--sites", "7", "--tenant", "other")):
        node = ("--node", f"127.0.0.1:{port}", "--data", str(folder / "data"), "--fixes-gb", str(fixes_gb))
        assert main(["hub", "init", str(folder / "hub"), *node, *words]) == 0
    with started(_program(), "-c", folder / "hub" / f"127.0.0.1-{port}" / "nats-server.conf", limit_s=300) as server:
        yield read_json(folder / "hub" / "hub.json", Hub), server


async def client_of(address):
    return await nats.connect(address.servers, user=address.user, password=address.password)


async def has_stream(client, name):
    with contextlib.suppress(nats.errors.Error):
        return await client.jetstream().stream_info(name) is not None
    return False


@contextlib.asynccontextmanager
async def site(folder, leaf, keep_bytes=10**8):
    """The broker of a site with its gather, whose streams are there."""
    place = folder / f"{leaf.tenant}{leaf.site}"
    settings = BrokerSettings(port=free_port(), data=place, gathered_bytes=keep_bytes, hub=leaf)
    async with await start_broker(settings) as broker, running(Gather(broker.nats, leaf.site, keep_bytes, print).run()):
        client = await client_of(broker.nats)
        async with asyncio.timeout(30):
            while not await has_stream(client, at(EVENT_STREAM, leaf.site)):
                await asyncio.sleep(0.05)
        await client.close()
        yield broker
