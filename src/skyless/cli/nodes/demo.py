"""``skyless demo``: a whole site as it runs, with emulated radios, from one command."""

import asyncio
import contextlib
import sys
import time
from collections import Counter
from pathlib import Path
from shlex import quote
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Any, Final, Self

from cyclopts import App, Parameter

from skyless.cli.common.options import command
from skyless.cli.common.output import console, number, print_json
from skyless.cli.nodes.options import MqttCa, WalkingSpeed, check_live, log, site_named
from skyless.core.alert import Alert
from skyless.core.arguments import Method, Picoseconds, Positive, Seed, whole
from skyless.core.errors import SkylessError
from skyless.core.extras import extra_module
from skyless.core.method_names import DEFAULT_METHOD
from skyless.run.mqtt.address import PASSWORD_VARIABLE
from skyless.sim.evaluation.request import ProtectionOptions

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import RenderableType
    from rich.live import Live

    from skyless.cli.demo import SiteRun, WholeSite
    from skyless.cli.watch import Watch, WatchedTag
    from skyless.run.mqtt.address import MqttAddress
    from skyless.run.mqtt.messages import FixMessage

_LONGEST_START_S: Final = 60.0
"""Programs that have not made a fix for every tag by then will not."""

_POLL_S: Final = 0.05
_FRAME_S: Final = 0.25
"""Time between two drawings of the tables."""

MAX_ALERTS: Final = 3
"""Tags named in the line of alerts, so that the tables stay in view."""

ALERT_SHOWN_S: Final = 1.0
"""How long an alert is shown, even if only one fix has it: some come and go with each message of a faulty anchor."""

_SENDING_S: Final = 3.0
"""An anchor whose health is not older than this is on the air."""

_STYLES: Final = {Alert.EXCLUDED.value: "yellow", Alert.NOT_EXCLUDED.value: "red", Alert.LIMIT.value: "red"}
"""The colours of the page."""

app = App(name="demo", help_epilogue="Example: skyless demo --duration 10 --json")


class DemoOptions(ProtectionOptions, frozen=True, kw_only=True):
    """Options of ``skyless demo``."""

    duration: Positive | None = None
    """Seconds to run, from when all tags have a fix; by default until Ctrl-C."""
    tags: Annotated[int, whole(1, 200)] = 3
    """How many tags walk."""
    speed: WalkingSpeed = 1.0
    """How fast they walk in m/s."""
    noise_ps: Picoseconds = 100.0
    """Noise of every TX and RX stamp in picoseconds."""
    seed: Seed = 1
    """Same seed, same crystals and noise; what processes do in real time is never the same."""
    carrier: bool = False
    """Let radios measure the phase of the carrier, as a DW1000 can."""
    site: Path | None = None
    """Site file; by default the lab, six anchors on the walls of 6 m × 8 m."""
    paper: bool = False
    """Use the paper's protocol for the lab: one anchor is the master, and another takes over when it fails."""
    method: Method = DEFAULT_METHOD
    """How positions are computed."""
    apart: bool = False
    """Run every anchor and every tag as a process of its own, to kill and to freeze."""
    mqtt: Annotated[str | None, Parameter(env_var="SKYLESS_MQTT")] = None
    """Broker to use instead of the embedded one."""
    mqtt_ca: MqttCa = None
    """Certificates (PEM) to trust for mqtts."""
    record: str | None = None
    """File for the recording, .mcap, or none; by default one in the folder that the page shows."""
    history: Path | None = None
    """Folder of the history to keep, which the page then asks; by default none."""
    json: bool = False
    """Write one JSON object at the end instead of the tables."""


@app.default
@command
def demo(*, asked: DemoOptions) -> None:
    """Run a site with walking tags in real time; Ctrl-C stops.

    Anchors, tags, broker, page and recorder are the real programs, each a process; radios, clocks and motion are
    simulated. Watch it on the page, or with: mosquitto_sub -t 'skyless/#' -v
    """
    from skyless.cli.demo import WholeSite
    from skyless.run.process import run

    settings = _settings(asked)
    whole = WholeSite(settings, log)
    screen = Screen(whole, show=not asked.json and sys.stdout.isatty())
    with screen, contextlib.suppress(KeyboardInterrupt):
        run(_run(whole, settings, screen, asked))
    _report(screen, json=asked.json)


