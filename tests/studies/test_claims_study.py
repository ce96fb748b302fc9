"""The study ``claims`` on sites small enough for a test."""

import warnings

import pytest

from skyless.evaluation.claim_graphs import SUPERFRAME_TICKS, ClaimGraph, components, grid_m, links_within
from skyless.evaluation.figures import picture
from skyless.slot_claims import MOST_PATIENCE
from skyless.studies import claims
from skyless.studies.catalogue import STUDIES
from skyless.studies.claims import EVENTS, ClaimRun, ClaimSite, run_claims
from skyless.studies.common.plan import Plan

SMALL = ClaimSite("small", 180.0, 30.0, 15.0, 22.0, 17, 20, (0.8,), 300)


def test_one_claim_is_left_after_each_event_and_none_changes_afterwards():
    result = run_claims(ClaimRun(SMALL, 0.8, 5, 1_000))
    assert result.hops == 12
    assert None not in result.superframes
    by_event = dict(zip(EVENTS, result.superframes, strict=True))
    assert by_event["cold start"] <= 15
    assert by_event["root killed"] <= 20
    assert by_event["joined"] <= 10
    assert result.changes_afterwards == 0


def test_runs_of_one_seed_are_the_same():
    run = ClaimRun(SMALL, 0.5, 9, 100)
    assert run_claims(run) == run_claims(run)


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(claims, "SITES", (SMALL,))


def test_rows_say_how_long_it_took_and_what_missed_its_limit(small):
    study, plan = STUDIES["claims"], Plan(worlds=2, seed=3)
    cells = study.cells(plan)
    assert [cell.name for cell in cells] == ["small 80 %"] * 2
    results = [cell.function(cell.argument) for cell in cells]
    rows = study.rows(plan, results)
    assert [row.case for row in rows] == [f"small 80 %, {event}" for event in EVENTS]
    for index, row in enumerate(rows):
        assert row.superframes_most == max(result.superframes[index] for result in results)
        limit = next(one.most for one in row.limits if one.figure == "superframes_most")
        assert row.passed == (row.superframes_most <= limit and not row.changes)
    assert rows[-1].changes == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing has a width on a logarithmic axis where no time has passed
        picture(study.draw(rows), "png", 40.0)


def test_a_component_without_links_leads_itself():
    graph = ClaimGraph([[1], [0], []], [0, SUPERFRAME_TICKS // 2, 7], 1.0, 1)
    for node in range(3):
        graph.switch_on(node)
    assert sorted(map(len, components(graph))) == [1, 2]
    assert graph.run_until_one(2 * MOST_PATIENCE, components(graph)) is not None
    assert len(graph.claims()) == 2


def test_grids_have_neighbours_within_reach():
    links = links_within(grid_m(30.0, 15.0, 15.0), 22.0)
    assert [len(others) for others in links] == [3, 3, 5, 5, 3, 3]
