"""The Cramér–Rao bound with biases: against closed forms, and the bound without them."""

from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace
from textbook_bound import ALL_BIASES, LAB, settings_of, walk

from skyless.research.uncertainty import Biases, tracking_bound

pytestmark = pytest.mark.site


def still(place, stamp_s, superframes):
    """A tag that is known to rest, among crystals that keep their rates."""
    settings = settings_of(stamp_s, white_fm=0.0, random_walk_fm=0.0, qa=0.0, speed_std_mps=0.0)
    return np.tile([*place, 0.0], (6 * superframes, 1)), settings


@pytest.mark.parametrize("place", [(3.0, 4.0), (1.2, 1.6), (5.0, 7.0)])
def test_constants_and_the_slope_leave_what_weighted_least_squares_of_one_snapshot_leave(place):
    """Once all noise has averaged away and nothing moves."""
    path, settings = still(place, 1e-12, 100)
    to_tag = path[0] - LAB
    ranges = np.linalg.norm(to_tag, axis=1)
    G = np.column_stack([to_tag[:, :2] / ranges[:, None], np.ones(6)])
    g = np.clip((ranges - 4.0) / 4.0, -1.0, 1.0)
    R = 0.029**2 * np.eye(6) + 0.05**2 * np.outer(g, g)
    expected = np.linalg.inv(G.T @ np.linalg.solve(R, G))[:2, :2]
    found = tracking_bound(LAB, path, settings, Biases(constant_std_m=0.029, slope_std_m=0.05))[-1]
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-8)


@pytest.mark.parametrize("place", [(3.0, 4.0), (1.2, 1.6), (5.0, 7.0)])
def test_displaced_anchors_that_measure_their_distances_leave_the_whole_site_displaced_and_turned(place):
    """σ²/n on each axis, and a rotation of variance σ²/Σr² about the anchors' middle."""
    path, settings = still(place, 1e-12, 100)
    away = LAB[:, :2] - LAB[:, :2].mean(axis=0)
    x, y = np.array(place) - LAB[:, :2].mean(axis=0)
    across = np.array([-y, x])
    expected = 0.02**2 * (np.eye(2) / 6.0 + np.outer(across, across) / np.square(away).sum())
    found = tracking_bound(LAB, path, settings, Biases(survey_std_m=0.02))[-1]
    np.testing.assert_allclose(found, expected, rtol=5e-3, atol=1e-7)


def test_a_part_that_never_changes_is_a_constant_and_one_that_changes_at_once_is_noise():
    path, settings = walk(), settings_of(at_once=False)
    constant = tracking_bound(LAB, path, settings, Biases(constant_std_m=0.03))
    np.testing.assert_allclose(tracking_bound(LAB, path, settings, Biases(changing_std_m=0.03)), constant, rtol=1e-6)
    noisy = tracking_bound(LAB, path, settings, Biases(changing_std_m=0.03, correlation_s=1e-5))
    clean = tracking_bound(LAB, path, settings, Biases())
    assert np.trace(clean[-1]) < np.trace(noisy[-1]) < np.trace(constant[-1])


@pytest.mark.parametrize("name", ["survey_std_m", "constant_std_m", "changing_std_m", "slope_std_m"])
def test_larger_biases_never_make_the_bound_smaller(name):
    path, settings = walk(), settings_of(at_once=False)
    bounds = [
        tracking_bound(LAB, path, settings, replace(ALL_BIASES, **{name: std_m}))[-1]
        for std_m in (0.0, 0.02, 0.05, 0.2)
    ]
    for smaller, larger in pairwise(bounds):
        assert np.linalg.eigvalsh(larger - smaller).min() > -1e-12
        assert np.trace(larger) > np.trace(smaller)
