"""Counts, latencies and Unix times of a tag's fixes, and the decision which receptions and fixes are too old.

Old fixes are worthless, and receptions queued in a slow program delay all those behind them. So a reception that is
too old when its turn comes is dropped with all that are queued then; positioning continues with the next ones.
"""

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Final

from skyless.core.any_receiver import decode_any
from skyless.core.fix import Fix
from skyless.core.protocol1.beacon import Beacon as Protocol1Beacon
from skyless.run.mqtt.messages import Counters, FixMessage, Phase, TagHealth, fix_message
from skyless.run.process import HEALTH_S, RateLimit

FixListener = Callable[[FixMessage], None]

MAX_AGE_S: Final = 0.1
"""Largest age of a fix, after the end of its last frame, when it reaches a subscriber, as far as the sender can ensure.
"""

FIX_LEAVES_S: Final = 0.6 * MAX_AGE_S
"""Largest age of a fix to publish; the rest of the time is for the broker and the subscriber on a busy computer."""

MAX_RECEPTION_AGE_S: Final = 0.5 * MAX_AGE_S
"""Largest age of a reception when its turn comes; older ones are dropped, so that time is left for the fix."""

_MAX_LATENCIES: Final = 4096
_MAX_PHASES: Final = 64


class FixLog:
    """Numbers, times and publishes the fixes of one tag, across restarts of its radio."""

    def __init__(
        self, tag: str, publish: FixListener, publish_hz: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """``publish`` is called at most ``publish_hz`` times a second, never with old fixes. All are counted.

        ``clock`` gives the host's monotonic time in s.
        """
        self.tag, self._clock = tag, clock
        self._interval_s = 1.0 / publish_hz if publish_hz < 1.0 else None
        self.started_s = clock()
        self.unix_less_host_s = 0.0
        self.update_clock_offset()
        self.serial = 0  # number of the newest fix, which is the number of fixes so far
        self.first_fix_s: float | None = None  # since the start
        self._hypotheses = 0
        self.last_fix_s: float | None = None  # when the last fix was made, by the host's monotonic clock
        self.due_s = 0.0
        """When the last frame needed for the newest fix ended: the fix's own, or for a verified fix the one with the
        key, which comes later."""
        self.latencies = Latencies()
        self.lateness = Lateness()  # which receptions and fixes are too old
        self._reported_serial = 0
        self._publish, self._rate = publish, RateLimit(publish_hz)

    def update_clock_offset(self) -> None:
        """Measure the offset of Unix time from the host's monotonic clock again, as Unix time is set now and then."""
        self.unix_less_host_s = time.time() - self._clock()

    def add(self, fix: Fix, ended_s: float, done_s: float, due_s: float | None = None) -> None:
        """Add a fix, with the host's monotonic times of its last frame's end and of its computation.

        ``due_s``: when it could first be made, if that is after its last frame; its age counts from then.
        """
        self.serial += 1
        self.due_s = ended_s if due_s is None else due_s
        self.last_fix_s = done_s
        self._hypotheses = fix.hypotheses
        self.latencies.add(done_s - ended_s)
        if self.first_fix_s is None:
            self.first_fix_s = done_s - self.started_s
        if self.lateness.gives(self.due_s, done_s) and self._rate.is_due(ended_s):
            self._publish(fix_message(self.tag, self.serial, fix, ended_s + self.unix_less_host_s, done_s - ended_s))

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
        late_in_link: int = 0,
    ) -> TagHealth:
        """Return the tag's state; some figures cover the time since the last call.

        ``reason``: why there is no fix, if there is none. ``late_in_link``: fixes that became too old while waiting for
        the broker.
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
            phases=(),
            carrier_phase_hypotheses=self._hypotheses,
            late=self.lateness.dropped + late_fixes,
            lateness_s=self.lateness.drain(),
            interval_s=self._interval_s,
        )


class Lateness:
    """Ages of one tag's receptions and fixes. Times are of the host's monotonic clock, in s."""

    def __init__(self) -> None:
        self.dropped = 0  # receptions that were too old when their turn came
        self.withheld = 0  # fixes that were too old to be published
        self._largest_s = 0.0
        self._present_s = float("-inf")  # when the newest backlog was noticed: frames that ended before are dropped

    def admits(self, ended_s: float, now_s: float) -> bool:
        """Whether to process a reception whose frame ended at ``ended_s``; count it if not."""
        self._note(now_s - ended_s)
        if now_s - ended_s > MAX_RECEPTION_AGE_S:
            self._present_s = now_s
        if ended_s <= self._present_s:
            self.dropped += 1
            return False
        return True

    def gives(self, ended_s: float, now_s: float) -> bool:
        """Whether to publish a fix made now, whose last frame ended at ``ended_s``; count it if not."""
        self._note(now_s - ended_s)
        if now_s - ended_s > FIX_LEAVES_S:
            self.withheld += 1
            return False
        return True

    @property
    def drops(self) -> Counter[str]:
        """The number of dropped receptions, by reason."""
        return +Counter({"late-reception": self.dropped})

    def drain(self) -> float:
        """Return the largest age since the last call, or 0."""
        largest_s, self._largest_s = self._largest_s, 0.0
        return largest_s

    def _note(self, age_s: float) -> None:
        self._largest_s = max(self._largest_s, age_s)


class Latencies:
    """Latencies since the last reading, in s."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=_MAX_LATENCIES)

    def add(self, latency_s: float) -> None:
        """Add the latency of one fix."""
        self._values.append(latency_s)

    def drain(self) -> tuple[float | None, float | None, int]:
        """Return and reset the median, 99th percentile and number of the latencies."""
        ordered = sorted(self._values)
        self._values.clear()
        if not ordered:
            return None, None, 0
        return ordered[len(ordered) // 2], ordered[min(len(ordered) - 1, (99 * len(ordered)) // 100)], len(ordered)


class PhaseLog:
    """Records when the frames of the current superframe, and of the last complete one, ended and were processed."""

    def __init__(self) -> None:
        self._superframe: int | None = None
        self._begin_s = 0.0
        self._present: list[Phase] = []
        self.last: tuple[Phase, ...] = ()

    def add(self, frame: bytes, ended_s: float, done_s: float, *, made_fix: bool) -> None:
        """Add a frame, with the host's monotonic times of its end and of the end of its processing.

        Frames without slots, from anchors that send at random instants, are ignored.
        """
        beacon = decode_any(frame)
        if not isinstance(beacon, Protocol1Beacon):
            return
        if beacon.superframe != self._superframe:
            self.last = tuple(self._present)
            self._present.clear()
            self._superframe, self._begin_s = beacon.superframe, ended_s
        if len(self._present) >= _MAX_PHASES:
            return
        begin_s = self._begin_s
        self._present.append(
            Phase(beacon.superframe, beacon.slot, beacon.anchor, ended_s - begin_s, done_s - begin_s, made_fix)
        )
