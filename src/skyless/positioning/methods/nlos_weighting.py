"""How much less a reception is to be trusted whose first path is weak beside all that arrived (``docs/maths.md`` 6).

A DW1000 tells the power of the first path and of the whole frame. Its maker's rule of thumb (DW1000 User Manual 4.7;
APS006 part 3): a difference below 6 dB is likely a line of sight, one above 10 dB likely none. The powers are those of
the manual's formulas. Drivers that bend them afterwards to the level that truly arrived (libdw1000 above −88 dBm)
stretch differences 2.17 times at a PRF of 64 MHz and 3.33 times at 16.
"""

import math
from typing import Final

CLEAR_DB: Final = 7.0
BLOCKED_DB: Final = 11.0
"""Up to the former nothing changes, from the latter on all that can: the maker's 6 and 10, and 1 dB. Lines of sight of
the UTIL data set have up to 8.4 dB, paths through metal, the only ones that are much later, from 11.3."""

MOST: Final = 36.0
"""Factor on the variance of a blocked path: metal made messages 0.2 to 0.4 m late, 4 to 8 times what noise does."""


def variance_factor(rx_power_dbm: float | None, first_path_power_dbm: float | None) -> float:
    """Factor on the variance of a reception, from 1 to ``MOST``; it never falls as the difference of the powers grows.

    What is not told, not finite or impossible (a first path above the total) says nothing: the factor is then 1.
    """
    if rx_power_dbm is None or first_path_power_dbm is None:
        return 1.0
    difference_db = rx_power_dbm - first_path_power_dbm
    if not CLEAR_DB < difference_db < math.inf:
        return 1.0
    part = min((difference_db - CLEAR_DB) / (BLOCKED_DB - CLEAR_DB), 1.0)
    return float(MOST ** (part * part * (3.0 - 2.0 * part)))
