"""Unix time of recorded receptions: by the tag's counter, which the least delayed of them tie to its host's clock.

A host sees frames late, by changing amounts, so the times that it gives them are too coarse to be compared with the
truth. But now and then the two clocks move against each other: the emulated air stood still, a clock was set, a radio
was started again. Then they are tied again. When receptions suddenly come late, it may also be that the host was busy
and receives what had waited. Which of the two it is shows within a second; until then they are held back.
"""

import math
from typing import Final, Generic, TypeVar

from skyless.core.air.frame import Reception
from skyless.core.ticks import TICK_S, Unwrapper

_HOST_DRIFT: Final = 1e-4
"""By how much a host's clock and a tag's may differ in rate."""

_SUDDEN_S: Final = 0.1
"""Receptions that are later than this are held back until it is clear why."""

_STEADY_S: Final = 1.0
"""A host that is late for so long without a break has another clock, or the tag's counter stood still."""

_MAX_HELD: Final = 10_000
"""A forged recording could hold back any number."""

_T = TypeVar("_T")


class HostClock(Generic[_T]):
    """Unix times of one tag's receptions, and of what each of them carries through here."""

    def __init__(self) -> None:
        self._ticks = Unwrapper()
        self._less_counter_s = math.inf
        """Unix time less the counter, as the least delayed reception has it."""
        self._last_s = 0.0
        self._held: list[tuple[_T, float, float, float]] = []
        """What is carried, its counter, its host's time less that, and its host's time."""

    def add(self, reception: Reception, unix_less_host_s: float, carried: _T) -> list[tuple[_T, float]]:
        """Add a reception; what is carried by those whose Unix time is known now, in order, with that time."""
        counter_s = self._ticks.unwrap(reception.rx_ticks, reception.host_s) * TICK_S
        least_s = self._less_counter_s + _HOST_DRIFT * max(counter_s - self._last_s, 0.0)
        self._last_s = counter_s
        if reception.host_s is None:
            return [*self.rest(), (carried, counter_s + (0.0 if math.isinf(least_s) else least_s))]
        unix_s = reception.host_s + unix_less_host_s
        self._less_counter_s = least_s
        self._held.append((carried, counter_s, unix_s - counter_s, unix_s))
        if unix_s - counter_s <= least_s + _SUDDEN_S:
            self._less_counter_s = min(least_s, unix_s - counter_s)
        elif unix_s - self._held[0][3] >= _STEADY_S or len(self._held) > _MAX_HELD:
            self._tie_again()
        else:
            return []
        return self._released()

    def rest(self) -> list[tuple[_T, float]]:
        """What is still held back at the end."""
        if len(self._held) > 1:
            (_, first_s, _, begun_s), (_, last_s, _, ended_s) = self._held[0], self._held[-1]
            if ended_s - begun_s >= 0.5 * (last_s - first_s):  # no backlog, which is processed at once
                self._tie_again()
        return self._released()

    def _tie_again(self) -> None:
        self._less_counter_s = min(less_counter_s for _, _, less_counter_s, _ in self._held)

    def _released(self) -> list[tuple[_T, float]]:
        released = [(carried, counter_s + self._less_counter_s) for carried, counter_s, _, _ in self._held]
        self._held.clear()
        return released
