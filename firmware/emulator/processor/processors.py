"""Processors in true time: each runs ahead of the timeline as far as nothing from outside can reach it.

What processors do to the world is planned as events of the timeline at its true time, and reaches other processors only
through the air, which takes longer than a slice. So all processors that are awake run one after the other up to the
timeline's next event, at most ``SLICE_TICKS``; an event never finds one further than that, but for a block of
instructions. The order is that of the timeline, so runs repeat themselves.
"""

from operator import itemgetter
from typing import Any, ClassVar, Final, Protocol
from weakref import WeakKeyDictionary

from emulator.processor.cycles import CPU_HZ
from skyless.core.ticks import TICK_RATE_HZ
from skyless.sim.medium import Timeline

TICKS_PER_CYCLE: Final = TICK_RATE_HZ / CPU_HZ
SLICE_TICKS: Final = round(2000 * TICKS_PER_CYCLE)
MIN_TICKS: Final = round(TICKS_PER_CYCLE) + 1
"""A processor runs at least so far, lest several events at one instant stop time."""


class Processor(Protocol):
    """One that is to be run."""

    def advance(self, due_ticks: int, until_ticks: int) -> int | None:
        """Run from when it is due up to a true time; when to run it again.

        Not before ``until_ticks``, unless it has just been woken, or waits for an event that it has planned: then not
        before ``MIN_TICKS`` from now. None while it sleeps until something happens.
        """


class Processors:
    """All processors of one timeline."""

    _of: ClassVar["WeakKeyDictionary[Timeline[Any], Processors]"] = WeakKeyDictionary()

    @classmethod
    def of(cls, timeline: "Timeline[Any]") -> "Processors":
        """Those of a timeline."""
        if timeline not in cls._of:
            cls._of[timeline] = cls(timeline)
        return cls._of[timeline]

    def __init__(self, timeline: "Timeline[Any]") -> None:
        self._timeline = timeline
        self._due_ticks: dict[Processor, int] = {}
        """When each that does not sleep is to be run."""
        self._asked_ticks: int | None = None

    def plan(self, processor: Processor, ticks: int) -> None:
        """Run a processor from then on, instead of when it was planned before."""
        self._due_ticks[processor] = ticks
        self._ask()

    def _ask(self) -> None:
        """Have the timeline call when the first processor is due."""
        ticks = min(self._due_ticks.values())
        if self._asked_ticks is None or ticks < self._asked_ticks:
            self._asked_ticks = ticks
            self._timeline.at(ticks, self._turn)

    def _turn(self) -> None:
        timeline = self._timeline
        now = timeline.now_ticks
        if self._asked_ticks is not None and self._asked_ticks <= now:
            self._asked_ticks = None
        horizon = self._cut(min(now + SLICE_TICKS, timeline.until_ticks))
        while self._due_ticks:
            processor, ticks = min(self._due_ticks.items(), key=itemgetter(1))
            if ticks >= horizon:
                self._ask()
                return
            del self._due_ticks[processor]
            due = processor.advance(ticks, horizon)
            if due is not None:
                self._due_ticks.setdefault(processor, due)  # unless it has been planned meanwhile
            horizon = self._cut(horizon)

    def _cut(self, horizon: int) -> int:
        """The timeline's next event, where it comes before a horizon."""
        if self._timeline.next_ticks is not None:
            horizon = min(horizon, self._timeline.next_ticks)
        return max(horizon, self._timeline.now_ticks + MIN_TICKS)
