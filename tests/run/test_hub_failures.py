"""Cut lines, full stores, clocks and versions that differ: what is lost is counted, and the rest is there once."""

import asyncio
import signal
import subprocess
import time
from collections import Counter
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from pyarrow import parquet

from skyless.cli.main import main
from skyless.run.broker import _program
from skyless.run.fix_batch import RECORD, Batch, encode_batch
from skyless.run.gather import subjects
from skyless.run.gather.node import Summary
from skyless.run.gather.streams import Names
from skyless.run.gather.subjects import NatsAddress, connect, rarely
from skyless.run.history.layout import current_files, day_of
from skyless.run.history.program import HubHistory
from skyless.run.history.writer import Keep
from skyless.run.hub import HubSites, make_streams_of
from skyless.run.hub_files import LEAF_PORT
from skyless.run.mqtt.address import mqtt_address
from skyless.run.mqtt.connection import check_broker
from support.hub_stage import Line
from support.processes import SKYLESS, free_node_port, free_port, started
from support.small_hub import client_of, running_hub, site
from support.waiting import running

SITE, ROWS, RUN = 7, 20, 5
FIX_STREAM = subjects.at(subjects.FIX_STREAM, SITE)
FULL_BYTES = 300_000
"""A stream that is full after some 250 batches."""
FEW, MANY = 20, 600
LIMIT_S = 120.0


