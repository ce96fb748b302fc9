"""Smoothed fixes, height sensors and bounds, on time differences of a simulated tag."""

import numpy as np
import pytest

import skyless
from skyless.core.air.masterless_packets import PairTdoa
from skyless.core.estimator.settings import EstimatorSettings
from skyless.run.masterless.difference_tracking import DifferenceTracking
from skyless.run.masterless.smoothing import CHUNK, smoothed
from skyless.site.survey.anchor_errors import DifferenceCalibration
from support import synthetic_recordings as synthetic

ANCHORS_M = {1: (0.0, 0.0, 0.2), 2: (8.0, 0.0, 2.8), 3: (8.0, 6.0, 0.2), 4: (0.0, 6.0, 2.8), 5: (4.0, 0.0, 1.5)}
NOISE_M = 0.12
EXACT = EstimatorSettings(
    qa=0.05,
    gate=8.0,
    white=0.0,
    walk=0.0,
    drop_s=1e3,
    range_std_m=0.0,
    slope_std_m=0.0,
    place_std_m=0.0,
    survey_std_m=0.0,
)
"""A filter that knows ranges and anchors exactly: then it is linear but for the ranges' curvature."""


def measured(place_m, anchor):
    """A range as radios of this kind usually measure it, which the filter knows."""
    range_m = float(np.linalg.norm(place_m - ANCHORS_M[anchor]))
    return range_m + DifferenceCalibration({}).error_m(anchor, range_m)


def walk(seed, count, noise_m=NOISE_M, period_s=0.002):
    """Differences of a tag that accelerates at random as the filter assumes, and its true positions."""
    random, anchors = np.random.default_rng(seed), list(ANCHORS_M)
    place_m, speed_mps, pairs, places = np.array([4.0, 3.0, 1.2]), np.zeros(3), [], []
    for number in range(count):
        a, b = random.choice(anchors, 2, replace=False).tolist()
        ranges = {anchor: measured(place_m, anchor) for anchor in (a, b)}
        pairs.append(PairTdoa(number * period_s, a, b, float(ranges[b] - ranges[a] + random.normal(0.0, noise_m))))
        places.append(place_m.copy())
        speed_mps += random.normal(0.0, (EXACT.qa * period_s) ** 0.5, 3)
        place_m = place_m + period_s * speed_mps
    return pairs, np.array(places)


