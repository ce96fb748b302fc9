"""Constants of anchors from differences at known places: Monte Carlo against the truth, and what cannot be told."""

import numpy as np
import pytest

from skyless.site.survey.estimate import Differences, estimate

pytestmark = pytest.mark.site

ANCHORS_M = np.array([[x, y, z] for x, y in ((-3, -4), (3, -4), (3, 4), (-3, 4)) for z in (0.2, 2.7)])
BIAS_M = np.array([-0.08, 0.33, 0.19, -0.15, -0.24, 0.07, 0.06, -0.18])


def walk(rng, count, speed=0.5):
    """A path through the room, 100 differences a second."""
    t = np.arange(count) / 100.0
    phases = rng.uniform(0.0, 6.0, 3)
    swing = np.sin(np.outer(t, [0.21, 0.16, 0.33]) * speed + phases)
    return t, np.array([0.0, 0.0, 1.3]) + np.array([2.0, 3.0, 0.6]) * swing


def measured(rng, count=6000, noise_m=0.06, outliers=0.0, slope_m=0.0, still=False, bias_m=BIAS_M, anchors_m=ANCHORS_M):
    t, path = walk(rng, count)
    path = np.tile(path[:1], (count, 1)) if still else path
    a = rng.integers(0, len(anchors_m), count)
    b = (a + rng.integers(1, len(anchors_m), count)) % len(anchors_m)
    ranges = [np.linalg.norm(path - anchors_m[one], axis=1) for one in (a, b)]
    log_ratio = np.log(ranges[1] / ranges[0])
    excess = bias_m[b] - bias_m[a] + slope_m * log_ratio + rng.normal(0.0, noise_m, count)
    late = rng.random(count) < outliers
    excess[late] += rng.choice([-1.0, 1.0], late.sum()) * rng.exponential(2.0, late.sum())
    return Differences(t, a, b, excess, log_ratio)


def constants(found):
    return np.array([one.bias_m for one in found.anchors]), np.array([one.std_m for one in found.anchors])


@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_constants_are_recovered_within_their_standard_errors(outliers):
    truth_m = BIAS_M - BIAS_M.mean()
    scores = []
    for seed in range(60):
        bias, std = constants(estimate(measured(np.random.default_rng(seed), 3000, outliers=outliers)))
        scores.append((bias - truth_m) / std)
    squares = np.mean(np.square(scores))  # 60 × 7 independent ones; few blocks of time make the errors' errors 40 %
    assert 0.75 < squares < 1.5
    assert abs(np.mean(scores, axis=0)).max() < 4.5 / np.sqrt(60)


def test_the_error_is_that_of_least_squares_on_clean_data():
    """Of 6000 differences each anchor has 1500: σ·√(1/1500) times the share of a complete graph, and Huber's 5 %."""
    truth_m = BIAS_M - BIAS_M.mean()
    errors = [constants(estimate(measured(np.random.default_rng(seed))))[0] - truth_m for seed in range(40)]
    expected_m = 0.06 / np.sqrt(6000 * 2 / 7) * np.sqrt(7 / 8)  # eigenvalue of HᵀH but zero: 2·6000/7
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(expected_m / np.sqrt(0.95), rel=0.15)


@pytest.mark.statistical
def test_errors_that_last_widen_the_standard_errors():
    """A reflection that stays for five seconds is one error and not five hundred."""
    rng = np.random.default_rng(5)
    squares = []
    for _ in range(15):
        data = measured(rng, 12_000, noise_m=0.03)
        block = (data.t_s / 5.0).astype(int)
        lasting = rng.normal(0.0, 0.1, (block.max() + 1, 8))
        excess = data.excess_m + lasting[block, data.anchor_b] - lasting[block, data.anchor_a]
        found = estimate(Differences(data.t_s, data.anchor_a, data.anchor_b, excess, data.log_ratio))
        bias, std = constants(found)
        squares.append(np.mean(((bias - BIAS_M + BIAS_M.mean()) / std) ** 2))
    assert 0.6 < np.mean(squares) < 1.7  # as if independent: some 100


