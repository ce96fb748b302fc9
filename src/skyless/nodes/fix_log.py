"""What a tag's program keeps of its fixes: numbers, latencies and Unix times; which of them are given."""

import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Final

from skyless.air.beacon import Beacon, Malformed
from skyless.air.beacon2 import Beacon2
from skyless.air.frames import decode_any
from skyless.mqtt.fix_message import fix_message
from skyless.mqtt.messages import Counters, FixMessage, Phase, TagHealth
from skyless.nodes.lateness import Lateness
from skyless.nodes.process import HEALTH_S
from skyless.positioning.fix import Fix
from skyless.rate_limit import RateLimit

FixListener = Callable[[FixMessage], None]

_MOST_LATENCIES: Final = 4096
_MOST_PHASES: Final = 64


class FixLog:
    """Numbers, times and publishes the fixes of one tag, from the first one on, whatever its radio does."""

    def __init__(
        self, tag: str, publish: FixListener, publish_hz: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """``publish`` is called at most ``publish_hz`` times a second, and not with fixes that are too old; all count.

        ``clock`` gives the host's monotonic time in s.
        """
        self.tag, self._clock = tag, clock
        self.started_s = clock()
        self.unix_less_host_s = 0.0
        self.update_clock_offset()
        self.serial = 0
        """Number of the newest fix, which is the number of fixes so far."""
        self.first_fix_s: float | None = None
        """Since the start."""
        self.last_fix_s: float | None = None
        """When the last fix was made, by the host's monotonic clock."""
        self.due_s = 0.0
        """When the last frame had ended without which the newest fix could not be made: its own, except for a verified
        fix, which needs a key that comes later."""
        self.latencies = Latencies()
        self.lateness = Lateness()
        """Which receptions and fixes are too old."""
        self._reported_serial = 0
        self._publish, self._rate = publish, RateLimit(publish_hz)

    def update_clock_offset(self) -> None:
        """Measure again how far Unix time is from the host's monotonic clock: it is set now and then."""
        self.unix_less_host_s = time.time() - self._clock()

    def add(self, fix: Fix, ended_s: float, done_s: float, due_s: float | None = None) -> None:
        """Add a fix: when its last frame ended, and when it was made, by the host's monotonic clock.

        ``due_s``: when it could be made, where that is not at its last frame; its age counts from then.
        """
        self.serial += 1
        self.due_s = ended_s if due_s is None else due_s
        self.last_fix_s = done_s
        self.latencies.add(done_s - ended_s)
        if self.first_fix_s is None:
            self.first_fix_s = done_s - self.started_s
        if self.lateness.gives(self.due_s, done_s) and self._rate.is_due(ended_s):
            unix_s = ended_s + self.unix_less_host_s
            self._publish(fix_message(self.tag, self.serial, fix, unix_s, done_s - ended_s))

    def health(
        self,
        *,
        method: str,
        receptions: int,
        reason: str,
        counters: Mapping[str, int],
        mqtt: Counters,
        cpu: float,
        memory_bytes: int,
        phases: tuple[Phase, ...] = (),
        late_in_link: int = 0,
    ) -> TagHealth:
        """The tag's state since the last call; ``reason``: why there is no fix, where there is none.

        ``late_in_link``: fixes that became too old while they waited for the broker.
        """
        now_s = self._clock()
        median_s, late_s, _ = self.latencies.drain()
        fixes, self._reported_serial = self.serial - self._reported_serial, self.serial
        is_silent = self.last_fix_s is None or now_s - self.last_fix_s > HEALTH_S
        late_fixes = self.lateness.withheld + late_in_link
        return TagHealth(
            tag=self.tag,
            unix_s=time.time(),
            uptime_s=now_s - self.started_s,
            method=method,
            receptions=receptions,
            fixes=self.serial,
            updates_per_s=fixes / HEALTH_S,
            reason=reason if is_silent else None,
            first_fix_s=self.first_fix_s,
            latency_p50_s=median_s,
            latency_p99_s=late_s,
            counters=dict(counters) | ({"late-fix": late_fixes} if late_fixes else {}),
            mqtt=mqtt,
            cpu=cpu,
            memory_bytes=memory_bytes,
            phases=phases,
            late=self.lateness.dropped + late_fixes,
            lateness_s=self.lateness.drain(),
        )


class Latencies:
    """Latencies since they were last read, in s."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=_MOST_LATENCIES)

    def add(self, latency_s: float) -> None:
        """Count one fix."""
        self._values.append(latency_s)

    def drain(self) -> tuple[float | None, float | None, int]:
        """Median, 99th percentile and number; the latencies are forgotten."""
        ordered = sorted(self._values)
        self._values.clear()
        if not ordered:
            return None, None, 0
        return ordered[len(ordered) // 2], ordered[min(len(ordered) - 1, (99 * len(ordered)) // 100)], len(ordered)


class PhaseLog:
    """When the frames of the present superframe and of the last whole one ended and were processed."""

    def __init__(self) -> None:
        self._superframe: int | None = None
        self._begin_s = 0.0
        self._present: list[Phase] = []
        self.last: tuple[Phase, ...] = ()

    def add(self, frame: bytes, ended_s: float, done_s: float, *, made_fix: bool) -> None:
        """Add one frame: when it ended, and when its processing did, by the host's monotonic clock.

        Frames without slots, of anchors that send at random instants, are left out.
        """
        beacon = decode_any(frame)
        when = beacon if isinstance(beacon, Beacon) else beacon.slot_time if isinstance(beacon, Beacon2) else None
        if when is None or isinstance(beacon, Malformed):
            return
        if when.superframe != self._superframe:
            self.last = tuple(self._present)
            self._present.clear()
            self._superframe, self._begin_s = when.superframe, ended_s
        if len(self._present) >= _MOST_PHASES:
            return
        begin_s = self._begin_s
        self._present.append(
            Phase(when.superframe, when.slot, beacon.anchor, ended_s - begin_s, done_s - begin_s, made_fix)
        )
