"""How long a tag takes from a frame's end to its fix, and in which phases of the superframe it works."""

from collections import deque
from typing import Final

from skyless.air.beacon import Malformed
from skyless.air.codec import decode_cached
from skyless.mqtt.messages import Phase

_MOST: Final = 4096
_MOST_PHASES: Final = 64


class Latencies:
    """Latencies since they were last asked for, in s."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=_MOST)

    def add(self, latency_s: float) -> None:
        """Count one fix."""
        self._values.append(latency_s)

    def take(self) -> tuple[float | None, float | None, int]:
        """Median, 99th percentile and number, and begin anew."""
        ordered = sorted(self._values)
        self._values.clear()
        if not ordered:
            return None, None, 0
        return ordered[len(ordered) // 2], ordered[min(len(ordered) - 1, (99 * len(ordered)) // 100)], len(ordered)


class PhaseLog:
    """What was heard and computed in the present superframe and in the last whole one."""

    def __init__(self) -> None:
        self._superframe: int | None = None
        self._begin_s = 0.0
        self._present: list[Phase] = []
        self.last: tuple[Phase, ...] = ()

    def hear(self, frame: bytes, ended_s: float, done_s: float, *, made_fix: bool) -> None:
        """Note one frame: when it ended, and when its processing did, by the host's monotonic clock."""
        beacon = decode_cached(frame)
        if isinstance(beacon, Malformed):
            return
        if beacon.superframe != self._superframe:
            self.last = tuple(self._present)
            self._present.clear()
            self._superframe, self._begin_s = beacon.superframe, ended_s
        if len(self._present) >= _MOST_PHASES:
            return
        begin_s = self._begin_s
        self._present.append(
            Phase(beacon.superframe, beacon.slot, beacon.anchor, ended_s - begin_s, done_s - begin_s, made_fix)
        )
