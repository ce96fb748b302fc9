"""What ``skyless demo`` costs: time and CPU up to its first fixes, memory, processes and ports; simulated radios.

    python benchmarks/demo_start.py --runs 3
    python benchmarks/demo_start.py --runs 3 --other ../earlier    # another checkout in turn, and the ratios

CPU and memory are of all its processes together; memory is the proportional share (PSS), after ten seconds.
"""

import argparse
import asyncio
import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

from skyless.run.mqtt.address import mqtt_address
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.topics import EVERY_NODE, fix_topic
from skyless.sim.lab import lab_site

HERE = Path(__file__).parents[1]
TICKS = os.sysconf("SC_CLK_TCK")
LATER_S = 10.0
TAGS = 3
SITE = lab_site().id


def processes_of(session: int) -> list[int]:
    """Processes that descend from one."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        children.setdefault(int(fields[1]), []).append(int(entry.parent.name))
    found, queue = [], [session]
    while queue:
        found.append(queue[0])
        queue += children.get(queue.pop(0), [])
    return found


def cpu_s(pids: list[int]) -> float:
    total = 0.0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        total += (int(fields[11]) + int(fields[12])) / TICKS
    return total


def pss_mb(pids: list[int]) -> float:
    lines = (line for pid in pids for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines())
    return sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024


def ports(pids: list[int]) -> int:
    """Sockets that listen for TCP."""
    rows = [line.split() for file in ("tcp", "tcp6") for line in Path(f"/proc/net/{file}").read_text().splitlines()[1:]]
    listening = {row[9] for row in rows if row[3] == "0A"}
    found = set()
    for pid in pids:
        for entry in Path(f"/proc/{pid}/fd").glob("*"):
            with contextlib.suppress(OSError):
                found |= {str(entry.readlink()).removeprefix("socket:[").removesuffix("]")} & listening
    return len(found)


async def first_fixes(broker: str) -> None:
    """Until all tags have a fix."""
    link, seen, all_seen = Link(mqtt_address(broker), "bench", site=SITE, kind="watch"), set(), asyncio.Event()

    def on_fix(topic: str, _payload: bytes) -> None:
        seen.add(topic)
        if len(seen) == TAGS:
            all_seen.set()

    link.subscribe(fix_topic(SITE, EVERY_NODE), on_fix)
    running = asyncio.create_task(link.run())
    async with asyncio.timeout(60.0):
        await all_seen.wait()
    running.cancel()


def run(tree: Path) -> dict[str, float]:
    """One start of a checkout's demo."""
    command = (sys.executable, "-m", "skyless.cli.main", "demo", "--json", "--record", "none", "--duration", "60")
    environment = os.environ | {"PYTHONPATH": str(tree / "src")}
    began_s = time.monotonic()
    demo = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        asyncio.run(first_fixes(next(line.split()[1] for line in demo.stderr if line.startswith("broker"))))
        first_s, first_cpu_s = time.monotonic() - began_s, cpu_s(processes_of(demo.pid))
        time.sleep(LATER_S)
        pids = processes_of(demo.pid)
        costs = {"PSS MB": pss_mb(pids), "processes": len(pids), "ports": ports(pids)}
        return {"first fixes s": first_s, "CPU s": first_cpu_s, **costs}
    finally:
        demo.send_signal(signal.SIGINT)
        demo.communicate()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--other", type=Path)
    asked = parser.parse_args()
    trees = [HERE] + ([asked.other.resolve()] if asked.other else [])
    results: dict[Path, list[dict[str, float]]] = {tree: [] for tree in trees}
    for _ in range(asked.runs):
        for tree in trees:
            results[tree].append(run(tree))
            print(json.dumps({"tree": str(tree), **results[tree][-1]}), flush=True)
    medians = {
        tree: {key: statistics.median(row[key] for row in rows) for key in rows[0]} for tree, rows in results.items()
    }
    for tree, row in medians.items():
        print(tree, {key: round(value, 2) for key, value in row.items()})
    if asked.other:
        own, other = (medians[tree] for tree in trees)
        print("ratios", {key: round(own[key] / other[key], 3) for key in own})


if __name__ == "__main__":
    main()
