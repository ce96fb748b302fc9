"""What a filter knows of the tag's motion, as fixes carry it."""

from typing import Final

from skyless.compiled import borrowing_kernel
from skyless.positioning.kalman import Matrix, Vector
from skyless.positioning.tracker import RESTLESS_CHI2

MOTION_ROWS: Final = 8
"""Position, velocity, then the covariance of either: rows of one array, which costs less than four."""


@borrowing_kernel
def fill_motion(rows: Matrix, x: Vector, P: Matrix, dim: int, chi2: float, height_m: float) -> None:
    """Write them, shape (8, 3), of a state that begins with position and velocity (2 axes each at a known height).

    ``chi2`` is the running mean of the normalised squared innovation. While it shows a tag more agile than the filter
    assumes, the covariances are scaled by its square: most of an innovation is the stamps' noise, so the state errs by
    more than the innovations tell (``docs/maths.md`` section 6).
    """
    scale = chi2 * chi2 if chi2 > RESTLESS_CHI2 else 1.0
    for one in range(dim):
        rows[0, one] = x[one]
        rows[1, one] = x[dim + one]
        for other in range(dim):
            rows[2 + one, other] = scale * P[one, other]
            rows[5 + one, other] = scale * P[dim + one, dim + other]
    if dim == 2:
        rows[0, 2] = height_m
