"""A largest rate of events."""

from typing import Final

_LATE_SHARE: Final = 0.5
"""An event that comes late by up to this share of the interval does not lower the average rate."""

_EARLY_SHARE: Final = 0.25
"""An event that comes early by up to this share passes: else of events at just this rate some would not."""


class RateLimit:
    """Passes at most a given number of events a second on average."""

    def __init__(self, max_hz: float) -> None:
        self._interval_s = 1.0 / max_hz
        self._due_s = 0.0

    def is_due(self, now_s: float) -> bool:
        """Whether an event at this time passes."""
        if now_s < self._due_s - _EARLY_SHARE * self._interval_s:
            return False
        self._due_s = max(self._due_s, now_s - _LATE_SHARE * self._interval_s) + self._interval_s
        return True
