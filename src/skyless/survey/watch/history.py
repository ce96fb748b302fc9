"""What the range of a pair usually is, how it drifts, and how much noise its exchanges have.

All arrays grow with the pairs that are seen; memory does not grow with time.
"""

from typing import Final

import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Array, Mask

_GAUSSIAN: Final = 1.4826
"""From a median of magnitudes to a standard deviation."""

_GIVEN_SHARE: Final = 0.5
"""Part of the median's windows as which a given range counts."""

_PRIOR_DIFFERENCES: Final = 4
_PRIOR_DRIFT_M: Final = 0.03
"""What is expected of a pair's drift, and as how many observed differences that counts."""

_LEAST_LAGS: Final = 6
"""Known windows over the distance of those compared, at least."""

_NOISE_MEMORY: Final = 2000.0
"""Exchanges after which the estimate of their noise forgets."""
_NOISE_JUMP: Final = 9.0
"""By how much one block can be noisier than the blocks before."""

_PRESENCE_MEMORY: Final = 60.0
"""Windows after which it is forgotten how regularly a pair's ranges came."""


class HistorySettings(Struct, frozen=True):
    """How a pair's usual range and drift are learned."""

    usual_windows: int = 60
    """Over which the usual range is the median."""
    drift_windows: int = 360
    drift_floor_m: float = 0.02
    learns_drift: bool = True
    """Otherwise the drift is ``drift_floor_m``."""


class RangeHistory:
    """Of all pairs; a pair's row is its number."""

    def __init__(self, settings: HistorySettings) -> None:
        self._settings = settings
        self._usual = np.full((0, settings.usual_windows), np.nan)
        self._used = np.zeros(0, np.int64)
        """Windows that have gone into each row of ``_usual``."""
        self._values = np.full((0, settings.drift_windows), np.nan)
        self._windows = 0
        self._usual_m = np.zeros(0)
        self._noise_m2 = np.zeros(0)
        self._noise_exchanges = np.zeros(0)
        self.first_m = np.zeros(0)
        """Shape (m,): the range that was given, or the first median over ``usual_windows``; NaN before."""
        self.presence = np.zeros(0)
        """Shape (m,): share of the windows with both anchors in which the pair had a range."""

    def __len__(self) -> int:
        return len(self._usual)

    @property
    def usual_m(self) -> Array:
        """Shape (m,): the usual range; NaN where it is not known."""
        return self._usual_m

    @property
    def windows(self) -> Array:
        """Shape (m,): windows that the usual range is made of."""
        return np.minimum(self._used, self._settings.usual_windows).astype(np.float64)

    @property
    def noise_m2(self) -> Array:
        """Shape (m,): variance of one exchange."""
        return self._noise_m2

    def add_pair(self, given_m: float | None = None) -> int:
        """The number of another pair. ``given_m``: its range by the survey."""
        settings = self._settings
        row = np.full((1, settings.usual_windows), np.nan)
        used = 0
        if given_m is not None:
            used = max(round(_GIVEN_SHARE * settings.usual_windows), 1)
            row[0, :used] = given_m
        first_m = np.nan if given_m is None else given_m
        self._usual = np.concatenate([self._usual, row])
        self._used = np.append(self._used, used)
        self._values = np.concatenate([self._values, np.full((1, settings.drift_windows), np.nan)])
        self._usual_m = np.append(self._usual_m, first_m)
        self._noise_m2 = np.append(self._noise_m2, 0.0)
        self._noise_exchanges = np.append(self._noise_exchanges, 0.0)
        self.first_m = np.append(self.first_m, first_m)
        self.presence = np.append(self.presence, 1.0)
        return len(self._usual) - 1

    def add_noise(self, pair: int, variance_m2: float, exchanges: int) -> None:
        """Count the noise of a block: variance of one exchange."""
        known = self._noise_exchanges[pair]
        if known > 0.0:
            variance_m2 = min(variance_m2, _NOISE_JUMP * self._noise_m2[pair])
        total = known + exchanges
        self._noise_m2[pair] += (variance_m2 - self._noise_m2[pair]) * exchanges / total
        self._noise_exchanges[pair] = min(total, _NOISE_MEMORY)

    def add_window(self, range_m: Array, is_usable: Mask, is_drifting: Mask, is_expected: Mask) -> None:
        """Add the ranges of a window, shape (m,), NaN where there is none.

        ``is_usable``: where nothing has changed, so that the usual range may follow it. ``is_drifting``: where changes
        may count as drift. ``is_expected``: where a missing range counts for ``presence``.
        """
        self._values[:, self._windows % self._settings.drift_windows] = np.where(is_drifting, range_m, np.nan)
        self._windows += 1
        is_present = np.isfinite(range_m)
        rows = np.flatnonzero(is_present & is_usable)
        self._usual[rows, self._used[rows] % self._settings.usual_windows] = range_m[rows]
        self._used[rows] += 1
        if len(rows):
            self._usual_m[rows] = np.nanmedian(self._usual[rows], axis=1)
        is_full = np.isnan(self.first_m) & (self._used >= self._settings.usual_windows)
        self.first_m[is_full] = self._usual_m[is_full]
        self.presence[is_expected] += (is_present[is_expected] - self.presence[is_expected]) / _PRESENCE_MEMORY

    def drift_m(self) -> Array:
        """Standard deviation of each pair's drift about its usual range, shape (m,).

        From differences of windows up to half the median's length apart: a step spoils few of them, and drift that is
        slower than the median is left to the median.
        """
        settings = self._settings
        floor_m2 = settings.drift_floor_m**2
        if not settings.learns_drift or not len(self):
            return np.full(len(self), settings.drift_floor_m)
        length = settings.drift_windows
        known = min(self._windows, length)
        lag = max(min(settings.usual_windows // 2, known // _LEAST_LAGS), 1)
        newest = np.arange(self._windows - known + lag, self._windows)
        apart = np.abs(self._values[:, newest % length] - self._values[:, (newest - lag) % length])
        count = np.isfinite(apart).sum(axis=1)
        scale_m2 = np.zeros(len(self))
        rows = np.flatnonzero(count)
        if len(rows):
            scale_m2[rows] = (_GAUSSIAN * np.nanmedian(apart[rows], axis=1)) ** 2 / 2.0
        prior_m2 = max(_PRIOR_DRIFT_M**2, floor_m2)
        learned_m2 = (count * scale_m2 + _PRIOR_DIFFERENCES * prior_m2) / (count + _PRIOR_DIFFERENCES)
        return np.asarray(np.sqrt(np.maximum(learned_m2, floor_m2)))

    def restart(self, pairs: Mask) -> None:
        """Forget the usual ranges of these pairs, which are learned from the start."""
        self._used[pairs] = 0
        self._usual[pairs] = np.nan
        self._usual_m[pairs] = self.first_m[pairs] = np.nan
        self._values[pairs] = np.nan
