"""The gather at a real nats-server: nothing lost, nothing twice, numbers for good, and one gather at a time."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import time
from unittest.mock import Mock

import msgspec
import nats
import numpy as np
import pytest
from gathered_fixes import of_tag, payload
from msgspec.structs import replace
from nats.js.errors import NotFoundError

from skyless.core.errors import SkylessError
from skyless.page.gathered import Gathered
from skyless.page.live import LiveSite
from skyless.page.sites import LiveSites
from skyless.run.broker import BrokerSettings, nats_of, start_broker
from skyless.run.fix_batch import MAX_RECORDS, RECORD, Batch, decode_batch, encode_batch
from skyless.run.gather import streams as names_module
from skyless.run.gather import subjects
from skyless.run.gather.node import Gather, Summary
from skyless.run.gather.streams import Names, messages
from skyless.run.gather.subjects import NatsAddress, nats_address
from skyless.run.mqtt.address import MqttAddress, create_access, mqtt_address, read_access
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import StatusMessage, site_message
from skyless.run.mqtt.topics import fix_topic, status_topic
from skyless.sim.lab import lab_site
from support.processes import SKYLESS, started
from support.waiting import running, until

pytestmark = pytest.mark.site

SITE = 7
KEEP_BYTES = 5_000_000_000
"""More than half of what the broker may store, so that its stream fits once only."""


@contextlib.asynccontextmanager
async def broker(folder, **options):
    settings = BrokerSettings(data=folder / "store", gathered_bytes=KEEP_BYTES, **options)
    async with await start_broker(settings) as server:
        yield server


@contextlib.asynccontextmanager
async def gathering(address, site=SITE, keep_bytes=KEEP_BYTES):
    lines = []
    node = Gather(address, site, keep_bytes, lines.append)
    async with running(node.run()):
        yield node, lines


@contextlib.asynccontextmanager
async def client_of(address):
    client = await nats.connect(address.url, user=address.user, password=address.password)
    try:
        yield client
    finally:
        await client.close()


async def summaries(client):
    return await client.subscribe(subjects.at(subjects.SUMMARY, SITE))


async def serving(client):
    """Until a gather serves the site."""
    reading = await summaries(client)
    await reading.next_msg(20)
    await reading.unsubscribe()
    async with asyncio.timeout(20):
        while subjects.at(subjects.NAMES_STREAM, SITE) not in await stream_names(client):
            await asyncio.sleep(0.02)


async def stream_names(client):
    return [info.config.name for info in await client.jetstream().streams_info()]


async def publish(client, tag, x_m):
    level = tag.replace(".", "//")
    await client.publish(f"skyless.v1.{SITE}.tag.{level}.fix", payload(tag, x_m))


async def stored(address, count, after=-1):
    """The first rows of the stream: number, tag's number and x in mm."""
    found, last = [], max(after, 0) // MAX_RECORDS
    async with asyncio.timeout(20), client_of(address) as client:
        stream, names = client.jetstream(), Names(client.jetstream(), SITE)
        while len(found) < count:
            with contextlib.suppress(NotFoundError):  # no gather has made it yet
                async for message in messages(stream, subjects.at(subjects.FIX_STREAM, SITE), last):
                    last = message.metadata.sequence.stream
                    rows = enumerate(decode_batch(message.data).records, last * MAX_RECORDS)
                    found += [(number, int(row["tag"]), int(row["position_mm"][0])) for number, row in rows]
            await asyncio.sleep(0.02)
        await names.read()
        return found, {number: tag.name for number, tag in names.tags.items()}


