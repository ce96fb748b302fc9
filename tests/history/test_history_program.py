"""``skyless history run`` against a real broker: killed, with a full disk, and what it takes of a site's messages."""

import asyncio
import json
import signal
import sqlite3
import time

import msgspec
import pytest
from made_fixes import fix, in_files, on_disk
from pyarrow import parquet

from mqtt.mqtt_brokers import Embedded, stopped
from skyless.run.history.layout import current_events, current_files, rows_of, site_folder
from skyless.run.history.program import HistoryNode
from skyless.run.history.queries import History
from skyless.run.history.writer import Keep, Writer
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
from skyless.run.mqtt.topics import (
    alarm_topic,
    assets_topic,
    fix_topic,
    site_topic,
    status_topic,
    zone_event_topic,
    zones_topic,
)
from skyless.sim.lab import lab_site
from support.processes import SKYLESS, free_port, running_program
from support.waiting import until as until_

pytestmark = pytest.mark.site


def until(condition, limit_s=60.0):
    """Longer than usual: programs start here that load much."""
    return until_(condition, limit_s)


SITE = 5
TAG = "ann"


def numbered_fix(serial):
    return fix(TAG, serial, time.time(), (serial / 1000.0, 0.0, 0.0))


class Stage:
    """A broker and somebody who publishes."""

    def __init__(self, folder):
        folder.mkdir()
        self.broker = Embedded(folder)
        self.link = None
        self.serial = 0

    async def __aenter__(self):
        await self.broker.start()
        self.link = Link(self.broker.address, TAG, site=SITE, kind="tag")
        self._task = asyncio.ensure_future(self.link.run())
        await until(lambda: self.link.connected)
        return self

    async def __aexit__(self, *_):
        self._task.cancel()
        await asyncio.wait([self._task])
        await self.broker.stop()

    async def publish_fixes(self):
        """Until cancelled: 200 a second, each with the next serial."""
        while True:
            self.serial += 1
            self.link.publish(fix_topic(SITE, TAG), numbered_fix(self.serial))
            await asyncio.sleep(0.005)


def test_nothing_that_reached_the_journal_is_lost_or_doubled_by_kills(tmp_path):
    folder = tmp_path / "history"

    async def scenario():
        async with Stage(tmp_path / "broker") as stage:
            command = (*SKYLESS, "history", "run", "--to", folder, "--mqtt", str(stage.broker.address))
            command = (*command, "--site-id", str(SITE), "--json")
            publishing = asyncio.ensure_future(stage.publish_fixes())
            stored, options = [], {"stdout": asyncio.subprocess.PIPE, "stderr": asyncio.subprocess.PIPE}
            for rows in (30, 1, 60):
                async with running_program(*command, **options) as process:
                    aim = len(stored) + rows
                    await until(lambda aim=aim: len(serials(folder)) >= aim)
                    process.kill()
                    await process.communicate()
                before, stored = stored, serials(folder)
                assert stored[: len(before)] == before
            async with running_program(*command, **options) as process:
                await until(lambda: len(serials(folder)) > len(stored))
                process.send_signal(signal.SIGINT)
                out, err = await process.communicate()
            publishing.cancel()
            return stored, process.returncode, json.loads(out), err

    stored, code, report, err = asyncio.run(scenario())
    assert (code, b"Traceback" in err) == (0, False), err
    final = in_files(folder, SITE)
    assert final[: len(stored)] == stored
    assert final == sorted(set(final)) == on_disk(folder, SITE)
    assert report["fixes"] == len(final) - len(stored)
    assert (report["waiting"], report["lost"], report["tags"], report["disk"]) == (0, 0, 1, None)
    numbers = [
        number for file in current_files(folder, SITE) for number in range(rows_of(file)[0], rows_of(file)[1] + 1)
    ]
    assert numbers == list(range(1, len(final) + 1))


def serials(folder):
    try:
        return on_disk(folder, SITE)
    except (OSError, sqlite3.Error):  # it was copied while it changed
        return []


async def keeping(stage, folder, log, scenario):
    """Run a node in this process during a scenario."""
    node = HistoryNode(Writer(folder, SITE), stage.broker.address, Keep(), log)
    task = asyncio.ensure_future(node.run())
    try:
        await until(lambda: node.link.connected or task.done())
        await scenario(node)
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    return node


def test_a_full_disk_is_said_and_forgiven(tmp_path):
    folder, lines = tmp_path / "history", []

    async def scenario(node):
        publishing = asyncio.ensure_future(stage.publish_fixes())
        await until(lambda: node.state().waiting > 10)
        set_limit(node, 1)
        await until(lambda: node.state().disk is not None)
        during = node.state()
        await until(lambda: node.state().waiting > during.waiting + 10)
        set_limit(node, 1_000_000)
        await until(lambda: node.state().disk is None)
        publishing.cancel()
        assert "database or disk is full" in during.disk

    async def whole():
        nonlocal stage
        async with stage:
            return await keeping(stage, folder, lines.append, scenario)

    stage = Stage(tmp_path / "broker")
    node = asyncio.run(whole())
    assert lines == [
        "the history's journal cannot be written: database or disk is full",
        "the history's journal can be written again; 0 rows were lost so far",
    ]
    found = in_files(folder, SITE)
    assert found == list(range(found[0], found[0] + node.state().fixes))


