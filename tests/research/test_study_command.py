"""``skyless study`` as its user meets it."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from itertools import cycle
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from skyless.cli.main import main
from skyless.research.studies import room
from skyless.research.studies.picture import draw
from skyless.research.studies.run import STUDIES
from skyless.research.studies.runner import plan_of
from skyless.research.studies.worlds import RunResult, run_world
from skyless.site.report import picture

pytestmark = pytest.mark.statistical

COMMAND = [sys.executable, "-m", "skyless.cli.main", "study"]
SMALL = ["--method", "joint", "--quick", "--worlds", "2", "--seconds", "1", "--processes", "1"]


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    """The command in an empty folder: exit code, standard output and standard error."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        return main(["study", *map(str, arguments)]), *capsys.readouterr()

    return call


def test_a_study_tells_its_rows_and_writes_its_files(run, tmp_path):
    code, out, err = run("room", "--conditions", "loss", *SMALL, "--json", "--out", "deep/folder", "--plot", "loss.svg")
    assert (code, err, out.count("\n")) == (0, "wrote loss.svg\n", 1)
    printed = json.loads(out)
    assert (printed["study"], printed["conditions"], printed["seed"], printed["simulated"]) == ("room", "loss", 1, True)
    keys = {"method", "mesh", "noise_ps", "case", "rmse_m", "bound_m", "ratio", "limits", "passed", "nees"}
    assert all(row.keys() >= keys for row in printed["rows"])
    rows = {row["case"]: row for row in printed["rows"]}
    assert rows["50 % lost at tags"]["passed"] == (rows["50 % lost at tags"]["ratio"] <= 1.3)
    bounds_m = [rows[f"{share} % lost, unbiased air"]["bound_m"] for share in (50, 90)]
    assert 0.0167 < bounds_m[0] < bounds_m[1]  # the smaller one where nothing is lost: docs/studies.md
    folder = tmp_path / "deep" / "folder"
    assert {file.name for file in folder.iterdir()} == {"room.json", "room.csv", "room.png", "room.svg"}
    assert json.loads((folder / "room.json").read_text()) == printed["rows"]
    with (folder / "room.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(row["rmse_m"]) for row in table] == [row["rmse_m"] for row in printed["rows"]]
    assert (folder / "room.png").read_bytes().startswith(b"\x89PNG")
    for drawn in (folder / "room.svg", tmp_path / "loss.svg"):
        assert ElementTree.fromstring(drawn.read_bytes()).tag.endswith("svg")


def test_the_study_of_levels_tells_how_often_they_mislead(run):
    code, out, err = run("integrity", "--episodes", "1", "--integrity-risk", "0.01", "--processes", "1")
    assert (code, err) == (0, "")
    for words in ("misleading", "HPL", "room, ramp to 0.5 m", "all faults", "0.01 held", "in 10⁻⁴", "Simulated."):
        assert words in out


def test_the_study_of_the_room_tells_levels_and_what_is_missed(run, tmp_path):
    """In worlds that are too small to find anything."""
    code, out, err = run("room", *SMALL, "--json", "--out", "folder")
    assert (code, err, out.count("\n")) == (0, "", 1)
    rows = json.loads(out)["rows"]
    assert len(rows) == 8
    first = rows[0]
    assert (first["case"], first["method"], first["runs"]) == ("the room", "joint", 2)
    assert {limit["figure"] for limit in first["limits"]} == {"rmse_m", "nees", "level", "exceeded", "hpl_m", "ratio"}
    assert first["passed"] == (not first["missed"])
    assert 0.024 < first["bound_m"] < 0.035
    for row in rows:
        assert 0.0 <= row["level"] <= 1.0
        assert (row["exceeded"] is None) == (row["level"] == 0.0)
        assert row["said_m"] > 0.0
    with (tmp_path / "folder" / "room.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert table[0]["limits"].split()[:2] == ["rmse_m:..0.03", "nees:0.7..1.3"]
    assert ElementTree.fromstring((tmp_path / "folder" / "room.svg").read_bytes()).tag.endswith("svg")


@pytest.mark.parametrize("conditions", room.CONDITIONS)
def test_all_conditions_can_be_drawn(conditions):
    """From rows as they may be, without simulating: with numbers, without, with a single world."""
    plan = plan_of("joint", 1, study="room", quick=True, conditions=conditions, worlds=2)
    study = STUDIES["room"]
    some = RunResult(9, 9, 0.01, 0.01, 9.0, 0, 0.1, np.full(9, 0.03), 9, 1.0, 1e-3)
    none = RunResult(0, 9, 0.0, 0.0, 0.0, 0, 0.0, np.empty(0), 9, 1.0, 1e-3)
    cells = study.cells(plan)
    for results in ([some], [none], [some, none]):
        worlds = cycle(results)
        rows = study.rows(plan, [next(worlds) if cell.function.func is run_world else 0.02**2 for cell in cells])
        assert picture(draw(study, rows), "png", 50.0).startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["lost"], "NAME is 'lost'; it should be one of efficiency, integrity"),
        (["room", "--conditions", "lost"], "--conditions is 'lost'; it should be one of usual, loss"),
        (["large", "--conditions", "loss"], "--conditions is 'loss'; it should be left out: it is for the study room"),
        (["room", "--episodes", "5"], "for the studies efficiency and integrity; room takes --worlds and --seconds"),
        (["room", "--integrity-risk", "1e-3"], "it should be left out: it is for the study integrity"),
        (["room", "--method", "guess"], "it should be one of literal"),
        (["efficiency", "--noise-ps", "50"], "--noise-ps is 50; it should be left out: the study efficiency"),
        (["efficiency", "--seconds", "5"], "--seconds is 5; it should be left out: the study efficiency"),
        (["efficiency", "--method", "literal"], "--method is 'literal'"),
        (["room", "--alert-limit-m", "1"], "it should be left out: it is for the study integrity"),
        (["integrity", "--integrity-risk", "0"], "--integrity-risk"),
        (["integrity", "--alert-limit-m", "nan"], "--alert-limit-m"),
        (["integrity", "--method", "literal"], "protection levels are given by joint"),
        (["room", "--worlds", "1"], "--worlds"),
        (["room", "--seconds", "nan"], "--seconds"),
        (["room", "--plot", "room.doc"], "--plot is 'room.doc'"),
        (["room", "--plot", "nowhere/room.png"], "a file in a folder that exists"),
        (["room", "--out", __file__], "--out is '" + __file__ + "', which is a file"),
        (["room", "--resume", __file__], "--resume is '" + __file__ + "', which is a file"),
        (["room", "--resume", "/proc/parts"], "--resume is '/proc/parts', w"),
    ],
)
def test_wrong_input_is_one_line(run, complaint, arguments, said):
    assert said in complaint("study", *arguments)


def computed_s(pid):
    """How long the processes of a process have computed, the longest of them."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    stats = [Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split() for child in children]
    return max((int(fields[11]) / os.sysconf("SC_CLK_TCK") for fields in stats), default=-1.0)


def test_an_interrupt_leaves_no_file_and_no_traceback(tmp_path):
    """As a terminal sends it: to the whole group, workers among them, at the start and in the middle."""
    parts = ["--resume", str(tmp_path / "parts")]
    for begun_s, resume in (0.0, []), (3.0, parts):
        command = ["env", "--default-signal=INT", *COMMAND, "room", "--out", str(tmp_path / "out"), *resume]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)
        while computed_s(process.pid) < begun_s:
            time.sleep(0.1)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=60)
        assert (process.returncode, out) == (130, b"")
        way_on = (
            f"the same command with {' '.join(resume)} goes on" if resume else "nothing was written; --resume FOLDER"
        )
        *progress, last = err.decode().splitlines() or [""]
        assert [line for line in progress if not line.startswith("studying room: ")] == []
        assert last.startswith(("studying room: ", f"stopped; {way_on}")) or not last
        assert not (tmp_path / "out").exists()
