"""True time that passes from event to event."""

import heapq
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

Told = TypeVar("Told")


class Timeline(Generic[Told]):
    """Events in the order of true time (whole ideal ticks); those of one tick in the order of their planning."""

    def __init__(self) -> None:
        self.now_ticks = 0
        self._serial = self._until_ticks = 0
        self._events: list[tuple[int, int, Callable[[], Told | None]]] = []

    @property
    def next_ticks(self) -> int | None:
        """When the next event happens; None while nothing is planned."""
        return self._events[0][0] if self._events else None

    def at(self, ticks: int, happen: Callable[[], Told | None]) -> None:
        """Plan an event; one that should have happened already happens now."""
        self._serial += 1
        heapq.heappush(self._events, (max(ticks, self.now_ticks), self._serial, happen))

    def pass_to(self, ticks: int) -> bool:
        """Let time pass up to ``ticks`` at once if nothing is to happen before, nor ``run`` to end; whether it did."""
        if ticks > self._until_ticks or (self._events and self._events[0][0] <= ticks):
            return False
        self.now_ticks = max(self.now_ticks, ticks)
        return True

    def run(self, until_ticks: int) -> Iterator[Told]:
        """Let everything happen up to a time, and give what the events have to tell."""
        self._until_ticks = until_ticks
        while self._events and self._events[0][0] <= until_ticks:
            self.now_ticks, _, happen = heapq.heappop(self._events)
            told = happen()
            if told is not None:
                yield told
        self.now_ticks = max(self.now_ticks, until_ticks)
