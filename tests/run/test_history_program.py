"""``skyless history run`` against real brokers: killed, with a full disk, and what it takes of a site's messages."""

import asyncio
import contextlib
import errno
import multiprocessing
import os
import random
import signal
import time
from collections import Counter
from functools import partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest
from made_fixes import fix, in_files, records
from pyarrow import parquet
from short_lived import keep_history

from skyless.run.fix_batch import Batch, encode_batch
from skyless.run.gather import subjects
from skyless.run.gather.streams import Names, make_streams
from skyless.run.gather.subjects import connect
from skyless.run.history import program
from skyless.run.history import writer as writer_module
from skyless.run.history.layout import current_events, current_files, rows_of, site_folder
from skyless.run.history.program import HistoryNode, import_recording
from skyless.run.history.queries import History
from skyless.run.history.writer import Keep, Writer
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import MqttAddress, Role, create_access, mqtt_address, read_access
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import (
    AlarmMessage,
    Asset,
    AssetsMessage,
    SiteMessage,
    StatusMessage,
    Zone,
    ZoneEvent,
    ZonesMessage,
)
from skyless.run.record import RecorderNode
from skyless.run.recordings.recorder import McapFile
from skyless.run.recordings.recording import McapRecording
from skyless.sim.lab import lab_site
from support.mqtt_brokers import MOSQUITTO, Embedded, Mosquitto, stopped
from support.processes import SKYLESS, free_port, running_program
from support.waiting import running
from support.waiting import until as until_

pytestmark = pytest.mark.site
until = partial(until_, limit_s=60.0)
"""Longer than usual: programs start here that load much."""

SITE = 5
HALL = msgspec.structs.replace(lab_site(), id=SITE)
TAG = "ann"


def numbered_fix(serial):
    return fix(TAG, serial, time.time(), (serial / 1000.0, 0.0, 0.0))


class Stage:
    """A broker and somebody who publishes."""

    def __init__(self, folder, kind=Embedded, **settings):
        folder.mkdir()
        self.broker = kind(folder, **settings)
        self.link = Link(self.broker.address, TAG, site=SITE, kind="tag")

    async def __aenter__(self):
        await self.broker.start()
        self._task = asyncio.ensure_future(self.link.run())
        await until(lambda: self.link.connected)
        return self

    async def __aexit__(self, *_):
        await stopped(self._task)
        await self.broker.stop()

    async def publish_fixes(self):
        """Until cancelled: 200 a second, each with the next serial."""
        for serial in count(1):
            self.link.publish(topics.fix_topic(SITE, TAG), numbered_fix(serial))
            await asyncio.sleep(0.005)


class Sender:
    """Sends numbered batches of three fixes, and zone events, into a site's streams until each is acknowledged."""

    def __init__(self, nats):
        self.nats, self.batches, self.events = nats, 0, 0

    async def run(self):
        """Until cancelled: 100 batches a second, and an event after each tenth."""
        client = await connect(self.nats, "sender", print, Counter())
        try:
            await self._send(client)
        finally:
            await client.close()

    async def _send(self, client):
        stream = client.jetstream()
        await make_streams(stream, SITE, 10**9)
        names = Names(stream, SITE)
        for number in count(1):
            await names.give([f"t{number % 7}"], "host", time.time())
            rows = records(range(3 * number, 3 * number + 3), names.numbers[f"t{number % 7}"], time.time())
            batch = Batch(1, number, 1, names.issue, rows)
            await stream.publish(subjects.at(subjects.FIXES, SITE, "sender"), encode_batch(batch))
            self.batches = number
            if number % 10 == 0:
                event = ZoneEvent("z1", f"door {number // 10}", "t1", "enter", time.time(), (0.0, 0.0, 0.0))
                await stream.publish(f"skyless.v1.{SITE}.zone.z1.event", msgspec.json.encode(event))
                self.events += 1
                await client.publish(subjects.at(subjects.SUMMARY, SITE), b"")  # that of a gather
            await asyncio.sleep(0.01)


