"""The solver on noisy data: against SciPy, dense matrices and its own covariance, and how often it ends well."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from skyless.core.clock_filter import stamp_variances_m2
from skyless.core.fix import NoFixReason
from skyless.core.protocol1.snapshots import bracketed_covariance, literal_covariance, literal_delayed_covariance
from skyless.core.tag.position import NoSolution, Solution, locate
from support.dense_covariance import position_covariance

pytestmark = pytest.mark.site

LAB = np.array([(0, 0, 0), (6, 0, 0), (6, 4, 0), (6, 8, 0), (0, 8, 0), (0, 4, 0)], float)
LAB_3D = LAB + np.column_stack([np.zeros((6, 2)), [0.5, 2.5] * 3])
"""Alternating heights, as docs/maths.md section 5 advises."""
P1, P2 = np.array([3.0, 4.0, 0.0]), np.array([1.2, 1.6, 0.0])
LITERAL = (np.diag([5.0, 9, 13, 17, 21]) + 1) / 15
"""Shape of the paper's covariance: own variances that grow with the slot, and the tag's reference in common."""
KAPPA = np.arange(1, 6) / 6.0


def tdoas(anchors, p):
    ranges = np.linalg.norm(anchors - p, axis=1)
    return ranges[1:] - ranges[0]


def draws(seed, anchors, p, covariance, count):
    noise = np.random.default_rng(seed).normal(size=(count, len(anchors) - 1)) @ np.linalg.cholesky(covariance).T
    return tdoas(anchors, p) + noise


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize(("anchors", "height"), [(LAB, 0.0), (LAB_3D, None), (LAB_3D, 1.0)])
def test_the_minimum_is_the_one_that_scipy_finds(anchors, height, weighted):
    covariance = 0.1**2 * LITERAL
    p = np.array([2.2, 3.1, 1.0 if height is None else height])
    whiten = np.linalg.inv(np.linalg.cholesky(covariance)) if weighted else np.eye(5)
    dims = 3 if height is None else 2
    for measured in draws(11, anchors, p, covariance, 60):
        solution = locate(anchors, measured, covariance, height_m=height, weighted=weighted, z_bounds_m=(0, 3))
        assert isinstance(solution, Solution), solution
        here = [solution.position_m]
        dense = position_covariance(anchors, here, covariance, height_known=height is not None, weighted=weighted)[0]
        np.testing.assert_allclose(solution.covariance_m2, dense, rtol=1e-7, atol=1e-12)

        def residuals(x, measured=measured):
            return whiten @ (measured - tdoas(anchors, np.append(x, p[dims:])))

        peer = least_squares(residuals, p[:dims], xtol=1e-14, ftol=1e-14, gtol=1e-14)
        np.testing.assert_allclose(solution.position_m[:dims], peer.x, atol=2e-6)
        np.testing.assert_allclose(solution.residuals_m, measured - tdoas(anchors, solution.position_m), atol=1e-9)
        at_minimum = np.linalg.solve(np.linalg.cholesky(covariance), solution.residuals_m)
        assert solution.chi2 == pytest.approx(at_minimum @ at_minimum, rel=1e-9)
        if weighted:
            normal = peer.jac.T @ peer.jac
            np.testing.assert_allclose(
                solution.covariance_m2[:dims, :dims], np.linalg.inv(normal), rtol=1e-4, atol=1e-9
            )


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize(
    ("anchors", "p", "height", "std"),
    [
        (LAB, P1, 0.0, 0.02),
        (LAB, P2, 0.0, 0.02),
        (LAB_3D, np.array([2.0, 3.0, 1.2]), None, 0.01),
        (LAB_3D, np.array([1.7, 2.9, 1.0]), 1.0, 0.01),
        (LAB, np.array([2.0, 3.0, 1.5]), None, 0.01),  # one plane: the unfolded covariance
    ],
)
@pytest.mark.statistical
def test_the_covariance_is_that_of_the_estimates(anchors, p, height, std, weighted):
    """4000 draws: N·S of a normal sample is Wishart, so each variance has a relative error of √(2/N) = 2.2 %."""
    count, covariance = 4000, std**2 * LITERAL
    z_bounds = (0.0, 3.0)
    solutions = [
        locate(anchors, measured, covariance, height_m=height, weighted=weighted, z_bounds_m=z_bounds)
        for measured in draws(7, anchors, p, covariance, count)
    ]
    assert all(isinstance(s, Solution) for s in solutions)
    dims = 3 if height is None else 2
    errors = np.array([s.position_m - p for s in solutions])[:, :dims]
    at_truth = locate(anchors, tdoas(anchors, p), covariance, height_m=height, weighted=weighted, z_bounds_m=z_bounds)
    root = np.linalg.inv(np.linalg.cholesky(at_truth.covariance_m2[:dims, :dims]))
    whitened = errors @ root.T
    scatter = whitened.T @ whitened / count
    np.testing.assert_allclose(np.diag(scatter), 1.0, atol=5 * math.sqrt(2 / count))
    np.testing.assert_allclose(scatter - np.diag(np.diag(scatter)), 0.0, atol=5 / math.sqrt(count))
    np.testing.assert_allclose(
        np.mean([s.covariance_m2[:dims, :dims] for s in solutions], axis=0),
        at_truth.covariance_m2[:dims, :dims],
        rtol=0.05,
        atol=0.02 * at_truth.covariance_m2.max(),
    )
    dof = len(anchors) - 1 - dims
    chi2s = np.array([s.chi2 for s in solutions])
    assert {s.dof for s in solutions} == {dof}
    if weighted:
        assert chi2s.mean() == pytest.approx(dof, abs=5 * math.sqrt(2 * dof / count))
    else:
        assert chi2s.mean() > dof  # only the weighted estimate minimises it


@pytest.mark.parametrize("std", [0.1, 0.5])
@pytest.mark.statistical
def test_it_always_converges_in_the_lab(std):
    """Tags anywhere in the lab. With 0.5 m of noise the two sides of a wall of anchors can fit equally well."""
    covariance = std**2 * (np.eye(5) + 1)
    draw = np.random.default_rng(21)
    inside = covered = mirrors = 0
    count = 2500
    for _ in range(count):
        p = np.append(draw.uniform([0.3, 0.3], [5.7, 7.7]), 0.0)
        measured = tdoas(LAB, p) + np.linalg.cholesky(covariance) @ draw.normal(size=5)
        solution = locate(LAB, measured, covariance, height_m=0)
        if isinstance(solution, NoSolution):
            assert solution.reason is NoFixReason.MIRROR, solution
            mirrors += 1
            continue
        inside += 1
        off = (solution.position_m - p)[:2]
        covered += off @ np.linalg.solve(solution.covariance_m2[:2, :2], off) < chi2.isf(0.01, 2)
    assert mirrors == 0 if std < 0.2 else mirrors < 0.02 * count
    # Half a metre bends the hyperbolas within one sigma; the ellipse still holds what it promises, nearly.
    assert covered > (0.98 if std < 0.2 else 0.96) * inside


@pytest.mark.parametrize("across", [0.0, 0.05, 0.2, 0.5, 1.0, 2.0])
@pytest.mark.statistical
def test_near_the_anchors_plane_the_reported_height_error_is_honest(across):
    """Merged or apart, the height is known about as well as claimed: its mean normalised square is 1, or less.

    What is measured is the height's square s, with a sigma of 0.85 m² here: merged is s < 1.7 m².
    """
    covariance = 0.03**2 * (np.eye(5) + 1)
    p = np.array([1.7, 2.6, across])
    solutions = [locate(LAB, m, covariance, z_bounds_m=(-1e-9, 3)) for m in draws(31, LAB, p, covariance, 2000)]
    assert all(isinstance(s, Solution) for s in solutions)
    merged = [s for s in solutions if s.mirror_m is None]
    assert all(abs(s.position_m[2]) < 1e-12 for s in merged)
    assert len(merged) > 1800 if across < 0.7 else len(merged) < 800
    assert len(merged) == 0 if across == 2.0 else merged
    normalised = [(s.position_m[2] - across) ** 2 / s.covariance_m2[2, 2] for s in solutions]
    assert 0.3 < np.mean(normalised) < 1.3
    if across == 2.0:
        assert np.mean(normalised) == pytest.approx(1.0, abs=0.2)


@pytest.mark.statistical
def test_chi2_rejects_about_as_often_as_it_says():
    count, tail, covariance = 4000, 0.05, 0.05**2 * (np.eye(5) + 1)
    rejected = [
        isinstance(locate(LAB, measured, covariance, height_m=0, residual_tail=tail), NoSolution)
        for measured in draws(41, LAB, P1, covariance, count)
    ]
    assert np.mean(rejected) == pytest.approx(tail, abs=5 * math.sqrt(tail * (1 - tail) / count))


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
def test_the_covariance_predicts_the_simulated_lab(covariance, weighted, at_p1_cm, at_p2_cm):
    """The column "predicted σ" of docs/maths.md section 5: 100 ps, one fix per superframe."""
    tx, rx = stamp_variances_m2(100e-12, 100e-12)
    predicted = position_covariance(LAB, [P1, P2], covariance(KAPPA, tx, rx), height_known=True, weighted=weighted)
    sigma_cm = 100.0 * np.sqrt(np.trace(predicted, axis1=1, axis2=2))
    np.testing.assert_allclose(sigma_cm, [at_p1_cm, at_p2_cm], atol=0.008)
