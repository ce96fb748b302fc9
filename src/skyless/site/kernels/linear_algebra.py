"""Cholesky factors of small matrices, in place and without allocation.

For the few unknowns of a position these beat LAPACK's call overhead, and they run in compiled loops.
"""

import math

from skyless.core.arrays import Array
from skyless.site.kernels.compiled import kernel

SINGULAR_PIVOT = 1e-12
"""A pivot below this part of its diagonal element is rounding noise: the matrix is singular."""


@kernel
def factorise(matrix: Array, size: int) -> bool:
    """Replace the leading ``size`` × ``size`` block by its lower factor L, with L·Lᵀ = matrix.

    Only the lower triangle is read and written. False where the matrix is not positive definite (or not
    finite); its contents are then undefined.
    """
    for j in range(size):
        diagonal = matrix[j, j]
        pivot = diagonal
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not (pivot > SINGULAR_PIVOT * diagonal and diagonal > 0.0):
            return False
        root = math.sqrt(pivot)
        matrix[j, j] = root
        for i in range(j + 1, size):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / root
    return True


@kernel
def solve(factor: Array, size: int, vector: Array) -> None:
    """Replace ``vector`` by (L·Lᵀ)⁻¹·vector."""
    for i in range(size):
        total = vector[i]
        for k in range(i):
            total -= factor[i, k] * vector[k]
        vector[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        total = vector[i]
        for k in range(i + 1, size):
            total -= factor[k, i] * vector[k]
        vector[i] = total / factor[i, i]


@kernel
def invert(factor: Array, size: int, inverse: Array) -> None:
    """Write (L·Lᵀ)⁻¹ into the leading block of ``inverse``."""
    for j in range(size):
        for i in range(size):
            inverse[j, i] = 1.0 if i == j else 0.0
        solve(factor, size, inverse[j])