@pytest.mark.statistical
async def test_fifty_kills_lose_no_acknowledged_batch_and_double_none(tmp_path):
    folder, chance = tmp_path / "history", random.Random(50)
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["skyless.run.history.program", "skyless.run.zones"])  # for a quick start

    def begun(stage):
        given = (folder, SITE, stage.broker.address, stage.broker.broker.nats)
        process = processes.Process(target=keep_history, args=given)
        process.start()
        return process

    def kept():
        return sum(last - first + 1 for first, last in map(rows_of, current_files(folder, SITE)))

    def zones():
        files = current_events(folder, SITE)
        texts = [text for file in files for text in parquet.read_table(file, partitioning=None)["text"].to_pylist()]
        return [int(text.split()[-1]) for text in texts if "entered" in text]

    async with Stage(tmp_path / "broker", gathered_bytes=10**9) as stage:
        sender = Sender(stage.broker.broker.nats)
        sending = asyncio.ensure_future(sender.run())
        for _ in range(50):
            process = begun(stage)
            await asyncio.sleep(chance.uniform(0.0, 1.5))
            assert process.exitcode is None
            process.kill()
            process.join()
        await stopped(sending)
        process = begun(stage)
        await until(lambda: kept() >= 3 * sender.batches and len(zones()) >= sender.events, limit_s=300.0)
        process.kill()
        process.join()
    assert sender.batches > 500
    assert len(current_files(folder, SITE)) > 20
    found = sorted(in_files(folder, SITE))  # a batch or an event that was not acknowledged may be there
    assert found in ([*range(3, 3 * sender.batches + 3 * more)] for more in (1, 2))
    assert zones() in ([*range(1, sender.events + more)] for more in (1, 2))
    numbers = [n for first, last in map(rows_of, current_files(folder, SITE)) for n in range(first, last + 1)]
    assert numbers == [*range(1, len(found) + 1)]


@contextlib.asynccontextmanager
async def keeping(stage, folder, log):
    """A node that runs in this process, once it is connected."""
    node = HistoryNode(folder, SITE, stage.broker.address, Keep(), log)
    async with running(node.run()) as (task,):
        await until(lambda: node.link.connected or task.done())
        yield node


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
async def test_a_disk_that_takes_nothing_is_said_and_forgiven(tmp_path, monkeypatch, number):
    folder, lines = tmp_path / "history", []
    monkeypatch.setattr(program, "_CHECK_S", 0.05)
    monkeypatch.setattr(program, "_FIRST_FILE_S", 0.1)
    is_at_fault = True
    free = lambda _: SimpleNamespace(free=0 if is_at_fault and number == errno.ENOSPC else 10**12)  # noqa: E731
    monkeypatch.setattr(writer_module.shutil, "disk_usage", free)
    write_bytes = Path.write_bytes

    def write(file, data):
        if is_at_fault and file.name == "check.tmp":
            raise OSError(number, os.strerror(number), str(file))
        return write_bytes(file, data)

    monkeypatch.setattr(Path, "write_bytes", write)

    async with Stage(tmp_path / "broker") as stage, keeping(stage, folder, lines.append) as node:
        publishing = asyncio.ensure_future(stage.publish_fixes())
        await until(lambda: node.state().disk is not None)
        during = node.state()
        await until(lambda: node.state().waiting > during.waiting + 10)
        assert not current_files(folder, SITE)
        is_at_fault = False
        await until(lambda: "the history's own nats-server is started again" in lines)
        later = node.state().fixes + 100
        await until(lambda: node.state().fixes > later and current_files(folder, SITE))
        publishing.cancel()
    assert lines[:3] == [
        f"the history's files cannot be written: {os.strerror(number)}",
        "the history's files can be written again",
        "the history's own nats-server is started again",
    ]
    found = in_files(folder, SITE)
    assert found == list(range(found[0], found[0] + node.state().fixes))


ZONE = Zone("z1", "door", ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)))


