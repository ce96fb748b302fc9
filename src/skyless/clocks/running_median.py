"""The median of the latest values, kept sorted so that each new value costs about half a microsecond."""

from bisect import bisect_left, insort
from collections import deque


class RunningMedian:
    """Median of the last ``window`` values; fewer than half of them may be arbitrarily wrong."""

    def __init__(self, window: int = 31) -> None:
        self._window = window
        self._arrived: deque[float] = deque()
        self._sorted: list[float] = []

    def __len__(self) -> int:
        return len(self._sorted)

    def add(self, value: float) -> float:
        """Take one finite value and return the median, the upper one of an even number of values."""
        ordered = self._sorted
        if len(ordered) == self._window:
            del ordered[bisect_left(ordered, self._arrived.popleft())]
        self._arrived.append(value)
        insort(ordered, value)
        return ordered[len(ordered) >> 1]

    @property
    def value(self) -> float | None:
        """The median, None before the first value."""
        return self._sorted[len(self._sorted) >> 1] if self._sorted else None
