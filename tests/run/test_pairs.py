"""TDoAs of pairs brought against one reference."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.estimator.settings import TUNING
from skyless.core.tag.position import Solution, locate
from skyless.run.masterless.difference_tracking import joined_tdoas

pytestmark = pytest.mark.site


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
