"""Long commands take no more memory than their documents state, and the paper's verdicts are those stated.

Memory is what all processes have at a time, each shared page counted once (Linux' PSS). The CPU time that the documents
state is that of one machine: it is not judged on another.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.statistical

DOCS = Path(__file__).parents[2] / "docs"
STATED = re.compile(r"`skyless ([^`]+)` takes \d+ s of CPU time and at most (\d+) MB of memory on two cores")


def memory_mb(group):
    """Memory of all processes of a group at this moment."""
    total_kb = 0
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if os.getpgid(int(process.name)) == group:
                total_kb += int(re.search(r"^Pss: +(\d+)", (process / "smaps_rollup").read_text(), re.MULTILINE)[1])
        except (OSError, TypeError):  # it has ended meanwhile
            continue
    return total_kb / 1024.0


def within_what_is_stated(command, page, folder, *more):
    """What a command writes on standard output and error, which takes no more memory than a page says."""
    ((_, most_mb),) = (found for found in STATED.findall(" ".join(page.read_text().split())) if found[0] == command)
    cores = ",".join(map(str, sorted(os.sched_getaffinity(0))[:2]))
    words = ["taskset", "--cpu-list", cores, sys.executable, "-m", "skyless.cli.main", *command.split(), *more]
    peak_mb, ended = 0.0, 0
    with (folder / "out").open("w") as out, (folder / "err").open("w") as err:
        started = subprocess.Popen(words, cwd=folder, stdout=out, stderr=err, start_new_session=True)
        try:
            while not ended:
                time.sleep(0.5)
                peak_mb = max(peak_mb, memory_mb(started.pid))
                ended, status = os.waitpid(started.pid, os.WNOHANG)
        finally:
            if not ended:
                os.killpg(started.pid, signal.SIGKILL)
    started.returncode = os.waitstatus_to_exitcode(status)
    assert started.returncode == 0, (folder / "err").read_text()
    assert peak_mb <= float(most_mb)
    return (folder / "out").read_text(), (folder / "err").read_text()


@pytest.mark.timeout(3600)
def test_the_paper(tmp_path):
    page = DOCS / "paper.md"
    out, _ = within_what_is_stated("paper", page, tmp_path, "--out", "report", "--seed", "1", "--json")
    verdicts = [section["verdict"] for section in json.loads(out)["sections"]]
    assert len(verdicts) == 10
    assert verdicts == re.findall(r"^\| \d+ [^|]+\|[^|]+\| ([^|]+) \|", page.read_text(), re.MULTILINE)


@pytest.mark.timeout(3600)
def test_a_quick_study_of_the_room(tmp_path):
    out, err = within_what_is_stated("study room --quick", DOCS / "howto" / "study.md", tmp_path)
    assert max(map(len, out.splitlines())) <= 100
    assert re.fullmatch(r"(studying room: \d+%\n)*", err)