def test_smoothing_is_the_batch_solution_of_a_linear_model():
    """With all measurements and noises in one least squares (position and velocity at every difference)."""
    pairs, _ = walk(1, 240, noise_m=NOISE_M / 5.0)  # so small that all innovations have their full weight
    tracking = DifferenceTracking(EXACT, ANCHORS_M)
    found = dict(smoothed(tracking, pairs))
    first = min(found)
    # the same by normal equations, linearised at the smoothed positions
    tracking = DifferenceTracking(EXACT, ANCHORS_M)
    for pair in pairs[:first]:
        tracking.update((pair,))
    tracking.update((pairs[first],))
    x, P = tracking.estimator.motion()
    count = len(pairs) - first
    information, evidence = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
    information[:6, :6], evidence[:6] = np.linalg.inv(P), np.linalg.solve(P, x)
    for number in range(1, count):
        pair, dt = pairs[first + number], pairs[first + number].time_s - pairs[first + number - 1].time_s
        F = np.eye(6) + dt * np.eye(6, k=3)
        Q = EXACT.qa * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(3))
        both = np.hstack([-F, np.eye(6)])
        here = slice(6 * (number - 1), 6 * (number + 1))
        information[here, here] += both.T @ np.linalg.solve(Q, both)
        at_m = found[first + number].position_m
        to_a, to_b = at_m - ANCHORS_M[pair.anchor_a], at_m - ANCHORS_M[pair.anchor_b]
        gradient = to_b / np.linalg.norm(to_b) - to_a / np.linalg.norm(to_a)
        value = pair.tdoa_m - (measured(at_m, pair.anchor_b) - measured(at_m, pair.anchor_a)) + gradient @ at_m
        scale = 1.0 / EXACT.difference_std_m**2
        position = slice(6 * number, 6 * number + 3)
        information[position, position] += scale * np.outer(gradient, gradient)
        evidence[position] += scale * gradient * value
    covariance = np.linalg.inv(information)
    best = covariance @ evidence
    for number in (0, count // 3, count - 1):
        fix, position = found[first + number], slice(6 * number, 6 * number + 3)
        sigmas = np.sqrt(np.diagonal(covariance[position, position]))
        # the curvature of ranges leaves a part of a standard deviation
        assert np.abs(fix.position_m - best[position]).max() < 0.1 * sigmas.max()
        assert np.sqrt(np.diagonal(fix.covariance_m2)) == pytest.approx(sigmas, rel=0.1)


@pytest.mark.statistical
def test_smoothed_fixes_are_better_and_as_honest():
    """Eight tags of the filter's own model: NEES by degree of freedom 1 within what a few hundred free fixes allow."""
    nees, ratios = [], []
    for seed in range(8):
        pairs, places_m = walk(seed, CHUNK + 500)
        fixes, tracking = {}, DifferenceTracking(EXACT, ANCHORS_M)
        for number, pair in enumerate(pairs):
            if tracking.update((pair,)):
                fixes[number] = tracking.fix()
        later = dict(smoothed(DifferenceTracking(EXACT, ANCHORS_M), pairs))
        assert later.keys() == fixes.keys()
        judged = [number for number in later if number > 300]
        errors_m = np.array([later[number].position_m - places_m[number] for number in judged])
        filtered_m = np.array([fixes[number].position_m - places_m[number] for number in judged])
        ratios.append(np.sqrt((errors_m**2).sum() / (filtered_m**2).sum()))
        inverse = np.linalg.inv([later[number].covariance_m2 for number in judged])
        nees.append(np.einsum("ni,nij,nj->n", errors_m, inverse, errors_m).mean() / 3.0)
    assert np.mean(ratios) < 0.9
    assert 0.7 < np.mean(nees) < 1.3


@pytest.fixture
def table(tmp_path):
    (tmp_path / "anchors.csv").write_text(synthetic.anchors_csv())
    path = tmp_path / "tdoa.csv"
    path.write_bytes(b"".join(synthetic.tdoa_table(3000)))
    return path


def replayed(table, **asked):
    times_s = np.arange(0.0, 3000 * synthetic.PERIOD_S, 0.02)
    truth = np.array([(t_s, *synthetic.place_m(t_s)) for t_s in times_s])
    return skyless.replay(table, anchors=table.with_name("anchors.csv"), truth=truth, **asked).reports["tag"]


def heights_of(seconds_s, std_m, zero_m=0.0):
    random = np.random.default_rng(7)
    rows = [(t_s, synthetic.place_m(t_s)[2] + zero_m + random.normal(0.0, std_m), std_m) for t_s in seconds_s]
    return np.array(rows)


@pytest.mark.site
def test_a_height_sensor_corrects_the_height(table):
    heights = heights_of(np.arange(0.0, 3000 * synthetic.PERIOD_S, 0.05), 0.01)
    alone, given = replayed(table), replayed(table, heights=heights)
    assert given.rmse_axes_m[2] < 0.6 * alone.rmse_axes_m[2]
    barometer = replayed(table, heights=heights + np.array([0.0, 345.0, 0.0]), height_kind="barometer")
    assert barometer.fixes > 0.9 * alone.fixes
    assert barometer.rmse_axes_m[2] < alone.rmse_axes_m[2]


@pytest.mark.site
def test_heights_serve_packets_as_well(tmp_path):
    """Of a recording whose time is that of its first packet."""
    (tmp_path / "anchors.csv").write_text(synthetic.anchors_csv())
    path = synthetic.write(tmp_path / "packets", "bitcraze-binary", 3000)
    times_s = np.arange(0.0, 3000 * synthetic.PERIOD_S, 0.05)
    for asked in ({}, {"measurements": "differences"}):
        alone, given = (
            skyless.replay(path, anchors=tmp_path / "anchors.csv", tag_height_m="free", **asked, **more)
            for more in ({}, {"heights": heights_of(times_s, 0.01)})
        )
        spread_m = [result.fixes.position_m[len(result.fixes) // 2 :, 2].std() for result in (alone, given)]
        assert spread_m[1] < 0.7 * spread_m[0]


@pytest.mark.site
def test_smoothing_serves_the_command_as_well(table):
    alone, later = replayed(table), replayed(table, smooth=True)
    assert (later.fixes, later.method, later.hpl_m) == (alone.fixes, "joint-smoothed", None)
    assert later.rmse_3d_m < alone.rmse_3d_m


@pytest.mark.site
def test_a_truth_that_is_late_is_moved(table):
    right, moved = replayed(table), replayed(table, truth_offset_s=0.7)
    assert right.truth_offset_s == pytest.approx(0.0, abs=0.1)
    assert moved.truth_offset_s == pytest.approx(-0.7, abs=0.1)


class Failing:
    def hear(self, one):
        return one.tdoa_m / 0


class Misleading:
    def hear(self, one):
        return [one.tdoa_m]


class Nowhere:
    def hear(self, one):
        return skyless.Fix.of(one.time_s, [np.nan] * 3)


@pytest.mark.parametrize(
    ("asked", "named"),
    [
        ({"heights": np.zeros((3, 5))}, "heights is .*; it should be rows of time in s"),
        ({"height_kind": "barometer"}, "height_kind is 'barometer'; it should be left out: heights gives none"),
        ({"z_bounds_m": (2.0, 1.0)}, "z_bounds_m is .*; it should be the lowest and then the highest"),
        ({"truth_offset_s": "soon"}, "truth_offset_s is 'soon'; it should be a number"),
        ({"smooth": True, "measurements": "packets"}, "measurements is 'packets'; smooth needs differences"),
        (
            {"tag_height_m": 1.2, "heights": np.ones((3, 2)), "height_kind": "barometer"},
            "height_kind is 'barometer'; it",
        ),
        ({"estimator": Failing}, r"Failing.hear has failed: ZeroDivisionError: .* \(.*test_smoothing.py, line \d+\)"),
        ({"estimator": Misleading}, "Misleading.hear has returned list; it should be None or a fix"),
        ({"estimator": Nowhere}, r"Nowhere.hear has failed: ValueError: time_s is .*; both should be finite"),
        ({"estimator": 3}, "estimator is 3; it should be a class with a method hear"),
    ],
    ids=str,
)
def test_mistakes_are_named(table, asked, named):
    with pytest.raises(skyless.SkylessError, match=named):
        replayed(table, **asked)
