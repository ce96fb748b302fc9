"""What fixes carry: rows of three numbers in one array, which costs less than an array for each."""

from typing import Final

POSITION: Final = 0
"""The position, then three rows of its covariance."""

QUALITY: Final = 4
"""Chi-square and mean squared residual in m²."""

VELOCITY: Final = 5
"""The velocity, then three rows of its covariance, for methods that know it."""

PROTECTION: Final = 9
"""The first three of the levels (``protect``), for methods that know some."""

PROTECTED_ROWS: Final = 10
