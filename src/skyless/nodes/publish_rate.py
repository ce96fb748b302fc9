"""How often something that comes often is to be told."""

from typing import Final

_MADE_UP: Final = 0.5
"""What is told late by up to this share of the interval does not lower the average rate."""


class Pace:
    """Lets through so many a second at most."""

    def __init__(self, most_hz: float) -> None:
        self._interval_s = 1.0 / most_hz
        self._due_s = 0.0

    def is_due(self, now_s: float) -> bool:
        """Whether what happens now is to be told."""
        if now_s < self._due_s:
            return False
        self._due_s = max(self._due_s, now_s - _MADE_UP * self._interval_s) + self._interval_s
        return True
