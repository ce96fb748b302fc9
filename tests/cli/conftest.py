"""A clock that the test moves, and commands that are interrupted."""

import csv
import signal
import subprocess
import sys
import time

import pytest
from dashboard_builders import Times


@pytest.fixture
def times():
    return Times()


@pytest.fixture
def interrupted(tmp_path):
    """The head and the rows of fixes of a command that is interrupted while it writes them."""

    def table_of(*arguments):
        path = tmp_path / "fixes.csv"
        command = [sys.executable, "-m", "skyless.cli.main", *arguments, "--fixes-csv", path, "--json"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        for _ in range(1200):
            if any(scratch.stat().st_size > 0 for scratch in tmp_path.glob(".fixes.csv.*")):
                break
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        assert (*process.communicate(timeout=30), process.returncode) == (b"", b"", 130)
        assert path.read_bytes().endswith(b"\n")
        with path.open(newline="") as file:
            head, *rows = csv.reader(file)
        assert len(rows) > 10
        assert {len(row) for row in rows} == {len(head)}
        return head, rows

    return table_of
