"""Truth, lever arms and what is judged, against SciPy and plain NumPy."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from skyless.sim.evaluation.judge import Judge, antenna_truth
from skyless.site.tables import Truth

numbers = st.floats(-10, 10)
triples = st.tuples(numbers, numbers, numbers)


def line(times_s, speed=(1.0, -2.0, 0.5), quaternion=None):
    times_s = np.array(times_s, dtype=float)
    return Truth(times_s, times_s[:, None] * np.array(speed), quaternion)


def fed(judge, times_s, positions_m, first_s=0.0):
    for time_s, position_m in zip(times_s, positions_m, strict=True):
        judge.add(float(time_s), float(time_s) - first_s, tuple(map(float, position_m)))
    return judge.judgement()


@given(quaternion=st.tuples(numbers, numbers, numbers, numbers), arm_m=triples)
def test_the_lever_arm_turns_as_scipy_turns_it(quaternion, arm_m):
    norm = np.linalg.norm(quaternion)
    assume(norm > 1e-3)
    unit = np.array([quaternion]) / norm
    moved = antenna_truth(line([0.0], quaternion=unit), arm_m)
    assert moved.position_m[0] == pytest.approx(Rotation.from_quat(unit[0]).apply(arm_m), abs=1e-12)


def test_without_attitude_the_body_is_level():
    assert antenna_truth(line([0.0, 1.0]), (0.1, 0.2, 0.3)).position_m.tolist() == [[0.1, 0.2, 0.3], [1.1, -1.8, 0.8]]


@given(time_s=st.floats(-1, 6))
def test_truth_is_interpolated_but_not_across_gaps_nor_beyond_its_ends(time_s):
    """The table has gaps of 1.0 s (allowed) and 1.5 s (not)."""
    times_s = [0.0, 0.5, 1.5, 1.5, 3.0, 4.0]
    found = Judge(line(times_s), planar=False, max_gap_s=1.0).at(time_s)
    if time_s < 0.0 or time_s > 4.0 or 1.5 < time_s < 3.0:
        assert found is None
    elif time_s != 1.5:  # where the gap begins, either is right
        assert found == pytest.approx((time_s, -2.0 * time_s, 0.5 * time_s), abs=1e-12)


def test_no_truth_is_no_error():
    judge = Judge(None, planar=False, settle_s=0.0)
    judgement = fed(judge, [0.0, 1.0, 2.0], [(1.0, 2.0, 3.0)] * 3)
    assert judgement.median_m == (1.0, 2.0, 3.0)
    assert (judgement.errors.count, judgement.errors.rmse_2d_m) == (0, None)
    assert np.isnan(judge.track.rows[:, 4:]).all()


def test_figures_are_numpys():
    random = np.random.default_rng(5)
    times_s = np.linspace(0.0, 9.9, 400)
    truth = line(np.linspace(0.0, 10.0, 101))
    errors = random.normal([0.1, -0.2, 0.05], [0.3, 0.2, 0.6], (400, 3))
    judgement = fed(Judge(truth, planar=False, settle_s=0.0), times_s, times_s[:, None] * [1.0, -2.0, 0.5] + errors)
    lengths = np.linalg.norm(errors, axis=1)
    assert judgement.errors.rmse_3d_m == pytest.approx(np.sqrt(np.mean(lengths**2)))
    assert judgement.errors.rmse_2d_m == pytest.approx(np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1))))
    assert judgement.errors.p95_m == pytest.approx(np.percentile(lengths, 95))
    assert judgement.errors.max_m == pytest.approx(lengths.max())
    assert judgement.errors.bias_m == pytest.approx(errors.mean(axis=0))


def test_a_given_height_leaves_the_horizontal_error():
    judgement = fed(Judge(line([0.0, 1.0]), planar=True, settle_s=0.0), [0.5], [(0.5 + 0.3, -1.0 - 0.4, 9.0)])
    assert judgement.errors.rmse_2d_m == pytest.approx(0.5)
    assert judgement.errors.max_m == pytest.approx(0.5)
    assert judgement.errors.rmse_3d_m is None


def test_nothing_is_judged_before_it_has_settled():
    """The start is 100 m off, and is at 5 s of the recording's own time."""
    times_s = np.arange(5.05, 10.0, 0.1)
    positions = [(100.0, 100.0, 0.0) if time_s < 7.0 else (1.0, 2.0, 0.0) for time_s in times_s]
    still = Truth(np.array([0.0, 0.9, 20.0]), np.tile([1.0, 2.0, 0.0], (3, 1)), None)
    judge = Judge(still, planar=False, settle_s=2.0, max_gap_s=100.0)
    judgement = fed(judge, times_s, positions, first_s=5.0)
    assert judgement.median_m == (1.0, 2.0, 0.0)
    assert max(judgement.std_m) == 0.0
    assert judgement.errors.max_m == 0.0
    assert judgement.errors.count == sum(position[0] == 1.0 for position in positions)


def test_settling_counts_from_the_first_reception_even_if_the_first_fix_is_late():
    judgement = fed(Judge(None, planar=False, settle_s=3.0), [4.9, 5.0, 5.1], [(7.0, 8.0, 9.0)] * 3)
    assert judgement.median_m == (7.0, 8.0, 9.0)


def test_a_recording_shorter_than_the_settling_has_no_figures():
    judgement = fed(Judge(None, planar=False, settle_s=3.0), [0.1, 1.0], [(7.0, 8.0, 9.0)] * 2)
    assert (judgement.median_m, judgement.std_m) == (None, None)


def test_only_what_is_above_is_judged():
    times_s = np.arange(0.0, 4.0, 0.1)
    truth = line(np.arange(0.0, 4.1, 0.1), speed=(0.0, 0.0, 0.1))  # passes 0.2 m at 2 s
    positions = [(5.0 if time_s < 2.05 else 0.25, 0.0, 0.1 * time_s) for time_s in times_s]
    judgement = fed(Judge(truth, planar=False, settle_s=0.0, above_m=0.2), times_s, positions)
    assert judgement.errors.max_m == pytest.approx(0.25)
    assert judgement.errors.count == 19
    assert judgement.median_m[0] == 5.0  # the place itself is that of the whole recording


@given(origin=st.tuples(*[st.floats(-1e7, 1e7)] * 3))
def test_the_spread_does_not_depend_on_where_the_site_lies(origin):
    """Sites may lie in map coordinates of thousands of kilometres, whose squares would eat up centimetres."""
    offsets = np.random.default_rng(3).normal(0.0, 0.02, (500, 3))
    places = np.array(origin) + offsets
    judgement = fed(Judge(None, planar=False, settle_s=0.0), np.arange(500.0), places)
    assert judgement.std_m == pytest.approx(places.std(axis=0), rel=1e-5)
    assert judgement.median_m == pytest.approx(np.median(places, axis=0), rel=1e-15)
