"""How a tag's program stays in the present on a computer that is too slow: what is too old is dropped and counted.

A fix is worth nothing when it is old, and what waits in front of a slow program makes everything behind it old as well.
So a reception that is too old at its turn is dropped with all that wait at that moment: positioning goes on with what
comes next, and the receptions that it gets follow one another without gaps between such pauses.
"""

from collections import Counter
from typing import Final

MOST_AGE_S: Final = 0.1
"""No fix reaches a subscriber later than this after the end of its last frame, as far as its sender can see to it."""

FIX_LEAVES_S: Final = 0.6 * MOST_AGE_S
"""A fix that is older is not given: the broker and the subscriber need the rest where a computer is busy."""

OLDEST_RECEPTION_S: Final = 0.5 * MOST_AGE_S
"""A reception that is older at its turn is dropped, so that time is left for its fix."""


class Lateness:
    """Ages of one tag's receptions and fixes. Times are of the host's monotonic clock, in s."""

    def __init__(self) -> None:
        self.dropped = 0
        """Receptions that were too old at their turn."""
        self.withheld = 0
        """Fixes that were too old to be given."""
        self._largest_s = 0.0
        self._present_s = float("-inf")
        """When the newest backlog was noticed: what had ended by then is dropped."""

    def admits(self, ended_s: float, now_s: float) -> bool:
        """Whether to process a reception whose turn it is, ``ended_s`` being its frame's end; if not it is counted."""
        self._note(now_s - ended_s)
        if now_s - ended_s > OLDEST_RECEPTION_S:
            self._present_s = now_s
        if ended_s <= self._present_s:
            self.dropped += 1
            return False
        return True

    def gives(self, ended_s: float, now_s: float) -> bool:
        """Whether a fix made now is to be given, ``ended_s`` being the end of its last frame; if not it is counted."""
        self._note(now_s - ended_s)
        if now_s - ended_s > FIX_LEAVES_S:
            self.withheld += 1
            return False
        return True

    @property
    def drops(self) -> Counter[str]:
        """Dropped receptions as a counter."""
        return +Counter({"late-reception": self.dropped})

    def drain(self) -> float:
        """The largest age since the last call; 0 if there was nothing."""
        largest_s, self._largest_s = self._largest_s, 0.0
        return largest_s

    def _note(self, age_s: float) -> None:
        self._largest_s = max(self._largest_s, age_s)
