"""Progress of long work: a bar on a terminal, a line now and then in a pipe."""

import os
import pty
import subprocess
import sys
import threading

import pytest

pytestmark = pytest.mark.site

WORK = """
from skyless.cli import common as progress
progress._HIDDEN_S = {patience}
with progress.progress_bar("replaying", 3) as reach:
    for done in range(4):
        reach(done)
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


@pytest.mark.parametrize(("every_s", "written"), [(3600.0, b""), (0.0, b"replaying: 33%\nreplaying: 67%\n")])
def test_lines_in_a_pipe(every_s, written):
    """One every few seconds, so none of short work, and none once all is done."""
    environment = {**os.environ, "FORCE_COLOR": "1"}
    code = WORK.format(patience=0).replace("progress._HIDDEN_S", f"progress._LINE_S = {every_s}; progress._HIDDEN_S")
    code = code.replace("range(4)", "(1, 2, 3)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, env=environment)
    assert (done.stdout, done.stderr) == (b"", written)
