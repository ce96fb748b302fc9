"""Every script of ``benchmarks/`` runs in a short form and prints its figures; none of speed is judged."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.statistical

ROOT = Path(__file__).parents[2]
MULOC = Path(os.environ.get("SKYLESS_DATA", ROOT.parent / "shared" / "data")) / "muloc" / "location1_2.npz"
RUNS = {
    "alarms": (["--seconds", "0.3"], ("cost",)),
    "attacks": (["forged", "--attack", "any", "--seconds", "4.5"], ("| any | 477 |", "| 0 (0.0 mm), 0 (0.0 mm) | 0 |")),
    "board": (["accuracy", "--seeds", "1", "--seconds", "2", "--only", "50 %"], ("RMSE, `joint`", "| 50 % lost |")),
    "estimator_table": (
        ["--worlds", "1", "--only", "NONE", "--rows", "90 % lost"],
        ("| | RMSE | worst tag | NEES |", "| 90 % lost |"),
    ),
    "fira_accuracy": (["--worlds", "1", "--seeds", "1", "--seconds", "2.2"], ("round_ratio", "one way")),
    "firmware": (
        ["tag", "--only", "awake", "--seconds", "0.2", "--seeds", "1"],
        ("| always on | received a second |", "| 12 anchors"),
    ),
    "history": (
        ["--rows", "20000", "--json"],
        ("peak_mb", "way of a tag in a shift", "SQL: mean error of each tag, a day"),
    ),
    "host_latency": (["--seconds", "5", "--seeds", "1", "--slot-ms", "5"], ("| tag heard |", "| 5 ms | adapts |")),
    "hub": (
        ["gather", "--seconds", "1", "--rate", "10000", "--json-rate", "500"],
        ("json: 500 fixes", "'read': 10000", "in the stream: 10500 of 10500 fixes, no gap"),
    ),
    "page": (["--part", "page", "--quick", "--seconds", "1"], ("frames_per_s", "cpu_ms_per_frame")),
    "recorded_phases": ([str(MULOC)], ("channel 1, stamps alone:", "place at rest")),
    "running_site": (["--minutes", "0.05"], ("fixes_made_per_s", "cpu_share", "age_less_own_ms")),
    "speed": (["--quick", "--json"], ("joint_room_mesh", "seconds_per_message", "rows_per_s", "all_cores_draws_per_s")),
}
NEEDS = {"board": "gcc", "firmware": "arm-none-eabi-gcc", "page": "chromium"}


def test_every_script_is_run():
    assert {file.stem for file in (ROOT / "benchmarks").glob("*.py")} == RUNS.keys()


@pytest.mark.parametrize("name", RUNS)
def test_it_prints_what_it_measures(name):
    if name == "recorded_phases" and not MULOC.exists():
        pytest.skip(f"the recording {MULOC} is not here")
    if name in NEEDS and shutil.which(NEEDS[name]) is None:
        pytest.skip(f"{NEEDS[name]} is not installed")
    arguments, words = RUNS[name]
    done = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / f"{name}.py", *arguments],
        capture_output=True, text=True, check=False, timeout=300, cwd=ROOT, env=os.environ,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [word for word in words if word not in done.stdout] == [], done.stdout
