"""A study goes on from the parts that an earlier call has left in a folder."""

import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from msgspec.structs import replace

from skyless.core.errors import SkylessError
from skyless.research.studies import runner
from skyless.research.studies.run import Parts, run_study
from skyless.research.studies.runner import Cell, Plan, Study

NUMBERS, DEADLY, PLAN = range(5), 3, Plan(noise_ps=50.0)
ROWS = [number / 3 for number in NUMBERS]


def computed(log, number):
    with log.open("a") as file:
        file.write(f"{number}\n")
    if number == DEADLY and "KILLED" in os.environ:
        os.kill(os.getpid(), signal.SIGKILL)
    return number / 3


def ran(log, folder, plan=PLAN, name="thirds"):
    """Rows and parts of a study that is its own results, whose work is logged."""
    cells = [Cell("case", partial(computed, log, number), 1.0) for number in NUMBERS]
    study = Study(name, "Thirds", lambda _: cells, lambda _, results: results, print)
    return run_study(study, plan, lambda _: None, 1, folder)


@pytest.fixture
def log(tmp_path):
    return tmp_path / "log"


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "deep" / "parts"


def numbers(log):
    return [int(line) for line in log.read_text().split()]


@pytest.mark.site
def test_after_a_kill_only_what_is_missing_is_computed(log, folder):
    code = "import sys; from pathlib import Path; sys.path.insert(0, sys.argv[1]); import test_study_resume as t; "
    code += "t.ran(*map(Path, sys.argv[2:]))"
    command = [sys.executable, "-c", code, str(Path(__file__).parent), str(log), str(folder)]
    ended = subprocess.run(command, check=False, env={**os.environ, "KILLED": "1"})
    assert ended.returncode == -signal.SIGKILL
    assert ran(log, folder) == (ROWS, Parts(2, 3, ()))
    assert numbers(log) == [0, 1, 2, DEADLY, DEADLY, 4]
    assert ran(log, folder) == (ROWS, Parts(0, 5, ()))


def test_damaged_parts_are_named_and_computed_again(log, folder):
    ran(log, folder)
    cut, changed = files = [folder / "00001.part", folder / "00004.part"]
    cut.write_bytes(cut.read_bytes()[:-1])
    changed.write_bytes(changed.read_bytes()[:-2] + b"x.")
    assert ran(log, folder) == (ROWS, Parts(2, 3, tuple(map(str, files))))
    assert numbers(log) == [*NUMBERS, 1, 4]


def test_another_study_is_refused_and_what_differs_is_named(log, folder, monkeypatch):
    ran(log, folder)
    for other, said in (
        (lambda: ran(log, folder, name="halves"), "study is 'thirds' there, 'halves' here"),
        (lambda: ran(log, folder, replace(PLAN, noise_ps=100.0)), "noise_ps is 50.0 there, 100.0 here"),
        (lambda: ran(log, folder, replace(PLAN, quick=True)), "quick is False there, True here"),
    ):
        with pytest.raises(SkylessError, match=f"^--resume is .*parts', of another study: {said}; give another folder"):
            other()
    with monkeypatch.context() as patch:
        patch.setattr(runner, "program_digest", lambda: "another")
        with pytest.raises(SkylessError, match=r"source digest is .* there, 'another' here"):
            ran(log, folder)
    (folder / "study.json").write_text("{")
    with pytest.raises(SkylessError, match=r"study.json is damaged; give another folder"):
        ran(log, folder)
    assert numbers(log) == [*NUMBERS]


def test_parts_of_another_plan_count_as_damaged(log, folder, tmp_path):
    ran(log, folder)
    ran(log, tmp_path / "other", replace(PLAN, seed=2))
    (tmp_path / "other" / "00002.part").replace(folder / "00002.part")
    assert ran(log, folder) == (ROWS, Parts(1, 4, (str(folder / "00002.part"),)))


def test_a_part_that_cannot_be_written_is_one_line(log, folder):
    (folder / "00000.part").mkdir(parents=True)
    with pytest.raises(SkylessError, match=r"^--resume: .*00000.part cannot be written: "):
        ran(log, folder)
