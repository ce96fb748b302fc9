"""Figures of fixes against plain NumPy, SciPy, and evo, the program that papers compare trajectories with."""

import numpy as np
import pytest
from evo.core import geometry, metrics
from evo.core.trajectory import PosePath3D
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from skyless.core.alert import Alert
from skyless.core.fix import Fix
from skyless.core.integrity import IntegrityRequirement
from skyless.sim.evaluation import figures
from skyless.site.tables import Truth

numbers = st.floats(-10, 10)
triples = st.tuples(numbers, numbers, numbers)


def line(times_s, speed=(1.0, -2.0, 0.5), quaternion=None):
    times_s = np.array(times_s, dtype=float)
    return Truth(times_s, times_s[:, None] * np.array(speed), quaternion)


def table_of(times_s, position_m, covariance_m2=None, levels_m=None, alert=None):
    times_s, count = np.asarray(times_s, dtype=float), len(times_s)
    return figures.FixTable(
        times_s,
        np.asarray(position_m, dtype=float).reshape(count, 3),
        np.full((count, 3, 3), np.nan) if covariance_m2 is None else covariance_m2,
        np.full((count, 2), np.nan) if levels_m is None else levels_m,
        np.full(count, -1.0) if alert is None else alert,
    )


def judged(truth, times_s, *, planar=False, settle_s=0.0, above_m=None, begin_s=0.0):
    return figures.Judged(truth, begin_s, float(np.max(times_s)), planar, settle_s, above_m)


# Truth


@given(quaternion=st.tuples(numbers, numbers, numbers, numbers), arm_m=triples)
def test_the_lever_arm_turns_as_scipy_turns_it(quaternion, arm_m):
    norm = np.linalg.norm(quaternion)
    assume(norm > 1e-3)
    unit = np.array([quaternion]) / norm
    moved = figures.antenna_truth(line([0.0], quaternion=unit), arm_m)
    assert moved.position_m[0] == pytest.approx(Rotation.from_quat(unit[0]).apply(arm_m), abs=1e-12)


def test_without_attitude_the_body_is_level():
    assert figures.antenna_truth(line([0.0, 1.0]), (0.1, 0.2, 0.3)).position_m.tolist() == [
        [0.1, 0.2, 0.3],
        [1.1, -1.8, 0.8],
    ]


@given(times_s=st.lists(st.floats(-1, 6), min_size=1, max_size=9))
def test_truth_is_interpolated_but_not_across_gaps_nor_beyond_its_ends(times_s):
    """The table has gaps of 1.0 s (allowed) and 1.5 s (not)."""
    truth = line([0.0, 0.5, 1.5, 1.5, 3.0, 4.0])
    track = figures.TruthTrack(truth)
    for time_s, found in zip(times_s, figures.truth_at(truth, np.array(times_s)), strict=True):
        one = track.at(time_s)
        if time_s < 0.0 or time_s > 4.0 or 1.5 < time_s < 3.0:
            assert one is None
            assert np.isnan(found).all()
        elif time_s not in {1.5, 3.0}:  # where the gap begins and ends, either is right
            assert one == pytest.approx((time_s, -2.0 * time_s, 0.5 * time_s), abs=1e-12)
            assert found == pytest.approx(one, abs=1e-12)


@given(offset_s=st.floats(-2.0, 2.0))
@settings(max_examples=15)
def test_the_offset_of_a_truth_is_found(offset_s):
    times_s = np.arange(0.0, 30.0, 0.02)
    truth = Truth(times_s, np.column_stack([np.sin(times_s), np.cos(0.7 * times_s), 0.0 * times_s]), None)
    noise_m = np.random.default_rng(3).normal(0.0, 0.05, (len(times_s), 3))
    late = figures.shifted(truth, -offset_s)
    assert figures.estimated_offset_s(late, times_s, figures.truth_at(truth, times_s) + noise_m) == pytest.approx(
        offset_s, abs=0.02
    )


def test_a_tag_at_rest_shows_no_offset():
    times_s = np.arange(0.0, 10.0, 0.1)
    still = Truth(times_s, np.zeros((100, 3)), None)
    assert figures.estimated_offset_s(still, times_s, np.random.default_rng(1).normal(0.0, 0.1, (100, 3))) is None


# Figures


@pytest.mark.parametrize("planar", [False, True])
def test_figures_are_numpys(planar):
    random, dim = np.random.default_rng(5), 2 if planar else 3
    times_s = np.linspace(0.0, 9.9, 400)
    truth = line(np.linspace(0.0, 10.0, 101))
    errors_m = random.normal([0.1, -0.2, 0.05], [0.3, 0.2, 0.6], (400, 3))
    covariance_m2 = np.einsum("nij,nkj->nik", *[random.normal(0.0, 0.4, (400, 3, 3))] * 2)
    position_m = figures.truth_at(truth, times_s) + errors_m
    found = figures.figures_of(table_of(times_s, position_m, covariance_m2), judged(truth, times_s, planar=planar))
    for of in range(2, dim + 1):
        lengths_m = np.linalg.norm(errors_m[:, :of], axis=1)
        assert getattr(found, f"rmse_{of}d_m") == pytest.approx(np.sqrt(np.mean(lengths_m**2)))
        assert getattr(found, f"max_{of}d_m") == pytest.approx(lengths_m.max())
        for share in (50, 75, 95):
            assert getattr(found, f"p{share}_{of}d_m") == pytest.approx(np.percentile(lengths_m, share))
    assert (found.rmse_3d_m is None) is planar
    assert found.rmse_axes_m == pytest.approx(np.sqrt((errors_m**2).mean(axis=0)))
    assert found.bias_m == pytest.approx(errors_m.mean(axis=0))
    nees = [e[:dim] @ np.linalg.inv(P[:dim, :dim]) @ e[:dim] for e, P in zip(errors_m, covariance_m2, strict=True)]
    assert found.nees == pytest.approx(np.mean(nees) / dim)
    assert found.beyond_95 == pytest.approx(np.mean(np.array(nees) > chi2.ppf(0.95, dim)))
    claimed_m2 = covariance_m2[:, range(dim), range(dim)].sum(axis=1)
    assert getattr(found, f"sigma_{dim}d_m") == pytest.approx(np.sqrt(claimed_m2.mean()))
    assert found.std_m == pytest.approx(position_m.std(axis=0))
    assert found.median_m == pytest.approx(np.median(position_m, axis=0))
    assert (found.judged, found.left_out, found.availability) == (400, {}, 1.0)


