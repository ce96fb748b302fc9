"""Arithmetic that is also translated to C, with the same bits on every processor: functions, small matrices, tails."""

from math import floor as _floor
from math import sqrt
from typing import Annotated, Final

from skyless.core.native.records import MAX_ANCHORS, Matrix, Reals, Record, record

__all__ = ["exp", "floor", "hypot", "log", "sqrt", "square"]

_LN_2_HIGH: Final = 0.6931471803691238
"""The leading bits of ln 2: products with small whole numbers are exact."""
_LN_2_LOW: Final = 1.9082149292705877e-10
_LOWEST: Final = -700.0
"""Exponentials of smaller numbers are 0."""
_LARGEST: Final = 9e18
"""All 64-bit integers are smaller."""


def floor(x: float) -> int:
    """The largest 64-bit integer not above x; 0 if there is none."""
    return _floor(x) if -_LARGEST < x < _LARGEST else 0


def exp(x: float) -> float:
    """The exponential of a number up to 0, to four units in the last place.

    x = k·ln 2 + r with |r| ≤ ½·ln 2, where the error of the diagonal Padé approximant of order 6 is below rounding.
    """
    if x < _LOWEST:
        return 0.0
    halvings = -floor(x / 0.6931471805599453 + 0.5)
    r = x + halvings * _LN_2_HIGH + halvings * _LN_2_LOW
    square = r * r
    even = 665280.0 + square * (75600.0 + square * (840.0 + square))
    odd = r * (332640.0 + square * (10080.0 + square * 42.0))
    result = (even + odd) / (even - odd)
    for _ in range(halvings):
        result *= 0.5
    return result


def log(x: float) -> float:
    """The natural logarithm of a positive number, to four units in the last place.

    x = m·2ᵏ with m between √½ and √2, and log m = 2·artanh((m − 1)/(m + 1)) by its series.
    """
    twos = 0
    while x > 1.4142135623730951:
        x *= 0.5
        twos += 1
    while x < 0.7071067811865476 and twos > -1100:
        x *= 2.0
        twos -= 1
    s = (x - 1.0) / (x + 1.0)
    square, total = s * s, 0.0
    for term in range(12, -1, -1):
        total = total * square + 1.0 / (2 * term + 1)
    return twos * 0.6931471805599453 + 2.0 * s * total


def hypot(x: float, y: float) -> float:
    """Length of a vector, without protection against overflow of the squares."""
    return sqrt(x * x + y * y)


def square(x: float) -> float:
    """x²."""
    return x * x


# Symmetric matrices by Cholesky's method, and least squares of few unknowns by rotations of columns.
#
# A symmetric matrix is kept as its lower triangle, row by row: element (i, j) with j ≤ i is number i·(i + 1)/2 + j.

SINGULAR_PIVOT: Final = 1e-12
"""A pivot below this fraction of its diagonal element is rounding noise: the matrix is singular."""
DEPENDENT: Final = 1e-6
"""Columns are dependent if their smallest singular value is below this fraction of the largest."""
ORTHOGONAL: Final = 1e-14
"""Columns are orthogonal if the cosine of their angle does not exceed this."""
MAX_SWEEPS: Final = 12
"""Most sweeps over all pairs of columns; they converge quadratically, four columns in about six."""
MAX_ROWS: Final = MAX_ANCHORS
MAX_COLUMNS: Final = 4


# Cholesky's method


def factorise(A: Reals, size: int) -> bool:
    """Replace A by its lower Cholesky factor L, L·Lᵀ = A.

    Returns False, with undefined elements, if A is not positive definite, singular or not finite.
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
    """Make two columns orthogonal and order them by the smallest rotation. Returns False if they are so already."""
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
    """Find the x that minimises |A·x − right|, after ``orthogonalise``. Returns False if A does not determine it."""
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


# Tails of the normal and the chi2 distribution.

SQRT_2_PI: Final = 2.5066282746310002
FAR_TAIL: Final = 3.0
"""From here on the normal tail's continued fraction converges faster than its series."""
TERMS: Final = 60
NEWTON_STEPS: Final = 10
"""The logarithm is concave and the first z too large, so each step doubles the number of correct digits."""


def normal_tail(z: float) -> float:
    """Probability that a standard normal variable exceeds z, to 10⁻¹² of itself.

    With its density φ it is ½ − φ(z)·Σ z²ⁿ⁺¹/(1·3·…·(2n + 1)), or φ(z)/(z + 1/(z + 2/(z + …))) after Laplace.
    """
    size = abs(z)
    density = exp(-0.5 * size * size) / SQRT_2_PI
    if size < FAR_TAIL:
        term, total = size, size
        for n in range(1, TERMS):
            term *= size * size / (2 * n + 1)
            total += term
        tail = 0.5 - density * total
    else:
        tail = density / _continued_fraction(size, 1)
    return tail if z >= 0.0 else 1.0 - tail


def normal_quantile(tail: float) -> float:
    """The value that a standard normal variable exceeds with this probability below ½, by Newton's method."""
    z = sqrt(-2.0 * log(tail))
    for _ in range(NEWTON_STEPS):
        found = normal_tail(z)
        z += (log(found) - log(tail)) * found * SQRT_2_PI / exp(-0.5 * z * z)
    return z


def _continued_fraction(z: float, first: int) -> float:
    """The value of z + n/(z + (n + 1)/(z + …)) for the first n."""
    fraction = z
    for n in range(TERMS, first - 1, -1):
        fraction = z + n / fraction
    return fraction


def chi2_tail(dof: int, chi2: float) -> float:
    """Probability that chi2 with at least one degree of freedom exceeds a value, by the finite sum."""
    half = 0.5 * chi2
    if not half < 700.0:
        return 0.0
    is_odd = dof % 2 == 1
    term = 2.0 * sqrt(chi2) / SQRT_2_PI if is_odd else 1.0
    total = 0.0
    for k in range(dof // 2):
        total += term
        term *= half / (k + (1.5 if is_odd else 1.0))
    return (2.0 * normal_tail(sqrt(chi2)) if is_odd else 0.0) + exp(-half) * total


def mean_if_positive(mean: float, sigma: float) -> float:
    """Mean of a normal variable given that it is positive: E[w²] if w² was measured and may be near 0."""
    z = mean / sigma
    if z < -FAR_TAIL:  # where the mean and what is added to it would cancel
        return sigma / _continued_fraction(-z, 2)
    return mean + sigma * exp(-0.5 * z * z) / (SQRT_2_PI * normal_tail(-z))
