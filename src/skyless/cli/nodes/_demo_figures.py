"""Figures of a demo: errors of its fixes against the truth, rates, alerts and latencies."""

import time
from collections import Counter
from typing import Any, Final

from msgspec import Struct

from skyless.cli.nodes._site_view import SiteView
from skyless.core.integrity import Alert
from skyless.run.fix_log import Latencies
from skyless.run.mqtt.messages import AnchorHealth, FixMessage, TagHealth, TruthBuffer, TruthMessage
from skyless.run.mqtt.topics import truth_topic
from skyless.run.process import reader
from skyless.sim.evaluation.figures import ErrorStatistics

_WARMUP_S: Final = 1.0  # fixes of a tag count for the errors from this time after its first

_ALERTS: Final = frozenset(alert.value for alert in Alert)
_ALERT_WORDS: Final[dict[str, str]] = {
    Alert.EXCLUDED: "left out a message that disagreed with the others",
    Alert.NOT_EXCLUDED: "have messages that disagree, and none could be left out",
    Alert.UNAVAILABLE: "had no bound on their error yet",
    Alert.LIMIT: "have a bound on their error above the alert limit",
}


class TagFigures(Struct):
    """What is known of one tag."""

    first_unix_s: float
    error_m: float | None = None
    """Of its newest fix; None where the truth is not known."""
    health: TagHealth | None = None
    began: tuple[float, int] | None = None
    """Time and number of fixes of the first health message that counts."""

    @property
    def updates_per_s(self) -> float | None:
        """Fixes per second between the first and the last health message that count."""
        if self.health is None or self.began is None or self.health.unix_s <= self.began[0]:
            return None
        return (self.health.fixes - self.began[1]) / (self.health.unix_s - self.began[0])


class DemoFigures:
    """Gathered from what a view of the site receives."""

    def __init__(self, *, planar: bool) -> None:
        self.tags: dict[str, TagFigures] = {}
        self.errors = ErrorStatistics(planar=planar)
        self.variance_sum_m2 = 0.0
        self.judged = 0
        self.alerts: Counter[str] = Counter()
        """How often fixes reported each state of their integrity, for methods that report one."""
        self.arrivals = Latencies()  # from the end of a fix's last frame to its arrival in this process
        self.latencies = Latencies()  # from there to the computed fix, as the tags report them
        self._late_transmissions: dict[int, int] = {}  # by anchor
        self._truths = TruthBuffer()

    def follow(self, view: SiteView) -> None:
        """Take what this view receives from now on."""
        view.on_fix.append(self._on_fix)
        view.on_health.append(self._on_health)
        view.link.subscribe(truth_topic(view.number), reader(TruthMessage, self._truths.add, lambda: None))

    def _on_fix(self, fix: FixMessage) -> None:
        self.arrivals.add(time.time() - fix.unix_s)
        self.latencies.add(fix.latency_s)
        tag = self.tags.setdefault(fix.tag, TagFigures(fix.unix_s))
        if fix.alert in _ALERTS:
            self.alerts[fix.alert] += 1
        true_m = self._truths.at(fix.tag, fix.unix_s)
        tag.error_m = None
        if true_m is not None:
            dx, dy, dz = (have - true for have, true in zip(fix.position_m, true_m, strict=True))
            dz = 0.0 if fix.height_known else dz
            tag.error_m = (dx * dx + dy * dy + dz * dz) ** 0.5
            if fix.unix_s - tag.first_unix_s >= _WARMUP_S:
                self.errors.add(dx, dy, dz)
                self.judged += 1
                self.variance_sum_m2 += fix.std_m**2

    def _on_health(self, health: object) -> None:
        if isinstance(health, AnchorHealth):
            self._late_transmissions[health.anchor] = health.late
        elif isinstance(health, TagHealth) and (tag := self.tags.get(health.tag)) is not None:
            restarted = tag.health is not None and health.fixes < tag.health.fixes
            tag.health = health
            if tag.began is None or restarted:
                tag.began = health.unix_s, health.fixes

    def summary(self) -> dict[str, Any]:
        """The figures, for a program."""
        rates = [rate for tag in self.tags.values() if (rate := tag.updates_per_s) is not None]
        healths = [tag.health for tag in self.tags.values() if tag.health is not None]
        firsts = sorted(health.first_fix_s for health in healths if health.first_fix_s is not None)
        dropped = sum((Counter(health.counters) for health in healths), Counter[str]())
        errors = self.errors.summary() if self.judged else None
        fix_p50_s, fix_p99_s, _ = self.latencies.drain()
        here_p50_s, here_p99_s, _ = self.arrivals.drain()
        return {
            "tags": len(self.tags),
            "boards": sum(health.on_board for health in healths),
            "fixes": sum(health.fixes for health in healths),
            "judged": self.judged,
            "rmse_m": None if errors is None else errors.rmse_3d_m if errors.rmse_2d_m is None else errors.rmse_2d_m,
            "p95_m": None if errors is None else errors.p95_m,
            "max_m": None if errors is None else errors.max_m,
            "sigma_m": (self.variance_sum_m2 / self.judged) ** 0.5 if self.judged else None,
            "updates_per_s": sum(rates) / len(rates) if rates else None,
            "messages": sum(health.receptions for health in healths),
            "dropped": dropped.total(),
            "first_fix_s": firsts[len(firsts) // 2] if firsts else None,
            "alerts": dict(sorted(self.alerts.items())),
            # from the end of a frame on the air to the fix, and to a subscriber of the broker
            "fix_latency_p50_s": fix_p50_s,
            "fix_latency_p99_s": fix_p99_s,
            "subscriber_latency_p50_s": here_p50_s,
            "subscriber_latency_p99_s": here_p99_s,
            # what was too old to be used or given
            "late_receptions": dropped["late-reception"],
            "late_fixes": dropped["late-fix"],
            "late_transmissions": sum(self._late_transmissions.values()),
        }


def sentence(summary: dict[str, Any]) -> str:
    """A summary with its ``duration_s``, for a person."""
    if not summary["tags"]:
        return "no fix was made"
    late = ""
    if summary["late_receptions"] or summary["late_fixes"]:
        late = (
            f"; this computer is too slow: {summary['late_receptions']} receptions dropped and "
            f"{summary['late_fixes']} fixes withheld as too old"
        )
    if summary["rmse_m"] is None or summary["updates_per_s"] is None:
        return f"{summary['tags']} tags with a fix; too short for errors and updates per second{late}"
    alerts = ", ".join(f"{n} {_ALERT_WORDS[alert]}" for alert, n in summary["alerts"].items() if alert != Alert.NONE)
    boards = f" ({summary['boards']} of them on emulated boards)" if summary["boards"] else ""
    return (
        f"{summary['tags']} tags{boards}, {summary['messages']} messages in {summary['duration_s']:.1f} s: "
        f"RMSE {100 * summary['rmse_m']:.1f} cm, largest error {100 * summary['max_m']:.1f} cm, "
        f"{summary['updates_per_s']:.0f} updates per second and tag, "
        f"99 % of fixes within {1e3 * (summary['fix_latency_p99_s'] or 0.0):.1f} ms of the frame"
        + (f"; fixes with an alert: {alerts or 'none'}" if summary["alerts"] else "")
        + late
    )