def _settings(asked: DemoOptions) -> "SiteRun":
    from skyless.cli.demo import SiteRun
    from skyless.run.mqtt.address import mqtt_address
    from skyless.run.process import recordings_folder

    if asked.mqtt == "none":
        raise SkylessError("--mqtt is 'none'; the demo needs a broker, and brings one where --mqtt is not given")
    if asked.mqtt is None and asked.mqtt_ca is not None:
        raise SkylessError("--mqtt-ca is for another broker; give it together with --mqtt")
    if asked.paper and asked.site is not None:
        raise SkylessError("--paper is for the demo's own site; the mode of a site file stands in it (schedule.mode)")
    lab = "paper" if asked.paper else "lab"
    name = f"{lab}:{asked.noise_ps:g}" if asked.site is None else str(asked.site.absolute())
    site = site_named(name)
    check_live(site, asked.method)
    folder = recordings_folder()
    if asked.history is not None:
        extra_module("pyarrow", "--history")
        try:
            asked.history.mkdir(parents=True, exist_ok=True)  # the page asks it before the history's first file
        except OSError as error:
            raise SkylessError(f"--history is {str(asked.history)!r}, which is no folder: {error.strerror}") from None
    return SiteRun(
        site=site,
        site_name=name,
        tags=asked.tags,
        speed_mps=asked.speed,
        noise_ps=asked.noise_ps,
        seed=asked.seed,
        method=asked.method,
        integrity=asked.requirement(asked.method),
        broker=None if asked.mqtt is None else mqtt_address(asked.mqtt, asked.mqtt_ca),
        record=_recording(asked.record, folder),
        record_limit_mb=1000.0,
        apart=asked.apart,
        recordings=folder,
        carrier=asked.carrier,
        history=None if asked.history is None else asked.history.absolute(),
    )


def _recording(asked: str | None, folder: Path) -> Path | None:
    """Where to record; None: nowhere. Raises SkylessError."""
    from skyless.run.process import new_recording

    if asked == "none":
        return None
    file = new_recording(folder, "demo") if asked is None else Path(asked)
    if file.exists() or not file.parent.is_dir():
        raise SkylessError(f"--record is {asked!r}; it should be a new file in a folder that exists, or none")
    return file


async def _run(whole: "WholeSite", settings: "SiteRun", screen: "Screen", asked: DemoOptions) -> None:
    """Start everything, print its addresses, and watch for as long as was asked."""
    site = asyncio.ensure_future(whole.run())
    try:
        await _either(site, whole.ready.wait())
        screen.print_addresses(settings, json=asked.json)
        await _either(site, _until_all_fix(whole, asked.tags))
        screen.begin()
        await _either(site, _watch(screen, asked.duration))
        screen.stopped_early = False
    finally:
        screen.end()
        site.cancel()
        await asyncio.gather(site, return_exceptions=True)


async def _either(site: "asyncio.Task[None]", part: object) -> None:
    """Wait for a part, unless the site fails first."""
    waiting = asyncio.ensure_future(part)  # type: ignore[call-overload]
    try:
        await asyncio.wait((site, waiting), return_when=asyncio.FIRST_COMPLETED)
        if site.done():
            site.result()
        if waiting.done():
            waiting.result()
    finally:
        waiting.cancel()


async def _until_all_fix(whole: "WholeSite", tags: int) -> None:
    """Until a fix and the health of every tag have arrived."""
    begun_s = time.monotonic()
    while time.monotonic() - begun_s < _LONGEST_START_S:
        known = whole.watch.tags.values() if whole.watch is not None else ()
        if sum(tag.health is not None for tag in known) >= tags:
            return
        await asyncio.sleep(_POLL_S)
    log("not all tags have a fix yet; skyless/… on the broker and the page show more")


async def _watch(screen: "Screen", duration: float | None) -> None:
    begun_s = time.monotonic()
    while duration is None or time.monotonic() - begun_s < duration:
        screen.draw()
        left_s = _FRAME_S if duration is None else begun_s + duration - time.monotonic()
        await asyncio.sleep(min(max(left_s, 0.0), _FRAME_S))


