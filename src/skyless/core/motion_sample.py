"""What a tag's motion sensor or wheels show, and when by the tag's own counter."""

from math import inf, isfinite
from typing import Final

from msgspec import Struct

from skyless.core.ticks import MAX_DRIFT, TICK_RATE_HZ, TICK_S, Unwrapper

_SET_S: Final = 0.1
"""A larger change between the two clocks means that one of them was set or began again [s]."""

_MOST_RPS, _MOST_MPS2, _MOST_MPS = 40.0, 250.0, 100.0
"""Larger values no sensor of these kinds shows."""


class MotionSample(Struct, frozen=True, gc=False):
    """What a motion sensor shows at an instant, in its own frame: x forward, y to the left, z up."""

    time_s: float
    """Time of the sample, by the clock of the receptions' ``host_s``."""
    rate_rps: tuple[float, float, float]
    """Angular rate; of wheels (0, 0, rate)."""
    force_mps2: tuple[float, float, float] | None = None
    """Specific force: 9.8 m/s² along z at rest. None without an accelerometer."""
    speed_mps: float | None = None
    """Speed along x that wheels show; None without."""
    arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the antenna seen from the sensor."""

    def check(self) -> None:
        """See that all numbers are finite, and as sensors show them. Raises ValueError."""
        limits = (self.rate_rps, _MOST_RPS), (self.force_mps2 or (), _MOST_MPS2), ((self.speed_mps or 0.0,), _MOST_MPS)
        is_possible = all(abs(value) <= most for values, most in limits for value in values)
        if not (is_possible and all(map(isfinite, (self.time_s, *self.arm_m)))):
            raise ValueError(f"{self} should have numbers that sensors show, in rad/s, m/s² and m/s")


class ShortestLatency:
    """How far another clock is ahead of the host's, seen from messages whose latencies vary.

    Of recent latencies the shortest is right, but for the drift of the clocks.
    """

    def __init__(self) -> None:
        self._host_s, self._ahead_s = -inf, -inf

    def ahead_s(self, host_s: float, other_s: float) -> float:
        """The other clock less the host's, after a message of ``other_s`` that arrived at ``host_s``."""
        ahead_s, elapsed_s = other_s - host_s, host_s - self._host_s
        if 0.0 <= elapsed_s < inf and abs(ahead_s - self._ahead_s) < _SET_S:
            ahead_s = max(ahead_s, self._ahead_s - 2.0 * MAX_DRIFT * elapsed_s)
        self._host_s, self._ahead_s = host_s, ahead_s
        return ahead_s


class SampleClock(ShortestLatency):
    """Converts times of the host to ticks of the tag's counter."""

    def ticks(self, own: Unwrapper, time_s: float) -> int | None:
        """The tag time of a host time, by the newest reception in ``own``; None if that has no host time."""
        if not isfinite(own.last_host_s):
            return None
        return round((time_s + self.ahead_s(own.last_host_s, own.last_ticks * TICK_S)) * TICK_RATE_HZ)
