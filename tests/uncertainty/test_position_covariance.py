"""From TDoA noise to position noise: against dense matrices, the solver, its estimates, and the simulated lab."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.positioning.solver import Solution, locate
from skyless.uncertainty.dop import dilution_of_precision
from skyless.uncertainty.position import position_covariance, pseudorange_covariance
from skyless.uncertainty.tdoa import (
    bracketed_covariance,
    literal_covariance,
    literal_delayed_covariance,
    stamp_variance_m2,
)

LAB = np.array([(0, 0, 0), (6, 0, 0), (6, 4, 0), (6, 8, 0), (0, 8, 0), (0, 4, 0)], float)
LAB_3D = LAB + np.column_stack([np.zeros((6, 2)), [0.5, 2.5] * 3])
KAPPA = np.arange(1, 6) / 6.0
P1, P2 = (3.0, 4.0, 0.0), (1.2, 1.6, 0.0)
GEOMETRIES = [(LAB, 0.0), (LAB_3D, 1.0), (LAB_3D, None)]


def tdoas(anchors, p):
    ranges = np.linalg.norm(anchors - p, axis=1)
    return ranges[1:] - ranges[0]


def dense(anchors, p, covariance, dims, weighted):
    """(HᵀΣ⁻¹H)⁻¹ or G·Σ·Gᵀ as they are written."""
    towards = (p - anchors) / np.linalg.norm(p - anchors, axis=1)[:, None]
    H = (towards[1:] - towards[0])[:, :dims]
    if weighted:
        return np.linalg.inv(H.T @ np.linalg.solve(covariance, H))
    G = np.linalg.pinv(H)
    return G @ covariance @ G.T


@given(
    st.lists(st.floats(0.1, 20.0), min_size=7, max_size=7),
    st.floats(0.01, 10.0),
    st.tuples(*[st.floats(-9.0, 9.0)] * 2, st.floats(0.2, 2.2)),
    st.booleans(),
    st.booleans(),
)
def test_it_is_what_the_dense_matrices_say(own, common, place, height_known, weighted):
    corners = [(0, 0, 3), (12, 0, 0), (12, 11, 3), (0, 10, 0), (6, 5, 4), (5, -7, 1), (-8, 6, 2), (9, 3, 5)]
    anchors, p, dims = np.array(corners, float), np.array(place), 2 if height_known else 3
    covariance = np.diag(own) + common
    expected = dense(anchors, p, covariance, dims, weighted)
    found = position_covariance(anchors, [place], covariance, height_known=height_known, weighted=weighted)[0]
    np.testing.assert_allclose(found[:dims, :dims], expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
    assert (found[dims:] == 0.0).all()


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize(("anchors", "height"), GEOMETRIES)
def test_it_is_what_the_solver_says_of_its_solution(anchors, height, weighted):
    p = np.array([1.7, 2.9, 1.1 if height is None else height])
    covariance = literal_covariance(KAPPA, 1e-3, 2e-3)
    options = {"height_m": height, "weighted": weighted, "z_bounds_m": (0.0, 3.0)}
    solution = locate(anchors, tdoas(anchors, p), covariance, **options)
    assert isinstance(solution, Solution)
    found = position_covariance(anchors, [p], covariance, height_known=height is not None, weighted=weighted)[0]
    np.testing.assert_allclose(found, solution.covariance_m2, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize(("anchors", "height"), GEOMETRIES)
def test_it_is_the_scatter_of_the_solvers_estimates(anchors, height, weighted):
    """4000 draws of correlated noise: each normalised variance within 5·√(2/4000)."""
    count, dims = 4000, 3 if height is None else 2
    p = np.array([1.7, 2.9, 1.1 if height is None else height])
    covariance = literal_covariance(KAPPA, 0.01**2, 0.01**2)
    noise = np.random.default_rng(17).normal(size=(count, 5)) @ np.linalg.cholesky(covariance).T
    errors = []
    for e in noise:
        measured = tdoas(anchors, p) + e
        solution = locate(anchors, measured, covariance, height_m=height, weighted=weighted, z_bounds_m=(0.0, 3.0))
        assert isinstance(solution, Solution)
        errors.append((solution.position_m - p)[:dims])
    predicted = position_covariance(anchors, [p], covariance, height_known=dims == 2, weighted=weighted)[0]
    root = np.linalg.inv(np.linalg.cholesky(predicted[:dims, :dims]))
    whitened = np.array(errors) @ root.T
    np.testing.assert_allclose(whitened.T @ whitened / count, np.eye(dims), atol=5.0 * math.sqrt(2.0 / count))


@pytest.mark.parametrize(
    ("covariance", "weighted", "at_p1_cm", "at_p2_cm"),
    [
        (literal_covariance, False, 5.36, 5.46),
        (literal_delayed_covariance, False, 3.60, 3.63),
        (literal_covariance, True, 5.16, 5.29),
        (bracketed_covariance, True, 3.41, 3.59),
    ],
    ids=["literal", "literal-delayed", "weighted", "bracketed"],
)
def test_it_predicts_the_simulated_lab(covariance, weighted, at_p1_cm, at_p2_cm):
    """The column "said by the fixes" of docs/maths.md section 5: 100 ps, one fix per superframe."""
    tx, rx = (stamp_variance_m2(100e-12, rounded=rounded) for rounded in (False, True))
    predicted = position_covariance(LAB, [P1, P2], covariance(KAPPA, tx, rx), height_known=True, weighted=weighted)
    sigma_cm = 100.0 * np.sqrt(np.trace(predicted, axis1=1, axis2=2))
    np.testing.assert_allclose(sigma_cm, [at_p1_cm, at_p2_cm], atol=0.008)


@pytest.mark.parametrize("height_known", [True, False])
def test_equal_pseudoranges_give_the_dilution_of_precision(height_known):
    place = (2.0, 3.0, 1.0)
    covariance = pseudorange_covariance(LAB_3D, [place], np.full(6, 4.0), height_known=height_known)[0]
    dops = dilution_of_precision(LAB_3D, place, height_known=height_known)
    assert math.sqrt(np.trace(covariance)) == pytest.approx(2.0 * dops.pdop, rel=1e-9)


def test_pseudoranges_and_their_differences_know_the_same():
    """With the reference's variance as the common one."""
    variances = np.array([2.0, 1.0, 3.0, 1.5, 0.7, 2.2])
    places = [(2.0, 3.0, 1.0), (5.0, 7.0, 0.3)]
    differences = position_covariance(
        LAB_3D, places, np.diag(variances[1:]) + variances[0], height_known=False, weighted=True
    )
    np.testing.assert_allclose(
        pseudorange_covariance(LAB_3D, places, variances, height_known=False), differences, rtol=1e-9
    )