def _report(screen: "Screen", *, json: bool) -> None:
    if screen.stopped_early:
        log("stopped")
    if json:
        print_json(screen.summary())
        return
    if not sys.stdout.isatty():
        console().print(screen.tags())
    console().print(screen.closing(), soft_wrap=True)


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

    def print_addresses(self, settings: "SiteRun", *, json: bool) -> None:
        """Print where everything is; on standard error when standard output is for a program."""
        whole = self._whole
        lines = [f"page      {whole.page}", f"broker    {whole.address}"]
        if whole.address is not None:
            lines.append(f"fixes     {_subscriber(whole.address)} -t 'skyless/v1/#' -v")
        lines.append(f"air       --radio ether:127.0.0.1:{whole.ether_port}, for tags and anchors of your own")
        if settings.record is not None:
            lines.append(f"recording {settings.record}")
        if self._live is not None:
            self._live.console.print("\n".join(lines), soft_wrap=True)
        else:
            print("\n".join(lines), file=sys.stderr if json else sys.stdout, flush=True)

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
        late = _late(self._late())
        return f"{sent} beacons on the air{late and f'; {late}'}; page {self._whole.page}; Ctrl-C stops"

    def _late(self) -> dict[str, int]:
        """What the tags dropped and withheld because it was too old."""
        late = Counter[str]()
        for _, tag in self._tags():
            if tag.health is not None:
                late.update({name: tag.health.counters.get(name, 0) for name in ("late-reception", "late-fix")})
        return {"late_receptions": late["late-reception"], "late_fixes": late["late-fix"]}

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
                number(speed, "{:.2f}"),
                number(tag.error_m, "{:.1f}", 100.0),
                f"{100 * fix.std_m:.1f}",
                number(None if health is None else health.updates_per_s, "{:.0f}"),
                str(len(fix.anchors)),
                "–" if health is None else str(sum(health.counters.values())),
                number(None if health is None else health.latency_p99_s, "{:.1f}", 1e3),
            )
        return table

    def alerts(self) -> "list[RenderableType]":
        """A line with the tags whose fixes carry an alert, and how many did so far; none for methods without any."""
        from rich.text import Text

        watch = self._watch
        if watch is None or not watch.alerts:
            return []
        line, since_s = Text("alerts: "), time.monotonic() - ALERT_SHOWN_S
        shown = [(name, tag.alerted) for name, tag in self._tags() if tag.alerted and tag.alerted_s >= since_s]
        for name, fix in shown[:MAX_ALERTS]:
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
        sending = {n for n, health in self._watch.anchors.items() if now_s - health.unix_s < _SENDING_S}
        out = sorted(sending.difference(fix.anchors))
        return f" (without {', '.join(map(str, out))})" if out else ""

    def _anchors(self) -> "RenderableType":
        from rich.table import Table

        anchors = {} if self._watch is None else self._watch.anchors
        has_master = any(health.mode == "master" for health in anchors.values())
        clock = ("rate ppm", "clock sigma cm") if has_master else ()
        title = "synchronisation" if has_master else "anchors"
        table = Table("anchor", "role", "heard", *clock, "sent", "late", title=title)
        now_s = time.time()
        for anchor, health in sorted(anchors.items()):
            role = health.role if now_s - health.unix_s < _SENDING_S else "offline"
            own = number(health.rate_ppm, "{:+.4f}"), number(health.offset_std_m, "{:.2f}", 100.0)
            cells = (("–", "–") if role == "master" else own) if has_master else ()
            table.add_row(str(anchor), role, str(health.heard), *cells, str(health.sent), str(health.late))
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
            **self._late(),
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
        found = self.summary()
        if not found["tags"]:
            return "no fix was made"
        late = f"; {found_late}" if (found_late := _late(found)) else ""
        if found["rmse_m"] is None or found["updates_per_s"] is None:
            return f"{found['tags']} tags with a fix; too short for errors and updates per second{late}"
        return (
            f"{found['tags']} tags, {found['messages']} messages in {found['duration_s']:.1f} s: "
            f"RMSE {100 * found['rmse_m']:.1f} cm, largest error {100 * found['max_m']:.1f} cm, "
            f"{found['updates_per_s']:.0f} updates per second and tag, "
            f"99 % of fixes within {1e3 * (found['fix_latency_p99_s'] or 0.0):.1f} ms of the frame"
            + (f"; alerts: {_counts(found['alerts']) or 'none'}" if found["alerts"] else "")
            + late
        )


def _late(found: "Mapping[str, Any]") -> str:
    """What was too old to be used or given, for a person; empty where there is nothing."""
    receptions, fixes = found["late_receptions"], found["late_fixes"]
    if not receptions and not fixes:
        return ""
    return f"this computer is too slow: {receptions} receptions dropped and {fixes} fixes withheld as too old"


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
