"""Each rule of the estimator's monitor, at the very number from which it holds."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from skyless.core.estimator import monitor
from skyless.core.estimator.settings import TUNING, EstimatorSettings
from skyless.core.estimator.state import CHANGING_RANGE_ERRORS, NO_RANGE_ERRORS, add_anchor, at, new_state

HAIR = 1e-9
"""What is beyond a bound, or within it, by so much of it."""
OFF_ZERO = TUNING.suspect * math.sqrt(TUNING.mean_gain / (2.0 - TUNING.mean_gain))
"""A running mean that chance just explains."""
beyond = pytest.mark.parametrize(("factor", "is_beyond"), [(1.0 - HAIR, False), (1.0 + HAIR, True)])


def state(count=4, **settings):
    made = new_state(EstimatorSettings(height_m=0.0, **settings))
    for number in range(count):
        add_anchor(made, number + 1, np.array([10.0 * number, 5.0, 3.0]), -1.0, False)
    return made


def near(value):
    return pytest.approx(value, rel=1e-12)


def test_a_state_is_warm_after_two_packets_of_each_anchor():
    s = state()
    for s.status.packets, is_warm in ((0, False), (8, False), (9, True)):
        assert monitor.is_warm(s) is is_warm


# Jumps


def noted(innovations, variance, s=None):
    s = s or state()
    found = []
    for innovation in innovations:
        monitor.note_outlier(s, 1, innovation, variance)
        found.append(s.anchors[1].outliers_in_row)
    return found


def test_outliers_are_those_beyond_three_sigmas_and_others_end_their_row():
    assert noted([3.0, 3.0 + 1e-9, -3.0, 40.0, -2.9], 1.0) == [0, 1, 0, 1, 0]
    assert noted([6.0, 6.0 + 1e-9], 4.0) == [0, 1]


def test_outliers_that_agree_to_three_sigmas_of_two_stamps_are_in_a_row():
    s = state()
    apart_m = TUNING.suspect * math.sqrt(2.0 * (s.settings.tx_variance_m2 + s.settings.rx_variance_m2))
    variance = 1e-4
    for sign in (1.0, -1.0):
        assert noted([5.0, 5.0 + sign * apart_m * (1.0 - HAIR)], variance) == [1, 2]
        assert noted([5.0, 5.0 + sign * apart_m * (1.0 + HAIR)], variance) == [1, 1]
    assert noted([5.0, 5.0 + 0.9 * apart_m, 5.0 + 1.8 * apart_m, 5.0], variance) == [1, 2, 3, 1]


def test_two_outliers_together_are_beyond_seven_sigmas():
    s = state()
    std = 0.05 * math.sqrt(s.settings.rx_variance_m2)  # so that they always agree
    assert noted([3.4 * std, 3.6 * std * (1.0 - HAIR)], std * std) == [1, 1]
    assert noted([3.4 * std, 3.6 * std * (1.0 + HAIR)], std * std) == [1, 2]
    assert noted([3.1 * std, -3.1 * std, -3.8 * std, -3.1 * std], std * std) == [1, 1, 1, 1]


@pytest.mark.parametrize(("late_share", "needed"), [(TUNING.late_often_share, 2), (TUNING.late_often_share + HAIR, 5)])
def test_two_outliers_make_a_jump_and_five_where_packets_are_often_late(late_share, needed):
    s = state()
    s.status.late_share = late_share
    jumped = []
    for s.anchors[2].outliers_in_row in range(7):
        jumped.append(monitor.has_jumped(s, 2))
    assert jumped.index(True) == needed


def test_a_range_error_that_has_jumped_is_estimated_again():
    s = state(survey_std_m=0.0, range_std_m=0.0, slope_std_m=0.0, place_std_m=0.0)
    change = s.layout.change + 1
    assert s.status.range_errors == NO_RANGE_ERRORS
    a = s.anchors[1]
    a.outliers_in_row, a.change_mean, a.ended_log_odds = 2, 1.0, 6.0
    monitor.open_range_error(s, 1, -0.7)
    assert a.ended_log_odds == 0.0
    assert (s.status.obstructions, a.is_obstructed, a.outliers_in_row, a.change_mean) == (1, True, 0, 0.0)
    assert (a.change_scale, s.status.obstruction) == (TUNING.first_change_scale, TUNING.jump_rise)
    assert s.P[at(change, change)] == near(0.49 + s.anchors[0].change_variance_m2)
    assert s.status.range_errors == CHANGING_RANGE_ERRORS


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_obstruction_ends_where_measurements_are_more_likely_without_its_error(sign):
    s, gate = state(), 4.0
    a, change, draw = s.anchors[1], s.layout.change + 1, np.random.default_rng(3)
    root = draw.normal(0.0, 0.02, (2, 2))
    P, h, noise_m2 = root @ root.T + 1e-4 * np.eye(2), np.array([0.8, sign]), 0.002  # of the range, and its error
    P[1, 1] += 0.1**2  # so that it is not known well
    s.status.obstruction, s.status.place_variance_m2, a.is_obstructed, summed = 0.5, 0.03**2, True, 0.0
    without = h[0] ** 2 * P[0, 0] + 0.5 * TUNING.obstructed_std_m**2 + 0.03**2 + noise_m2
    with_it = h @ P @ h + noise_m2
    for innovation, error_m in ((0.1, 0.2), (-0.15, 0.2), (0.05, 0.0), (9.0, 0.2), (-0.3, 0.3), (-0.3, 0.3)):
        s.x[change], s.P[at(change, change)], s.U[0][change] = sign * error_m, P[1, 1], P[1] @ h
        far_m, near_m = (
            min(x, gate * v**0.5) for x, v in ((abs(innovation + error_m), without), (abs(innovation), with_it))
        )
        ratio = norm.logpdf(far_m, 0.0, without**0.5) - norm.logpdf(near_m, 0.0, with_it**0.5)
        summed = max(summed + ratio, 0.0)
        assert monitor.judge_end(s, 1, sign, innovation, with_it) == (summed > TUNING.ended_log_odds)
        assert a.ended_log_odds == pytest.approx(summed)
    assert summed > TUNING.ended_log_odds
    monitor.judge_end(s, 1, sign, math.nan, with_it)
    assert a.ended_log_odds == 0.0, "no number is no evidence"
    s.U[0][change] = sign * 10.0
    monitor.judge_end(s, 1, sign, -0.3, with_it)
    least = s.settings.rx_variance_m2 + 0.5 * TUNING.obstructed_std_m**2 + 0.03**2
    assert a.ended_log_odds == pytest.approx(0.5 * (0.09 / with_it + math.log(with_it / least)))
    a.is_obstructed = False
    assert not monitor.judge_end(s, 1, sign, innovation, with_it), "there is none"


def test_an_obstruction_ends_as_it_is_once_its_error_is_known_and_close_to_zero():
    s, usual = state(), 0.0001
    a, change, known = s.anchors[1], s.layout.change + 1, TUNING.ended_std_m**2 + usual
    s.status.place_variance_m2, s.U[0][change] = usual, 0.0
    for share, sigmas, is_over in (
        (1.0 - HAIR, 0.0, True),
        (1.0 + HAIR, 0.0, False),
        (0.5, 1.0 - HAIR, True),
        (0.5, 1.0 + HAIR, False),
    ):
        s.P[at(change, change)], a.is_obstructed = share * known, True
        s.x[change] = error_m = -sigmas * math.sqrt(share * known + usual)
        assert not monitor.judge_end(s, 1, 1.0, 0.0, 1e-3), "nothing is reset"
        assert (a.is_obstructed, s.x[change]) == (not is_over, error_m)


# The clocks


@pytest.mark.parametrize(
    ("newest", "is_common"),
    [
        ((2.0, 2.0, 2.0, 2.0), True),
        ((2.0, 2.0, 2.0, -1.5), True),  # one small one
        ((2.0, 2.0, 2.0, -1.51), False),
        ((2.0, 2.0, 1.5, 1.5), False),
        ((-2.0, -2.0, -2.0, -2.0), False),
    ],
)
def test_innovations_of_all_anchors_but_one_small_one_are_on_one_side(newest, is_common):
    s = state()
    for anchor, innovation in enumerate(newest):
        s.anchors[anchor].innovation = innovation
    assert monitor.is_common(s, 3.0) is is_common
    assert monitor.is_common(s, -3.0) is (newest[0] < 0.0)
    assert monitor.is_common(s, 1.5) is False


def test_two_anchors_show_no_common_cause_in_the_plane():
    for count, is_common in ((2, False), (3, True)):
        s = state(count)
        for anchor in range(count):
            s.anchors[anchor].innovation = 2.0
        assert monitor.is_common(s, 2.0) is is_common


@beyond
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_relays_that_agree_with_a_reception_blame_the_anchor_s_clock(sign, factor, is_beyond):
    s = state()
    s.anchors[1].relay_mean = sign * OFF_ZERO * factor
    assert monitor.is_of_clock(s, 1, sign * 0.3) is is_beyond
    assert not monitor.is_of_clock(s, 1, -sign * 0.3)
    assert not monitor.is_of_clock(s, 1, 0.0)


@beyond
def test_noise_grows_while_a_running_mean_is_off_zero(factor, is_beyond):
    s, gain = state(), TUNING.mean_gain
    a, loss = s.anchors[1], (TUNING.noise_loss, 1.0 - TUNING.mean_gain, TUNING.noise_loss)
    a.relay_mean = a.change_mean = s.status.common_mean = mean = 0.1
    a.walk_scale = a.change_scale = s.status.walk_scale = 10.0
    monitor.adapt_change_noise(s, 1, 1.0)
    assert a.change_mean == 0.1, "it is not obstructed"
    a.is_obstructed = True
    normalised = (OFF_ZERO * factor - (1.0 - gain) * mean) / gain
    monitor.adapt_clock_noise(s, 1, normalised)
    monitor.adapt_change_noise(s, 1, normalised)
    monitor.adapt_process_noise(s, normalised)
    assert [a.relay_mean, a.change_mean, s.status.common_mean] == [near(OFF_ZERO * factor)] * 3
    expected = [near(10.0 * (TUNING.noise_growth if is_beyond else one)) for one in loss]
    assert [a.walk_scale, a.change_scale, s.status.walk_scale] == expected
    a.relay_mean = a.change_mean = s.status.common_mean = 10.0 if is_beyond else 0.0
    largest = (TUNING.max_walk_scale, TUNING.max_scale, TUNING.max_walk_scale)
    a.walk_scale, a.change_scale, s.status.walk_scale = largest if is_beyond else (1.0, 1.0, 1.0)
    monitor.adapt_clock_noise(s, 1, 0.0)
    monitor.adapt_change_noise(s, 1, 0.0)
    monitor.adapt_process_noise(s, 0.0)
    assert (a.walk_scale, a.change_scale, s.status.walk_scale) == (largest if is_beyond else (1.0, 1.0, 1.0))


@beyond
def test_the_noise_of_motion_grows_while_innovations_along_the_axes_stay_on_one_side(factor, is_beyond):
    s, gain, weight = state(), TUNING.mean_gain, TUNING.forgetting
    s.h[0], s.h[1], s.status.q_scale = 0.6, -0.8, 10.0
    s.status.lag[0], s.status.lag[1] = 0.2, 0.1
    lag = (0.95 * 0.2 + gain * 0.6 * 2.0, 0.95 * 0.1 - gain * 0.8 * 2.0)
    square = (lag[0] ** 2 + lag[1] ** 2) * (2.0 - gain) / gain
    s.status.lag_square = (TUNING.lag_limit * factor - weight * square) / (1.0 - weight)
    monitor.adapt_process_noise(s, 2.0)
    assert [s.status.lag[0], s.status.lag[1], s.status.lag[2]] == [near(lag[0]), near(lag[1]), 0.0]
    assert s.status.lag_square == near(TUNING.lag_limit * factor)
    assert s.status.q_scale == near(10.0 * (TUNING.noise_growth if is_beyond else TUNING.noise_loss))
    s.status.lag[0] = s.status.lag[1] = s.status.lag_square = 0.0
    s.status.q_scale = 1.0
    monitor.adapt_process_noise(s, 0.0)
    assert s.status.q_scale == 1.0


@pytest.mark.parametrize(
    ("changes", "stated", "shown", "least"),
    [
        (1, 2.0, 0.5, 1.0),
        (2, 2.0, 0.5, 0.25),
        (2, 2.0, 1e-9, 0.02),
        (2, 2.0, 1e9, 1e4),
        (2, 0.5, 0.25, 0.5),
        (2, 0.0, 1.0, 1.0),
    ],
)
def test_the_noise_of_clocks_returns_to_what_their_rates_have_shown(changes, stated, shown, least):
    s = state()
    s.settings.walk, s.status.rate_changes = stated, changes
    s.status.anchors_walk, s.status.tag_walk = shown, 0.0
    s.anchors[1].walk_scale = s.status.walk_scale = 1e-3
    monitor.adapt_clock_noise(s, 1, 0.0)
    monitor.adapt_process_noise(s, 0.0)
    assert (s.anchors[1].walk_scale, s.status.walk_scale) == (near(least), near(least))


@beyond
def test_the_noise_of_motion_doubles_at_once_while_innovations_are_far_off(factor, is_beyond):
    s, gain = state(), TUNING.mean_gain
    lag = math.sqrt(TUNING.sudden_lag * factor * gain / (2.0 - gain))
    for scale, most in ((10.0, 20.0), (0.7 * TUNING.max_scale, TUNING.max_scale)):
        s.h[0], s.h[1], s.status.q_scale, s.status.lag_square = 0.6, -0.8, scale, 0.0
        s.status.lag[0], s.status.lag[1] = 0.6 * lag / (1.0 - gain), -0.8 * lag / (1.0 - gain)
        monitor.adapt_process_noise(s, 0.0)
        assert s.status.q_scale == near(most if is_beyond else scale * TUNING.noise_loss)


# The gate


def test_the_gate_is_symmetric_and_no_number_is_beyond_it():
    s = state()
    gate = s.settings.gate
    within = [monitor.is_within_gate(s, one) for one in (gate, -gate, gate + 1e-9, -gate - 1e-9, math.nan, math.inf)]
    assert within == [True, True, False, False, False, False]


@pytest.mark.parametrize("is_difference", [False, True])
def test_innovations_are_counted_and_averaged(is_difference):
    s = state()
    beyond_m = 2.0 * (s.settings.gate + 0.1)
    for innovation in (1.0, beyond_m, -beyond_m):
        monitor.note_innovation(s, innovation, 4.0, is_difference)
    status, weight, slow = s.status, TUNING.forgetting, TUNING.slow_forgetting
    assert (status.accepted, status.rejected, status.rejected_in_row) == (1, 2, 2)
    assert status.rejected_share == near(weight + weight * (1.0 - weight))
    assert status.late_share == (0.0 if is_difference else near(slow + slow * (1.0 - slow)))
    nis, square_m2 = state().status.mean_nis, state().status.mean_square_m2
    assert status.mean_nis == near(nis + weight * (0.25 - nis))
    assert status.mean_square_m2 == near(square_m2 + weight * (1.0 - square_m2))
    monitor.note_innovation(s, -1.0, 4.0, is_difference)
    assert (status.accepted, status.rejected, status.rejected_in_row) == (2, 2, 0)


def test_large_innovations_weigh_less_where_they_may_be_late():
    s, full, less = state(), (1.0, 1.0, 1.0, 0.0), (1.0, 4.0 / 3.0, 4.0 / 3.0, 0.0)
    recent = TUNING.recent_jumps
    for share, jumps, scales in ((0.0, recent, full), (0.1, 0.0, less), (0.0, recent * (1.0 + HAIR), less)):
        s.status.late_share, s.status.obstruction = share, jumps
        found = [monitor.variance_scale(s, one, False) for one in (1.4, 2.0, -2.0, s.settings.gate + 0.1)]
        assert found == [near(scale) for scale in scales]
        found = [monitor.variance_scale(s, one, True) for one in (0.9, 2.0, -2.0, s.settings.gate + 0.1)]
        assert found == [near(scale) for scale in (1.0, 2.0, 2.0, 0.0)]


@pytest.mark.parametrize(("nis", "scale"), [(0.5, 1.0), (2.0, 1.0), (2.5, 6.25)])
def test_covariances_grow_with_the_square_of_a_mean_nis_beyond_two(nis, scale):
    s = state()
    s.status.mean_nis = nis
    assert monitor.covariance_scale(s) == scale


# What is learnt of range errors


@pytest.mark.parametrize(
    ("x_m", "elapsed_s", "memory_s", "expected_m2"),
    [
        (0.1, 1.0, 10.0, 0.02 + 0.1 * (0.01 + 0.003 - 0.02)),
        (0.1, 0.05, 0.5, 0.02 + 0.1 * (0.01 + 0.003 - 0.02)),
        (0.1, 7.0, 10.0, 0.02 + 0.5 * (0.01 + 0.003 - 0.02)),  # half of it at most
        (3.0, 5.0, 10.0, TUNING.max_change_std_m**2),
        (0.0, 5.0, 10.0, 0.12**2),  # the least
        (0.1, 1.0, 0.0, 0.02),
    ],
)
def test_the_variance_of_a_changing_range_error_is_the_mean_square_of_its_estimate(
    x_m, elapsed_s, memory_s, expected_m2
):
    s = state(change_memory_s=memory_s, least_change_std_m=0.12 if x_m == 0.0 else 0.0)
    change = s.layout.change + 1
    s.x[change], s.P[at(change, change)], s.anchors[1].change_variance_m2 = x_m, 0.003, 0.02
    monitor.adapt_change_variance(s, 1, elapsed_s)
    assert s.anchors[1].change_variance_m2 == near(expected_m2)


class Walk:
    """A tag that walks past one anchor, whose residuals are given."""

    def __init__(self):
        self.s = state()
        self.a = self.s.anchors[1]

    def step(self, residual_m, by_m=TUNING.place_step_m):
        self.s.status.walked_m += by_m
        monitor.learn_place(self.s, 1, residual_m)
        return self.a.place_steps

    @property
    def squares_m2(self):
        return [self.s.status.place_square_m2[lag] for lag in range(2)]


def test_range_errors_are_compared_after_each_step_and_after_two():
    walk = Walk()
    walk.s.status.place_square_m2[0] = walk.s.status.place_square_m2[1] = 1.0  # so that nothing is limited
    assert walk.step(9.0, 0.09) == 0
    assert (walk.a.place_walked_m, walk.a.place_residual_m[0]) == (0.0, 0.0), "it is no step yet"
    assert [walk.step(0.1, 0.02), walk.step(0.3), walk.step(0.2, 0.19)] == [1, 2, 3]
    first = 1.0 / (TUNING.place_first + 1), 1.0 / (TUNING.place_first + 2)
    expected = []
    for differences in ((0.2, -0.1), (0.3, 0.1)):  # after one step; after two, of which the first had no residual
        mean = 1.0
        for weight, difference in zip(first, differences, strict=True):
            mean += weight * (0.5 * difference**2 / monitor._PLACE_LIMITED_MEAN - mean)
        expected.append(mean)
    assert walk.squares_m2 == [near(one) for one in expected]
    assert walk.s.status.place_samples == 2
    assert walk.step(0.0, 0.21) == 0, "steps of twice the length are not compared"
    assert [walk.a.place_residual_m[lag] for lag in range(2)] == [0.0, 0.2]
    assert walk.s.status.place_samples == 2


def test_a_jump_is_no_multipath():
    walk = Walk()
    walk.s.status.place_square_m2[0] = walk.s.status.place_square_m2[1] = 0.01
    for residual_m in (0.0, 0.0, 50.0):
        walk.step(residual_m)
    mean = 0.01 + (0.0 - 0.01) / 21.0
    limited = monitor._PLACE_LIMIT * mean / monitor._PLACE_LIMITED_MEAN
    assert walk.squares_m2 == [near(mean + (limited - mean) / 22.0)] * 2


@pytest.mark.parametrize(
    ("samples", "near_m2", "far_m2", "kept"),
    [
        (99, 0.004, 0.006, None),  # it needs a hundred comparisons
        (100, 0.004, 0.006, 0.5),
        (100, 0.00119, 0.0018, None),
        (100, 0.00121, 0.0018, 0.0018 / 0.00121 - 1.0),
        (100, 0.004, 0.004, TUNING.place_kept),
        (100, 0.004, 0.008, 1.0 - TUNING.place_kept),
    ],
)
def test_the_variogram_of_range_errors_gives_the_multipath_and_how_far_it_reaches(samples, near_m2, far_m2, kept):
    walk = Walk()
    status, settings = walk.s.status, walk.s.settings
    noise = settings.tx_variance_m2 + settings.rx_variance_m2
    status.place_samples = samples
    status.place_square_m2[0], status.place_square_m2[1] = near_m2 + noise, far_m2 + noise
    walk.step(0.0)
    if kept is None:
        assert (status.place_variance_m2, status.place_distance_m) == (0.0, settings.place_distance_m)
    else:
        assert status.place_variance_m2 == pytest.approx(min(near_m2 / (1.0 - kept), 0.25), rel=1e-9)
        assert status.place_distance_m == pytest.approx(-TUNING.place_step_m / math.log(kept), rel=1e-9)


def test_multipath_that_the_settings_state_is_not_learnt_and_comparisons_are_remembered_up_to_a_thousand():
    walk = Walk()
    walk.s.settings.place_std_m = 0.1
    status, settings = walk.s.status, walk.s.settings
    noise = settings.tx_variance_m2 + settings.rx_variance_m2
    status.place_samples = 1000
    for near_m2, learnt_m2 in ((0.0049, 0.0), (0.0051, 0.0102)):  # with a correlation of a half
        status.place_square_m2[0], status.place_square_m2[1] = near_m2 + noise, 1.5 * near_m2 + noise
        walk.a.place_steps = 0
        walk.step(0.0)
        assert status.place_variance_m2 == pytest.approx(learnt_m2, rel=1e-9)
    walk.step(0.0)
    assert status.place_samples == TUNING.place_memory


# Rest


def still(**changes):
    s = state()
    for axis in range(2):
        s.P[at(axis, axis)] = 0.01
        s.status.stationary_m2[axis] = 0.01
    s.status.stationary_s = 5.0
    for name, value in changes.items():
        setattr(s.status, name, value)
    return s


@pytest.mark.parametrize(
    ("moved_m", "changes", "moved"),
    [
        ((0.1, 0.0999), {}, False),  # χ² of two axes, at most 2
        ((0.1, 0.1001), {}, True),
        ((0.0, 0.0), {"lag_square": TUNING.lag_limit}, False),
        ((0.0, 0.0), {"lag_square": TUNING.lag_limit + HAIR}, True),
        ((0.0, 0.0), {"rejected_in_row": 1}, False),
        ((0.0, 0.0), {"rejected_in_row": 2}, True),
    ],
)
def test_a_tag_is_at_rest_until_its_position_or_its_innovations_show_motion(moved_m, changes, moved):
    s = still(**changes)
    rest_m = (3.0, -2.0)
    now_m = [rest + by for rest, by in zip(rest_m, moved_m, strict=True)]
    for axis in range(2):
        s.status.stationary_m[axis], s.x[axis] = rest_m[axis], now_m[axis]
    monitor.update_stationary(s, 0.25)
    assert s.status.stationary_s == (0.0 if moved else 5.25)
    assert [s.status.stationary_m[axis] for axis in range(2)] == (now_m if moved else list(rest_m))


@pytest.mark.parametrize(("variance", "is_better"), [(0.008 + 1e-12, False), (0.008 - 1e-12, True)])
def test_the_position_of_rest_is_taken_again_once_it_is_better_known(variance, is_better):
    s = still()
    s.x[0], s.P[at(0, 0)] = 0.01, variance
    monitor.update_stationary(s, 0.25)
    assert (s.status.stationary_s, s.status.stationary_m[0]) == (5.25, 0.01 if is_better else 0.0)
    assert (s.status.stationary_m2[0], s.status.stationary_m2[1]) == (variance if is_better else 0.01, 0.01)
