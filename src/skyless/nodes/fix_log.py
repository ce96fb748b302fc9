"""What a tag's program keeps of its fixes: their numbers, latencies and Unix times; what of them goes onto MQTT."""

import time
from collections.abc import Callable, Mapping

from skyless.mqtt.fix_message import fix_message
from skyless.mqtt.messages import Counters, FixMessage, Phase, TagHealth
from skyless.nodes.latency import Latencies
from skyless.nodes.process.running import HEALTH_S
from skyless.nodes.publish_rate import Pace
from skyless.positioning.fix import Fix

FixListener = Callable[[FixMessage], None]


class FixLog:
    """Numbers, times and publishes the fixes of one tag, from the first one on, whatever its radio does."""

    def __init__(self, tag: str, publish: FixListener, publish_hz: float) -> None:
        """``publish`` is given so many of the fixes a second at most; all of them count."""
        self.tag = tag
        self.started_s = time.monotonic()
        self.unix_less_host_s = 0.0
        self.tie_clocks()
        self.serial = 0
        """Number of the newest fix: how many there were."""
        self.first_fix_s: float | None = None
        """Since the start."""
        self.last_fix_s: float | None = None
        """When the last fix was made, by the host's monotonic clock."""
        self.latencies = Latencies()
        self._told = 0
        self._publish, self._pace = publish, Pace(publish_hz)

    def tie_clocks(self) -> None:
        """Ask again how far Unix time is from the host's monotonic clock: it is set now and then."""
        self.unix_less_host_s = time.time() - time.monotonic()

    def take(self, fix: Fix, ended_s: float, done_s: float) -> None:
        """Take a fix: when its last frame ended, and when it was made, by the host's monotonic clock."""
        self.serial += 1
        self.last_fix_s = done_s
        self.latencies.add(done_s - ended_s)
        if self.first_fix_s is None:
            self.first_fix_s = done_s - self.started_s
        if self._pace.is_due(ended_s):
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
    ) -> TagHealth:
        """How the tag has done since this was last asked; ``reason``: why there is no fix, where there is none."""
        now_s = time.monotonic()
        median_s, late_s, _ = self.latencies.take()
        fixes, self._told = self.serial - self._told, self.serial
        silent = self.last_fix_s is None or now_s - self.last_fix_s > HEALTH_S
        return TagHealth(
            tag=self.tag,
            unix_s=time.time(),
            uptime_s=now_s - self.started_s,
            method=method,
            receptions=receptions,
            fixes=self.serial,
            updates_per_s=fixes / HEALTH_S,
            reason=reason if silent else None,
            first_fix_s=self.first_fix_s,
            latency_p50_s=median_s,
            latency_p99_s=late_s,
            counters=dict(counters),
            mqtt=mqtt,
            cpu=cpu,
            memory_bytes=memory_bytes,
            phases=phases,
        )