@pytest.mark.parametrize("weighted", [True, False])
def test_anchors_out_of_view_do_not_count(weighted):
    covariance = literal_covariance(KAPPA, 1e-3, 1e-3)
    view = np.array([[1, 1, 1, 0, 1, 0], [0, 1, 1, 1, 1, 1], [1, 1, 0, 0, 0, 0]], bool)
    options = {"height_known": True, "weighted": weighted}
    found = position_covariance(LAB, [P2] * 3, covariance, in_view=view, **options)
    kept = [0, 1, 3]
    without = position_covariance(LAB[[0, 1, 2, 4]], [P2], covariance[np.ix_(kept, kept)], **options)[0]
    np.testing.assert_allclose(found[0], without, rtol=1e-12)
    assert np.isinf(found[1]).all(), "no reference, no TDoA"
    assert np.isinf(found[2]).all(), "one TDoA is no position"


@pytest.mark.parametrize("weighted", [True, False])
def test_where_there_is_no_position_the_covariance_is_infinite(weighted):
    covariance = literal_covariance(KAPPA, 1e-3, 1e-3)
    places = [LAB[2], (math.nan, 1.0, 0.0), (3.0, 4.0, 0.0)]
    flat = position_covariance(LAB, places, covariance, height_known=False, weighted=weighted)
    assert np.isinf(flat).all(), "an anchor's own place, no place, and the height in the anchors' plane"


def test_shapes_that_do_not_fit_are_refused():
    covariance = literal_covariance(KAPPA, 1e-3, 1e-3)
    options = {"height_known": True, "weighted": True}
    with pytest.raises(ValueError, match=r"anchors \(5, 3\) and 5 TDoAs"):
        position_covariance(LAB[1:], [P1], covariance, **options)
    with pytest.raises(ValueError, match="in_view"):
        position_covariance(LAB, [P1], covariance, in_view=np.ones((2, 6), bool), **options)
    with pytest.raises(ValueError, match="common to all"):
        position_covariance(LAB, [P1], np.diag(np.ones(5)) + np.diag(np.full(4, 0.3), 1), **options)
