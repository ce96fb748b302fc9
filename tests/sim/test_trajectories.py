"""Paths: continuous, at the speed asked for, inside their box, and with the statistics they promise."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from skyless.sim.trajectory import Roaming, Static, Waypoints

pytestmark = pytest.mark.site

SQUARE = [(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)]


def test_static_point_rests():
    tag = Static(1.0, 2.0, 3.0)
    assert tag.position(1e7).tolist() == [1.0, 2.0, 3.0]
    assert tag.velocity(1e7).tolist() == [0.0, 0.0, 0.0]


def test_polyline_passes_its_points_on_time_and_ends():
    path = Waypoints(SQUARE, 2.0)
    expected = {-5.0: (0, 0), 0.0: (0, 0), 1.0: (2, 0), 2.0: (4, 0), 3.5: (4, 3), 5.5: (0, 3), 94.0: (0, 3)}
    for t_s, place in expected.items():
        assert path.position(t_s)[:2] == pytest.approx(place, abs=1e-12)
    assert path.velocity(1.0).tolist() == [2.0, 0.0, 0.0]
    assert not path.velocity(6.0).any()


def test_loop_closes_and_repeats():
    path = Waypoints(SQUARE, 1.0, loop=True)
    assert path.position(13.0) == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
    for t_s in np.linspace(0.0, 13.9, 50):
        assert path.position(t_s + 14.0 * 1000) == pytest.approx(path.position(t_s), abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(t_s=st.floats(-2.0, 58.0), loop=st.booleans(), corner_s=st.sampled_from([0.3, 1.0]))
def test_bent_corners_keep_velocity_continuous(t_s, loop, corner_s):
    path = Waypoints(SQUARE, 1.5, loop=loop, corner_s=corner_s)
    step_s = 1e-5
    before, after = path.position(t_s), path.position(t_s + step_s)
    midway = path.velocity(t_s + 0.5 * step_s)
    assert (after - before) / step_s == pytest.approx(midway, abs=1e-3)
    most_turning = 2 * 1.5 / corner_s
    assert np.linalg.norm(path.velocity(t_s + step_s) - path.velocity(t_s)) <= most_turning * step_s + 1e-9


@settings(max_examples=40, deadline=None)
@given(t_s=st.floats(-1.0, 1e6), loop=st.booleans(), corner_s=st.sampled_from([0.0, 0.5]))
def test_pieces_hold_the_time_they_are_asked_for(t_s, loop, corner_s):
    for path in (Waypoints(SQUARE, 1.3, loop=loop, corner_s=corner_s), Static(0, 0)):
        piece = path.piece(t_s)
        assert piece.start_s <= t_s < piece.end_s


@pytest.mark.parametrize(
    ("points", "options"),
    [([(0, 0)], {}), ([(0, 0), (0, 0)], {}), (SQUARE, {"corner_s": 9.0}), ([(0, 0, 0, 0)] * 2, {})],
)
def test_paths_that_cannot_be_walked_are_refused(points, options):
    with pytest.raises(ValueError, match=r"should|need"):
        Waypoints(points, 1.0, **options)


@pytest.mark.statistical
def test_roaming_keeps_its_spread_and_speed_from_the_start_on():
    """Over 400 paths, at the start and much later; and velocities gain what a constant-velocity model says."""
    count, qa, damping_s = 400, 0.3, 3.0
    middle, spread = np.array([3.0, 4.0, 1.0]), np.array([0.8, 1.2, 0.3])
    paths = [Roaming(middle, spread, qa_m2ps3=qa, damping_s=damping_s, seed=seed) for seed in range(count)]
    low, high = chi2.ppf([1e-4, 1 - 1e-4], count) / count
    for t_s in (0.0, 12.35):
        places = np.array([path.position(t_s) for path in paths])
        motions = np.array([path.velocity(t_s) for path in paths])
        for values, squared in ((places - middle, spread**2), (motions, np.full(3, 0.5 * qa * damping_s))):
            shares = np.mean(values**2, axis=0) / squared
            assert (shares > low).all()
            assert (shares < high).all()
    gained = np.array([path.velocity(12.45) for path in paths]) - motions
    drawn = gained + 0.1 * ((0.5 * qa * damping_s / spread**2) * (places - middle) + motions / damping_s)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 3 * count) / (3 * count)
    assert low < np.mean(drawn[:, :2] ** 2) / (qa * 0.1) < 1.1 * high


def test_roaming_is_smooth_and_a_function_of_time():
    path, again = (Roaming((3, 4, 0), (0.8, 1.2, 0.0), seed=7) for _ in range(2))
    times = [12.0, 3.5, 0.0, 30.0, 12.0]
    assert [path.position(t).tolist() for t in times] == [again.position(t).tolist() for t in times]
    assert path.position(3.0).tolist() != Roaming((3, 4, 0), (0.8, 1.2, 0.0), seed=8).position(3.0).tolist()
    track = np.array([path.position(0.001 * k) for k in range(10_000)])
    motion = np.array([path.velocity(0.001 * k) for k in range(10_000)])
    assert np.abs(np.diff(track, axis=0) / 0.001 - motion[:-1]).max() < 0.01
    assert np.abs(np.diff(motion, axis=0)).max() < 0.001 * (5.0 * math.sqrt(0.3 / 0.05) + 5.0)
    assert not track[:, 2].any()
