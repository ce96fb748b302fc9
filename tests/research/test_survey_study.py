"""The study ``survey`` with few runs, and its figures against plain arithmetic."""

import numpy as np
import pytest

from skyless.research.studies import survey as study
from skyless.research.studies.picture import draw
from skyless.research.studies.run import STUDIES
from skyless.research.studies.runner import Plan
from skyless.research.studies.survey import GROUPS, Group, Variant, limits_of
from skyless.research.studies.surveyed_rooms import RoomErrors, aligned, drawn_errors, survey_layouts, tag_error_m
from skyless.site.report import picture

pytestmark = pytest.mark.site

SMALL = {
    "lab": (
        Group("exact", (Variant("delays known", 0.0), Variant("positions kept", 0.15, keeps=True)), seconds=1.0),
        Group("late", (Variant("late", 0.0),), RoomErrors(pair_std_m=0.02, late_share=0.2, missing_share=0.1), 1.0),
    )
}


def test_all_cases_have_their_limits():
    with_limits = [
        (layout, variant.name)
        for layout, groups in GROUPS.items()
        for group in groups
        for variant in group.variants
        if limits_of(layout, variant.name)
    ]
    assert len(with_limits) >= 18


@pytest.mark.statistical
def test_rows_of_few_runs(monkeypatch):
    monkeypatch.setattr(study, "GROUPS", SMALL)
    chosen, plan = STUDIES["survey"], Plan(worlds=2, seconds=1.0, seed=5, quick=True)
    cells = chosen.cells(plan)
    assert [cell.name for cell in cells] == ["lab, exact", "lab, late"]
    results = [cell.function() for cell in cells]
    assert results[0] == cells[0].function()
    exact, kept, late = chosen.rows(plan, results)
    assert exact.case == "lab, delays known"
    assert 0.2 < exact.ratio < 3.0  # two runs of 12 coordinates
    assert exact.rmse_m < 0.01
    assert exact.near == 1.0
    assert kept.bound_m == pytest.approx(0.02 * np.sqrt(2.0))
    assert kept.delay_m < 0.1
    assert late.runs == 2
    assert picture(draw(chosen, [exact, kept]), "svg")


def test_alignment_takes_motion_and_reflection_away():
    layout = survey_layouts()["room"]
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    for sign in (1.0, -1.0):
        found_m = sign * layout.position_m @ turn + [1.0, 2.0, 3.0]
        assert aligned(layout.position_m, found_m, 3) == pytest.approx(found_m)


def test_what_all_anchors_share_does_not_move_a_tag():
    layout = survey_layouts()["hall"]
    n = len(layout.position_m)
    none, common = np.zeros(n), np.full(n, 0.3)
    assert tag_error_m(layout, layout.position_m, none, common) == pytest.approx(0.0, abs=1e-9)
    shifted = layout.position_m + np.array([0.5, 0.0, 0.0])
    assert tag_error_m(layout, shifted, none, none) == pytest.approx(0.5)


def test_shares_of_late_and_missing_pairs():
    layout, errors = survey_layouts()["hall"], RoomErrors(late_share=0.3, missing_share=0.25)
    drawn = [drawn_errors(layout, errors, 100.0, seed) for seed in range(100)]
    missing, late = (sum(len(getattr(one, name)) for one in drawn) for name in ("missing", "late"))
    pairs = 6600
    assert missing / pairs == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / pairs))
    assert late / (pairs - missing) == pytest.approx(0.3, abs=4 * np.sqrt(0.3 * 0.7 / (pairs - missing)))
