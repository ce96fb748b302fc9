"""Error statistics in bounded memory: sums are exact, percentiles and plots come from an even sample of the run."""

from array import array
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Array

SAMPLE_ROWS: Final = 1 << 17
"""Rows kept at most; with fewer, percentiles are exact."""


class EvenSample:
    """Every k-th row of a stream, k doubling whenever the store is full: an even sample, reproducible."""

    def __init__(self, columns: int, rows: int = SAMPLE_ROWS) -> None:
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
            self._halve()
            if seen % self._stride:
                return
        self._store.extend(row)

    def _halve(self) -> None:
        self._store = array("d", self.rows[::2].tobytes())
        self._stride *= 2

    @property
    def rows(self) -> Array:
        """The rows kept, shape (kept, columns), in their order; a copy."""
        return np.array(self._store).reshape(-1, self._columns)


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
        """Take one error vector."""
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
        """What the errors come to."""
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
