"""What fixes carry: rows of three numbers in one array, which costs less than an array for each."""

from typing import Final

from skyless.compiled import borrowing_kernel
from skyless.positioning.kalman import Matrix, Vector
from skyless.positioning.tracker import RESTLESS_CHI2

POSITION: Final = 0
"""The position, then three rows of its covariance."""

QUALITY: Final = 4
"""Chi-square and mean squared residual in m²."""

VELOCITY: Final = 5
"""The velocity, then three rows of its covariance, for methods that know it."""

PROTECTION: Final = 9
"""The first three of the levels (``protect``), for methods that know some."""

MOTION_ROWS: Final = 9

PROTECTED_ROWS: Final = 10


@borrowing_kernel
def fill_motion(rows: Matrix, x: Vector, P: Matrix, dim: int, chi2: float, squared_m2: float, height_m: float) -> None:
    """Write all but the protection, of a state that begins with position and velocity (2 axes each at a known height).

    ``chi2`` and ``squared_m2`` are the running means of the normalised and of the plain squared innovation. While
    ``chi2`` shows a tag more agile than the filter assumes, the covariances are scaled by its square: most of an
    innovation is the stamps' noise, so the state errs by more than the innovations tell (``docs/maths.md`` section 6).
    """
    scale = chi2 * chi2 if chi2 > RESTLESS_CHI2 else 1.0
    for one in range(dim):
        rows[POSITION, one] = x[one]
        rows[VELOCITY, one] = x[dim + one]
        for other in range(dim):
            rows[POSITION + 1 + one, other] = scale * P[one, other]
            rows[VELOCITY + 1 + one, other] = scale * P[dim + one, dim + other]
    if dim == 2:
        rows[POSITION, 2] = height_m
    rows[QUALITY, 0], rows[QUALITY, 1] = chi2, squared_m2
