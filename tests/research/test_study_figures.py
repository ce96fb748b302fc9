"""Figures of studies: errors of errors, what is simulated, and that honest fixes are found honest."""

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.research.studies import efficiency, lab
from skyless.research.studies.picture import Case, interval, jackknife, world_cells, world_rows
from skyless.research.studies.room import CONDITIONS
from skyless.research.studies.runner import Limit, Plan, plan_of, seed_of
from skyless.research.studies.worlds import RunResult, box, large_lab_site, run_world, walking
from skyless.site.file.check import check_site

pytestmark = pytest.mark.statistical

SMALL = Plan(method="joint", worlds=2, seconds=1.0, tags=1)
RANDOM = np.random.default_rng(5)


def test_the_jackknife_finds_the_standard_error_of_a_mean():
    rows = np.column_stack([np.ones(40), RANDOM.normal(3.0, 2.0, 40)])
    mean, error = jackknife(rows, lambda part: part[:, 1].sum() / part[:, 0].sum())
    assert mean == pytest.approx(rows[:, 1].mean())
    assert error == pytest.approx(rows[:, 1].std(ddof=1) / 40**0.5)
    assert jackknife(rows[:1], lambda part: part[:, 1].sum()) == (rows[0, 1], None)


def worlds_of(errors_m, sigma_m=1.0):
    """What worlds would have found whose fixes err so, shape (worlds, fixes, 2), and say ``sigma_m`` for each axis."""
    squared = np.square(errors_m).sum(axis=2)
    return [
        RunResult(
            fixes=len(own),
            superframes=2 * len(own),
            squared_m2=own.sum(),
            variance_m2=2 * sigma_m**2 * len(own),
            nees=own.sum() / sigma_m**2 / 2,
            outside=int((own / sigma_m**2 > 13.8155).sum()),
            max_m=own.max() ** 0.5,
            sample_m=own**0.5,
            messages=len(own),
            tag_s=1.0,
            cpu_s=1e-3,
        )
        for own in squared
    ]


def test_rows_have_the_statistics_of_their_worlds():
    """100 tables of honest fixes: the intervals hold as often as they should, and the errors are as large as said."""
    draw = np.random.default_rng(1)
    runs = walking(replace(SMALL, worlds=10))
    held, rmse, said, ratio_scores = 0, [], [], []
    for _ in range(100):
        common = draw.normal(size=(10, 200, 2))
        clean, worse = worlds_of(common), worlds_of(1.5 * common + draw.normal(0.0, 0.5, common.shape))
        cases = [Case("clean", "s", None, runs), Case("worse", "s", None, runs, "clean", (Limit("ratio", most=1.3),))]
        rows = world_rows("study", SMALL, cases, [*clean, *worse])
        low, high = rows[0].nees_interval
        held += low <= rows[0].nees <= high
        rmse.append(rows[0].rmse_m)
        said.append(rows[0].rmse_error_m)
        ratio_scores.append((rows[1].ratio - 2.5**0.5) / rows[1].ratio_error)
        assert rows[1].passed is False
    assert held >= 94  # of 100 with 99 %, less than one time in ten thousand fewer
    assert np.std(rmse) == pytest.approx(np.mean(said), rel=0.25)
    assert np.mean(rmse) == pytest.approx(2**0.5, rel=0.003)
    assert np.std(ratio_scores) == pytest.approx(1.15, rel=0.25)  # Student's with nine degrees of freedom
    assert rows[0].outside == pytest.approx(0.001, abs=0.003)
    assert rows[0].available == 0.5


def test_a_case_without_a_fix_is_no_success():
    runs = walking(SMALL)
    nothing = worlds_of(np.ones((2, 1, 2)))
    nothing = [replace(one, fixes=0, squared_m2=0.0, variance_m2=0.0, nees=0.0) for one in nothing]
    cases = [Case("clean", "s", None, runs), Case("worse", "s", None, runs, "clean", (Limit("ratio", most=1.3),))]
    rows = world_rows("study", SMALL, cases, [*worlds_of(np.ones((2, 5, 2))), *nothing])
    assert (rows[1].rmse_m, rows[1].ratio, rows[1].passed, rows[1].available) == (None, None, False, 0.0)


def test_the_interval_is_students():
    """From its table: 4.032 for five degrees of freedom and 99 %."""
    low, high = interval(0.1, 6)
    assert (low, high) == pytest.approx((1.0 - 0.4032, 1.0 + 0.4032), abs=1e-4)
    assert interval(None, 1) is None


@pytest.mark.statistical
def test_joint_in_the_lab_is_found_honest_and_as_good_as_it_is():
    """1.4 cm at 100 ps (``docs/studies.md``), walking at 1 m/s; it allows for turns that are few, so NEES is 0.8."""
    plan = Plan(method="joint", worlds=6, seconds=4.0, tags=2)
    case = Case("clean", "s", None, walking(plan), "clean", (Limit("ratio", most=1.3),))
    (row,) = world_rows("study", plan, [case], [run_world(run) for run in case.runs])
    assert row.rmse_m == pytest.approx(0.0143, rel=0.1)
    assert 0.0 < row.rmse_error_m < 0.1 * row.rmse_m
    assert 0.7 < row.nees < row.nees_interval[1]
    assert row.available == pytest.approx(1.0, abs=0.003)
    assert (row.ratio, row.passed, row.mesh) == (1.0, True, True)
    assert row.fixes == pytest.approx(6 * 2 * 4.0 / 0.015, rel=0.01)
    assert 0.0 < row.cpu_us_per_message < 10_000.0


