"""What the demo shows: tables while it runs, figures at its end."""

import sys
import time
from shlex import quote
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from skyless.cli.common.output import console
from skyless.mqtt.address import PASSWORD_VARIABLE
from skyless.positioning.integrity import Alert

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import RenderableType
    from rich.live import Live

    from skyless.mqtt.address import MqttAddress
    from skyless.mqtt.messages import FixMessage
    from skyless.nodes.demo import SiteRun, WholeSite
    from skyless.nodes.watch import Watch, WatchedTag


MOST_ALERTS: Final = 3
"""So many tags are named, that the tables stay in view."""
SHOWN_S: Final = 1.0
"""So long an alert is seen, be it of one fix: some come and go with each message of a faulty anchor."""
SPEAKING_S: Final = 3.0
_STYLES: Final = {Alert.EXCLUDED.value: "yellow", Alert.NOT_EXCLUDED.value: "red", Alert.LIMIT.value: "red"}
"""As grave as the page has them."""


class Screen:
    """Draws the tables a few times a second, or never, and sums up."""

    def __init__(self, whole: "WholeSite", *, show: bool) -> None:
        self.stopped_early = True
        self._whole, self._show = whole, show
        self._live: Live | None = None
        self._begun_s: float | None = None
        self._took_s = 0.0

    def __enter__(self) -> Self:
        if self._show:
            from rich.live import Live

            self._live = Live(console=console(), auto_refresh=False)
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def tell_places(self, asked: "SiteRun", *, json: bool) -> None:
        """Say where to look; on standard error when standard output is for a program."""
        whole = self._whole
        lines = [f"page      {whole.page}", f"broker    {whole.address}"]
        if whole.address is not None:
            lines.append(f"fixes     {_subscriber(whole.address)} -t 'skyless/v1/#' -v")
        lines.append(f"air       --radio ether:127.0.0.1:{whole.ether_port}, for tags and anchors of your own")
        if asked.record is not None:
            lines.append(f"recording {asked.record}")
        to = sys.stderr if json else sys.stdout
        if self._live is not None:
            self._live.console.print("\n".join(lines), soft_wrap=True)
        else:
            print("\n".join(lines), file=to, flush=True)

    def begin(self) -> None:
        """All tags have a fix."""
        self._begun_s = time.monotonic()

    def end(self) -> None:
        """The programs are about to be ended."""
        if self._begun_s is not None:
            self._took_s = time.monotonic() - self._begun_s

    def draw(self) -> None:
        """Draw the tables, where there is a terminal."""
        if self._live is not None:
            from rich.console import Group

            self._live.update(Group(self._line(), self.tags(), *self.alerts(), self._anchors()), refresh=True)

    @property
    def _watch(self) -> "Watch | None":
        return self._whole.watch

    def _tags(self) -> "list[tuple[str, WatchedTag]]":
        known = [] if self._watch is None else list(self._watch.tags.items())
        return sorted(known, key=lambda item: (len(item[0]), item[0]))

    def _line(self) -> str:
        sent = 0 if self._watch is None or self._watch.ether is None else self._watch.ether.transmissions
        return f"{sent} beacons on the air; page {self._whole.page}; Ctrl-C stops"

    def tags(self) -> "RenderableType":
        """The table of tags."""
        from rich.table import Table

        columns = ("tag", "x m", "y m", "m/s", "error cm", "sigma cm", "fixes /s", "anch. used", "lost", "late ms")
        table = Table(*columns, title="tags (radio world simulated)")
        for name, tag in self._tags():
            fix, health = tag.fix, tag.health
            speed = None if fix.velocity_mps is None else sum(v * v for v in fix.velocity_mps) ** 0.5
            table.add_row(
                name,
                f"{fix.position_m[0]:.2f}",
                f"{fix.position_m[1]:.2f}",
                _number(speed, "{:.2f}"),
                _number(tag.error_m, "{:.1f}", 100.0),
                f"{100 * fix.std_m:.1f}",
                _number(None if health is None else health.updates_per_s, "{:.0f}"),
                str(len(fix.anchors)),
                "–" if health is None else str(sum(health.counters.values())),
                _number(None if health is None else health.latency_p99_s, "{:.1f}", 1e3),
            )
        return table

    def alerts(self) -> "list[RenderableType]":
        """A line that says whose fixes carry an alert, and how many did so far; none for methods without any."""
        from rich.text import Text

        watch = self._watch
        if watch is None or not watch.alerts:
            return []
        line, since_s = Text("alerts: "), time.monotonic() - SHOWN_S
        shown = [(name, tag.alerted) for name, tag in self._tags() if tag.alerted and tag.alerted_s >= since_s]
        for name, fix in shown[:MOST_ALERTS]:
            without = self._without(fix)
            line.append(f"{name} {fix.alert}{without}", style=_STYLES.get(fix.alert or "", ""))
            line.append(", ")
        line.append("none now" if not shown else f"{len(shown)} of {len(watch.tags)} tags now")
        so_far = _counts(watch.alerts)
        line.append(f"; so far {so_far}" if so_far else "; none so far")
        return [line]

    def _without(self, fix: "FixMessage") -> str:
        """Which anchors on the air an exclusion leaves out of a fix."""
        if fix.alert != Alert.EXCLUDED or self._watch is None:
            return ""
        now_s = time.time()
        speaking = {n for n, health in self._watch.anchors.items() if now_s - health.unix_s < SPEAKING_S}
        out = sorted(speaking.difference(fix.anchors))
        return f" (without {', '.join(map(str, out))})" if out else ""

    def _anchors(self) -> "RenderableType":
        from rich.table import Table

        table = Table("anchor", "role", "heard", "rate ppm", "clock sigma cm", "sent", "late", title="synchronisation")
        anchors = {} if self._watch is None else self._watch.anchors
        for number, health in sorted(anchors.items()):
            table.add_row(
                str(number),
                health.role,
                str(health.heard),
                "–" if health.role == "master" else _number(health.rate_ppm, "{:+.4f}"),
                "–" if health.role == "master" else _number(health.offset_std_m, "{:.2f}", 100.0),
                str(health.sent),
                str(health.late),
            )
        return table

    def summary(self) -> dict[str, Any]:
        """The figures, for a program."""
        tags = [tag for _, tag in self._tags()]
        rates = [rate for tag in tags if (rate := tag.updates_per_s) is not None]
        healths = [tag.health for tag in tags if tag.health is not None]
        firsts = sorted(health.first_fix_s for health in healths if health.first_fix_s is not None)
        return {
            "tags": len(tags),
            "fixes": sum(health.fixes for health in healths),
            **self._errors(),
            "updates_per_s": sum(rates) / len(rates) if rates else None,
            "messages": sum(health.receptions for health in healths),
            "dropped": sum(sum(health.counters.values()) for health in healths),
            "first_fix_s": firsts[len(firsts) // 2] if firsts else None,
            "alerts": {} if self._watch is None else dict(sorted(self._watch.alerts.items())),
            **self._latencies(),
            "late_transmissions": sum(health.late for health in self._watch.anchors.values()) if self._watch else 0,
            "restarts": sum(max(0, child.starts - 1) for child in self._whole.children),
            "duration_s": self._took_s,
            "page": self._whole.page,
            "broker": str(self._whole.address),
        }

    def _errors(self) -> dict[str, float | int | None]:
        watch = self._watch
        found = None if watch is None else watch.errors.summary()
        if watch is None or found is None or not watch.judged:
            return {"judged": 0, "rmse_m": None, "p95_m": None, "max_m": None, "sigma_m": None}
        return {
            "judged": watch.judged,
            "rmse_m": found.rmse_3d_m if found.rmse_2d_m is None else found.rmse_2d_m,
            "p95_m": found.p95_m,
            "max_m": found.max_m,
            "sigma_m": (watch.variance_sum_m2 / watch.judged) ** 0.5,
        }

    def _latencies(self) -> dict[str, float | None]:
        """From the end of a frame on the air to the fix, and to a subscriber of the broker."""
        if self._watch is None:
            return {}
        fix_p50_s, fix_p99_s, _ = self._watch.latencies.drain()
        here_p50_s, here_p99_s, _ = self._watch.arrivals.drain()
        return {
            "fix_latency_p50_s": fix_p50_s,
            "fix_latency_p99_s": fix_p99_s,
            "subscriber_latency_p50_s": here_p50_s,
            "subscriber_latency_p99_s": here_p99_s,
        }

    def closing(self) -> str:
        """The figures, for a person."""
        told = self.summary()
        if not told["tags"]:
            return "no fix was made"
        if told["rmse_m"] is None or told["updates_per_s"] is None:
            return f"{told['tags']} tags with a fix; too short for errors and updates per second"
        return (
            f"{told['tags']} tags, {told['messages']} messages in {told['duration_s']:.1f} s: "
            f"RMSE {100 * told['rmse_m']:.1f} cm, largest error {100 * told['max_m']:.1f} cm, "
            f"{told['updates_per_s']:.0f} updates per second and tag, "
            f"99 % of fixes within {1e3 * (told['fix_latency_p99_s'] or 0.0):.1f} ms of the frame"
            + (f"; alerts: {_counts(told['alerts']) or 'none'}" if told["alerts"] else "")
        )


def _counts(alerts: "Mapping[str, int]") -> str:
    return ", ".join(f"{alert} {count}" for alert, count in sorted(alerts.items()) if alert != Alert.NONE)


def _subscriber(address: "MqttAddress") -> str:
    """How to watch this broker with mosquitto's program."""
    words = ["mosquitto_sub"]
    if address.host != "127.0.0.1":
        words.append(f"-h {address.host}")
    words.append(f"-p {address.port}")
    if address.user is not None:
        words.append(f'-u {quote(address.user)} -P "${PASSWORD_VARIABLE}"')
    if address.tls:
        words.append("--tls-use-os-certs" if address.ca is None else f"--cafile {quote(str(address.ca))}")
    return " ".join(words)


def _number(value: float | None, form: str, scale: float = 1.0) -> str:
    return "–" if value is None else form.format(scale * value)
