"""A demo on a computer that is too busy, or with many tags: how old fixes are when a subscriber gets them.

    python benchmarks/overload.py                          # a busy loop on every core for 20 s
    python benchmarks/overload.py --loops 4 --plain        # four of them, and no higher priority for radios' programs
    python benchmarks/overload.py --tags 20 --minutes 10   # no busy loops: latency, and memory of each process

The first prints the ages of fixes before, during and after, what was withheld, and how long it took until health
messages reported the overload and until they no longer did. The age of a fix is the time from the end of its last
frame to its arrival in this process, which asks for the priority of a radio's program: it is to measure the site, not
itself. All the same ``own_delay_ms`` is how late it was at worst; ``age_less_own_ms`` is without that.
"""

import argparse
import asyncio
import contextlib
import ctypes
import json
import math
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import msgspec

from skyless.run.children import end
from skyless.run.fix_log import MAX_AGE_S
from skyless.run.mqtt.address import mqtt_address
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import AnchorHealth, EtherHealth, FixMessage, TagHealth
from skyless.run.mqtt.topics import fix_topic, health_topic
from skyless.run.process import end_with_parent
from skyless.sim.lab import lab_site

START_S = 300.0
SETTLE_S = 10.0
AFTER_S = 15.0
SHOWN_SHARE = 0.02
"""Missed transmissions from which on the overload counts as reported; some are always missed next to other programs."""
SITE = lab_site()
PRIORITY = -15
PR_CAPBSET_DROP, CAP_SYS_NICE = 24, 23


class Subscriber:
    """Ages of fixes, and what health messages report, since ``begin``."""

    def __init__(self, link):
        self.tags, self.anchors, self.ether = {}, {}, None
        self._due_s = math.inf
        self.begin()
        for topic, kind, handle in (
            (fix_topic(SITE.id, "+"), FixMessage, self._on_fix),
            (health_topic(SITE.id, "tag", "+"), TagHealth, self._on_tag),
            (health_topic(SITE.id, "anchor", "+"), AnchorHealth, self._on_anchor),
            (health_topic(SITE.id, "ether", "+"), EtherHealth, self._on_ether),
        ):
            decode = msgspec.json.Decoder(kind).decode
            link.subscribe(topic, lambda _, payload, decode=decode, handle=handle: handle(decode(payload)))

    def begin(self):
        self.ages_s, self.site_s, self.latencies_s, self.own_s = [], [], [], [0.0]
        self.reports = []
        """Health messages with overload: arrival, and what they report."""
        self.shares = {"air": [0.0], "anchors": [0.0]}
        self.begun = {name: health.counters | {"fixes": health.fixes} for name, health in self.tags.items()}

    def _on_fix(self, fix):
        own_s = max(0.0, time.monotonic() - self._due_s)
        self.ages_s.append(time.time() - fix.unix_s)
        self.site_s.append(self.ages_s[-1] - own_s)
        self.latencies_s.append(fix.latency_s)

    def _on_tag(self, health):
        before = self.tags.get(health.tag)
        late = health.late - (before.late if before is not None and before.late <= health.late else 0)
        self.tags[health.tag] = health
        if late:
            self.reports.append((time.monotonic(), "late receptions or fixes of tags"))

    def _on_anchor(self, health):
        self.anchors[health.anchor] = health
        self._on_share("anchors", health.missed_share)

    def _on_ether(self, health):
        self.ether = health
        self._on_share("air", health.missed_share)

    def _on_share(self, where, share):
        self.shares[where].append(share)
        if share > SHOWN_SHARE:
            self.reports.append((time.monotonic(), f"transmissions missed by the {where}"))

    async def measure_itself(self):
        """How late this process itself is."""
        while True:
            self._due_s = time.monotonic() + 0.005
            await asyncio.sleep(0.005)
            self.own_s.append(time.monotonic() - self._due_s)

    def figures(self):
        """Ages in ms, and what was counted."""
        counted = Counter()
        for name, health in self.tags.items():
            now = Counter(health.counters | {"fixes": health.fixes})
            now.subtract(self.begun.get(name, {}))
            counted += now
        return {
            "fixes_received": len(self.ages_s),
            "fixes_made": counted["fixes"],
            "late_receptions": counted["late-reception"],
            "late_fixes": counted["late-fix"],
            "age_ms": quantiles(self.ages_s),
            "age_less_own_ms": quantiles(self.site_s),
            "latency_ms": quantiles(self.latencies_s),
            "over_100_ms": sum(age_s > MAX_AGE_S for age_s in self.ages_s),
            "over_100_ms_less_own": sum(age_s > MAX_AGE_S for age_s in self.site_s),
            "missed_share": {
                where: {"mean": round(sum(shares) / len(shares), 3), "max": round(max(shares), 3)}
                for where, shares in self.shares.items()
            },
            "own_delay_ms": round(1e3 * max(self.own_s), 1),
        }


def quantiles(values_s):
    """Median, 99th percentile and largest, in ms."""
    ordered = sorted(values_s)
    if not ordered:
        return None
    return {name: round(1e3 * ordered[min(len(ordered) - 1, int(share * len(ordered)))], 2)
            for name, share in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))}  # fmt: skip


