"""The newest fix of every tag of a large site in a NumPy array, by the tags' numbers. No I/O."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyless.page._state import UNHEARD_S
from skyless.run.fix_batch import ALERT_BITS, Records

MAX_NUMBER: Final = 1_000_000
_SET_BACK_US: Final = 10_000_000
"""A fix that is older than the newest by more than this is of a clock that was set back. Others come late."""

_MAX_U16: Final = 65_535
_NEWEST: Final = np.dtype(
    [("x_mm", "i4"), ("y_mm", "i4"), ("sigma_mm", "u2"), ("alert", "u1"), ("unix_us", "i8"), ("arrived_s", "f8")]
)

Array = NDArray[Any]


class Columns:
    """The newest fix of each tag: position, horizontal radial sigma, alert, time, and when it arrived."""

    def __init__(self) -> None:
        self.serial = self.dropped = 0
        """Batches taken, and fixes whose numbers are too large."""
        self._used = 0
        self._newest = np.zeros(MAX_NUMBER + 1, _NEWEST)  # the system gives memory only for what is written

    def update(self, records: Records, now_s: float) -> None:
        """Take the records of a batch that has arrived."""
        self.serial += 1
        allowed = records["tag"] <= MAX_NUMBER
        self.dropped += int(len(records) - allowed.sum())
        records = records.compress(allowed)  # ten times as fast as an index
        records = records.take(np.argsort(records["unix_us"], kind="stable"))  # of several of a tag the last one stays
        unix_us = records["unix_us"].astype(np.int64)
        before_us = self._newest["unix_us"][records["tag"]]
        is_new = (unix_us >= before_us) | (unix_us < before_us - _SET_BACK_US)
        records, unix_us = records.compress(is_new), unix_us.compress(is_new)
        self._used = max(self._used, int(records["tag"].max(initial=0)) + 1)
        with np.errstate(invalid="ignore", over="ignore"):
            sigma_mm = 1000.0 * np.sqrt(records["covariance_m2"][:, 0] + records["covariance_m2"][:, 2])
        newest = np.empty(len(records), _NEWEST)
        newest["x_mm"], newest["y_mm"], _ = records["position_mm"].T
        newest["sigma_mm"] = np.minimum(np.nan_to_num(sigma_mm, nan=_MAX_U16), _MAX_U16)
        newest["alert"] = records["flags"] & ALERT_BITS
        newest["unix_us"], newest["arrived_s"] = unix_us, now_s
        self._newest.put(records["tag"], newest)

    def visible(self, view: tuple[float, float, float, float], now_s: float) -> tuple[Array, Array]:
        """Numbers and newest fixes of the tags heard recently between least x, y and largest x, y of a view in m."""
        low_x, low_y, high_x, high_y = (1000.0 * edge for edge in view)
        newest = self._newest[: self._used]
        x_mm, y_mm = newest["x_mm"], newest["y_mm"]
        inside = (x_mm >= low_x) & (x_mm <= high_x) & (y_mm >= low_y) & (y_mm <= high_y)
        inside &= newest["arrived_s"] > max(0.0, now_s - UNHEARD_S)
        tags = np.flatnonzero(inside)
        return tags, newest.take(tags)
