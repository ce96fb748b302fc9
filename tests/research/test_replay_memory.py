"""The memory of a replay does not grow with its recording."""

import subprocess
import sys

import pytest

from support import synthetic_recordings as synthetic

pytestmark = pytest.mark.statistical

ROWS = {"tdoa-table": 8_000, "bitcraze-binary": 2_000, "avalue": 2_000}
PEAKS = """
import sys
from pathlib import Path
from skyless.cli.main import main

for recording in sys.argv[1:4]:
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here on
    if main(["replay", recording, *sys.argv[4:], "--json"]) != 0:
        sys.exit(1)
    status = Path("/proc/self/status").read_text()
    print(status.partition("VmHWM:")[2].split()[0], file=sys.stderr)
"""


@pytest.mark.parametrize("name", ROWS)
def test_ten_times_the_recording_takes_the_same_memory(tmp_path, name):
    """What may grow is bounded: a table of 524 288 fixes (55 MB at most) that figures and pictures come from.

    One process replays a few rows first, which load the kernels or compile them, and then the two recordings.
    """
    (tmp_path / "anchors.csv").write_text(synthetic.anchors_csv())
    counts = 500, ROWS[name], 10 * ROWS[name]
    files = [synthetic.write(tmp_path / str(rows), name, rows) for rows in counts]
    options = ["--anchors", tmp_path / "anchors.csv", *synthetic.LISTENER.get(name, [])]
    if name == "bitcraze-binary":
        options += ["--fixes-csv", tmp_path / "fixes.csv"]
    command = [sys.executable, "-c", PEAKS, *map(str, [*files, *options])]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    _, short, long = (int(word) for word in done.stderr.split() if word.isdecimal())  # between lines of progress
    table = min(9 * ROWS[name], 2**19) * 13 * 8 / 1024
    # Six times: the store, the copy that ``rows`` gives of it, and what the figures of all fixes are computed with.
    assert long - short < 6 * table + 4_000, (short, long)
