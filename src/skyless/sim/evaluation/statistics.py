"""Which fixes are judged, and tallies of errors and protection levels, in bounded memory.

Sums are exact; percentiles, medians and plots come from an even sample of the run.
"""

import math
from array import array
from collections import Counter
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.any_receiver import superframe_s
from skyless.core.arrays import Array
from skyless.core.fix import Fix
from skyless.core.integrity import Alert
from skyless.core.site import Site

_SAMPLE_ROWS: Final = 1 << 17
"""Rows kept at most; with fewer, percentiles are exact."""


class FirstFixes:
    """Picks the first fix of each tag and superframe, so that all methods are judged at the same times."""

    def __init__(self, site: Site, tags: int) -> None:
        self.superframe_s = superframe_s(site)
        self._last = [-1] * tags

    def is_first(self, tag: int, time_s: float) -> bool:
        """Whether a fix at that true time is the tag's first one in its superframe."""
        superframe = int(time_s / self.superframe_s)
        if superframe == self._last[tag]:
            return False
        self._last[tag] = superframe
        return True


class EvenSample:
    """Every k-th row of a stream, k doubling whenever the store is full: an even sample, reproducible."""

    def __init__(self, columns: int, rows: int = _SAMPLE_ROWS) -> None:
        self._columns = columns
        self._most = rows * columns
        self._store = array("d")
        self._stride = 1
        self.seen = 0
        """Rows offered so far."""

    def add(self, row: tuple[float, ...]) -> None:
        """Offer one row."""
        seen = self.seen
        self.seen = seen + 1
        if seen % self._stride:
            return
        if len(self._store) >= self._most:
            self._store = array("d", self.rows[::2].tobytes())
            self._stride *= 2
            if seen % self._stride:
                return
        self._store.extend(row)

    @property
    def rows(self) -> Array:
        """The rows kept, shape (kept, columns), in their order; a copy."""
        return np.array(self._store).reshape(-1, self._columns)


def dimensions(*, planar: bool) -> str:
    """What percentiles and the like are of, for people: of the horizontal error where the height was given."""
    return "2-D" if planar else "3-D"


class ErrorSummary(Struct, frozen=True):
    """Errors of a run in metres; None where there were none to judge."""

    count: int
    rmse_2d_m: float | None
    rmse_3d_m: float | None
    p95_m: float | None
    max_m: float | None
    bias_m: tuple[float, float, float] | None


class ErrorStatistics:
    """Position errors, one vector at a time."""

    def __init__(self, *, planar: bool) -> None:
        """``planar``: percentiles and the maximum are of the horizontal error, because the height was given."""
        self._planar = planar
        self._count = 0
        self._origin = (0.0, 0.0, 0.0)
        """The first vector: sums are about it, so that far from the site's origin no digits are lost."""
        self._sum = [0.0, 0.0, 0.0]
        self._squares = [0.0, 0.0, 0.0]
        self._max = 0.0
        self._sample = EvenSample(1)

    def add(self, x_m: float, y_m: float, z_m: float) -> None:
        """Add one error vector."""
        if self._count == 0:
            self._origin = (x_m, y_m, z_m)
        self._count += 1
        for axis, value in enumerate((x_m, y_m, z_m)):
            offset = value - self._origin[axis]
            self._sum[axis] += offset
            self._squares[axis] += offset * offset
        error_m = (x_m * x_m + y_m * y_m + (0.0 if self._planar else z_m * z_m)) ** 0.5
        self._max = max(self._max, error_m)
        self._sample.add((error_m,))

    @property
    def count(self) -> int:
        """How many errors there were."""
        return self._count

    def std(self) -> tuple[float, float, float]:
        """Standard deviation of each component about its mean."""
        x, y, z = (variance**0.5 for variance in self._variances())
        return x, y, z

    def _variances(self) -> list[float]:
        count = self._count
        return [
            max(square / count - (total / count) ** 2, 0.0)
            for square, total in zip(self._squares, self._sum, strict=True)
        ]

    def summary(self) -> ErrorSummary:
        """Figures of all errors."""
        if self._count == 0:
            return ErrorSummary(0, None, None, None, None, None)
        x_m, y_m, z_m = (start + total / self._count for start, total in zip(self._origin, self._sum, strict=True))
        means_m = (x_m, y_m, z_m)
        mean_squares = [mean**2 + variance for mean, variance in zip(means_m, self._variances(), strict=True)]
        return ErrorSummary(
            count=self._count,
            rmse_2d_m=(mean_squares[0] + mean_squares[1]) ** 0.5,
            rmse_3d_m=None if self._planar else sum(mean_squares) ** 0.5,
            p95_m=float(np.percentile(self._sample.rows, 95)),
            max_m=self._max,
            bias_m=means_m,
        )


class LevelCounts(Struct, frozen=True):
    """Protection levels of each tag's judged fixes; counts have shape (tags,)."""

    fixes: Array
    levels: Array
    """Fixes with a horizontal protection level."""
    exceeded: Array
    """Those whose horizontal error is larger than it."""
    unwarned: Array
    """Those of them that carry no alert."""
    hpl_m: Array
    """Levels, an even sample of them."""


class LevelReport(Struct, frozen=True):
    """Protection levels of all judged fixes, of a method that gives levels."""

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
    """Counts fixes by their protection levels and whether these held."""

    def __init__(self, tags: int, sample_rows: int) -> None:
        self._risk: float | None = None
        self._counts = np.zeros((4, tags))
        self._misleading = 0
        self._alerts: Counter[str] = Counter()
        self._sample = EvenSample(1, sample_rows)

    def add(self, tag: int, fix: Fix, error_m: Array) -> None:
        """Add a fix and its error, shape (3,)."""
        integrity = fix.integrity
        if integrity is None:
            return
        self._risk = fix.integrity_risk
        self._alerts[integrity.alert.value] += 1
        self._counts[0, tag] += 1
        hpl_m, vpl_m = integrity.hpl_m, integrity.vpl_m
        if hpl_m is None:
            return
        self._sample.add((hpl_m,))
        self._counts[1, tag] += 1
        exceeded = math.hypot(error_m[0], error_m[1]) > hpl_m
        self._misleading += exceeded or (vpl_m is not None and bool(abs(error_m[2]) > vpl_m))
        if exceeded:
            self._counts[2, tag] += 1
            self._counts[3, tag] += integrity.alert is Alert.NONE

    def counts(self) -> LevelCounts | None:
        """By tag; None where no fix was judged, or the method gives no levels."""
        if self._risk is None:
            return None
        fixes, levels, exceeded, unwarned = self._counts
        return LevelCounts(fixes, levels, exceeded, unwarned, self._sample.rows[:, 0])

    def report(self) -> LevelReport | None:
        """Report of all tags together; None where no fix was judged, or the method gives no levels."""
        if self._risk is None:
            return None
        fixes, levels = self._counts[:2].sum(axis=1).tolist()
        median_m = float(np.median(self._sample.rows)) if levels else None
        return LevelReport(self._risk, levels / fixes, self._misleading, median_m, dict(sorted(self._alerts.items())))
