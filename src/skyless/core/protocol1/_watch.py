"""Whether the master still lives, from its own beacons and from what others relay of them.

Every listener estimates how often each link brings news of the master. A silent master is declared dead once its
silence is almost impossible on those links; lost frames alone do not replace a master.
"""

import math
from typing import Final

from msgspec import Struct

MAX_CHANCE: Final = 1e-10
"""Chance of a silence, were the master alive, below which it is declared dead."""

MEMORY: Final = 64
"""Turns of the master over which a link's share is averaged."""

RECENT_TURNS: Final = 8
"""A link that has brought nothing for this number of turns does not count."""

SEQUENCES: Final = 256


class _Link(Struct):
    """A source of news of the master: itself, or an anchor that receives it."""

    sequence: int
    """Sequence number of the master's last beacon that it reported."""
    turns: int = 0
    share: float = 0.5
    """Part of the master's turns that it reports before the next one."""


class MasterWatch:
    """Tracks the sequence numbers of one master's beacons; a turn is one beacon that it should send."""

    def __init__(self) -> None:
        self.news_ticks = 0
        """Own time of the last news, unwrapped."""
        self._sequence: int | None = None
        self._links: dict[int, _Link] = {}

    def begin(self, now_ticks: int) -> None:
        """Watch another master, which lives at this time."""
        self.news_ticks, self._sequence = now_ticks, None
        self._links.clear()

    def update(self, source: int, sequence: int, now_ticks: int) -> None:
        """Process the sequence number of the master's last beacon, from itself or an anchor that received it."""
        if self._sequence is None or 0 < (sequence - self._sequence) % SEQUENCES < SEQUENCES // 2:
            self._sequence, self.news_ticks = sequence, now_ticks
        link = self._links.get(source)
        if link is None:
            self._links[source] = _Link(sequence)
            return
        turns = (sequence - link.sequence) % SEQUENCES
        if not 0 < turns < SEQUENCES // 2:
            return
        for turn in range(1, turns + 1):
            link.turns = min(link.turns + 1, MEMORY)
            link.share += ((turn == turns) - link.share) / (link.turns + 2)
        link.sequence = sequence

    def is_dead(self, missed_turns: int) -> bool:
        """Whether this number of turns without news shows that the master is dead."""
        return missed_turns * self._surprise() > -math.log(MAX_CHANCE)

    def _surprise(self) -> float:
        """Negative logarithm of the chance that a turn of a living master brings no news."""
        least = 1.0 / (MEMORY + 2)
        return sum(
            -math.log(max(1.0 - link.share, least))
            for link in self._links.values()
            if self._sequence is not None and (self._sequence - link.sequence) % SEQUENCES < RECENT_TURNS
        )
