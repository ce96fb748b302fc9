"""The newest fix of every tag of a large site in NumPy arrays, by the tags' numbers. No I/O."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyless.page._state import UNHEARD_S
from skyless.run.fix_batch import RECORD, Records

MAX_NUMBER: Final = 1_000_000
MAX_DUE: Final = 1_000

_SET_BACK_US: Final = 10_000_000
"""A fix that is older than the newest by more than this is of a clock that was set back. Others come late."""

_INTERVAL_S: Final = 0.5
_DUE_PER_S: Final = 20_000
"""The interval of ``pop_due`` is longer where more tags than this would have a turn in a second."""

Array = NDArray[Any]


class Columns:
    """The newest record of each tag, and when it arrived."""

    def __init__(self) -> None:
        self.serial = self.dropped = 0
        """Batches taken, and fixes whose numbers are too large."""
        self.names: dict[int, str] = {}
        """Of the numbers, as far as they were asked for; empty where there is none."""
        self._used = 0
        self._newest = np.zeros(MAX_NUMBER + 1, RECORD)  # the system gives memory only for what is written
        self._arrived_s, self._popped_s = np.zeros((2, MAX_NUMBER + 1))

    def update(self, records: Records, now_s: float) -> None:
        """Take the records of a batch that has arrived."""
        self.serial += 1
        allowed = records["tag"] <= MAX_NUMBER
        self.dropped += int(len(records) - allowed.sum())
        records = records.compress(allowed)  # ten times as fast as an index
        records = records.take(np.argsort(records["unix_us"], kind="stable"))  # of several of a tag the last one stays
        unix_us = records["unix_us"].astype(np.int64)
        before_us = self._newest["unix_us"][records["tag"]].astype(np.int64)
        records = records.compress((unix_us >= before_us) | (unix_us < before_us - _SET_BACK_US))
        self._used = max(self._used, int(records["tag"].max(initial=0)) + 1)
        self._newest.put(records["tag"], records)
        self._arrived_s[records["tag"]] = now_s

    def visible(self, view: tuple[float, float, float, float], now_s: float) -> tuple[Records, Array]:
        """The records of the tags between least x, y and largest x, y of a view in m, and for how long they are here.

        Tags without a fix for ``UNHEARD_S`` are left out.
        """
        low_x, low_y, high_x, high_y = (1000.0 * edge for edge in view)
        x_mm, y_mm, _ = self._newest["position_mm"][: self._used].T
        inside = (x_mm >= low_x) & (x_mm <= high_x) & (y_mm >= low_y) & (y_mm <= high_y)
        inside &= self._arrived_s[: self._used] > max(0.0, now_s - UNHEARD_S)
        tags = np.flatnonzero(inside)
        return self._newest.take(tags), now_s - self._arrived_s.take(tags)

    def pop_due(self, now_s: float, first: Sequence[int] = ()) -> tuple[Records, Array]:
        """New records, some ``MAX_DUE`` at most, for those who take single fixes, and when they arrived.

        Each tag has its turn at most once in an interval, but for those that are to be first, which never wait; of the
        others those come first that have waited longest.
        """
        interval_s = max(_INTERVAL_S, self._used / _DUE_PER_S)
        arrived_s, popped_s = self._arrived_s[: self._used], self._popped_s[: self._used]
        is_new = arrived_s > popped_s
        tags = np.flatnonzero(is_new & (popped_s <= now_s - interval_s))
        if len(tags) > MAX_DUE:
            tags = tags[np.argpartition(popped_s[tags], MAX_DUE)[:MAX_DUE]]
        tags = np.union1d(tags, [tag for tag in first if is_new[tag]]).astype(np.int64)
        self._popped_s[tags] = now_s
        return self._newest.take(tags), arrived_s.take(tags)

    def heard_since(self, time_s: float) -> list[int]:
        """Numbers of the tags of which a fix has arrived since a time."""
        numbers: list[int] = np.flatnonzero(self._arrived_s[: self._used] > time_s).tolist()
        return numbers
