"""Cholesky's method and rotations of columns against NumPy."""

import ctypes

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.native.arithmetic import (
    DEPENDENT,
    Columns,
    factorise,
    least_squares,
    orthogonalise,
    solve,
    solve_lower,
)
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
    m = Columns(rows=len(A), columns=A.shape[1])
    view(m.A)[: m.rows, : m.columns] = A
    orthogonalise(m)
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
    np.testing.assert_allclose(np.array(L) / scale.repeat(size, 1)[np.tril_indices(size)],
                               (expected / scale)[np.tril_indices(size)], atol=1e-12)  # fmt: skip
    for function, solution in ((solve, np.linalg.solve(A, b)), (solve_lower, np.linalg.solve(expected, b))):
        x = reals(b)
        function(L, size, x)
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
