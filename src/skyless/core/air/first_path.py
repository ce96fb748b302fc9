"""Receptions whose first path is weak: they may be late, and count for less."""

import math
from typing import Final

from skyless.core.air.reception import Diagnostics
from skyless.core.native.arithmetic import exp

CLEAR_DB: Final = 7.0
BLOCKED_DB: Final = 11.0
"""Up to the former nothing changes, from the latter on all that can: the maker's 6 and 10, and 1 dB. Lines of sight of
the UTIL data set have up to 8.4 dB, paths through metal, the only ones that are much later, from 11.3."""

MAX_VARIANCE_FACTOR: Final = 36.0
"""Factor on the variance of a blocked path: metal made messages 0.2 to 0.4 m late, 4 to 8 times what noise does."""


_LOG_FACTOR: Final = math.log(MAX_VARIANCE_FACTOR)
_MAX_DIFFERENCE_DB: Final = 1000.0
"""Larger ones are no powers."""


def variance_factor(rx_power_dbm: float, first_path_power_dbm: float) -> float:
    """Factor on the variance of a reception, from 1 to ``MAX_VARIANCE_FACTOR``; it grows with the powers' difference.

    Where a power is missing (NaN), not finite or impossible (a first path above the total) the factor is 1.
    """
    difference_db = rx_power_dbm - first_path_power_dbm
    if not CLEAR_DB < difference_db <= _MAX_DIFFERENCE_DB:
        return 1.0
    part = min((difference_db - CLEAR_DB) / (BLOCKED_DB - CLEAR_DB), 1.0)
    return MAX_VARIANCE_FACTOR * exp((part * part * (3.0 - 2.0 * part) - 1.0) * _LOG_FACTOR)


def variance_factor_of(diagnostics: Diagnostics | None) -> float:
    """The same from what a radio measured of a frame."""
    return variance_factor(*powers_dbm(diagnostics))


def powers_dbm(diagnostics: Diagnostics | None) -> tuple[float, float]:
    """Received power and that of the first path, NaN where the radio does not report it."""
    if diagnostics is None:
        return math.nan, math.nan
    rx_dbm, first_path_dbm = diagnostics.rx_power_dbm, diagnostics.first_path_power_dbm
    return (math.nan if rx_dbm is None else rx_dbm), (math.nan if first_path_dbm is None else first_path_dbm)


WEAK_FACTOR: Final = math.sqrt(MAX_VARIANCE_FACTOR)
"""From this factor on an anchor says that the first path of a reception that it relays was weak: 9 dB."""


def is_weak_first_path(diagnostics: Diagnostics | None) -> bool:
    """Whether a reception may be late, as its first path is weak; False where a power is missing or impossible."""
    return variance_factor_of(diagnostics) >= WEAK_FACTOR