class Stage:
    """A site, a hub and its history, with lines between them that can be cut, and a sender of numbered batches."""

    def __init__(self, folder, hub):
        self.folder, self.hub, self.sent, self.said = folder, hub, 0, []
        self.to_hub, self.to_history = Line(hub.nodes[0].port + LEAF_PORT), Line(hub.nodes[0].port)

    async def run(self, keep_bytes, act):
        leaf = replace(self.hub.leaf("plant", SITE), urls=[f"nats://127.0.0.1:{await self.to_hub.open()}"])
        async with site(self.folder, leaf, keep_bytes) as broker:
            client = await connect(broker.nats, "sender", print, Counter())
            self.stream, self.names = client.jetstream(), Names(client.jetstream(), SITE)
            await self.names.give(["a", "b"], "sender", time.time())
            await make_streams_of(self.hub, "plant", print)
            tenant = self.hub.address("plant")
            far = NatsAddress(f"nats://127.0.0.1:{await self.to_history.open()}", tenant.user, tenant.password)
            self.history = HubHistory(self.folder / "history", far, None, Keep(), self.said.append)
            async with running(self.history.run()):
                await act(self)
            await client.close()

    async def send(self, count, clock_s=0.0):
        for _ in range(count):
            self.sent += 1
            records = np.zeros(ROWS, RECORD)
            records["position_mm"][:, 0] = ROWS * self.sent + np.arange(ROWS)
            records["tag"], records["unix_us"] = 1 + np.arange(ROWS) % 2, round(1e6 * (time.time() + clock_s))
            batch = Batch(RUN, self.sent, round(1e6 * time.time()), self.names.issue, records)
            subject = subjects.at(subjects.FIXES, SITE, "sender")
            await self.stream.publish(subject, encode_batch(batch), headers={"Nats-Msg-Id": batch.id})

    async def until(self, condition):
        async with asyncio.timeout(LIMIT_S):
            while not await condition():
                await asyncio.sleep(0.1)

    async def settled(self):
        """Wait until each batch is in the history, or counted as lost."""

        async def has_all():
            return self.history.state().fixes // ROWS + self.lost == self.sent

        await self.until(has_all)

    @property
    def lost(self):
        return self.history.state().drops.get("lost-batches", 0)

    def rows(self):
        """Days, times and numbers of what the history has."""
        files = current_files(self.folder / "history", SITE)
        tables = [parquet.read_table(file, columns=["t", "x_mm"]).to_pydict() for file in files]
        return SimpleNamespace(
            days={day_of(file) for file in files},
            times=[time for table in tables for time in table["t"]],
            batches=Counter(x // ROWS for table in tables for x in table["x_mm"]),
        )


def batches(*ranges):
    return Counter({number: ROWS for one in ranges for number in one})


@pytest.mark.statistical
def test_a_cut_line_loses_what_the_site_cannot_keep_and_that_is_counted(tmp_path):
    async def act(stage):
        await stage.send(FEW)
        await stage.settled()
        for count in (FEW, MANY):
            stage.to_hub.cut()
            await stage.send(count, clock_s=-3600.0)
            stage.first = (await stage.stream.stream_info(subjects.at(subjects.FIX_STREAM, SITE))).state.first_seq
            if count == FEW:
                assert stage.first == 1
            stage.to_hub.cut(is_cut=False)
            await stage.settled()
            assert stage.lost == max(0, stage.first - 2 * FEW - 1)
        assert stage.lost > MANY // 4

    with running_hub(tmp_path) as (hub, _):
        stage, begin = Stage(tmp_path, hub), datetime.now(UTC)
        asyncio.run(stage.run(FULL_BYTES, act))
    found, end = stage.rows(), datetime.now(UTC)
    assert found.batches == batches(range(1, 2 * FEW + 1), range(stage.first, stage.sent + 1))
    assert found.days <= {begin.date().isoformat(), end.date().isoformat()}
    late = [time for time in found.times if time < begin - timedelta(minutes=30)]
    assert len(late) == len(found.times) - FEW * ROWS  # by the clock of the sender


@pytest.mark.statistical
def test_a_full_hub_drops_the_oldest_and_a_history_that_was_away_counts_them(tmp_path):
    async def act(stage):
        for _ in range(6):
            await stage.send(MANY // 6)
            await stage.settled()
        assert stage.lost == 0
        stage.to_history.cut()
        await stage.send(MANY)
        client = await client_of(hub.address("plant"))
        state = (await client.jetstream().stream_info(FIX_STREAM)).state
        while state.last_seq < stage.sent:
            await asyncio.sleep(0.1)
            state = (await client.jetstream().stream_info(FIX_STREAM)).state
        await client.close()
        stage.first = state.first_seq
        stage.to_history.cut(is_cut=False)
        await stage.settled()
        assert stage.lost == stage.first - MANY - 1 > 0
        assert f"site 7: {stage.lost} batches were dropped before they could be read" in stage.said

    with running_hub(tmp_path, FULL_BYTES / 1e9) as (hub, _):
        stage = Stage(tmp_path, hub)
        asyncio.run(stage.run(10**8, act))
    assert stage.rows().batches == batches(range(1, MANY + 1), range(stage.first, 2 * MANY + 1))


def test_a_summary_of_another_version_is_read():
    old = {"unix_s": 1.0, "host": "h", "version": "0.1", "site": "", "simulated": False, "names": 3, "online": {}}
    old |= {"fixes": 1, "batches": 1, "waiting": 0, "drops": {}, "cuts": 0}
    assert msgspec.convert(old, Summary).condition == ""
    new = old | {"condition": "splendid", "of the future": 1}
    assert msgspec.convert(new, Summary).condition == "splendid"
    sites = HubSites(NatsAddress("nats://127.0.0.1"), 0.0)
    for number, summary in enumerate((old, new)):
        sites.add_summary(number, msgspec.json.encode(summary), 0.0, 1.0)
    found = sites.sites(1.0)
    assert {site.condition for site in found} == {"unknown"}
    assert all("states no condition" in site.reason for site in found)


CERTIFICATES = """\
new="openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes"
$new -x509 -days 3650 -subj /CN=hub -keyout ca-key.pem -out ca.pem
$new -subj /CN=hub.test -addext subjectAltName=IP:127.0.0.1 \
    -addext extendedKeyUsage=serverAuth,clientAuth -keyout key.pem -out a.csr
sign="openssl x509 -req -in a.csr -CA ca.pem -CAkey ca-key.pem -copy_extensions copy"
$sign -days -1 -out expired.pem
$sign -days 30 -out new.pem
openssl req -x509 -key key.pem -days 30 -subj /CN=hub.test -addext subjectAltName=IP:127.0.0.1 -out stranger.pem
openssl req -new -key key.pem -subj /CN=hub.test -addext subjectAltName=IP:127.0.0.2 -out a.csr
$sign -days 30 -out elsewhere.pem
"""


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("expired", "has expired"),
        ("stranger", "unknown authority"),
        ("elsewhere", "valid for 127.0.0.2, not 127.0.0.1"),
    ],
)
def test_a_wrong_certificate_is_said_and_a_right_one_is_taken(tmp_path, wrong, said):
    subprocess.run(["sh", "-ec", CERTIFICATES], check=True, capture_output=True, cwd=tmp_path)
    (tmp_path / f"{wrong}.pem").rename(tmp_path / "cert.pem")
    port, folder = free_node_port(), tmp_path / "hub"
    node = ("--node", f"hub.test:{port}", "--data", str(tmp_path / "data"), "--certificates", str(tmp_path))
    assert main(["hub", "init", str(folder), *node, "--sites", "7"]) == 0
    server, leaf = folder / f"hub.test-{port}" / "nats-server.conf", folder / "sites" / "plant-site7.json"
    server.write_text(server.read_text().replace("0.0.0.0", "127.0.0.1"))
    leaf.write_text(leaf.read_text().replace("hub.test", "127.0.0.1"))
    words = ("--gather", "--keep-gb", "0.1", "--hub", str(leaf), "--port", str(free_port()))
    with (
        started(_program(), "-c", server) as hub,
        started(*SKYLESS, "broker", *words, "--data", str(tmp_path / "site")) as broker,
    ):
        mqtt = mqtt_address(broker.stdout.readline().strip())
        line = broker.stderr.readline()
        assert "the site works on without it" in line
        assert said in line
        asyncio.run(check_broker(mqtt))
        (tmp_path / "new.pem").replace(tmp_path / "cert.pem")
        hub.send_signal(signal.SIGHUP)
        assert "the line to the hub is up" in broker.stderr.readline()


def test_servers_that_are_away_in_turns_are_said_once_each():
    said = []
    say = rarely(said.append)
    for server in ("a", "b", "c") * 3:
        say(f"{server}: connection refused")
    assert len(said) == 3