async def test_fixes_of_mqtt_and_of_nats_are_in_the_stream_once_and_in_order_and_numbers_survive(tmp_path):
    async with broker(tmp_path) as server, client_of(server.nats) as client:
        async with gathering(server.nats):
            await serving(client)
            link = Link(server.address, "t", site=SITE, kind="tag")
            task = asyncio.ensure_future(link.run())
            for n in range(50):
                link.publish(fix_topic(SITE, f"t.{n % 5}"), of_tag(f"t.{n % 5}", n / 1000.0), qos=1)
            first, names = await stored(server.nats, 50)
            assert [x for _, _, x in first] == list(range(50))
            assert [names[tag] for _, tag, _ in first] == [f"t.{n % 5}" for n in range(50)]
            task.cancel()
        async with gathering(server.nats):  # a new process: nothing in memory
            await serving(client)
            for n in range(50, 60):
                await publish(client, f"t.{n % 7}", n / 1000.0)
            rows, again = await stored(server.nats, 60)
        assert [x for _, _, x in rows] == list(range(60))
        assert [again[tag] for _, tag, _ in rows[50:]] == [f"t.{n % 7}" for n in range(50, 60)]
        assert {number: again[number] for number in names} == names
        assert len(set(again.values())) == len(again) == 7
        numbers = [number for number, _, _ in rows]
        assert numbers == sorted(set(numbers))
        later, _ = await stored(server.nats, 60 - 50, after=rows[49][0])
        assert [x for _, _, x in later] == list(range(50, 60))


async def test_two_gathers_share_the_fixes_and_what_one_leaves_the_other_takes(tmp_path):
    """Each fix is in the stream once, under one number of its tag, whoever packed it and while one of them ends."""
    async with broker(tmp_path) as server, client_of(server.nats) as client, gathering(server.nats) as (first, _):
        async with gathering(server.nats) as (second, _):
            await until(lambda: first._names is not None and second._names is not None)
            for n in range(400):
                await publish(client, f"t{n % 40}", n / 1000.0)
            await client.flush()
            rows, names = await stored(server.nats, 400)
            assert first.summary.fixes > 0
            assert second.summary.fixes == 400 - first.summary.fixes > 0
            for n in range(400, 600):
                await publish(client, f"t{n % 40}", n / 1000.0)
            await client.flush()
        for n in range(600, 800):
            await publish(client, f"t{n % 40}", n / 1000.0)
        rows, names = await stored(server.nats, 800)
        assert sorted(x for _, _, x in rows) == list(range(800))
        assert all(names[tag] == f"t{x % 40}" for _, tag, x in rows)
        assert len(set(names.values())) == len(names) == 40
        async with gathering(server.nats, keep_bytes=10**6) as (third, _):
            await until(lambda: third._names is not None)
        info = await client.jetstream().stream_info(subjects.at(subjects.FIX_STREAM, SITE))
        assert info.config.max_bytes == 10**6


async def test_programs_that_give_numbers_at_once_give_each_once_and_duplicates_of_a_batch_are_dropped(tmp_path):
    async with broker(tmp_path) as server, client_of(server.nats) as client, gathering(server.nats):
        await serving(client)
        stream = client.jetstream()
        given = [Names(stream, SITE) for _ in range(3)]
        wanted = [("a", "b", "a"), ("c", "b", "d"), ("d", "e", "a")]
        gives = [names.give(tags, "elsewhere", 1.0) for names, tags in zip(given, wanted, strict=True)]
        await asyncio.gather(*gives)
        for names in given:
            await names.read()
            assert sorted(names.numbers) == sorted(tag.name for tag in names.tags.values()) == list("abcde")
            assert sorted(names.tags) == [1, 2, 3, 4, 5]
            assert (names.issue, names.numbers) == (5, given[0].numbers)
        records = np.zeros(3, RECORD)
        records["tag"], records["position_mm"][:, 0] = 1, (7, 8, 9)
        subject = subjects.at(subjects.FIXES, SITE, "elsewhere")
        for sequence in (1, 1, 2, 1):
            batch = Batch(5, sequence, 1, 1, records)
            await stream.publish(subject, encode_batch(batch), headers={"Nats-Msg-Id": batch.id})
        rows, _ = await stored(server.nats, 6)
        assert [x for _, _, x in rows] == [7, 8, 9] * 2
        info = await stream.stream_info(subjects.at(subjects.FIX_STREAM, SITE))
        assert info.config.max_bytes == KEEP_BYTES
        assert info.config.max_age == 24 * 3600


