"""Cholesky's method and rotations of columns against NumPy; tails of distributions against SciPy."""

import ctypes
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import chdtrc, erfcx, ndtr, ndtri

from skyless.core.native import arithmetic
from skyless.core.native.arithmetic import DEPENDENT, FAR_TAIL, chi2_tail, factorise, least_squares, normal_tail
from skyless.core.native.views import view

SEEDS = st.integers(0, 2**32 - 1)


def reals(values):
    return (ctypes.c_double * len(values))(*values)


def triangle(matrix):
    return reals(matrix[np.tril_indices(len(matrix))])


def drawn_columns(seed, rows, columns, dependence):
    """A matrix whose singular values span some powers of ten, and whose columns differ in size."""
    draw = np.random.default_rng(seed)
    U, V = (np.linalg.qr(draw.normal(size=(size, size)))[0] for size in (rows, columns))
    values = 10.0 ** draw.uniform(-dependence, 0, columns)
    return 10.0 ** draw.uniform(-3, 3) * U[:, :columns] * values @ V


def columns_of(A):
    m = arithmetic.Columns(rows=len(A), columns=A.shape[1])
    view(m.A)[: m.rows, : m.columns] = A
    arithmetic.orthogonalise(m)
    return m


@given(seed=SEEDS, size=st.integers(1, 31), spread=st.floats(0.0, 4.0))
def test_factors_and_solutions(seed, size, spread):
    draw = np.random.default_rng(seed)
    root = draw.normal(size=(size, size + 3)) * 10.0 ** draw.uniform(-spread, spread, (size, 1))
    A, b = root @ root.T, draw.normal(size=size)
    L = triangle(A)
    assert factorise(L, size)
    expected = np.linalg.cholesky(A)
    scale = np.sqrt(A.diagonal())[:, None]
    lower = np.tril_indices(size)
    np.testing.assert_allclose(np.array(L) / scale.repeat(size, 1)[lower], (expected / scale)[lower], atol=1e-12)
    for name, solution in (("solve", np.linalg.solve(A, b)), ("solve_lower", np.linalg.solve(expected, b))):
        x = reals(b)
        getattr(arithmetic, name)(L, size, x)
        np.testing.assert_allclose(x, solution, rtol=1e-6, atol=1e-9 * np.abs(solution).max())


@pytest.mark.parametrize(
    "matrix",
    [np.ones((3, 3)), np.diag([1.0, 0.0]), np.diag([1.0, -1.0]), np.diag([1.0, np.nan]), np.diag([np.inf, 1.0])],
)
def test_what_is_not_positive_definite_has_no_factor(matrix):
    assert not factorise(triangle(matrix), len(matrix))


@given(seed=SEEDS, rows=st.integers(1, 32), columns=st.integers(1, 4), dependence=st.floats(0.0, 12.0))
def test_singular_values_and_vectors(seed, rows, columns, dependence):
    columns = min(rows, columns)
    A = drawn_columns(seed, rows, columns, dependence)
    m = columns_of(A)
    values, V = np.linalg.svd(A)[1], view(m.V)[:columns, :columns]
    np.testing.assert_allclose(np.sqrt(view(m.squares)[:columns]), values, atol=1e-13 * values[0])
    np.testing.assert_allclose(V.T @ V, np.eye(columns), atol=1e-13)
    np.testing.assert_allclose(view(m.A)[:rows, :columns], A @ V, atol=1e-13 * values[0])
    product = A @ V
    np.testing.assert_allclose(product.T @ product, np.diag(values**2), atol=1e-13 * values[0] ** 2)


@given(seed=SEEDS, rows=st.integers(1, 32), columns=st.integers(1, 4), dependence=st.floats(0.0, 9.0))
def test_least_squares(seed, rows, columns, dependence):
    columns = min(rows, columns)
    A, b = drawn_columns(seed, rows, columns, dependence), np.random.default_rng(seed).normal(size=rows)
    x = reals(np.zeros(4))
    expected, _, rank, values = np.linalg.lstsq(A, b, rcond=DEPENDENT)
    condition = values[0] / values[-1]
    if abs(condition * DEPENDENT - 1.0) < 1e-6:
        return
    assert least_squares(columns_of(A), reals(b), x) == (rank == columns)
    if rank == columns:
        np.testing.assert_allclose(x[:columns], expected, atol=1e-13 * condition * np.linalg.norm(b) / values[-1])


@pytest.mark.parametrize("A", [np.zeros((3, 2)), np.ones((4, 3)), [[1.0, 2.0]], [[0.0, 1.0], [0.0, 1.0], [0.0, 3.0]]])
def test_dependent_columns_have_no_solution(A):
    assert not least_squares(columns_of(np.array(A)), reals(np.ones(4)), reals(np.zeros(4)))


@given(z=st.floats(-9.0, 37.0), tail=st.floats(1e-300, 0.4999), dof=st.integers(1, 100), chi2=st.floats(0.0, 1399.0))
def test_tails_and_quantiles_are_those_of_scipy(z, tail, dof, chi2):
    assert normal_tail(z) == pytest.approx(ndtr(-z), rel=1e-12)
    assert arithmetic.normal_quantile(tail) == pytest.approx(-ndtri(tail), rel=1e-12, abs=1e-12)
    assert chi2_tail(dof, chi2) == pytest.approx(chdtrc(dof, chi2), rel=1e-11, abs=1e-250)


@given(mean=st.floats(-60.0, 60.0), sigma=st.floats(1e-3, 1e3))
def test_the_mean_of_what_is_positive(mean, sigma):
    expected = mean + math.sqrt(2.0 / math.pi) / erfcx(-mean / math.sqrt(2.0))
    assert arithmetic.mean_if_positive(mean * sigma, sigma) == pytest.approx(sigma * expected, rel=1e-11)


def test_far_tails_are_none_and_series_and_fraction_meet():
    assert [chi2_tail(3, chi2) for chi2 in (1400.0, 1e300, np.inf)] == [0.0] * 3
    for mean in (-FAR_TAIL, FAR_TAIL):
        assert normal_tail(mean) == pytest.approx(normal_tail(mean * (1.0 - 1e-14)), rel=1e-12)
