"""Symmetric matrices by Cholesky's method, and least squares of few unknowns by rotations of columns.

A symmetric matrix is kept as its lower triangle, row by row: element (i, j) with j ≤ i is number i·(i + 1)/2 + j.
"""

from typing import Annotated, Final

from skyless.core.native.arithmetic import sqrt
from skyless.core.native.records import Matrix, Reals, Record, record
from skyless.core.native.sizes import MAX_ANCHORS

SINGULAR_PIVOT: Final = 1e-12
"""A pivot below this part of its diagonal element is rounding noise: the matrix is singular."""
DEPENDENT: Final = 1e-6
"""Columns are not independent if their smallest singular value is below this part of the largest."""
ORTHOGONAL: Final = 1e-14
"""Columns are orthogonal if the cosine of their angle is not larger."""
MAX_SWEEPS: Final = 12
"""Rotations of all pairs of columns; they converge quadratically, with four columns after about six."""
MAX_ROWS: Final = MAX_ANCHORS
MAX_COLUMNS: Final = 4


# Cholesky's method


def factorise(A: Reals, size: int) -> bool:
    """Replace A by its lower factor L, with L·Lᵀ = A.

    False where A is not positive definite, or singular, or not finite; its elements are then undefined.
    """
    for i in range(size):
        row = i * (i + 1) // 2
        diagonal = A[row + i]
        for j in range(i + 1):
            other = j * (j + 1) // 2
            total = A[row + j]
            for k in range(j):
                total -= A[row + k] * A[other + k]
            if j < i:
                A[row + j] = total / A[other + j]
            elif total > SINGULAR_PIVOT * diagonal and diagonal > 0.0:
                A[row + j] = sqrt(total)
            else:
                return False
    return True


def solve_lower(L: Reals, size: int, x: Reals) -> None:
    """Replace x by L⁻¹·x."""
    for i in range(size):
        row = i * (i + 1) // 2
        total = x[i]
        for k in range(i):
            total -= L[row + k] * x[k]
        x[i] = total / L[row + i]


def solve(L: Reals, size: int, x: Reals) -> None:
    """Replace x by (L·Lᵀ)⁻¹·x."""
    solve_lower(L, size, x)
    for i in range(size - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, size):
            total -= L[k * (k + 1) // 2 + i] * x[k]
        x[i] = total / L[i * (i + 1) // 2 + i]


# Rotations of columns


@record
class Columns(Record):
    """A matrix A of few columns; ``orthogonalise`` replaces it by A·V, whose columns are orthogonal."""

    rows: int
    columns: int
    A: Annotated[Matrix, MAX_ROWS, MAX_COLUMNS]
    V: Annotated[Matrix, MAX_COLUMNS, MAX_COLUMNS]
    """A rotation; its columns are the right singular vectors of A."""
    squares: Annotated[Reals, MAX_COLUMNS]
    """Squares of the singular values, the largest first."""


def orthogonalise(m: Columns) -> None:
    """Rotate pairs of columns, the longer one to the front, until all are orthogonal (M. R. Hestenes 1958)."""
    for i in range(m.columns):
        for j in range(m.columns):
            m.V[i][j] = 1.0 if i == j else 0.0
    for _ in range(MAX_SWEEPS):
        is_done = True
        for one in range(m.columns - 1):
            for other in range(one + 1, m.columns):
                if _has_rotated(m, one, other):
                    is_done = False
        if is_done:
            break
    for j in range(m.columns):
        m.squares[j] = _scalar_product(m, j, j)


def _has_rotated(m: Columns, one: int, other: int) -> bool:
    """Make two columns orthogonal and order them, by the smallest rotation; False where they are so already."""
    square, square_other, product = (
        _scalar_product(m, one, one),
        _scalar_product(m, other, other),
        _scalar_product(m, one, other),
    )
    is_orthogonal = not abs(product) > ORTHOGONAL * sqrt(square * square_other)
    if is_orthogonal and square >= square_other:
        return False
    tangent = 0.0
    if not is_orthogonal:
        cotangent = (square_other - square) / (2.0 * product)  # of twice the angle
        tangent = 1.0 / (abs(cotangent) + sqrt(1.0 + cotangent * cotangent))
        if cotangent < 0.0:
            tangent = -tangent
    cosine = 1.0 / sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    if square < square_other:
        cosine, sine = -sine, cosine
    _rotate_columns(m.A, m.rows, one, other, cosine, sine)
    _rotate_columns(m.V, m.columns, one, other, cosine, sine)
    return True


def _scalar_product(m: Columns, one: int, other: int) -> float:
    """The scalar product of two columns."""
    total = 0.0
    for i in range(m.rows):
        row = m.A[i]
        total += row[one] * row[other]
    return total


def _rotate_columns(
    A: Annotated[Matrix, MAX_ROWS, MAX_COLUMNS], rows: int, one: int, other: int, cosine: float, sine: float
) -> None:
    for i in range(rows):
        row = A[i]
        first, second = row[one], row[other]
        row[one] = cosine * first - sine * second
        row[other] = sine * first + cosine * second


def least_squares(m: Columns, right: Reals, x: Reals) -> bool:
    """Find the x that minimises |A·x − right|, after ``orthogonalise``; False where A does not determine it."""
    if not m.squares[m.columns - 1] > DEPENDENT * DEPENDENT * m.squares[0]:
        return False
    for k in range(m.columns):
        x[k] = 0.0
    for j in range(m.columns):
        total = 0.0
        for i in range(m.rows):
            total += m.A[i][j] * right[i]
        total /= m.squares[j]
        for k in range(m.columns):
            x[k] += m.V[k][j] * total
    return True