async def test_a_full_table_of_names_gives_no_more_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr(names_module, "MAX_NAMES", 2)
    async with broker(tmp_path) as server, client_of(server.nats) as client, gathering(server.nats) as (node, _):
        await serving(client)
        for n, tag in enumerate("abcab"):
            await publish(client, tag, n / 1000.0)
        rows, names = await stored(server.nats, 4)
        assert [x for _, _, x in rows] == [0, 1, 3, 4]
        assert names == {1: "a", 2: "b"}
        assert node.summary.drops == {"no-number": 1}


async def test_nothing_that_came_is_lost_when_the_server_was_away(tmp_path):
    """The broker is stopped by a signal while fixes wait, and the gather goes on with the same numbers afterwards."""
    async with broker(tmp_path) as server, client_of(server.nats) as client, gathering(server.nats) as (node, _):
        await serving(client)
        for n in range(5):
            await publish(client, "a", n / 1000.0)
        await stored(server.nats, 5)
        os.kill(server.pid, signal.SIGSTOP)
        for n in range(5, 9):
            node._packer.add("a", payload("a", n / 1000.0))
        await asyncio.sleep(0.5)
        os.kill(server.pid, signal.SIGCONT)
        rows, names = await stored(server.nats, 9)
        assert [x for _, _, x in rows] == list(range(9))
        assert names == {1: "a"}


async def test_the_site_is_found_and_its_programs_are_counted(tmp_path):
    opened = broker(tmp_path)
    async with opened as server, client_of(server.nats) as client, gathering(server.nats, None) as (node, _):
        reading = await summaries(client)

        async def tell(online, name):
            status = StatusMessage(online=online, kind="anchor", name=name)
            subject = status_topic(SITE, "anchor", name).replace("/", ".")
            await client.publish(subject, msgspec.json.encode(status))

        async with asyncio.timeout(20):
            while node.site is None:
                await tell(online=True, name="1")
                await asyncio.sleep(0.05)
            await reading.next_msg(20)
            for n in range(5):
                await tell(online=True, name=str(n))
            await tell(online=False, name="3")
            hall = site_message(replace(lab_site(100.0), name="hall"), simulated=True, unix_s=1.0)
            await client.publish(f"skyless.v1.{SITE}.site", msgspec.json.encode(hall))
            summary = node.summary
            while not summary.site or summary.online != {"anchor": 4}:
                summary = msgspec.json.decode((await reading.next_msg(20)).data, type=Summary)
        assert (node.site, summary.site, summary.simulated) == (SITE, "hall", True)


async def test_what_the_broker_had_kept_before_is_in_the_stream_of_the_state_and_newer_messages_stay(tmp_path):
    async with asyncio.timeout(60), broker(tmp_path) as server, client_of(server.nats) as client:
        link = Link(server.address, "1", site=SITE, kind="anchor")
        async with running(link.run()):
            for n in range(2):
                for topic in ("zones", "floor_plan/2"):
                    link.publish(f"skyless/v1/{SITE}/{topic}", f"{n}".encode(), qos=1, retain=True)
                await until(lambda: link.connected and not link.unacknowledged)
                node = Gather(server.nats, SITE, KEEP_BYTES, print, server.address)
                async with running(node.run()):
                    await until(lambda node=node: node.summary.online.get("anchor"))
                    stream = client.jetstream()
                    found, subjects_of_site = {}, ("zones", "floor_plan.2")
                    # Programs may be known as online before the messages that were kept have arrived.
                    while found != dict.fromkeys(subjects_of_site, f"{n}".encode()):
                        for subject in subjects_of_site:
                            with contextlib.suppress(NotFoundError):
                                kept = await stream.get_last_msg("STATE_7", f"skyless.v1.{SITE}.{subject}", direct=True)
                                found[subject] = kept.data


