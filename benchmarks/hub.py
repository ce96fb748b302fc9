"""What a gather costs, and what a hub does when servers die and lines are cut: real programs, made-up fixes.

    python benchmarks/hub.py gather [--part json|packed|core|all] [--rate 50000] [--json-rate 4000] [--seconds 60]
    python benchmarks/hub.py cuts                                        # a table: 3 minutes
    python benchmarks/hub.py random [--seed 1] [--actions 20]

``json``: a program publishes ``FixMessage`` as MQTT's messages reach NATS (with the header of QoS 0), and the gather
packs them. ``packed``: a program publishes batches of 1,000 records into the site's stream, and a reader takes them
into the page's columns. ``core``: the same at a site without a gather, so without a stream: the rest is JetStream's.
Latency is from a record's time to the end of the columns' update.

``cuts`` (``tests/support/hub_stage.py``): how long a viewer at the hub sees nothing, and after which time the hub's
stream has all that was acknowledged. There and after kills and cuts in a random order every fix must be there once
and in order; the exit code is 1 otherwise.
"""

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

sys.path.append(str(Path(__file__).parents[1] / "tests"))

import msgspec
import numpy as np
import psutil

from skyless.page.gathered import Gathered
from skyless.page.live import LiveSite
from skyless.run.fix_batch import MAX_RECORDS, RECORD, Batch, decode_batch, encode_batch
from skyless.run.gather import subjects
from skyless.run.gather.streams import messages
from skyless.run.gather.subjects import NatsAddress, connect
from skyless.run.mqtt.messages import FixMessage
from support.hub_stage import SITE, Process, Stage, at_random
from support.processes import free_node_port, free_port

OTHER = 8
TAGS = 10_000
VARIANCE = (1.23456e-3, 1e-5, 0.0, 1e-5, 1.3456e-3, 0.0, 0.0, 0.0, 1e-2)
FIX = FixMessage(
    *("tag00001", 12345, 1.79e9 + 0.123456, 123.456789, (1.2345678, 2.3456789, 1.0), VARIANCE),
    *((0.1234567, 0.2345678, 0.0), VARIANCE, 0.0323456, 1.234567, 1.2345678, 1.2345678, None),
    *((1, 2, 3, 4, 5, 6, 7, 8), 4.56789, 5, 0.012345, "joint", True, 0.0012345, 0.23456),
)