@pytest.mark.parametrize("kind", [Embedded, Mosquitto])
async def test_what_it_takes_of_a_sites_messages(tmp_path, kind):
    if kind is Mosquitto and not MOSQUITTO:
        pytest.skip("mosquitto is not installed")
    folder = tmp_path / "history"
    now_s = time.time()
    alarm = AlarmMessage(*("cold/ann/1", "cold", "Cold", "inside", "critical", "ann", now_s, now_s, "ann is in Cold"))
    ended = msgspec.structs.replace(alarm, ended_unix_s=now_s + 1.0)

    async with Stage(tmp_path / "broker", kind) as stage:
        publish, retain = partial(stage.link.publish, qos=1), partial(stage.link.publish, qos=1, retain=True)
        async with keeping(stage, folder, lambda _: None) as node:
            await until(lambda: node.state().events == 1)  # the tag's own status: it has subscribed
            retain(topics.site_topic(SITE), SiteMessage(HALL, True, now_s))
            retain(topics.zones_topic(SITE), ZonesMessage((ZONE,)))
            retain(topics.assets_topic(SITE), AssetsMessage((Asset(TAG, "Forklift"), Asset("bob"))))
            for name, say in (("3", retain), ("a b", publish)):
                say(topics.status_topic(SITE, "anchor", name), StatusMessage(True, "anchor", name, unix_s=now_s))
            retain(topics.alarm_topic(SITE, "cold", "ann"), alarm)
            entered = ZoneEvent("z1", "door", "ann", "enter", now_s, (0.0, 0.0, 0.0))
            publish(topics.zone_event_topic(SITE, "z1"), entered)
            stage.link.publish(topics.fix_topic(SITE, "bad"), b"{}")
            await until(lambda: (site_folder(folder, SITE) / "stream").is_dir() and node.state().events >= 4)
            await until(lambda: node.state().drops.get("wrong"))
            publish(topics.zones_topic(SITE), b'{"zones": [{"id": "/", "name": "", "polygon_m": []}]}')
            await until(lambda: node.state().drops.get("wrong-message"))
            stage.link.publish(topics.fix_topic(SITE, TAG), numbered_fix(1))
            await until(lambda: node.state().fixes == 1)
        async with keeping(stage, folder, lambda _: None) as node:
            while not node.state().fixes:  # nats-server may lose what comes while somebody subscribes
                stage.link.publish(topics.fix_topic(SITE, TAG), numbered_fix(2))
                await asyncio.sleep(0.05)
            retain(topics.status_topic(SITE, "anchor", 3), StatusMessage(False, "anchor", "3"))
            retain(topics.alarm_topic(SITE, "cold", "ann"), ended)
            await until(lambda: node.state().events >= 2)
    assert History(folder, SITE).assets() == {TAG: "Forklift"}
    found = [parquet.read_table(file, partitioning=None).to_pylist() for file in current_events(folder, SITE)]
    kinds = sorted((row["kind"], row["tag"] or row["subject"]) for table in found for row in table)
    assert kinds == [
        ("alarm-ended", "ann"),
        ("alarm-raised", "ann"),
        ("enter", "ann"),
        ("offline", "anchor-3"),
        ("online", "anchor-3"),
        ("online", "ann"),
    ]
    fixes = parquet.read_table(current_files(folder, SITE)[0], partitioning=None)
    assert fixes.select(["x_mm", "flags"]).to_pylist() == [{"x_mm": 1, "flags": 64}]
    zones = parquet.read_table(site_folder(folder, SITE) / "zones.parquet", partitioning=None)
    assert zones["zone"].to_pylist() == ["z1"]


async def test_a_recording_gives_the_rows_of_the_running_history(tmp_path):
    live, played, walk = tmp_path / "live", tmp_path / "played", tmp_path / "walk.mcap"
    chance = random.Random(7)

    def walked(serial):
        at_m, variances = ([chance.uniform(*limits) for _ in range(3)] for limits in ((-50.0, 50.0), (1e-6, 4.0)))
        return fix(f"t{serial % 3}", serial, time.time(), tuple(at_m), variances, hpl_m=chance.uniform(0.1, 9.0))

    stage = Stage(tmp_path / "broker")
    recorder = RecorderNode(McapFile(walk), stage.broker.address, SITE, print)
    async with stage, running(recorder.run()), keeping(stage, live, print) as node:
        await until(lambda: node.state().events == 1 and recorder.recorder.kinds["status"])
        publish, retain = partial(stage.link.publish, qos=1), partial(stage.link.publish, qos=1, retain=True)
        now_s = time.time()
        retain(topics.site_topic(SITE), SiteMessage(HALL, True, now_s))
        retain(topics.zones_topic(SITE), ZonesMessage((ZONE,)))
        retain(topics.assets_topic(SITE), AssetsMessage((Asset("t0", "Forklift"),)))
        await until(lambda: recorder.recorder.kinds["assets"])
        for serial in range(1, 301):
            made = walked(serial)
            stage.link.publish(topics.fix_topic(SITE, made.tag), made)
            if serial % 50 == 0:
                event = ZoneEvent("z1", "door", made.tag, "enter", made.unix_s, made.position_m)
                publish(topics.zone_event_topic(SITE, "z1"), event)
                alarm = ("cold", "Cold", "inside", "critical", made.tag, now_s, now_s, "in")
                retain(topics.alarm_topic(SITE, "cold", made.tag), AlarmMessage(f"cold/{serial}", *alarm))
                status = StatusMessage(serial % 100 > 0, "anchor", "3", unix_s=made.unix_s)
                publish(topics.status_topic(SITE, "anchor", 3), status)
            await asyncio.sleep(0.002)
        await until(lambda: (node.state().fixes, node.state().events) == (300, 1 + 6 + 6 + 6))
        await until(lambda: recorder.recorder.kinds["fix"] == 300 and recorder.recorder.kinds["event"] == 6)
    for folder, fixes, events in ((played, 300, 19), (live, 0, 0)):
        with McapRecording(walk) as recording:
            writer = Writer(folder, SITE)
            found = import_recording(recording, writer, print)
            writer.close()
        assert (found.fixes, found.events, found.drops) == (fixes, events, {})
    assert whole_rows(live) == whole_rows(played)


