"""The study ``watch`` with few events."""

import pytest

from skyless.research.studies import watch
from skyless.research.studies.picture import draw
from skyless.research.studies.run import STUDIES
from skyless.research.studies.runner import Plan
from skyless.research.studies.watch import WatchCase, WatchResult, run_watch
from skyless.site.report import picture

pytestmark = pytest.mark.site


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(watch, "_EVENTS", 1)
    monkeypatch.setattr(watch, "_QUIET_WINDOWS", 5)
    monkeypatch.setattr(watch, "_NOISE_WINDOWS", 2000)


def test_rows_hold_what_was_found_and_are_judged(few):
    study, plan = STUDIES["watch"], Plan(worlds=2, seed=3)
    cells = study.cells(plan)
    found = WatchResult(10, 9, 9, 8, 0, (10.0,) * 8 + (40.0,), 0, 0, 80)
    quiet = WatchResult(0, 0, 0, 0, 0, (), 1, 0, 8640)
    results = [0 if "noise" in cell.name else quiet if "nothing" in cell.name else found for cell in cells]
    rows = {row.case: row for row in study.rows(plan, results)}
    assert set(rows) == {cell.name for cell in cells}
    moved = rows["hall, moved 10 cm"]
    assert (moved.found, moved.named, moved.kind, moved.wrong) == (0.8, 1.0, 16 / 18, 0.0)
    assert moved.missed == ("found",)
    assert moved.passed is False
    assert rows["hall, one link 35 cm late"].passed is True
    assert rows["lab, nothing, drift of 60 s"].alarms_per_day == 1.0
    assert rows["lab, 10⁶ windows of noise"].passed is True
    picture(draw(study, list(rows.values())), "png", 40.0)


def test_cells_compute_and_runs_of_one_seed_are_the_same(few):
    cells = STUDIES["watch"].cells(Plan(worlds=1, seed=4))
    for name in ("lab, a person on some links", "lab, nothing, drift of 10 s", "lab, 10⁶ windows of noise"):
        (cell,) = [one for one in cells if one.name == name]
        assert cell.function() == cell.function()


def test_a_late_link_is_no_displacement():
    result = run_watch(WatchCase("", "", "lab", "link", 0.35), 5, seed=5)
    assert (result.tries, result.found, result.wrong, result.alarms_moved) == (5, 5, 0, 0)
