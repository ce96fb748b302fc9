"""Cells over processes: the same results, and what happens when something dies."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from skyless.core.errors import SkylessError
from skyless.research.studies import lab
from skyless.research.studies.picture import world_cells, world_rows
from skyless.research.studies.runner import MEASURED, Cell, Plan, run_cells
from support.processes import lives
from support.waiting import came

pytestmark = pytest.mark.statistical

PLAN = Plan(method="joint", seed=3, quick=True, worlds=2, seconds=1.0, tags=1)


CASES = lab.loss_cases(PLAN)[:2]


def rows_of(results):
    rows = world_rows("loss", PLAN, CASES, results)
    return [{name: getattr(row, name) for name in row.__struct_fields__ if name not in MEASURED} for row in rows]


def double(number):
    return 2 * number


def die(number):
    if number == 1:
        os._exit(3)
    time.sleep(0.2)


def fail(number):
    raise ValueError(f"cell {number} has gone wrong")


def rest(seconds):
    time.sleep(seconds)


def cells(function, arguments):
    return [Cell("cell", partial(function, argument), 1.0 + argument) for argument in arguments]


@pytest.mark.statistical
def test_one_process_and_two_give_the_same_rows():
    work, reached = world_cells(CASES), []
    one, two = (run_cells(work, reached.append, processes) for processes in (1, 2))
    assert reached[-1] == pytest.approx(1.0)
    assert rows_of(one) == rows_of(two)


def test_another_seed_gives_other_rows():
    work = [world_cells(lab.loss_cases(Plan(method="joint", seed=seed, worlds=2, seconds=1.0)))[0] for seed in (3, 4)]
    first, second = (cell.function() for cell in work)
    assert first.squared_m2 != second.squared_m2


@pytest.mark.statistical
def test_results_stand_in_the_order_of_the_cells():
    assert run_cells(cells(double, range(7)), lambda share: None, 2) == [0, 2, 4, 6, 8, 10, 12]


class CellUnderAlarm:
    """The command line delays Ctrl-C by an alarm, which may come while processes are being started."""

    name, weight_s = "cell", 1.0

    def __init__(self):
        self.submitted = 0

    @property
    def function(self):
        signal.raise_signal(signal.SIGALRM)
        self.submitted += 1
        return partial(rest, 60.0)


def test_a_delayed_interrupt_waits_until_all_processes_have_been_started():
    work = [CellUnderAlarm() for _ in range(3)]
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            run_cells(work, lambda share: None, 2)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert [one.submitted for one in work] == [1, 1, 1]


@pytest.mark.statistical
def test_a_process_that_dies_is_named():
    with pytest.raises(SkylessError, match="a process died"):
        run_cells(cells(die, range(4)), lambda share: None, 2)


def test_what_a_cell_raises_comes_through():
    with pytest.raises(ValueError, match="cell 0 has gone wrong"):
        run_cells(cells(fail, [0]), lambda share: None, 1)


def test_an_interrupt_ends_cells_that_would_last_for_minutes():
    def interrupt(share):
        raise KeyboardInterrupt

    begun_s = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_cells(cells(rest, [600.0, 600.0]), interrupt, 2)
    assert time.monotonic() - begun_s < 60.0


@pytest.mark.statistical
def test_processes_end_with_the_one_that_started_them(tmp_path):
    """Killed without a word, it leaves nobody behind."""
    code = (
        "import sys; sys.path[:0] = sys.argv[1:]\n"
        "import test_study_runner as t\n"
        "if __name__ == '__main__': t.run_cells(t.cells(t.tell_and_rest, [1.0, 2.0]), lambda share: None, 2)\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(code)
    environment = {**os.environ, "TOLD": str(tmp_path)}
    parent = subprocess.Popen([sys.executable, script, *Path(__file__).parents[:2]], env=environment)
    pids = came(lambda: found if len(found := list(tmp_path.glob("*.pid"))) == 2 else None)
    parent.kill()
    parent.wait()
    came(lambda: not any(lives(int(path.stem)) for path in pids))


def tell_and_rest(seconds):
    (Path(os.environ["TOLD"]) / f"{os.getpid()}.pid").touch()
    time.sleep(600.0)
