"""Fixes from time differences of pairs: anchors late, off or calibrated; tags at rest, in silence and in their plane.

All simulated: most tags go round in a room of eight anchors and hear one difference every 2.5 ms.
"""

from collections import Counter
from math import dist, log

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.masterless_packets import PairTdoa
from skyless.core.alert import Alert
from skyless.core.estimator.kalman import is_stationary
from skyless.core.estimator.settings import TUNING
from skyless.core.fix import NoFixReason
from skyless.core.tag.position import Solution, locate
from skyless.run.masterless.difference_tracking import DIFFERENCES, DifferenceTracking, Start, find_start, joined_tdoas
from skyless.site.survey.anchor_errors import AnchorCalibration, DifferenceCalibration

pytestmark = pytest.mark.site

ANCHORS_M = {n: (8.0 * (n & 1), 6.0 * (n >> 1 & 1), 0.3 + 2.4 * ((n ^ n >> 1 ^ n >> 2) & 1)) for n in range(4)}
ANCHORS_M |= {4 + n: (8.0 * (n & 1), 6.0 * (n >> 1 & 1), 2.7 - ANCHORS_M[n][2] + 0.3) for n in range(4)}
STEP_S = 0.0025
STD_M = 0.06


def place_m(time_s, speed_mps=1.0):
    angle = speed_mps * time_s / 2.0
    return 4.0 + 2.0 * np.cos(angle), 3.0 + 2.0 * np.sin(angle), 1.3 + 0.3 * np.sin(0.7 * angle)


def run(until_s, late_m=lambda _time_s, _anchor: 0.0, *, seed=0, still=False, anchors_m=ANCHORS_M, settings=None):
    """Rows of time, error, covariance; and the tracking."""
    generator = np.random.default_rng(seed)
    tracking = DifferenceTracking(settings or DIFFERENCES, anchors_m)
    rows, count = [], len(anchors_m)
    for k in range(int(until_s / STEP_S)):
        time_s = k * STEP_S
        tag_m = place_m(0.0 if still else time_s)
        a, b = (int(n) for n in generator.choice(count, 2, replace=False))
        off_m = [late_m(time_s, n) + 0.05 * np.log(dist(tag_m, anchors_m[n])) for n in (a, b)]
        true_m = dist(tag_m, anchors_m[b]) - dist(tag_m, anchors_m[a]) + off_m[1] - off_m[0]
        if tracking.update([PairTdoa(time_s, a, b, true_m + generator.normal(0.0, STD_M))]):
            fix = tracking.fix()
            rows.append((time_s, fix.position_m - tag_m, fix.covariance_m2))
    return rows, tracking


def fixes(until_s):
    """All fixes without faults."""
    generator, tracking = np.random.default_rng(0), DifferenceTracking(DIFFERENCES, ANCHORS_M)
    for k in range(int(until_s / STEP_S)):
        tag_m, (a, b) = place_m(k * STEP_S), generator.choice(8, 2, replace=False).tolist()
        true_m = dist(tag_m, ANCHORS_M[b]) - dist(tag_m, ANCHORS_M[a])
        if tracking.update([PairTdoa(k * STEP_S, a, b, true_m + generator.normal(0.0, STD_M))]):
            yield tracking.fix()


def rmse_m(rows, after_s=1.0, until_s=np.inf):
    errors = np.array([error for time_s, error, _ in rows if after_s <= time_s < until_s])
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


@pytest.mark.parametrize("off_m", [0.8, 3.0])
def test_an_anchor_that_is_late_for_seconds_is_left_out_and_taken_back(off_m):
    """Late by so much from 4 to 8 s, by jumps between that and nothing as reflections come and go."""
    clean, _ = run(12.0)
    rows, tracking = run(
        12.0, lambda time_s, n: off_m if n == 2 and 4.0 <= time_s < 8.0 and time_s % 0.5 < 0.4 else 0.0
    )
    assert rmse_m(rows) < 1.5 * rmse_m(clean) + 0.01
    used_late = sum(1 for time_s, *_ in rows if 4.2 <= time_s < 8.0)
    used_later = sum(1 for time_s, *_ in rows if 8.2 <= time_s < 12.0)
    assert used_late < 0.9 * used_later
    assert used_later > 0.97 * 3.8 / STEP_S
    assert tracking.counters["restart"] == 0


