"""The ellipse of a position's covariance on the floor. Plain arithmetic, for programs that must start quickly."""

from collections.abc import Sequence
from math import atan2, hypot, sqrt


def horizontal_ellipse(covariance_m2: Sequence[float]) -> tuple[float, float, float]:
    """Semi-axes of one standard deviation in m, the longer first, and the longer one's direction from x to y in rad.

    ``covariance_m2`` is 3 × 3, row by row.
    """
    xx, xy, yy = covariance_m2[0], covariance_m2[1], covariance_m2[4]
    middle, half = (xx + yy) / 2.0, hypot((xx - yy) / 2.0, xy)
    return sqrt(max(middle + half, 0.0)), sqrt(max(middle - half, 0.0)), atan2(2.0 * xy, xx - yy) / 2.0