async def test_a_dashboard_reads_batches_and_names_with_the_role_of_a_page(tmp_path):
    create_access(tmp_path / "access", MqttAddress("127.0.0.1", 1))
    roles = read_access(tmp_path / "access")
    async with broker(tmp_path, roles=roles) as server, client_of(server.nats) as client:
        page = NatsAddress(server.nats.url, "page", roles["page"])
        gathered = Gathered(page)
        live = LiveSite("here", "mqtt://here:1")
        live.attach(Mock(), SITE)
        async with gathering(server.nats), running(gathered.run(LiveSites(live))), asyncio.timeout(20):
            await serving(client)
            while not gathered.columns(SITE).serial:
                await publish(client, "a", 1.5)
                await asyncio.sleep(0.05)
            newest, _ = gathered.columns(SITE).visible((0.0, 0.0, 9.0, 9.0), time.monotonic())
            assert newest["position_mm"][:, 0].tolist() == [1500]
            await until(lambda: live.table.fixed)
            assert [*live.table.fixed] == ["a"]
            assert gathered.columns(SITE).names == {1: "a"}
        async with client_of(page) as reading:
            with pytest.raises(TimeoutError):
                await reading.request("$JS.API.DIRECT.GET." + subjects.at(subjects.FIX_STREAM, SITE), timeout=0.5)


async def test_more_than_the_server_has_room_for_is_refused(tmp_path):
    async with broker(tmp_path) as server:
        with pytest.raises(SkylessError, match=r"--keep-gb is 1000; it should be less"):
            await Gather(server.nats, SITE, 10**12, print).run()


@pytest.mark.parametrize(
    "url",
    ["", "4222", "mqtt://a", "nats://", "nats://a:0", "nats://a:x", "nats://a/b", "nats://u:secret@",
     "nats://u:secret@a,", "nats://a,b/c"],
)  # fmt: skip
def test_a_wrong_address_is_named_without_its_password(url):
    with pytest.raises(SkylessError, match=r"--nats is .*; it should be nats://") as raised:
        nats_address(url)
    assert "secret" not in str(raised.value)


def test_an_address_lists_the_servers_of_a_hub_with_commas_and_may_leave_its_password_to_the_environment(monkeypatch):
    address = nats_address("tls://plant:secret@a,b:4223,[::1]:4224")
    assert address.servers == ["tls://a:4222", "tls://b:4223", "tls://[::1]:4224"]
    assert str(address) == "tls://plant@a:4222,b:4223,[::1]:4224"
    monkeypatch.setenv("SKYLESS_MQTT_PASSWORD", "from-there")
    assert (address.user, address.password) == ("plant", "secret")
    assert nats_address("nats://here") == NatsAddress("nats://here:4222")
    assert nats_address("tls://ann@[::1]:9") == NatsAddress("tls://[::1]:9", "ann", "from-there")
    assert nats_address("nats://ann:own@here") == NatsAddress("nats://here:4222", "ann", "own")


async def test_the_broker_runs_a_gather_and_states_its_address(tmp_path):
    options = ("--data", str(tmp_path / "store"), "--gather", "--site-id", str(SITE), "--json")
    with started(*SKYLESS, "broker", *options, stderr=None) as process:
        stated = msgspec.json.decode(process.stdout.readline())
        address = NatsAddress(stated["nats"])
        mqtt = mqtt_address(stated["mqtt"])
        assert nats_of(mqtt) == address
        assert nats_of(replace(mqtt, port=1)) is None
        async with client_of(address) as client:
            await serving(client)
            await publish(client, "a", 0.0)
            rows, names = await stored(address, 1)
            assert rows == [(MAX_RECORDS, 1, 0)]
            assert names == {1: "a"}
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0


@pytest.mark.parametrize("modules", ["cli.nodes.broker, skyless.run.broker", "cli.dashboard, skyless.page.app"])
def test_without_a_gather_nothing_of_nats_is_loaded(modules):
    heavy = "{'nats', 'duckdb', 'pyarrow'} & {name.partition('.')[0] for name in sys.modules}"
    program = f"import sys, skyless, skyless.{modules}\nassert not {heavy}"
    subprocess.run([sys.executable, "-c", program], check=True)