async def publish_json(client, rate, seconds):
    names = [f"tag{number:05}" for number in range(TAGS)]
    payloads = [msgspec.json.encode(msgspec.structs.replace(FIX, tag=name)) for name in names]
    sent, begin_s = 0, time.monotonic()
    while sent < rate * seconds:
        for _ in range(rate // 50):
            place = sent % TAGS
            subject = f"skyless.v1.{SITE}.tag.{names[place]}.fix"
            await client.publish(subject, payloads[place], headers={"Nmqtt-Pub": "0"})
            sent += 1
        await asyncio.sleep(max(0.0, begin_s + sent / rate - time.monotonic()))
    return sent


async def publish_packed(client, rate, seconds, site):
    """Each batch holds fixes that were made since the one before it, at equal intervals."""
    records = np.zeros(MAX_RECORDS, RECORD)
    records["covariance_m2"] = (1e-3, 0.0, 1e-3)
    run, sequence, begin_s = os.getpid(), 0, time.time()
    while sequence * MAX_RECORDS < rate * seconds:
        first = sequence * MAX_RECORDS
        due_s = begin_s + (first + MAX_RECORDS) / rate
        await asyncio.sleep(max(0.0, due_s - time.time()))
        serials = first + np.arange(MAX_RECORDS)
        records["tag"] = serials % TAGS + 1
        records["unix_us"] = 1e6 * (begin_s + serials / rate)
        records["position_mm"][:, 0] = serials % 100_000
        sequence += 1
        data = encode_batch(Batch(run, sequence, round(1e6 * time.time()), TAGS, records))
        subject = subjects.at(subjects.FIXES, site, "bench")
        await client.publish(subject, data, headers={"Nats-Msg-Id": f"{run}-{sequence}"})
    return sequence * MAX_RECORDS


async def publisher(url, part, rate, seconds):
    client = await connect(NatsAddress(url), "bench", print, Counter())
    begin_s = time.process_time()
    if part == "json":
        sent = await publish_json(client, rate, seconds)
    else:
        sent = await publish_packed(client, rate, seconds, SITE if part == "packed" else OTHER)
    await client.flush(30)
    print(json.dumps({"sent": sent, "cpu_s": time.process_time() - begin_s}), flush=True)
    await client.close()


class Measured(Gathered):
    """The page's reader of one site, which also notes how old each record is once it is in the columns."""

    def __init__(self, address):
        super().__init__(address)
        self.ages_ms = np.zeros(20_000, np.int64)
        self.measuring_s = 0.0

    async def _on_batch(self, message):
        await super()._on_batch(message)
        begin_s = time.process_time()
        records = np.frombuffer(message.data, RECORD, offset=32)
        ages_ms = (round(1e6 * time.time()) - records["unix_us"].astype(np.int64)) // 1000
        self.ages_ms += np.bincount(np.clip(ages_ms, 0, 19_999), minlength=20_000)
        self.measuring_s += time.process_time() - begin_s


async def reader(url, site, expected):
    """Read until the expected number of fixes is there, or nothing came for 5 s."""
    measured, live = Measured(NatsAddress(url)), LiveSite("bench", url)
    live.attach(SimpleNamespace(subscribe=lambda *_: None), site)
    task = asyncio.create_task(measured.run(SimpleNamespace(all=[live])))
    print("ready", flush=True)
    begin_s, count, still = time.process_time(), 0, 0
    while count < expected and still < 20:
        await asyncio.sleep(0.5)
        still = still + 1 if count == measured.ages_ms.sum() and count else 0
        count = int(measured.ages_ms.sum())
    task.cancel()
    share = np.cumsum(measured.ages_ms) / max(count, 1)
    print(
        json.dumps(
            {
                "read": count,
                "cpu_s": time.process_time() - begin_s - measured.measuring_s,
                "p50_ms": int(np.searchsorted(share, 0.5)),
                "p99_ms": int(np.searchsorted(share, 0.99)),
                "max_ms": int(np.flatnonzero(measured.ages_ms).max(initial=0)),
                "dropped": dict(measured.drops),
            }
        ),
        flush=True,
    )


def own(*arguments):
    return subprocess.Popen([sys.executable, __file__, *map(str, arguments)], stdout=subprocess.PIPE, text=True)


def last_line(process):
    return json.loads(process.communicate()[0].splitlines()[-1])


async def stored(url):
    """Rows in the stream, and whether the numbers of their batches are without a gap."""
    rows, sequences = 0, []
    client = await connect(NatsAddress(url), "bench", print, Counter())
    async for message in messages(client.jetstream(), subjects.at(subjects.FIX_STREAM, SITE)):
        rows += len(decode_batch(message.data).records)
        sequences.append(message.metadata.sequence.stream)
    await client.close()
    return rows, sequences == list(range(sequences[0], sequences[0] + len(sequences))) if sequences else False


def measure(part, url, programs, rate, seconds):
    expected = rate * seconds
    reading = None if part == "json" else own("read", url, SITE if part == "packed" else OTHER, expected)
    if reading is not None:
        reading.stdout.readline()
        time.sleep(0.5)
    before = {name: sum(one.cpu_times()[:2]) for name, one in programs.items()}
    publishing = own("publish", url, part, rate, seconds)
    sent = last_line(publishing)
    read = {} if reading is None else last_line(reading)
    time.sleep(1.5)
    used = {name: sum(one.cpu_times()[:2]) - before[name] for name, one in programs.items()}
    us = {name: round(1e6 * value / sent["sent"], 2) for name, value in used.items()}
    us["publisher"] = round(1e6 * sent["cpu_s"] / sent["sent"], 2)
    if read:
        us["reader"] = round(1e6 * read.pop("cpu_s") / sent["sent"], 2)
    print(f"{part}: {sent['sent']} fixes, {rate} a second; us of a core for each: {us}; {read}")
    return sent["sent"]


def gather(chosen):
    with tempfile.TemporaryDirectory() as folder:
        command = (sys.executable, "-m", "skyless.cli.main", "broker", "--gather", "--site-id", str(SITE), "--json")
        broker = subprocess.Popen([*command, "--data", f"{folder}/data"], stdout=subprocess.PIPE, text=True)
        try:
            stated = json.loads(broker.stdout.readline())
            time.sleep(4.0)
            children = psutil.Process(broker.pid).children()
            gatherer = next(one for one in children if "gather" in one.cmdline())
            programs = {"broker": psutil.Process(stated["pid"]), "gather": gatherer}
            total = 0
            for part in ("json", "core", "packed"):
                if chosen.part in (part, "all"):
                    rate = chosen.json_rate if part == "json" else chosen.rate
                    sent = measure(part, stated["nats"], programs, rate, chosen.seconds)
                    total += sent if part != "core" else 0
            rows, whole = asyncio.run(stored(stated["nats"]))
            print(
                f"in the stream: {rows} of {total} fixes, {'no gap' if whole else 'with gaps'} in the batches' numbers"
            )
            size = sum(file.stat().st_size for file in Path(folder).rglob("*.blk"))
            print(f"on disk: {size / max(rows, 1):.1f} bytes for each")
        finally:
            broker.terminate()
            broker.wait()


async def cuts(stage):
    """Rows of what happened, the longest gap of the live view, and the time until the stream was complete."""

    async def during(name, act, undo, seconds, settle_s):
        stage.arrivals = [time.monotonic()]
        act()
        await asyncio.sleep(seconds)
        at_s = time.monotonic()
        undone = undo()
        if asyncio.iscoroutine(undone):
            await undone
        complete_s = await stage.complete()
        await asyncio.sleep(settle_s)
        times = [*stage.arrivals, time.monotonic()]
        gap_s = max(later - before for before, later in pairwise(times))
        back_s = next((time_s - at_s for time_s in stage.arrivals if time_s > at_s), float("inf"))
        print(f"{name:45} {gap_s:9.2f} {back_s:9.2f} {complete_s:9.1f}", flush=True)

    print(f"{'':45} {'gap, s':>9} {'back, s':>9} {'complete, s':>9}   after the end of the trouble")
    viewing = asyncio.ensure_future(stage.view())
    await asyncio.sleep(2)
    own, other, _ = stage.by_viewer()
    await during("a hub's server that is not the viewer's, 10 s", other.kill, other.start, 10, 5)
    await during("the viewer's own server, 10 s", own.kill, own.start, 10, 5)
    await during("the line, 25 s", stage.cut, lambda: stage.cut(is_cut=False), 25, 5)
    _, *two = stage.by_viewer()

    def both(act):
        for server in two:
            act(server)

    name = "the two servers that are not the viewer's, 10 s"
    await during(name, lambda: both(Process.kill), lambda: both(Process.start), 10, 5)
    await during("the site's broker, 3 s", stage.kill_broker, stage.start_broker, 3, 5)
    await stage.stop_sending()
    await stage.complete()
    viewing.cancel()
    found = await stage.sequences()
    is_ordered = found == list(range(1, len(found) + 1))
    print(f"{len(found)} of {stage.acknowledged} acknowledged batches at the hub, once and in order: {is_ordered}")
    return is_ordered


async def on_stage(asked):
    ports = [free_node_port() for _ in range(3)]
    with tempfile.TemporaryDirectory() as folder:
        async with Stage(Path(folder), ports, free_port()) as stage:
            return await (cuts(stage) if asked.what == "cuts" else at_random(stage, asked.seed, asked.actions))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("gather", "cuts", "random"))
    parser.add_argument("--part", choices=("json", "packed", "core", "all"), default="all")
    parser.add_argument("--rate", type=int, default=50_000)
    parser.add_argument("--json-rate", type=int, default=4_000)
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--actions", type=int, default=20)
    asked = parser.parse_args()
    if asked.what == "gather":
        gather(asked)
    elif not asyncio.run(on_stage(asked)):
        sys.exit(1)


if __name__ == "__main__":
    if sys.argv[1:2] == ["publish"]:
        asyncio.run(publisher(sys.argv[2], sys.argv[3], int(sys.argv[4]), int(sys.argv[5])))
    elif sys.argv[1:2] == ["read"]:
        asyncio.run(reader(sys.argv[2], int(sys.argv[3]), int(sys.argv[4])))
    else:
        main()
