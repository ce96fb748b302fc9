"""The newest fix of every tag of a large site in NumPy arrays, by the tags' numbers. No I/O."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyless.page._state import UNHEARD_S
from skyless.run.fix_batch import ALERT_BITS, Records

MAX_NUMBER: Final = 1_000_000
_FIRST_SIZE: Final = 1024
_SET_BACK_US: Final = 10_000_000
"""A fix that is older than the newest by more than this is of a clock that was set back. Others come late."""

_MAX_U16: Final = 65_535
_COLUMNS: Final = {"x_mm": np.int32, "y_mm": np.int32, "z_mm": np.int32, "sigma_mm": np.uint16, "alert": np.uint8}

Array = NDArray[Any]


class Visible(NamedTuple):
    """Tags in a view, one element each."""

    numbers: Array
    x_m: Array
    y_m: Array
    sigma_mm: Array
    age_s: Array
    alert: Array


class Columns:
    """The newest fix of each tag: position, horizontal radial sigma, time, alert, and when it arrived."""

    def __init__(self) -> None:
        self.serial = self.dropped = 0
        """Batches taken, and fixes whose numbers are too large."""
        self._used = 0
        self._unix_us = np.zeros(_FIRST_SIZE, np.int64)
        self._arrived_s = np.full(_FIRST_SIZE, -np.inf)
        self._columns = {name: np.zeros(_FIRST_SIZE, kind) for name, kind in _COLUMNS.items()}

    def update(self, records: Records, now_s: float) -> None:
        """Take the records of a batch that has arrived."""
        self.serial += 1
        allowed = records["tag"] <= MAX_NUMBER
        if not allowed.all():
            self.dropped += int(len(records) - allowed.sum())
            records = records[allowed]
        if not len(records):
            return
        self._make_room(int(records["tag"].max()) + 1)
        unix_us = records["unix_us"].astype(np.int64)
        if (unix_us[1:] < unix_us[:-1]).any():  # of several fixes of a tag the last one stays
            order = np.argsort(unix_us, kind="stable")
            records, unix_us = records[order], unix_us[order]
        before_us = self._unix_us[records["tag"]]
        new = (unix_us >= before_us) | (unix_us < before_us - _SET_BACK_US)
        if not new.all():
            records, unix_us = records[new], unix_us[new]
        tags, positions_mm, covariance = records["tag"], records["position_mm"], records["covariance_m2"]
        with np.errstate(invalid="ignore", over="ignore"):
            sigma_mm = np.nan_to_num(1000.0 * np.sqrt(covariance[:, 0] + covariance[:, 2]), nan=_MAX_U16)
        found = (*positions_mm.T, np.minimum(sigma_mm, _MAX_U16), records["flags"] & ALERT_BITS)
        for column, values in zip(self._columns.values(), found, strict=True):
            column[tags] = values
        self._unix_us[tags], self._arrived_s[tags] = unix_us, now_s

    def visible(self, view: tuple[float, float, float, float], now_s: float) -> Visible:
        """The tags that were heard recently, between the least x and y and the largest x and y of a view in m."""
        low_x, low_y, high_x, high_y = (1000.0 * edge for edge in view)
        x_mm, y_mm = self._columns["x_mm"][: self._used], self._columns["y_mm"][: self._used]
        inside = (x_mm >= low_x) & (x_mm <= high_x) & (y_mm >= low_y) & (y_mm <= high_y)
        inside &= self._arrived_s[: self._used] > now_s - UNHEARD_S
        tags = np.flatnonzero(inside)
        x_mm, y_mm, _, sigma_mm, alert = (column[tags] for column in self._columns.values())
        return Visible(tags, x_mm / 1000.0, y_mm / 1000.0, sigma_mm, now_s - self._arrived_s[tags], alert)

    def _make_room(self, used: int) -> None:
        self._used = max(self._used, used)
        more = max(used, 2 * len(self._unix_us)) - len(self._unix_us)
        if used > len(self._unix_us):
            self._unix_us = np.pad(self._unix_us, (0, more))
            self._arrived_s = np.pad(self._arrived_s, (0, more), constant_values=-np.inf)
            self._columns = {name: np.pad(column, (0, more)) for name, column in self._columns.items()}