def set_limit(node, pages):
    """SQLite's own error of a full disk comes where its file would become larger."""
    with node._writer.journal.transaction() as sql:
        sql.execute(f"PRAGMA max_page_count = {pages}")


ZONE = Zone("z1", "door", ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)))


def test_what_it_takes_of_a_sites_messages(tmp_path):
    folder = tmp_path / "history"
    now_s = time.time()
    alarm = AlarmMessage(*("cold/ann/1", "cold", "Cold", "inside", "critical", "ann", now_s, now_s, "ann is in Cold"))
    ended = msgspec.structs.replace(alarm, ended_unix_s=now_s + 1.0)

    async def scenario(node):
        publish = stage.link.publish
        await until(lambda: node.state().events == 1)  # the tag's own status: it has subscribed
        lab = msgspec.structs.replace(lab_site(), id=SITE)
        publish(site_topic(SITE), SiteMessage(lab, True, now_s), qos=1, retain=True)
        publish(zones_topic(SITE), ZonesMessage((ZONE,)), qos=1, retain=True)
        publish(assets_topic(SITE), AssetsMessage((Asset(TAG, "Forklift"), Asset("bob"))), qos=1, retain=True)
        publish(status_topic(SITE, "anchor", 3), StatusMessage(True, "anchor", "3", unix_s=now_s), qos=1, retain=True)
        publish(alarm_topic(SITE, "cold", "ann"), alarm, qos=1, retain=True)
        publish(zone_event_topic(SITE, "z1"), ZoneEvent("z1", "door", "ann", "enter", now_s, (0.0, 0.0, 0.0)), qos=1)
        publish(fix_topic(SITE, "bad"), b"{}")
        publish(zones_topic(SITE), b'{"zones": [{"id": "/", "name": "", "polygon_m": []}]}', qos=1)
        await until(lambda: node.state().events >= 4 and node.state().drops.get("wrong-message", 0) >= 2)
        publish(fix_topic(SITE, TAG), numbered_fix(1))
        await until(lambda: node.state().fixes == 1)

    async def again(node):
        publish = stage.link.publish
        while not node.state().fixes:  # nats-server may lose what comes while somebody subscribes
            publish(fix_topic(SITE, TAG), numbered_fix(2))
            await asyncio.sleep(0.05)
        publish(status_topic(SITE, "anchor", 3), StatusMessage(False, "anchor", "3"), qos=1, retain=True)
        publish(alarm_topic(SITE, "cold", "ann"), ended, qos=1, retain=True)
        await until(lambda: node.state().events >= 2)

    async def whole():
        nonlocal stage
        async with stage:
            await keeping(stage, folder, lambda _: None, scenario)
            await keeping(stage, folder, lambda _: None, again)

    stage = Stage(tmp_path / "broker")
    asyncio.run(whole())
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


def test_a_broker_keeps_the_history_of_the_sites_on_it(tmp_path):
    """With roles: its history may read everything, and publish nothing but its status."""
    folder, access, port = tmp_path / "history", tmp_path / "access", free_port()
    create_access(access, mqtt_address("mqtt://127.0.0.1"))
    words = ("broker", "--port", str(port), "--data", tmp_path / "store", "--access", access, "--history", folder)

    async def scenario():
        pipes = {"stdout": asyncio.subprocess.PIPE, "stderr": asyncio.subprocess.PIPE}
        async with running_program(*SKYLESS, *words, **pipes) as process:
            await process.stdout.readline()
            address = MqttAddress("127.0.0.1", port, user="operator", password=read_access(access)[Role.OPERATOR])
            link, statuses = Link(address, TAG, site=SITE, kind="tag"), []
            link.subscribe(status_topic(SITE, "history", "+"), lambda _, payload: statuses.append(payload), qos=1)
            lab = msgspec.structs.replace(lab_site(), id=SITE)
            link.publish(site_topic(SITE), SiteMessage(lab, False, time.time()), qos=1, retain=True)
            task = asyncio.ensure_future(link.run())
            await until(lambda: statuses)
            for serial in range(1, 200):
                link.publish(fix_topic(SITE, TAG), numbered_fix(serial))
                await asyncio.sleep(0.02)
            await until(lambda: serials(folder))
            process.send_signal(signal.SIGTERM)
            _, err = await process.communicate()
            await stopped(task)
            return process.returncode, err, statuses

    code, err, statuses = asyncio.run(scenario())
    assert (code, b"Traceback" in err) == (0, False), err
    assert b'"online":true' in statuses[0]
    assert in_files(folder, SITE)[-1] == 199