def test_messages_lost_at_tags_are_heard_by_anchors():
    """Half of a tag's messages are gone, as of a site whose anchors hear everything."""
    (clean,), (lossy,), (everywhere,) = (
        walking(replace(SMALL, worlds=1, seconds=4.0), **options)
        for options in ({}, {"lost_at_tags": 0.5}, {"loss": 0.5})
    )
    results = [run_world(run) for run in (clean, lossy, everywhere)]
    messages = [result.messages for result in results]
    assert messages[1] == pytest.approx(0.5 * messages[0], rel=0.05)
    assert messages[2] == pytest.approx(0.5 * messages[0], rel=0.05)
    assert results[0].squared_m2 / results[0].fixes < results[1].squared_m2 / results[1].fixes


def test_worlds_of_one_number_are_the_same_in_all_cases():
    for cases in CONDITIONS.values():
        pairs = {(number, run.seed) for case in cases(SMALL) for number, run in enumerate(case.runs)}
        assert len({number for number, _ in pairs}) == len(pairs)
    assert len({seed_of(seed, number) for seed in range(20) for number in range(20)}) == 400


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("cases_of", CONDITIONS.values(), ids=CONDITIONS)
def test_cases_can_be_told_apart_and_compared(cases_of, quick):
    plan = plan_of("joint", 1, quick=quick, worlds=2)
    cases = cases_of(plan)
    names = [case.name for case in cases]
    assert len(set(names)) == len(names)
    assert all(case.of is None or case.of in names for case in cases)
    worlds = [cell.function.func for cell in world_cells(cases)].count(run_world)
    assert worlds == sum(len(case.runs) for case in cases)
    for case in cases:
        assert "ratio" not in {one.figure for one in case.limits} or case.of or case.biases
        check_site(case.runs[0].site, None)


@pytest.mark.parametrize("quick", [False, True])
def test_the_limits_that_were_asked_for_are_there(quick):
    plan = plan_of("joint", 1, quick=quick, worlds=2)
    cases = [case for case in (*lab.loss_cases(plan), *lab.nlos_cases(plan)) if case.limits]
    limits = {case.name: limit.most for case in cases for limit in case.limits if limit.figure == "ratio"}
    for kind in (lab.AT_TAGS, lab.EVERYWHERE):
        assert (limits.pop(f"50 % {kind}"), limits.pop(f"90 % {kind}")) == (1.3, 2.5)
    late = {"20 % late by exp(1 m)", "one anchor +0.3 m", "one anchor +1.5 m in bursts"}
    assert limits == dict.fromkeys(late, 1.3)


@pytest.mark.parametrize(
    ("kind", "speed_mps"),
    [
        *((lab.rounds, speed_mps) for speed_mps in (1.0, 3.0, 5.0)),
        *((lab.zigzag, speed_mps) for speed_mps in (1.0, 3.0)),
        *((lab.to_and_fro, speed_mps) for speed_mps in (1.0, 3.0, 5.0)),
    ],
)
def test_paths_keep_to_speed_acceleration_and_room(kind, speed_mps):
    """By central differences, over a minute; and they do reach the speed and the acceleration."""
    low_m, high_m = box(large_lab_site(100.0))
    for seed in range(5):
        path = kind(np.random.default_rng(seed), low_m, high_m, speed_mps, 3.0)
        step_s = 0.01
        places = np.array([path.position(step_s * k) for k in range(6000)])
        assert (places >= low_m - 1e-9).all()
        assert (places <= high_m + 1e-9).all()
        speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / step_s
        pushes = np.linalg.norm(np.diff(places, 2, axis=0), axis=1) / step_s**2
        assert speeds.max() == pytest.approx(speed_mps, rel=0.01)
        assert pushes.max() == pytest.approx(3.0, rel=0.01)


def test_a_long_superframe_has_its_anchors_evenly_spread():
    plan = replace(SMALL, quick=True)
    for case in lab.sync_cases(plan):
        site = case.runs[0].site
        if case.x is None:
            continue
        assert site.schedule.slot_s * site.schedule.slots == pytest.approx(case.x * 1e-3)
        slots = [anchor.slot for anchor in site.anchors]
        assert np.ptp(np.diff(slots)) == 0
        assert slots[-1] + slots[1] == site.schedule.slots


def test_rows_of_efficiency_are_those_of_the_episodes():
    plan = Plan(seed=4, episodes=60)
    cells = efficiency.cells(plan)
    case = efficiency.EFFICIENCY_CASES[0]
    wanted = [number for number, cell in enumerate(cells) if cell.name == cells[0].name]
    assert wanted == [0, 1]  # chunks of 50
    results = [cells[number].function() for number in wanted]
    found = efficiency.row_of(case, efficiency.run_chunk(case, np.random.SeedSequence(4).spawn(60)))
    row = efficiency.rows(plan, results * len(efficiency.EFFICIENCY_CASES))[0]
    assert (row.rmse_m, row.bound_m, row.ratio) == (found.rmse_m, found.bound_m, found.ratio)
    assert row.nees == found.nees
    assert (row.mesh, row.noise_ps, row.limits[0].most, row.runs) == (False, 100.0, 1.02, 60)
    kinds = {(case.mesh, case.noise_ps, case.random_walk_fm, case.qa) for case in efficiency.EFFICIENCY_CASES}
    assert len(kinds) == 16
