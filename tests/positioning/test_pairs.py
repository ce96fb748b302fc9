"""TDoAs of pairs brought against one reference."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.positioning.masterless.difference_tracking import against_reference
from skyless.positioning.methods.locate import NoSolution, Solution, locate


def _tdoas(anchors, p, pairs):
    ranges = np.linalg.norm(np.asarray(anchors) - p, axis=1)
    return np.array([ranges[b] - ranges[a] for a, b in pairs])


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 9), extra=st.integers(0, 12))
def test_against_numpy_on_random_connected_graphs(seed, n, extra):
    draw = np.random.default_rng(seed)
    pairs = [(int(draw.integers(i)), i) for i in range(1, n)]
    pairs += [tuple(map(int, draw.choice(n, 2, replace=False))) for _ in range(extra)]
    pairs = [pair[:: int(draw.choice([1, -1]))] for pair in pairs]
    measured, variances = draw.normal(size=len(pairs)), draw.uniform(0.1, 2, len(pairs))
    result = against_reference(pairs, measured, variances)
    reference = result.anchors[0]
    others = [anchor for anchor in range(n) if anchor != reference]
    assert result.anchors == (reference, *others)
    H = np.zeros((len(pairs), n))
    for row, (a, b) in zip(H, pairs, strict=True):
        row[a] -= 1
        row[b] += 1
    # An independent way: the pseudo-inverse of the whole graph's Laplacian, with no anchor singled out.
    potentials, *_ = np.linalg.lstsq(H / np.sqrt(variances)[:, None], measured / np.sqrt(variances))
    difference = np.eye(n)[others] - np.eye(n)[reference]
    covariance = difference @ np.linalg.pinv(H.T @ np.diag(1 / variances) @ H) @ difference.T
    np.testing.assert_allclose(result.tdoa_m, difference @ potentials, atol=1e-9)
    np.testing.assert_allclose(result.covariance_m2, covariance, atol=1e-9)


def test_a_chain_is_measured_from_its_middle():
    result = against_reference([(7, 3), (3, 5)], [1.0, 2.0], [0.1, 0.4])
    assert result.anchors == (3, 5, 7)
    np.testing.assert_allclose(result.tdoa_m, [2, -1])
    np.testing.assert_allclose(result.covariance_m2, [[0.4, 0.0], [0.0, 0.1]], atol=1e-15)


def test_the_largest_part_is_used_and_bad_pairs_are_left_out():
    pairs = [(1, 2), (8, 9), (2, 3), (3, 3), (9, 10), (10, 11), (3, 8), (3, 8)]
    variances = [1, 1, 1, 1, 1, 1, 0, 1]
    result = against_reference(pairs, [0, 1, 0, 5, 2, 3, 0, math.nan], variances)
    assert set(result.anchors) == {8, 9, 10, 11}
    assert result.anchors[0] in (9, 10)  # these have two measurements each
    by_anchor = dict(zip(result.anchors[1:], result.tdoa_m, strict=True)) | {result.anchors[0]: 0.0}
    assert by_anchor[11] - by_anchor[8] == pytest.approx(6)


def test_of_equal_parts_the_better_known_one_is_used():
    assert set(against_reference([(1, 2), (3, 4)], [0, 0], [1.0, 0.5]).anchors) == {3, 4}
    assert set(against_reference([(3, 4), (1, 2)], [0, 0], [1.0, 1.0]).anchors) == {1, 2}


@pytest.mark.parametrize("pairs", [[], [(4, 4)], [(1, 2)]])
def test_nothing_usable_is_empty_and_locates_nothing(pairs):
    result = against_reference(pairs, [math.inf] * len(pairs), [1.0] * len(pairs))
    assert result.anchors == ()
    assert isinstance(locate(np.empty((0, 3)), result.tdoa_m, result.covariance_m2), NoSolution)


def test_lengths_that_differ_raise():
    with pytest.raises(ValueError, match="expected one each"):
        against_reference([(1, 2)], [0.0, 1.0], [1.0])


@given(seed=st.integers(0, 2**32 - 1), best=st.integers(0, 7))
def test_a_ring_of_pairs_locates_the_tag_whatever_the_reference(seed, best):
    """The same measurements, one pair a little better known: another anchor is then the reference."""
    draw = np.random.default_rng(seed)
    anchors = np.array([(x, y, z) for x in (0, 6) for y in (0, 8) for z in (0.2, 2.6)]) + draw.normal(0, 0.1, (8, 3))
    p = draw.uniform([1, 1, 0.5], [5, 7, 2])
    ring = [(i, (i + 1) % 8) for i in range(8)]
    noisy = _tdoas(anchors, p, ring) + draw.normal(0, 0.05, 8)
    solutions, references = [], []
    for favoured in (best, (best + 3) % 8):
        variances = np.full(8, 0.05**2)
        variances[favoured] *= 1.0 - 1e-9
        result = against_reference(ring, noisy, variances)
        references.append(result.anchors[0])
        solutions.append(locate(anchors[list(result.anchors)], result.tdoa_m, result.covariance_m2, residual_tail=0))
    assert references[0] != references[1]
    assert all(isinstance(s, Solution) for s in solutions)
    np.testing.assert_allclose(solutions[0].position_m, solutions[1].position_m, atol=1e-6)
    np.testing.assert_allclose(solutions[0].covariance_m2, solutions[1].covariance_m2, rtol=1e-4)
    off = solutions[0].position_m - p
    assert off @ np.linalg.solve(solutions[0].covariance_m2, off) < 40  # chi2 with 3 dof: 1e-8
