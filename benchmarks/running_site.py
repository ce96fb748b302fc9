"""What a running site costs: real processes, emulated radios, real time.

    python benchmarks/running_site.py --tags 50 --processes 2 --seconds 20 --json

Without ``--tags``, a table for 1, 10 and 50 tags. CPU is of one core, from /proc; updates and latencies are what
the tags tell on MQTT once a second.
"""

import argparse
import asyncio
import contextlib
import json
import os
import platform
import sys
import tempfile
from pathlib import Path

import msgspec

from skyless.run.broker import BrokerSettings, start_broker
from skyless.run.children import Child, Program
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import AnchorHealth, EtherHealth, TagHealth
from skyless.run.mqtt.topics import health_topic
from skyless.run.process import hold_any
from skyless.sim.lab import lab_site

START_S = 120.0
SETTLE_S = 3.0
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
SITE = lab_site()


class Healths:
    """The last health message of every node, and all latencies of tags since ``clear``."""

    def __init__(self, link):
        self.tags, self.anchors, self.ether, self.latencies = {}, {}, None, []
        for kind, take in (("tag", self._tag), ("anchor", self._anchor), ("ether", self._ether)):
            link.subscribe(health_topic(SITE.id, kind, "+"), take)

    def _tag(self, _, payload):
        health = msgspec.json.decode(payload, type=TagHealth)
        self.tags[health.tag] = health
        if health.latency_p99_s is not None:
            self.latencies.append((health.latency_p50_s, health.latency_p99_s))

    def _anchor(self, _, payload):
        health = msgspec.json.decode(payload, type=AnchorHealth)
        self.anchors[health.anchor] = health

    def _ether(self, _, payload):
        self.ether = msgspec.json.decode(payload, type=EtherHealth)


def cpu_s(pid):
    """CPU time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def resident_mb(pid):
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def programs(tags, processes, port, mqtt, publish_hz):
    """Ether, anchors, and the tags in so many processes."""
    radio, broker = ("--radio", f"ether:127.0.0.1:{port}"), ("--mqtt", mqtt)
    names = [f"tag{number}" for number in range(1, tags + 1)]
    yield Program("ether", ("ether", "--tags", str(tags), "--listen", f"127.0.0.1:{port}", *broker))
    yield Program("anchors", ("anchor", *(str(anchor.id) for anchor in SITE.anchors), *radio, *broker))
    for process in range(min(processes, tags)):
        rate = ("--publish-hz", str(publish_hz))
        yield Program("tags", ("tag", *names[process::processes], *radio, *broker, *rate))


async def measure(tags, processes, seconds, publish_hz):
    """Run a site of so many tags, and what it took."""
    with tempfile.TemporaryDirectory() as folder:
        port, held = hold_any("127.0.0.1")
        held.close()
        broker = await start_broker(BrokerSettings(data=Path(folder)))
        link = Link(broker.address, "benchmark", site=SITE.id, kind="watch")
        healths = Healths(link)
        children = [
            Child(program, lambda line: print(line, file=sys.stderr))
            for program in programs(tags, processes, port, str(broker.address), publish_hz)
        ]
        tasks = [asyncio.ensure_future(part.run()) for part in (link, *children)]
        try:
            async with asyncio.timeout(START_S):
                while sum(health.fixes > 0 for health in healths.tags.values()) < tags or healths.ether is None:
                    await asyncio.sleep(0.1)
            await asyncio.sleep(SETTLE_S)
            return await watch(healths, children, broker.pid, seconds)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
            await broker.stop()


async def watch(healths, children, broker_pid, seconds):
    """The figures of so many seconds."""
    pids = [child.pid for child in children] + [broker_pid]
    healths.latencies.clear()
    tags, anchors, ether = dict(healths.tags), dict(healths.anchors), healths.ether
    before, begin_s = [cpu_s(pid) for pid in pids], asyncio.get_running_loop().time()
    await asyncio.sleep(seconds)
    took_s = asyncio.get_running_loop().time() - begin_s
    shares = [(cpu_s(pid) - cpu) / took_s for pid, cpu in zip(pids, before, strict=True)]
    of_tags, tag_pids = shares[2:-1], pids[2:-1]
    rates = [
        (health.fixes - tags[name].fixes) / (health.unix_s - tags[name].unix_s) for name, health in healths.tags.items()
    ]
    return {
        "tags": len(rates),
        "processes": len(of_tags),
        "updates_per_s_mean": sum(rates) / len(rates),
        "updates_per_s_min": min(rates),
        "cpu_ether": shares[0],
        "cpu_anchors": shares[1],
        "cpu_tags": sum(of_tags),
        "cpu_per_tag": sum(of_tags) / len(rates),
        "cpu_broker": shares[-1],
        "tag_process_mb": max(resident_mb(pid) for pid in tag_pids),
        "ether_mb": resident_mb(pids[0]),
        "latency_p50_s": sorted(median_s for median_s, _ in healths.latencies)[len(healths.latencies) // 2],
        "latency_p99_s": sorted(late_s for _, late_s in healths.latencies)[len(healths.latencies) // 2],
        "latency_p99_worst_s": max(late_s for _, late_s in healths.latencies),
        "late_per_s": sum(h.late - anchors[a].late for a, h in healths.anchors.items()) / took_s,
        "stalls": healths.ether.stalls - ether.stalls,
        "overruns": healths.ether.overruns - ether.overruns,
        "restarts": sum(child.starts - 1 for child in children),
        "load_1_min": os.getloadavg()[0],
    }


COLUMNS = (
    ("tags", "tags", 1, "d"),
    ("updates/s", "updates_per_s_mean", 1, ".1f"),
    ("min", "updates_per_s_min", 1, ".1f"),
    ("ether %", "cpu_ether", 100, ".1f"),
    ("anchors %", "cpu_anchors", 100, ".1f"),
    ("tags %", "cpu_tags", 100, ".1f"),
    ("per tag %", "cpu_per_tag", 100, ".2f"),
    ("broker %", "cpu_broker", 100, ".1f"),
    ("tag MB", "tag_process_mb", 1, ".0f"),
    ("p50 ms", "latency_p50_s", 1e3, ".2f"),
    ("p99 ms", "latency_p99_s", 1e3, ".2f"),
    ("worst ms", "latency_p99_worst_s", 1e3, ".1f"),
    ("late/s", "late_per_s", 1, ".1f"),
    ("stalls", "stalls", 1, "d"),
    ("lost", "overruns", 1, "d"),
    ("load", "load_1_min", 1, ".1f"),
)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tags", type=int)
    parser.add_argument("--processes", type=int, default=2, help="processes to put the tags in")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--publish-hz", type=float, default=50.0)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    results = []
    if not asked.json:
        print(f"{platform.machine()}, {os.cpu_count()} cores; CPU in % of one core; p99 is the median of the seconds'")
        print("  ".join(f"{title:>9}" for title, *_ in COLUMNS), flush=True)
    for tags in (asked.tags,) if asked.tags else (1, 10, 50):
        with contextlib.suppress(KeyboardInterrupt):
            results.append(asyncio.run(measure(tags, asked.processes, asked.seconds, asked.publish_hz)))
        if not asked.json and results:
            cells = (f"{format(results[-1][key] * scale, form):>9}" for _, key, scale, form in COLUMNS)
            print("  ".join(cells), flush=True)
    if asked.json:
        print(json.dumps(results if asked.tags is None else results[0]))


if __name__ == "__main__":
    main()