def test_the_limits_of_chi_square_are_scipys():
    assert {dim: chi2.ppf(0.95, dim) for dim in figures.CHI2_95} == pytest.approx(figures.CHI2_95, rel=1e-12)


@pytest.mark.site
@given(seed=st.integers(0, 99))
def test_trajectory_errors_are_those_of_evo(seed):
    random = np.random.default_rng(seed)
    true_m = np.cumsum(random.normal(0.0, 0.1, (500, 3)), axis=0)
    position_m = true_m @ Rotation.from_rotvec([0.0, 0.1, 0.4]).as_matrix().T + 3.0 + random.normal(0.0, 0.1, (500, 3))
    times_s = np.arange(500) / 10.0
    found = figures.figures_of(table_of(times_s, position_m), judged(Truth(times_s, true_m, None), times_s))
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (500, 1))
    reference, estimate = PosePath3D(true_m, upright), PosePath3D(position_m, upright)
    relative = metrics.RPE(
        metrics.PoseRelation.translation_part, figures.STEP_M, metrics.Unit.meters, pairs_from_reference=True
    )
    relative.process_data((reference, estimate))
    assert found.rpe_m == pytest.approx(relative.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)
    turn, shift_m, _ = geometry.umeyama_alignment(position_m.T, true_m.T)
    absolute = metrics.APE(metrics.PoseRelation.translation_part)
    absolute.process_data((reference, PosePath3D(position_m @ turn.T + shift_m, upright)))
    assert found.ate_m == pytest.approx(absolute.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)


def test_levels_count_from_the_first_fix_on():
    """Three fixes: one level holds, one is exceeded horizontally without an alert, one vertically with one."""
    times_s, alerts = [0.0, 1.0, 2.0], [*Alert]
    truth = Truth(np.array(times_s), np.zeros((3, 3)), None)
    errors_m = [(0.3, 0.4, 0.1), (0.3, 0.5, 0.1), (0.0, 0.0, -0.3)]
    alert = np.array([alerts.index(one) for one in (Alert.NONE, Alert.NONE, Alert.EXCLUDED)], dtype=float)
    table = table_of(times_s, errors_m, levels_m=np.full((3, 2), [0.55, 0.2]), alert=alert)
    found = figures.figures_of(table, judged(truth, times_s, settle_s=10.0))
    assert (found.judged, found.left_out) == (0, {"settling": 3})
    assert (found.levels, found.exceeded_horizontal, found.exceeded_vertical, found.exceeded_unalerted) == (3, 1, 1, 1)
    assert (found.hpl_m, found.vpl_m) == (0.55, 0.2)
    assert found.alerts == {"none": 2, "detected-excluded": 1}


def test_what_is_left_out_is_counted_by_reason():
    times_s = np.arange(100) / 10.0
    truth = Truth(times_s[:90], np.column_stack([0 * times_s, 0 * times_s, times_s])[:90], None)
    found = figures.figures_of(table_of(times_s, np.zeros((100, 3))), judged(truth, times_s, settle_s=2.0, above_m=4.0))
    assert found.left_out == {"settling": 20, "without-truth": 10, "below-height": 21}
    assert found.judged == 49
    assert found.judged_s == pytest.approx(4.9)


def test_availability_is_the_time_with_a_fix_of_the_last_second():
    times_s = np.array([2.0, 2.5, 6.0, 6.5])
    how = figures.Judged(None, 0.0, 10.0, False, 0.0)
    found = figures.figures_of(table_of(times_s, np.zeros((4, 3))), how)
    assert found.availability == pytest.approx((0.5 + 1.0 + 0.5 + 1.0) / 10.0)
    assert (found.first_fix_s, found.first_fix_error_m, found.rmse_2d_m) == (2.0, None, None)


@given(rows=st.lists(st.tuples(triples, st.floats(0.1, 9.0), st.integers(0, 3)), min_size=1, max_size=20))
def test_samples_hold_what_fixes_say(rows):
    samples, fixes = figures.FixSamples(), []
    for number, (position_m, level_m, state) in enumerate(rows):
        place = np.zeros((10, 3))
        place[0], place[1:4], place[9] = position_m, np.outer(position_m, position_m), (level_m, 2 * level_m, state)
        fixes.append(Fix(0.0, place.tobytes(), (), np.zeros((0, 3)), "joint", False, 1, IntegrityRequirement()))
        samples.add(float(number), fixes[-1])
    table = samples.table()
    assert samples.count == len(rows) < figures.KEPT_FIXES
    for row, fix in enumerate(fixes):
        assert table.position_m[row].tolist() == fix.position_m.tolist()
        assert table.covariance_m2[row].tolist() == fix.covariance_m2.tolist()
        levels_m = [None if np.isnan(level_m) else level_m for level_m in table.levels_m[row].tolist()]
        assert levels_m == [fix.hpl_m, fix.vpl_m]
        assert [*Alert][int(table.alert[row])] is fix.alert