def children_of(pid):
    """Processes that a process has started, and what these have started: their pids and names."""
    found, parents = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, IndexError):
            stat = (folder / "stat").read_text(errors="replace").rpartition(")")[2].split()
            words = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
            parents[int(folder.name)] = int(stat[1]), words
    family = {pid}
    while more := {child for child, (parent, _) in parents.items() if parent in family} - family:
        family |= more
    for child in sorted(family & parents.keys()):
        words = parents[child][1]
        after = words.index("skyless.cli.main") + 1 if "skyless.cli.main" in words else 0
        found[child] = " ".join(words[after : after + 2])[:24] if after else Path(words[0]).name
    return found


def resident_mb(pid):
    with contextlib.suppress(OSError):
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    return None


@contextlib.contextmanager
def busy(loops):
    """A number of busy loops on every core."""
    cores = sorted(os.sched_getaffinity(0)) * loops
    code = "import os, sys; os.sched_setaffinity(0, {int(sys.argv[1])})\nwhile True: pass"
    running = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(core)],
            preexec_fn=end_with_parent(),  # noqa: PLW1509
            start_new_session=True,  # else Linux would count them and this process as one
        )
        for core in cores
    ]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def plain_user():
    """What a child does before it becomes a program that may not raise its priority, as of a user who is not root."""
    prepare, prctl = end_with_parent(), ctypes.CDLL(None).prctl

    def act():
        prepare()
        prctl(PR_CAPBSET_DROP, CAP_SYS_NICE, 0, 0, 0)
        os.setpriority(os.PRIO_PROCESS, 0, 0)

    return act


@contextlib.asynccontextmanager
async def demo(tags, folder, *, plain):
    """A demo, its process, and a subscriber to its broker once all tags have fixes."""
    command = ["-m", "skyless.cli.main", "demo", "--json", "--record", "none", "--tags", str(tags)]
    environment = os.environ | {"XDG_DATA_HOME": folder}
    log = Path(folder) / "demo.log"
    with log.open("wb") as stderr:
        process = await asyncio.create_subprocess_exec(
            sys.executable, *command, stdout=subprocess.DEVNULL, stderr=stderr, env=environment,
            preexec_fn=plain_user() if plain else end_with_parent(),
        )  # fmt: skip
    tasks = []
    try:
        async with asyncio.timeout(START_S):
            while not (found := re.search(r"^broker +(\S+)$", log.read_text(), re.MULTILINE)):
                if process.returncode is not None:
                    raise SystemExit(log.read_text())
                await asyncio.sleep(0.1)
            link = Link(mqtt_address(found[1]), "benchmark", site=SITE.id, kind="watch")
            subscriber = Subscriber(link)
            tasks = [asyncio.ensure_future(part) for part in (link.run(), subscriber.measure_itself())]
            while sum(health.fixes > 0 for health in subscriber.tags.values()) < tags:
                await asyncio.sleep(0.1)
        await asyncio.sleep(SETTLE_S)
        yield process, subscriber
    finally:
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)
        await end(process)
        print(log.read_text(), file=sys.stderr, end="")


async def overload(subscriber, seconds, loops):
    """Ages before, during and after the busy loops, and when health messages reported them."""
    result = {}
    subscriber.begin()
    await asyncio.sleep(10.0)
    result["before"] = subscriber.figures()
    subscriber.begin()
    begun_s = time.monotonic()
    with busy(loops):
        await asyncio.sleep(seconds)
        result["during"] = subscriber.figures()
    ended_s = time.monotonic()
    first = min(subscriber.reports, default=None)
    result["reported_after_s"], result["reported_as"] = (None, "") if first is None else (first[0] - begun_s, first[1])
    result["reports"] = dict(Counter(what for _, what in subscriber.reports))
    subscriber.begin()
    await asyncio.sleep(AFTER_S)
    result["normal_after_s"] = max((at_s - ended_s for at_s, _ in subscriber.reports), default=0.0)
    result["after"] = subscriber.figures()
    return result


async def endure(process, subscriber, minutes):
    """Latency over a long time, and how each process's memory has grown."""
    subscriber.begin()
    family = children_of(process.pid)
    before = {pid: resident_mb(pid) for pid in family}
    await asyncio.sleep(60.0 * minutes)
    result = subscriber.figures() | {"tags": len(subscriber.tags), "minutes": minutes, "memory_mb": {}}
    for pid, name in family.items():
        after = resident_mb(pid)
        if before[pid] is not None and after is not None:
            result["memory_mb"][f"{pid} {name}"] = [round(before[pid], 1), round(after, 1)]
    return result


async def measure(asked):
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    with tempfile.TemporaryDirectory() as folder:
        async with demo(asked.tags, folder, plain=asked.plain) as (process, subscriber):
            if asked.minutes is not None:
                return await endure(process, subscriber, asked.minutes)
            return await overload(subscriber, asked.seconds, asked.loops)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tags", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=20.0, help="of the busy loops")
    parser.add_argument("--loops", type=int, default=1, help="busy loops on every core")
    parser.add_argument("--minutes", type=float, help="without busy loops: latency and memory over this time")
    parser.add_argument("--plain", action="store_true", help="the demo may not raise its programs' priority")
    asked = parser.parse_args()
    result = asyncio.run(measure(asked))
    machine = {"machine": platform.machine(), "cores": len(os.sched_getaffinity(0)), "load_1_min": os.getloadavg()[0]}
    print(json.dumps(machine | result, indent=1))


if __name__ == "__main__":
    main()