def test_a_slope_is_found_and_the_constants_with_it():
    found = estimate(measured(np.random.default_rng(1), slope_m=0.08))
    assert found.slope_m == pytest.approx(0.08, abs=4 * found.slope_std_m)
    assert found.slope_std_m < 0.01
    assert constants(found)[0] == pytest.approx(BIAS_M - BIAS_M.mean(), abs=0.015)
    assert found.calibration().anchors[3].slope_m == found.slope_m


@pytest.mark.parametrize(
    ("slope_m", "still", "why"),
    [
        (0.0, False, "differ from zero"),
        (-0.08, False, "differ from zero"),
        (0.4, False, "no radio"),
        (0.08, True, "alike"),
    ],
)
def test_a_slope_that_cannot_be_told_or_cannot_be_is_left_out(slope_m, still, why):
    found = estimate(measured(np.random.default_rng(2), slope_m=slope_m, still=still))
    assert found.slope_m is None
    assert why in found.slope_note


@pytest.mark.parametrize("anchors_m", [ANCHORS_M[:3], np.array([[0.0, 0, 1], [2.0, 0, 1], [5.0, 0, 1]])])
def test_three_anchors_are_enough_at_a_known_place_even_in_one_line(anchors_m):
    data = measured(np.random.default_rng(3), still=True, bias_m=BIAS_M[:3], anchors_m=anchors_m)
    assert constants(estimate(data))[0] == pytest.approx(BIAS_M[:3] - BIAS_M[:3].mean(), abs=0.01)


def test_half_of_an_anchors_differences_far_off_do_not_move_its_constant():
    data = measured(np.random.default_rng(4))
    late = (data.anchor_b == 2) & (np.arange(len(data.t_s)) % 5 < 2)
    excess = data.excess_m + 1.5 * late
    found = estimate(Differences(data.t_s, data.anchor_a, data.anchor_b, excess, data.log_ratio))
    assert constants(found)[0] == pytest.approx(BIAS_M - BIAS_M.mean(), abs=0.02)
    assert found.rejected >= late.sum()


def test_anchors_that_no_chain_ties_to_the_others_are_not_determined():
    data = measured(np.random.default_rng(7))
    keep = (data.anchor_a < 5) == (data.anchor_b < 5)
    part = data.select(keep)
    found = estimate(part)
    assert [one.bias_m is None for one in found.anchors] == [False] * 5 + [True] * 3
    assert all("no chain" in one.reason for one in found.anchors[5:])


def test_an_anchor_with_two_differences_is_not_determined_and_does_not_move_the_zero():
    data = measured(np.random.default_rng(8))
    with_7 = np.flatnonzero((data.anchor_a == 7) | (data.anchor_b == 7))
    keep = np.ones(len(data.t_s), dtype=bool)
    keep[with_7[2:]] = False
    found = estimate(data.select(keep))
    assert found.anchors[7].bias_m is None
    assert "2 differences" in found.anchors[7].reason
    bias = np.array([one.bias_m for one in found.anchors[:7]])
    assert bias == pytest.approx(BIAS_M[:7] - BIAS_M[:7].mean(), abs=0.02)
    assert 7 not in found.calibration().anchors


def test_a_constant_that_few_noisy_differences_leave_open_is_not_given():
    found = estimate(measured(np.random.default_rng(9), count=24, noise_m=0.6, still=True))
    assert any(one.bias_m is None and "standard error" in one.reason for one in found.anchors)


def test_one_difference_determines_nothing_and_breaks_nothing():
    one = Differences(*(np.array(value) for value in ([0.0], [1], [2], [0.3], [0.1])))
    assert [anchor.bias_m for anchor in estimate(one).anchors] == [None, None]
