"""The progress bar: on a terminal when the work is long, nowhere else."""

import os
import pty
import subprocess
import sys
import threading

import pytest

from skyless.cli.common import progress
from skyless.core.kernels import processes
from skyless.core.kernels.processes import LAB

pytestmark = pytest.mark.site

WORK = """
from skyless.cli.common import progress
progress._HIDDEN_S = {patience}
with progress.progress_bar("replaying", 3) as bar:
    for done in range(4):
        bar.reach(done)
"""


def on_terminal(code):
    """What a program writes to its standard error when that is a terminal."""
    ours, theirs = pty.openpty()
    written = []

    def read():
        try:
            while data := os.read(ours, 4096):
                written.append(data)
        except OSError:  # the last writer has gone
            pass

    reader = threading.Thread(target=read)
    reader.start()
    environment = {**os.environ, "TERM": "xterm"}
    done = subprocess.run(
        [sys.executable, "-c", code], stderr=theirs, capture_output=False, check=True, env=environment
    )
    os.close(theirs)
    reader.join()
    os.close(ours)
    assert done.returncode == 0
    return b"".join(written).decode()


def test_long_work_on_a_terminal():
    assert "replaying" in on_terminal(WORK.format(patience=0))


def test_short_work_on_a_terminal():
    assert on_terminal(WORK.format(patience=60)) == ""


COUNTS = """
from skyless.cli.common.progress import CountLine
from skyless.core.kernels.processes import Preparation
with CountLine() as line:
    line.show(Preparation(0, 0, None))
    line._next_s = 0.0
    line.show(Preparation(37, 120, 25.2))
    line.show(Preparation(38, 120, 24.9))
"""


def test_counts_of_compilation_are_lines_in_a_pipe_and_one_line_on_a_terminal():
    done = subprocess.run([sys.executable, "-c", COUNTS], capture_output=True, text=True, check=True)
    assert done.stdout == ""
    assert done.stderr.splitlines() == [
        "skyless: compiling what this command needs and was not compiled before; skyless warm compiles everything",
        "skyless: compiling kernels",
        "skyless: compiling kernels: 37 of 120, about 25 s left",
        "skyless: compiling has ended",
    ]
    shown = on_terminal(COUNTS)
    assert shown.count("\n") == 1
    assert shown.rstrip(" \r").endswith("37 of 120, about 25 s left")
    assert shown.endswith("\r")


def test_kernels_that_cannot_be_compiled_are_reported(monkeypatch, capsys):
    monkeypatch.setattr(processes, "missing", lambda parts: parts)
    monkeypatch.setattr(progress, "compile_with_counts", lambda _: ("the kernels of air could not be compiled: no",))
    with progress.loading_kernels(*LAB):
        pass
    line = "skyless: the kernels of air could not be compiled: no; they are compiled where they are needed\n"
    assert capsys.readouterr().err == line


def test_never_in_a_pipe():
    environment = {**os.environ, "FORCE_COLOR": "1"}
    code = WORK.format(patience=0)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, env=environment)
    assert done.stdout + done.stderr == b""
