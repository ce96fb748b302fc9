"""Which sites a broker carries: those whose programs are online are found, and of several a command names each."""

import asyncio
import contextlib
import json
import subprocess

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.errors import SkylessError
from skyless.run.find_site import KnownSites, find_site, watch_sites
from skyless.run.mqtt.connection import Introduction, open_connection
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import SiteMessage, StatusMessage
from skyless.run.mqtt.topics import site_topic, status_topic
from skyless.sim.lab import lab_site
from support.mqtt_brokers import Embedded
from support.processes import SKYLESS, free_port
from support.waiting import running, until

pytestmark = pytest.mark.site


def site_message(number, name):
    site = msgspec.structs.replace(lab_site(), id=number, name=name)
    return site_topic(number), msgspec.json.encode(SiteMessage(site, simulated=True, unix_s=0.0))


def status(number, kind, name, *, online):
    return status_topic(number, kind, name), msgspec.json.encode(StatusMessage(online, kind, name))


async def publish(address, *messages):
    """Leave retained messages behind, as programs that have ended do."""
    connection = await open_connection(address, None, Introduction("", 60))
    for topic, payload in messages:
        connection.publish(topic, payload, 1, retain=True)
    await connection.leave()


@contextlib.asynccontextmanager
async def alive(address, number, name):
    """The emulated air of a site, online."""
    link = Link(address, "air", site=number, kind="ether")
    link.publish(*site_message(number, name), qos=1, retain=True)
    async with running(link.run()):
        await until(lambda: link.connected and not link.unacknowledged)
        yield


async def alive_at_the_broker(address, *numbers):
    """Wait until a new subscriber is given these sites: the broker retains a message after it has acknowledged it."""
    found = asyncio.Event()

    def on_sites(sites):
        if [site.number for site in sites if site.online] == [*numbers]:
            found.set()

    while not found.is_set():
        async with running(watch_sites(address, on_sites)):
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(found.wait(), 2.0)


async def test_a_site_of_which_nothing_is_online_is_not_chosen_though_its_number_is_lower(tmp_path, caplog):
    broker = Embedded(tmp_path)
    await broker.start()
    gone = status(1, "anchor", "1", online=False)
    await publish(broker.address, site_message(1, "lab"), gone, status(1, "dashboard", "x", online=True))
    searching = asyncio.create_task(find_site(broker.address))
    await until(lambda: "site 1 'lab' was here, but none of its programs is online" in caplog.text)
    assert not searching.done()
    async with alive(broker.address, 5, "hall"):
        assert await asyncio.wait_for(searching, 20.0) == 5
        assert await asyncio.wait_for(find_site(broker.address), 20.0) == 5
        await publish(broker.address, status(1, "anchor", "1", online=True))
        await alive_at_the_broker(broker.address, 1, 5)
        with pytest.raises(SkylessError, match="--site-id should name one of them"):
            async with asyncio.timeout(60.0):
                while await find_site(broker.address) == 5:  # a busy broker may send the rest too late to be waited for
                    pass
    await broker.stop()


@pytest.mark.statistical
async def test_commands_name_the_sites_that_are_alive_and_ask_for_one(tmp_path):
    broker = Embedded(tmp_path)
    await broker.start()
    async with alive(broker.address, 1, "lab"), alive(broker.address, 5, "hall"):
        await alive_at_the_broker(broker.address, 1, 5)
        address = str(broker.address)
        recording = tmp_path / "walk.mcap"
        await asyncio.gather(
            *(
                asyncio.to_thread(asks_for_the_site, *arguments, "--mqtt", address)
                for arguments in (
                    ("record", str(recording)),
                    ("bridge", f"jsonl+tcp://127.0.0.1:{free_port()}"),
                    ("survey",),
                )
            )
        )
        assert not recording.exists()
    await broker.stop()


def asks_for_the_site(*arguments):
    ended = subprocess.run([*SKYLESS, *arguments], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 2, ended.stderr
    line = ended.stderr.strip().splitlines()[-1]
    assert "number 1, 'lab', 1 program online; number 5, 'hall', 1 program online); --site-id should" in line


_MESSAGES = st.one_of(
    st.builds(site_message, st.integers(0, 3), st.sampled_from(["lab", "hall"])),
    st.builds(lambda n: (site_topic(n), b""), st.integers(0, 3)),
    st.builds(
        lambda n, kind, name, online: status(n, kind, name, online=online),
        st.integers(0, 3),
        st.sampled_from(["anchor", "tag", "ether"]),
        st.sampled_from("123"),
        st.booleans(),
    ),
    st.builds(lambda n, name: (status_topic(n, "tag", name), b""), st.integers(0, 3), st.sampled_from("123")),
)


@given(st.lists(_MESSAGES, max_size=30))
def test_the_last_message_of_each_topic_says_what_is_so(messages):
    known = KnownSites()
    for topic, payload in messages:
        known.add(topic, payload)
        known.add("skyless/v1/2/site", b'{"site": 7}')  # not readable, so nothing
    last = dict(messages)
    sites = {
        topic: json.loads(payload)["site"] for topic, payload in last.items() if payload and topic.endswith("/site")
    }
    online = [topic.split("/")[2] for topic, payload in last.items() if b'"online":true' in payload]
    assert [(site.number, site.name, site.online) for site in known.sites()] == sorted(
        (site["id"], site["name"], online.count(str(site["id"]))) for site in sites.values()
    )