def test_a_start_beside_a_wrong_anchor():
    """Anchor 5 is wrong from the first difference on, as anchors are behind metal or for a tag on the floor."""
    rows, _ = run(6.0, lambda _, n: 2.5 if n == 5 else 0.0)
    assert rows[0][0] < 0.5
    assert rmse_m(rows) < 0.08


@pytest.mark.parametrize("seed", range(20))
def test_a_start_tells_which_two_anchors_are_late_or_doubts_and_claims_no_more_than_it_knows(seed):
    generator = np.random.default_rng(seed)
    late = dict(zip(generator.choice(8, 2, replace=False).tolist(), generator.uniform(0.4, 2.0, 2), strict=True))
    tag_m, window = place_m(float(seed)), []
    for k in range(int(TUNING.window)):
        a, b = k % 8, (k + 1 + k // 8 % 3) % 8
        true_m = dist(tag_m, ANCHORS_M[b]) - dist(tag_m, ANCHORS_M[a]) + late.get(b, 0.0) - late.get(a, 0.0)
        window.append(PairTdoa(0.002 * k, a, b, true_m + generator.normal(0.0, STD_M)))
    places = {anchor: np.array(place) for anchor, place in ANCHORS_M.items()}
    start = find_start(window, places, DifferenceCalibration({}), None, None)
    assert isinstance(start, Start)
    assert start.is_ambiguous
    off_m = start.position_m - tag_m
    assert off_m @ np.linalg.solve(start.covariance_m2, off_m) < 21.0  # χ² of three, 1e-4
    assert np.linalg.norm(off_m) < 0.5 or np.trace(start.covariance_m2) > 0.25**2


def test_there_is_no_level_before_a_second_start_agrees():
    levels = [fix.hpl_m is not None for fix in fixes(2.0)]
    assert 300 < levels.index(True) < 600
    assert all(levels[levels.index(True) :])


def test_nothing_is_early_by_more_than_the_bound():
    """An anchor that is late makes others seem early, which pulls the position towards it."""
    _, tracking = run(3.0, lambda time_s, n: 1.5 if n == 2 and time_s > 1.0 else 0.0)
    state = tracking.estimator.state
    assert min(state.x[state.layout.change : state.layout.constant]) > DIFFERENCES.earliest_m - 0.01


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.statistical
def test_covariances_hold_where_anchors_are_off_as_assumed(seed):
    """Errors squared over their variance, of anchors as far off in all as the settings have them: about one.

    They do not average away within a run, so the mean over 40 rooms is taken: of 120 values of one degree of freedom
    it lies between 0.65 and 1.44 with 99.9 %. Reflections that change, for which the filter is ready, make it smaller.
    """
    generator = np.random.default_rng(seed)
    normalised = []
    for room in range(40):
        std_m = (DIFFERENCES.range_std_m**2 + DIFFERENCES.place_std_m**2) ** 0.5
        constants = generator.normal(0.0, std_m, len(ANCHORS_M))
        rows, _ = run(2.0, lambda _, n, off=constants: off[n], seed=100 * seed + room)
        _, error, covariance = rows[-1]
        normalised.append(error @ np.linalg.solve(covariance, error) / 3.0)
    assert 0.3 < np.mean(normalised) < 1.44


@pytest.mark.statistical
def test_a_tag_at_rest_is_known_better_than_one_that_may_move_and_wakes_at_once():
    moving, _ = run(30.0)
    rows, tracking = run(30.0, still=True)
    assert is_stationary(tracking.estimator.state)
    jitter = [np.std([error for time_s, error, _ in of if time_s >= 15.0], axis=0).max() for of in (rows, moving)]
    assert jitter[0] < 0.35 * jitter[1]
    for k in range(800):  # it goes on, at 1 m/s at once
        time_s = 30.0 + k * STEP_S
        tag_m = place_m(k * STEP_S)
        a, b = k % 8, (k + 1 + k // 8 % 7) % 8
        off_m = 0.05 * np.log(dist(tag_m, ANCHORS_M[b]) / dist(tag_m, ANCHORS_M[a]))
        tracking.update([PairTdoa(time_s, a, b, dist(tag_m, ANCHORS_M[b]) - dist(tag_m, ANCHORS_M[a]) + off_m)])
        assert dist(tracking.position_m, tag_m) < 0.3
    assert dist(tracking.position_m, tag_m) < 0.1


def test_many_anchors():
    """Twenty, all of them in the state."""
    many = {n: (8.0 * (n % 5) / 4.0, 6.0 * (n // 5) / 3.0, 0.3 + 2.4 * ((n + n // 5) % 2)) for n in range(20)}
    rows, tracking = run(4.0, anchors_m=many)
    assert len(rows) > 0.95 * 4.0 / STEP_S
    assert rmse_m(rows) < 0.15
    assert tracking.counters["restart"] == 0


# Calibration


PLACES = {k: (6.0 * (k % 2), 8.0 * (k // 2 % 2), 0.2 + 2.5 * ((k + k // 4) % 2)) for k in range(8)}
PLACES |= {k: (x + 3.0, y - 4.0, z) for k, (x, y, z) in PLACES.items() if k > 3}
BIAS_M = (-0.2, 0.3, 0.0, -0.25, 0.15, 0.1, -0.3, 0.2)
KNOWN = DifferenceCalibration({k: AnchorCalibration(b, 0.08, 0.05) for k, b in enumerate(BIAS_M)})


def heard(calibration, tag_m, count=3000, seed=1, noise_m=0.05, late_m=0.0):
    """Mean position over the second half; anchors are off as ``KNOWN`` says, anchor 2 by ``late_m`` more at the end."""
    rng = np.random.default_rng(seed)
    tracking = DifferenceTracking(DIFFERENCES, dict(PLACES), calibration=calibration)
    places = []
    for k in range(count):
        a, b = rng.choice(8, 2, replace=False).tolist()
        clean = PairTdoa(0.005 * k, a, b, dist(tag_m, PLACES[b]) - dist(tag_m, PLACES[a]))
        off_m = KNOWN.constant_m(clean) + 0.08 * log(dist(tag_m, PLACES[b]) / dist(tag_m, PLACES[a]))
        off_m += rng.normal(0.0, noise_m)
        off_m += late_m * ((b == 2) - (a == 2)) * (k > count // 2)
        if tracking.update((PairTdoa(clean.time_s, a, b, clean.tdoa_m + off_m),)) and k > count // 2:
            places.append(tracking.position_m)
    return np.array(places), tracking


@pytest.mark.parametrize("tag_m", [(1.0, 2.0, 1.2), (4.5, 6.0, 0.8)])
def test_a_calibration_takes_constants_and_slope_off(tag_m):
    raw, _ = heard(None, tag_m)
    calibrated, tracking = heard(KNOWN, tag_m)
    assert np.linalg.norm(raw.mean(axis=0) - tag_m) > 0.15
    assert np.linalg.norm(calibrated.mean(axis=0) - tag_m) < 0.05
    assert tracking.counters["restart"] == 0


def test_anchors_that_are_not_in_it_are_taken_as_they_are():
    nothing, _ = heard(DifferenceCalibration({}), (1.0, 2.0, 1.2), count=600)
    raw, _ = heard(None, (1.0, 2.0, 1.2), count=600)
    assert np.array_equal(nothing, raw)


def test_a_blocked_anchor_harms_less_where_the_others_are_known():
    """0.8 m late: more than a calibrated anchor can be."""
    tag_m = (2.0, 3.0, 1.2)
    errors = [np.linalg.norm(heard(known, tag_m, late_m=0.8)[0][-500:].mean(axis=0) - tag_m) for known in (None, KNOWN)]
    assert errors[0] > 0.15
    assert errors[1] < 0.05


def test_a_wrong_calibration_ends_in_worse_fixes_and_not_in_none():
    wrong = DifferenceCalibration({k: AnchorCalibration(-one.bias_m, 0.0, 0.01) for k, one in KNOWN.anchors.items()})
    places, _ = heard(wrong, (2.0, 3.0, 1.2), count=2000)
    assert len(places) > 300


# Tag and anchors in one plane


SEEN_FROM_ABOVE = ((0.0, 0.0), (8.0, 0.0), (8.0, 6.0), (0.0, 6.0), (4.0, 0.0), (4.0, 6.0))


@pytest.mark.parametrize("height_m", [None, 2.0])
def test_no_level_where_the_anchors_do_not_tell_the_height(height_m):
    """To first order the height is in no difference."""
    generator, reasons, std_m = np.random.default_rng(1), Counter(), []
    anchors_m = {n: (x, y, 2.0) for n, (x, y) in enumerate(SEEN_FROM_ABOVE)}
    tracking, place = DifferenceTracking(DIFFERENCES.changed(height_m=height_m), anchors_m), np.array([3.0, 2.0, 2.0])
    for k in range(12_000):
        a, b = k % 6, (k + 1 + k // 6 % 5) % 6
        true_m = np.linalg.norm(place - anchors_m[b]) - np.linalg.norm(place - anchors_m[a])
        if tracking.update([PairTdoa(k / 400.0, a, b, float(true_m + generator.normal(0.0, 0.1)))]):
            fix = tracking.fix()
            std_m.append(fix.covariance_m2[2, 2] ** 0.5)
            assert np.linalg.norm(fix.position_m - place) < 5.0 * fix.std_m
        elif k > 1000:
            reasons[tracking.reason] += 1
    if height_m is None:
        assert max(std_m) > 0.5
        assert tracking.fix().alert == Alert.UNAVAILABLE
        assert tracking.fix().vpl_m is None
    else:
        assert tracking.fix().hpl_m is not None
        assert len(std_m) > 11_000
        assert set(reasons) <= {NoFixReason.RESIDUALS}


# Silences


CORNERS_M = {n: (8.0 * (n & 1), 6.0 * (n >> 1 & 1), 0.3 + 2.4 * (n >> 2)) for n in range(8)}


@pytest.mark.statistical
def test_a_tag_that_moved_on_in_silence_is_found_again():
    """Round and round at 1 m/s, heard for 3 s and then not for 8 s; the noise is half of what the filter assumes."""
    generator = np.random.default_rng(4)
    tracking = DifferenceTracking(DIFFERENCES, CORNERS_M)
    errors_m, sigmas_m = [], []
    for k in range(60_000):
        time_s = k / 400.0
        if time_s % 11.0 > 3.0:
            continue
        place = np.array([4.0 + 2.5 * np.cos(time_s / 2.5), 3.0 + 2.5 * np.sin(time_s / 2.5), 1.2])
        a, b = k % 8, (k + 1 + k // 8 % 7) % 8
        true_m = np.linalg.norm(place - CORNERS_M[b]) - np.linalg.norm(place - CORNERS_M[a])
        if tracking.update([PairTdoa(time_s, a, b, float(true_m + generator.normal(0.0, 0.1)))]):
            fix = tracking.fix()
            errors_m.append(float(np.linalg.norm(fix.position_m - place)))
            sigmas_m.append(fix.std_m)
    assert len(errors_m) > 0.9 * 60_000 * 3 / 11
    assert max(np.array(errors_m) / np.array(sigmas_m)) < 5.0
    assert max(errors_m) < 1.5


# Pairs against one reference


def _tdoas(anchors, p, pairs):
    ranges = np.linalg.norm(np.asarray(anchors) - p, axis=1)
    return np.array([ranges[b] - ranges[a] for a, b in pairs])


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 9), extra=st.integers(0, 12))
def test_against_numpy_on_random_connected_graphs(seed, n, extra):
    """Within their noise all pairs weigh alike."""
    draw = np.random.default_rng(seed)
    pairs = [(int(draw.integers(i)), i) for i in range(1, n)]
    pairs += [tuple(map(int, draw.choice(n, 2, replace=False))) for _ in range(extra)]
    pairs = [pair[:: int(draw.choice([1, -1]))] for pair in pairs]
    measured = draw.uniform(-0.1, 0.1, len(pairs)) * TUNING.median_difference_std_m
    anchors, tdoa_m, covariance_m2 = joined_tdoas(pairs, measured)
    assert anchors == tuple(range(n))
    H = np.zeros((len(pairs), n))
    for row, (a, b) in zip(H, pairs, strict=True):
        row[a] -= 1
        row[b] += 1
    # An independent way: the pseudo-inverse of the whole graph's Laplacian, with no anchor singled out.
    potentials, *_ = np.linalg.lstsq(H, measured)
    difference = np.eye(n)[1:] - np.eye(n)[0]
    covariance = TUNING.median_difference_std_m**2 * difference @ np.linalg.pinv(H.T @ H) @ difference.T
    np.testing.assert_allclose(tdoa_m, difference @ potentials, atol=1e-9)
    np.testing.assert_allclose(covariance_m2, covariance, atol=1e-9)


def test_the_largest_part_is_used():
    pairs = [(1, 2), (8, 9), (2, 3), (9, 10), (10, 11)]
    anchors, tdoa_m, _ = joined_tdoas(pairs, [0, 1, 0, 2, 3])
    assert anchors == (8, 9, 10, 11)
    np.testing.assert_allclose(tdoa_m, [1, 3, 6])


def test_a_wrong_pair_among_many_counts_less():
    places = np.array([0.0, 1.0, 3.0, 4.0, 2.0])
    pairs = [(a, b) for a in range(5) for b in range(a)]
    measured = [places[b] - places[a] + 5.0 * ((a, b) == (3, 1)) for a, b in pairs]
    _, tdoa_m, _ = joined_tdoas(pairs, measured)
    assert np.abs(tdoa_m - (places[1:] - places[0])).max() < 0.2


@given(seed=st.integers(0, 2**32 - 1), turned=st.integers(1, 7))
def test_a_ring_of_pairs_locates_the_tag_whatever_the_reference(seed, turned):
    """The same measurements of anchors with other names: another one is then the reference."""
    draw = np.random.default_rng(seed)
    anchors = np.array([(x, y, z) for x in (0, 6) for y in (0, 8) for z in (0.2, 2.6)]) + draw.normal(0, 0.1, (8, 3))
    p = draw.uniform([1, 1, 0.5], [5, 7, 2])
    ring = [(i, (i + 1) % 8) for i in range(8)]
    noisy = _tdoas(anchors, p, ring) + draw.normal(0, 0.05, 8)
    solutions = []
    for by in (0, turned):
        named = [((a + by) % 8, (b + by) % 8) for a, b in ring]
        names, tdoa_m, covariance_m2 = joined_tdoas(named, noisy)
        solutions.append(locate(anchors[[(name - by) % 8 for name in names]], tdoa_m, covariance_m2, residual_tail=0))
    assert all(isinstance(s, Solution) for s in solutions)
    np.testing.assert_allclose(solutions[0].position_m, solutions[1].position_m, atol=1e-6)
    np.testing.assert_allclose(solutions[0].covariance_m2, solutions[1].covariance_m2, rtol=1e-4)
    off = solutions[0].position_m - p
    assert off @ np.linalg.solve(solutions[0].covariance_m2, off) < 40  # chi2 with 3 dof: 1e-8
