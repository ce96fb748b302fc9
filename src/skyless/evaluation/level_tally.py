"""How protection levels did in a simulation, where the truth is known."""

from collections import Counter
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Array
from skyless.positioning.fix import Fix

MOST_KEPT: Final = 1 << 16
"""Levels from which the median is taken; every other one is forgotten when there are more."""


class LevelReport(Struct, frozen=True):
    """Over the fixes that were judged, of a method that gives levels."""

    integrity_risk: float
    available: float
    """Share of fixes that give a level."""
    misleading: int
    """Fixes whose horizontal or vertical error exceeds their level."""
    hpl_m: float | None
    """Median of the horizontal levels, None where there is none."""
    alerts: dict[str, int]
    """How many fixes carry which alert."""


class LevelTally:
    """Counts fixes by what they say of their integrity."""

    def __init__(self) -> None:
        self._alerts: Counter[str] = Counter()
        self._promised = self._misleading = 0
        self._risk: float | None = None
        self._levels_m: list[float] = []
        self._stride = 1

    def add(self, fix: Fix, error_m: Array) -> None:
        """Take a fix and its error, shape (3,)."""
        if fix.alert is None:
            return
        self._risk = fix.integrity_risk
        self._alerts[fix.alert.value] += 1
        if fix.hpl_m is None:
            return
        above = fix.vpl_m is not None and abs(error_m[2]) > fix.vpl_m
        self._misleading += bool(np.hypot(error_m[0], error_m[1]) > fix.hpl_m or above)
        if self._promised % self._stride == 0:
            self._levels_m.append(fix.hpl_m)
            if len(self._levels_m) > MOST_KEPT:
                self._levels_m = self._levels_m[::2]
                self._stride *= 2
        self._promised += 1

    def report(self) -> LevelReport | None:
        """None where no fix was judged, or the method gives no levels."""
        if self._risk is None:
            return None
        median_m = float(np.median(self._levels_m)) if self._levels_m else None
        share = self._promised / self._alerts.total()
        return LevelReport(self._risk, share, self._misleading, median_m, dict(sorted(self._alerts.items())))
