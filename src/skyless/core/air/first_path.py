"""Receptions whose first path is weak: they may be late, and count for less."""

import math
from typing import Final

CLEAR_DB: Final = 7.0
BLOCKED_DB: Final = 11.0
"""Up to the former nothing changes, from the latter on all that can: the maker's 6 and 10, and 1 dB. Lines of sight of
the UTIL data set have up to 8.4 dB, paths through metal, the only ones that are much later, from 11.3."""

MAX_VARIANCE_FACTOR: Final = 36.0
"""Factor on the variance of a blocked path: metal made messages 0.2 to 0.4 m late, 4 to 8 times what noise does."""


def variance_factor(rx_power_dbm: float | None, first_path_power_dbm: float | None) -> float:
    """Factor on the variance of a reception, from 1 to ``MAX_VARIANCE_FACTOR``; it grows with the powers' difference.

    Where a power is missing, not finite or impossible (a first path above the total) the factor is 1.
    """
    if rx_power_dbm is None or first_path_power_dbm is None:
        return 1.0
    difference_db = rx_power_dbm - first_path_power_dbm
    if not CLEAR_DB < difference_db < math.inf:
        return 1.0
    part = min((difference_db - CLEAR_DB) / (BLOCKED_DB - CLEAR_DB), 1.0)
    return float(MAX_VARIANCE_FACTOR ** (part * part * (3.0 - 2.0 * part)))


WEAK_FACTOR: Final = math.sqrt(MAX_VARIANCE_FACTOR)
"""From this factor on an anchor says that the first path of a reception that it relays was weak: 9 dB."""


def is_weak_first_path(rx_power_dbm: float | None, first_path_power_dbm: float | None) -> bool:
    """Whether a reception may be late, as its first path is weak; False where a power is missing or impossible."""
    return variance_factor(rx_power_dbm, first_path_power_dbm) >= WEAK_FACTOR
