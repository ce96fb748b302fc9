"""True positions of simulated tags at any moment of the last seconds."""

from collections import deque
from typing import Final

from skyless.mqtt.messages import TruthMessage, Vector

REACH_S: Final = 0.25
"""A message holds for this time before and after it, along a straight line; a turning tag leaves the line by then."""

_MOST_MESSAGES: Final = 64


class TruthBuffer:
    """The newest messages of an ether."""

    def __init__(self) -> None:
        self._truths: deque[TruthMessage] = deque(maxlen=_MOST_MESSAGES)

    def add(self, truth: TruthMessage) -> None:
        """Add a message; one older than the last (a restarted ether) replaces all before it."""
        if self._truths and truth.unix_s < self._truths[-1].unix_s:
            self._truths.clear()
        self._truths.append(truth)

    def at(self, tag: str, unix_s: float) -> Vector | None:
        """True position of a tag: from the message nearest in time, along its velocity; None if none is near."""
        best, ahead_s = None, REACH_S
        for truth in reversed(self._truths):
            gap_s = unix_s - truth.unix_s
            if abs(gap_s) <= abs(ahead_s) and tag in truth.tags:
                best, ahead_s = truth.tags[tag], gap_s
            if gap_s > 0.0:
                break
        if best is None:
            return None
        (x, y, z), (vx, vy, vz) = best.position_m, best.velocity_mps
        return x + ahead_s * vx, y + ahead_s * vy, z + ahead_s * vz