def whole_rows(folder):
    """All rows of a history but for numbers of its own, and the times of arrival that offline programs have."""
    site = site_folder(folder, SITE)
    names, zones, assets = (parquet.read_table(site / f"{one}.parquet", partitioning=None) for one in TABLES)
    of = {row["tag"]: row["name"] for row in names.to_pylist()}
    rows = [
        [row for file in files for row in parquet.read_table(file, partitioning=None).to_pylist()]
        for files in (current_files(folder, SITE), current_events(folder, SITE))
    ]
    fixes = sorted((of[row.pop("tag")], *row.values()) for row in rows[0])
    events = sorted(str(row | ({"t": None} if row["kind"] == "offline" else {})) for row in rows[1])
    return fixes, events, zones, assets


TABLES = "names", "zones", "assets"


async def test_without_a_gather_one_runs_at_the_brokers_own_streams(tmp_path):
    folder = tmp_path / "history"

    async with Stage(tmp_path / "broker", gathered_bytes=10**9) as stage:
        node = HistoryNode(folder, SITE, stage.broker.address, Keep(), print, stage.broker.broker.nats)
        task = asyncio.ensure_future(node.run())
        publishing = asyncio.ensure_future(stage.publish_fixes())
        await until(lambda: node.state().fixes > 20 and node.state().events)
        await stopped(publishing)
        await stopped(task)
        state = node.state()
    found = in_files(folder, SITE)
    assert found == list(range(found[0], found[0] + state.fixes))
    assert (state.waiting, state.drops, (site_folder(folder, SITE) / "stream").exists()) == (0, {}, False)


async def test_a_broker_keeps_the_history_of_the_sites_on_it(tmp_path):
    """With roles: its history may read everything, and publish nothing but its status."""
    folder, access, port = tmp_path / "history", tmp_path / "access", free_port()
    create_access(access, mqtt_address("mqtt://127.0.0.1"))
    words = ("broker", "--port", str(port), "--data", tmp_path / "store", "--access", access, "--history", folder)

    pipes = {"stdout": asyncio.subprocess.PIPE, "stderr": asyncio.subprocess.PIPE}
    async with running_program(*SKYLESS, *words, **pipes) as process:
        await process.stdout.readline()
        address = MqttAddress("127.0.0.1", port, user="operator", password=read_access(access)[Role.OPERATOR])
        link, statuses = Link(address, TAG, site=SITE, kind="tag"), []
        link.subscribe(topics.status_topic(SITE, "history", "+"), lambda _, payload: statuses.append(payload), qos=1)
        link.publish(topics.site_topic(SITE), SiteMessage(HALL, False, time.time()), qos=1, retain=True)
        task = asyncio.ensure_future(link.run())
        await until(lambda: statuses)
        serials, blocks = count(1), "stream/jetstream/*/streams/FIX_*/msgs/*.blk"
        while not any(file.stat().st_size for file in site_folder(folder, SITE).glob(blocks)) or next(serials) < 200:
            link.publish(topics.fix_topic(SITE, TAG), numbered_fix(next(serials)))
            await asyncio.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        _, err = await process.communicate()
        await stopped(task)
    assert (process.returncode, b"Traceback" in err) == (0, False), err
    assert b'"online":true' in statuses[0]
    found = in_files(folder, SITE)
    assert found == sorted(set(found)) != []
