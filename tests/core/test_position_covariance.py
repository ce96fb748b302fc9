"""From TDoA noise to position noise: the solver against dense matrices, its estimates, and the simulated lab."""

import math

import numpy as np
import pytest

from skyless.core.clock_filter import stamp_variances_m2
from skyless.core.protocol1.snapshots import bracketed_covariance, literal_covariance, literal_delayed_covariance
from skyless.core.tag.position import Solution, locate
from support.dense_covariance import position_covariance

LAB = np.array([(0, 0, 0), (6, 0, 0), (6, 4, 0), (6, 8, 0), (0, 8, 0), (0, 4, 0)], float)
LAB_3D = LAB + np.column_stack([np.zeros((6, 2)), [0.5, 2.5] * 3])
KAPPA = np.arange(1, 6) / 6.0
P1, P2 = (3.0, 4.0, 0.0), (1.2, 1.6, 0.0)
GEOMETRIES = [(LAB, 0.0), (LAB_3D, 1.0), (LAB_3D, None)]


def tdoas(anchors, p):
    ranges = np.linalg.norm(anchors - p, axis=1)
    return ranges[1:] - ranges[0]


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
@pytest.mark.statistical
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
    """The column "predicted σ" of docs/maths.md section 5: 100 ps, one fix per superframe."""
    tx, rx = stamp_variances_m2(100e-12, 100e-12)
    predicted = position_covariance(LAB, [P1, P2], covariance(KAPPA, tx, rx), height_known=True, weighted=weighted)
    sigma_cm = 100.0 * np.sqrt(np.trace(predicted, axis1=1, axis2=2))
    np.testing.assert_allclose(sigma_cm, [at_p1_cm, at_p2_cm], atol=0.008)
