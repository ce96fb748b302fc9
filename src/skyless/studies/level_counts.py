"""How protection levels did at each tag of a world."""

from typing import Final

import numpy as np
from msgspec import Struct

from skyless.evaluation.statistics import EvenSample
from skyless.kernels.arrays import Array
from skyless.positioning.fix import Fix
from skyless.positioning.integrity import Alert

SAMPLE_ROWS: Final = 1 << 13


class LevelCounts(Struct, frozen=True):
    """Of each tag's judged fixes, shape (tags,)."""

    fixes: Array
    levels: Array
    """Those with a horizontal protection level."""
    exceeded: Array
    """Those whose horizontal error is larger than it."""
    unwarned: Array
    """Those of them that carry no alert."""
    hpl_m: Array
    """Levels, an even sample of them."""


class LevelCounter:
    """Counts a world's fixes by what they promise and whether it held."""

    def __init__(self, tags: int) -> None:
        self._counts = np.zeros((4, tags))
        self._sample = EvenSample(1, SAMPLE_ROWS)
        self._told = False

    def add(self, tag: int, fix: Fix, across_m: float) -> None:
        """Take a fix and its horizontal error."""
        self._told |= fix.requirement is not None
        self._counts[0, tag] += 1
        hpl_m = fix.hpl_m
        if hpl_m is None:
            return
        self._sample.add((hpl_m,))
        self._counts[1, tag] += 1
        if across_m > hpl_m:
            self._counts[2, tag] += 1
            self._counts[3, tag] += fix.alert is Alert.NONE

    def counts(self) -> LevelCounts | None:
        """None where no fix was judged, or the method gives no levels."""
        if not self._told:
            return None
        fixes, levels, exceeded, unwarned = self._counts
        return LevelCounts(fixes, levels, exceeded, unwarned, self._sample.rows[:, 0])
