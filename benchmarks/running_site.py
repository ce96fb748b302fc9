"""A running demo, and one on a computer that is too busy: how old fixes are when a subscriber gets them.

    python benchmarks/running_site.py --tags 20 --minutes 10    # latency; processor time and memory of each process
    python benchmarks/running_site.py --loops 1                 # a busy loop on every core for 20 s
    python benchmarks/running_site.py --loops 4 --plain         # four; no higher priority for radios' programs

With busy loops it prints the ages of fixes before, during and after, what was withheld, and how long it took until
health messages reported the overload and until they no longer did. The age of a fix is the time from the end of its
last frame to its arrival in this process, which asks for the priority of a radio's program: it is to measure the site,
not itself. All the same ``own_delay_ms`` is how late it was at worst; ``age_less_own_ms`` is without that. Programs
are real, radios emulated.
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
import psutil

from skyless.run.fix_log import MAX_AGE_S
from skyless.run.mqtt.address import mqtt_address
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import AnchorHealth, EtherHealth, FixMessage, TagHealth
from skyless.run.mqtt.topics import fix_topic, health_topic
from skyless.run.process import end, end_with_parent
from skyless.sim.lab import lab_site

SITE, START_S, SETTLE_S, PRIORITY = lab_site(), 300.0, 5.0, -15
SHOWN_SHARE = 0.02
"""Missed transmissions from which on the overload counts as reported; some are always missed next to other programs."""
PR_CAPBSET_DROP, CAP_SYS_NICE = 24, 23


class Subscriber:
    """Ages of fixes, and what health messages report, since ``begin``."""

    def __init__(self, link):
        self.tags, self._due_s = {}, math.inf
        self.begin()
        for topic, kind, handle in (
            (fix_topic(SITE.id, "+"), FixMessage, self._on_fix),
            (health_topic(SITE.id, "tag", "+"), TagHealth, self._on_tag),
            (health_topic(SITE.id, "anchor", "+"), AnchorHealth, lambda one: self._on_share("anchors", one)),
            (health_topic(SITE.id, "ether", "+"), EtherHealth, lambda one: self._on_share("air", one)),
        ):
            decode = msgspec.json.Decoder(kind).decode
            link.subscribe(topic, lambda _, payload, decode=decode, handle=handle: handle(decode(payload)))

    def begin(self):
        self.ages_s, self.site_s, self.latencies_s, self.own_s = [], [], [], [0.0]
        self.reports, self.shares, self.begun_s = [], {"air": [0.0], "anchors": [0.0]}, time.monotonic()
        self.begun = {name: health.counters | {"fixes": health.fixes} for name, health in self.tags.items()}

    def _on_fix(self, fix):
        self.ages_s.append(time.time() - fix.unix_s)
        self.site_s.append(self.ages_s[-1] - max(0.0, time.monotonic() - self._due_s))
        self.latencies_s.append(fix.latency_s)

    def _on_tag(self, health):
        before = self.tags.get(health.tag)
        self.tags[health.tag] = health
        if health.late > (before.late if before is not None and before.late <= health.late else 0):
            self.reports.append((time.monotonic(), "late receptions or fixes of tags"))

    def _on_share(self, where, health):
        self.shares[where].append(health.missed_share)
        if health.missed_share > SHOWN_SHARE:
            self.reports.append((time.monotonic(), f"transmissions missed by the {where}"))

    async def measure_itself(self):
        while True:
            self._due_s = time.monotonic() + 0.005
            await asyncio.sleep(0.005)
            self.own_s.append(time.monotonic() - self._due_s)

    def figures(self):
        counted, took_s = Counter(), time.monotonic() - self.begun_s
        for name, health in self.tags.items():
            now = Counter(health.counters | {"fixes": health.fixes})
            now.subtract(self.begun.get(name, {}))
            counted += now
        return {
            "fixes_received": len(self.ages_s), "fixes_made_per_s": round(counted["fixes"] / took_s, 1),
            "late_receptions": counted["late-reception"], "late_fixes": counted["late-fix"],
            "age_ms": quantiles(self.ages_s), "age_less_own_ms": quantiles(self.site_s),
            "latency_ms": quantiles(self.latencies_s), "over_100_ms": sum(one > MAX_AGE_S for one in self.ages_s),
            "missed_share": {where: round(sum(shares) / len(shares), 3) for where, shares in self.shares.items()},
            "own_delay_ms": round(1e3 * max(self.own_s), 1),
        }  # fmt: skip


def quantiles(values_s):
    ordered = sorted(values_s)
    shares = {"p50": 0.5, "p99": 0.99, "max": 1.0}
    at = {name: min(len(ordered) - 1, int(share * len(ordered))) for name, share in shares.items()}
    return {name: round(1e3 * ordered[place], 2) for name, place in at.items()} if ordered else None


def name_of(process):
    words = process.cmdline()
    after = words.index("skyless.cli.main") + 1 if "skyless.cli.main" in words else 0
    return " ".join(words[after : after + 2])[:24] if after else Path(words[0]).name


@contextlib.contextmanager
def busy(loops):
    """Busy loops on every core, in sessions of their own: Linux would count them and this process as one."""
    code = "import os, sys; os.sched_setaffinity(0, {int(sys.argv[1])})\nwhile True: pass"
    running = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(core)], start_new_session=True,
            preexec_fn=end_with_parent(),  # noqa: PLW1509
        )
        for core in sorted(os.sched_getaffinity(0)) * loops
    ]  # fmt: skip
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


async def overload(subscriber, asked):
    result = {}
    subscriber.begin()
    await asyncio.sleep(asked.seconds / 2)
    result["before"] = subscriber.figures()
    subscriber.begin()
    begun_s = time.monotonic()
    with busy(asked.loops):
        await asyncio.sleep(asked.seconds)
        result["during"] = subscriber.figures()
    ended_s, first_s = time.monotonic(), min((at_s for at_s, _ in subscriber.reports), default=math.nan)
    result["reported_after_s"], result["reports"] = first_s - begun_s, Counter(what for _, what in subscriber.reports)
    subscriber.begin()
    await asyncio.sleep(asked.seconds * 0.75)
    result["normal_after_s"] = max((at_s - ended_s for at_s, _ in subscriber.reports), default=0.0)
    return result | {"after": subscriber.figures()}


async def endure(pid, subscriber, seconds):
    """Latency over a long time; of each process the share of a core, and its memory at first and at last."""
    subscriber.begin()
    family = psutil.Process(pid).children(recursive=True)
    before = {one: (one.cpu_times(), one.memory_info().rss) for one in family}
    await asyncio.sleep(seconds)
    result, processes = subscriber.figures() | {"tags": len(subscriber.tags)}, {}
    for one, (cpu, rss) in before.items():
        if not one.is_running():  # such as a probe of the system at the start
            continue
        share = sum(one.cpu_times()[:2]) - sum(cpu[:2])
        memory_mb = [round(rss / 1e6, 1), round(one.memory_info().rss / 1e6, 1)]
        processes[f"{one.pid} {name_of(one)}"] = {"cpu_share": round(share / seconds, 3), "memory_mb": memory_mb}
    return result | {"processes": processes}


async def measure(asked):
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    with tempfile.TemporaryDirectory() as folder:
        command = ["-m", "skyless.cli.main", "demo", "--json", "--record", "none", "--tags", str(asked.tags)]
        log, tasks = Path(folder) / "demo.log", []
        with log.open("wb") as stderr:
            process = await asyncio.create_subprocess_exec(
                sys.executable, *command, stdout=subprocess.DEVNULL, stderr=stderr,
                env=os.environ | {"XDG_DATA_HOME": folder},
                preexec_fn=plain_user() if asked.plain else end_with_parent(),
            )  # fmt: skip
        try:
            async with asyncio.timeout(START_S):
                while not (found := re.search(r"^broker +(\S+)$", log.read_text(), re.MULTILINE)):
                    if process.returncode is not None:
                        raise SystemExit(log.read_text())
                    await asyncio.sleep(0.1)
                link = Link(mqtt_address(found[1]), "benchmark", site=SITE.id, kind="watch")
                subscriber = Subscriber(link)
                tasks = [asyncio.ensure_future(part) for part in (link.run(), subscriber.measure_itself())]
                while sum(health.fixes > 0 for health in subscriber.tags.values()) < asked.tags:
                    await asyncio.sleep(0.1)
            await asyncio.sleep(SETTLE_S)
            if asked.loops:
                return await overload(subscriber, asked)
            return await endure(process.pid, subscriber, 60.0 * asked.minutes)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await end(process)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tags", type=int, default=3)
    parser.add_argument("--minutes", type=float, default=1.0, help="without busy loops")
    parser.add_argument("--loops", type=int, default=0, help="busy loops on every core")
    parser.add_argument("--seconds", type=float, default=20.0, help="of the busy loops")
    parser.add_argument("--plain", action="store_true", help="the demo may not raise its programs' priority")
    asked = parser.parse_args()
    result = asyncio.run(measure(asked))
    machine = {"machine": platform.machine(), "cores": len(os.sched_getaffinity(0)), "load_1_min": os.getloadavg()[0]}
    print(json.dumps(machine | result, indent=1))


if __name__ == "__main__":
    main()
