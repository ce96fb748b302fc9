"""What questions to a history cost: ``python benchmarks/history.py [--rows 1e6] [--folder FOLDER] [--json]``.

Writes the fixes of 500 tags at 1 Hz, half of them walking, with their zone events, as the history's own program leaves
them after a night: files of an hour. Each question is asked in a process of its own. Processor seconds are those of all
threads, user and system: of the question alone, and with the start of Python and the loading of libraries. Data of
the same size in a given folder is used again; without --folder it is removed at the end. 1e8 rows take half a gigabyte.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from skyless.core.errors import SkylessError
from skyless.run.history.answers import Span
from skyless.run.history.layout import EVENT_COLUMNS, FIX_COLUMNS, NAME_COLUMNS, ZONE_COLUMNS, file_name, site_folder
from skyless.run.history.queries import History
from skyless.run.history.tables import columns_of, write_table

SITE, TAGS, HOUR_S = 1, 500, 3600
HALL_M = np.array([100.0, 60.0])
BEGIN = datetime(2026, 11, 2, tzinfo=UTC)
ZONES = 24
SHIFT_S = 8 * HOUR_S
ERROR_OF_TAGS = "SELECT tag, avg(std_m) AS std_m FROM fixes GROUP BY tag"


def write_history(folder, rows):
    """Hours of fixes until there are so many rows; returns the number of bytes of the fixes' files."""
    draw, site = np.random.default_rng(1), site_folder(folder, SITE)
    last: np.ndarray | None = None
    place, first, size, events = draw.uniform((0.0, 0.0), HALL_M, (TAGS, 2)), 1, 0, []
    number = np.arange(1, TAGS + 1)
    for hour in range(-(-rows // (TAGS * HOUR_S))):
        seconds = min(HOUR_S, -(-(rows - first + 1) // TAGS))
        begin = BEGIN + timedelta(hours=hour)
        ms = round(1000 * begin.timestamp()) + 1000 * np.arange(seconds) + draw.integers(0, 300, (TAGS, seconds))
        walks = draw.uniform(size=(TAGS, 1, 1)) < 0.5
        way = place[:, None] + np.cumsum(walks * draw.normal(0.0, 0.7, (TAGS, seconds, 2)), axis=1)
        way = np.abs((way + HALL_M) % (2.0 * HALL_M) - HALL_M)  # mirrored at the walls
        place = way[:, -1]
        mm = np.rint(1000.0 * (way + draw.normal(0.0, 0.03, way.shape))).astype(np.int32).reshape(-1, 2)
        count = TAGS * seconds
        columns = {
            "tag": np.repeat(number, seconds).astype(np.uint32), "t": ms.ravel(), "x_mm": mm[:, 0], "y_mm": mm[:, 1],
            "z_mm": np.rint(draw.normal(1200.0, 40.0, count)).astype(np.int32), "std_mm": draw.integers(30, 60, count),
            "hpl_cm": draw.integers(20, 50, count), "flags": np.full(count, 16),
        }  # fmt: skip
        file = site / f"day={begin.date()}" / file_name(first, first + count - 1)
        write_table(columns, FIX_COLUMNS, file)
        first, size = first + count, size + file.stat().st_size
        strip = (way[:, ::30, 0] / HALL_M[0] * ZONES).astype(int).clip(0, ZONES - 1)  # zones are strips of the hall
        before = strip if last is None else np.column_stack([last, strip])
        for tag, step in zip(*np.nonzero(np.diff(before, axis=1)), strict=True):
            at = int(ms[tag, min(30 * (step + (hour == 0)), seconds - 1)])
            events += [(at, "leave", tag, before[tag, step]), (at, "enter", tag, before[tag, step + 1])]
        last = strip[:, -1]
    write_events(site, events)
    return size


def write_events(site, events):
    events.sort()
    rows = [
        dict.fromkeys(EVENT_COLUMNS)
        | {"t": ms, "kind": kind, "tag": f"tag{tag + 1}", "zone": f"zone{zone}", "text": ""}
        for ms, kind, tag, zone in events
    ]
    write(rows, EVENT_COLUMNS, site / "events" / f"day={BEGIN.date()}" / file_name(1, len(events)))
    write([{"tag": k, "name": f"tag{k}", "since": 0} for k in range(1, TAGS + 1)], NAME_COLUMNS, site / "names.parquet")
    zones = [{"zone": f"zone{k}", "name": f"zone{k}", "corners_m": "[]"} for k in range(ZONES)]
    write(zones, ZONE_COLUMNS, site / "zones.parquet")


def write(rows, kinds, file):
    write_table(columns_of(rows, kinds), kinds, file)


def answer(folder, name, rows):
    """Ask one question in this process."""
    begin_s, end_s = BEGIN.timestamp(), BEGIN.timestamp() + rows / TAGS
    middle = min(begin_s + 10 * HOUR_S, end_s - 1.0)
    shift, day, whole = Span(middle, middle + SHIFT_S), Span(begin_s, begin_s + 86_400.0), Span(begin_s, end_s)
    history = History(folder, SITE)
    asked = {
        "way of a tag in a shift": lambda: history.track("tag77", shift).fixes,
        "way of a tag in a day": lambda: history.track("tag77", day).fixes,
        "heat map of all, whole range": lambda: round(sum(history.heatmap(whole).seconds)),
        "heat map of all, a day": lambda: round(sum(history.heatmap(day).seconds)),
        "heat map of a tag, whole range": lambda: round(sum(history.heatmap(whole, tags=("tag77",)).seconds)),
        "contacts of a tag in a shift": lambda: len(history.contacts("tag77", shift)),
        "contacts of a tag in a day": lambda: len(history.contacts("tag77", day)),
        "dwell of all, whole range": lambda: len(history.dwell(whole)),
        "dwell of all, a day": lambda: len(history.dwell(day)),
        "SQL: mean error of each tag, a day": lambda: len(history.sql(ERROR_OF_TAGS, day)),
    }
    if name is None:
        return list(asked)
    return measured(name, asked[name])


def measured(name, ask):
    """What a question costs."""
    before, started = cpu_s(), time.perf_counter()
    try:
        found = ask()
    except SkylessError as error:
        found = str(error)
    wall, after = time.perf_counter() - started, cpu_s()
    status = Path("/proc/self/status").read_text(encoding="ascii")
    peak = 1024 * int(status.partition("VmHWM:")[2].split()[0])  # ru_maxrss would be at least that of the parent
    return {
        "question": name,
        "found": found,
        "cpu_s": after - before,
        "process_cpu_s": after,
        "wall_s": wall,
        "peak_mb": peak / 1e6,
    }


def cpu_s():
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rows", type=lambda text: round(float(text)), default=1_000_000)
    parser.add_argument("--folder", type=Path, help="where the history is written, or was")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--ask", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.ask:
        print(json.dumps(answer(asked.folder, asked.ask, asked.rows)))
        return
    with tempfile.TemporaryDirectory() as scratch:
        folder = asked.folder or Path(scratch)
        if not site_folder(folder, SITE).exists():
            written = write_history(folder, asked.rows)
            print(
                f"{asked.rows} rows of {TAGS} simulated tags, {written / asked.rows:.2f} bytes a row", file=sys.stderr
            )
        answers = []
        for name in answer(folder, None, asked.rows):
            words = [sys.executable, __file__, "--folder", folder, "--rows", str(asked.rows), "--ask", name]
            answers.append(json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout))
    if asked.json:
        print(json.dumps(answers))
        return
    print("| question | CPU-s | CPU-s with the start | wall s | peak MB | found |\n|---|---|---|---|---|---|")
    for one in answers:
        figures = f"{one['cpu_s']:.2f} | {one['process_cpu_s']:.2f} | {one['wall_s']:.2f} | {one['peak_mb']:.0f}"
        print(f"| {one['question']} | {figures} | {one['found']} |")


if __name__ == "__main__":
    main()
