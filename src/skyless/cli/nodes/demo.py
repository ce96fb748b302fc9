"""``skyless demo``: a whole site as it runs, with emulated radios, from one command."""

import asyncio
import contextlib
import sys
import time
from collections import Counter, deque
from collections.abc import Awaitable, Mapping
from importlib.util import find_spec
from itertools import combinations
from math import dist
from pathlib import Path
from shlex import quote
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Final
from zlib import crc32

import msgspec
from cyclopts import App, Parameter
from msgspec import Struct
from msgspec.structs import replace

from skyless.arguments import Method, Picoseconds, Positive, Seed, TagCount, tag_count, whole
from skyless.cli.common import JsonOptions, command, console, make_folder, print_json
from skyless.cli.nodes.options import MqttCa, WalkingSpeed, check_live, log, run_until_stopped, site_named
from skyless.cli.nodes.site_view import Picture, SiteView, drawn
from skyless.core.alert import Alert
from skyless.core.any_anchor import beacon_period_s
from skyless.core.errors import SkylessError
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.site import AlarmRule, FloorPlanSite, GeoreferenceSite, Site
from skyless.files import replace_files
from skyless.machine import extra_module
from skyless.run.broker import Broker, BrokerSettings, start_broker
from skyless.run.condition.evidence import ProcessorUse
from skyless.run.fix_log import Latencies
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import PASSWORD_VARIABLE, MqttAddress, mqtt_address
from skyless.run.mqtt.connection import Introduction, RefusedError, kept_messages, open_connection, trouble_with
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import (
    AnchorHealth,
    Asset,
    AssetsMessage,
    EtherHealth,
    FixMessage,
    StatusMessage,
    TagHealth,
    TruthBuffer,
    TruthMessage,
    WrongMessageError,
    Zone,
    ZonesMessage,
    read_message,
)
from skyless.run.process import (
    Child,
    Log,
    Program,
    data_folder,
    hold_any,
    outlasting,
    recordings_folder,
    reserve_next,
    together,
)
from skyless.run.site_table import Health
from skyless.sim.evaluation.figures import ErrorStatistics
from skyless.sim.evaluation.request import ProtectionOptions
from skyless.sim.lab import lab_site
from skyless.site.file.template import rectangle, site_template
from skyless.site.survey.facts import PairRange, PairRanges, Survey, SurveyedAnchor
from skyless.site.survey.surveyed_site import SurveyRecord, encode_record, record_path

if TYPE_CHECKING:
    from rich.console import RenderableType


# Figures of a demo: errors of its fixes against the truth, rates, alerts and latencies.

_WARMUP_S: Final = 1.0  # a tag's fixes count for the errors only this long after its first

_ALERTS: Final = frozenset(alert.value for alert in Alert)
_ALERT_WORDS: Final[dict[str, str]] = {
    Alert.EXCLUDED: "left out a message that disagreed with the others",
    Alert.NOT_EXCLUDED: "have messages that disagree, and none could be left out",
    Alert.UNAVAILABLE: "had no bound on their error yet",
    Alert.LIMIT: "have a bound on their error above the alert limit",
}


class TagFigures(Struct):
    """Figures of one tag."""

    first_unix_s: float
    error_m: float | None = None
    """Error of the newest fix; None if the truth is unknown."""
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
    """Figures of a demo, from what a view of the site receives."""

    def __init__(self, *, planar: bool) -> None:
        self.tags: dict[str, TagFigures] = {}
        self.errors = ErrorStatistics(planar=planar)
        self.variance_sum_m2 = 0.0
        self.judged = 0
        self.alerts: Counter[str] = Counter()
        """Number of fixes with each state of integrity, for methods that report one."""
        self.arrivals = Latencies()  # from the end of a fix's last frame to its arrival in this process
        self.latencies = Latencies()  # from the end of that frame to the computed fix, as the tags report them
        self._late_transmissions: dict[int, int] = {}  # by anchor
        self._truths = TruthBuffer()

    def follow(self, view: SiteView) -> None:
        """Collect figures from what this view receives from now on."""
        view.feed.on(FixMessage, lambda fix, _: self._on_fix(fix))
        for kind in (TagHealth, AnchorHealth):
            view.feed.on(kind, lambda health, _: self._on_health(health))
        view.feed.on(TruthMessage, lambda truth, _: self._truths.add(truth))

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
        """The figures for JSON."""
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
            # From the end of a frame on the air to the fix, and to a subscriber of the broker.
            "fix_latency_p50_s": fix_p50_s,
            "fix_latency_p99_s": fix_p99_s,
            "subscriber_latency_p50_s": here_p50_s,
            "subscriber_latency_p99_s": here_p99_s,
            # Too old to be used or published.
            "late_receptions": dropped["late-reception"],
            "late_fixes": dropped["late-fix"],
            "late_transmissions": sum(self._late_transmissions.values()),
        }


def sentence(summary: dict[str, Any]) -> str:
    """Describe a summary in a sentence."""
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


# Furnishings of the demo's own site: a plan, zones, names, an alarm rule, a georeference, a moved anchor.

_PLAN: Final = Path(__file__).with_name("demo_plan.png")
_CELL: Final = Zone("cell", "Robot cell", ((3.7, 0.4), (5.7, 0.4), (5.7, 2.7), (3.7, 2.7)), "#c2410c")
_GOODS_IN: Final = Zone("goods-in", "Goods in", ((0.3, 5.3), (2.7, 5.3), (2.7, 7.7), (0.3, 7.7)), "#0f766e")
_PEOPLE: Final = "people"
_ASSETS: Final = (
    Asset("tag1", "Trolley", "vehicles", "▲", "#b45309"),
    Asset("tag2", "Forklift", "vehicles", "◆", "#7c3aed"),
    Asset("tag3", "Ada", _PEOPLE, "●", "#0284c7"),
)
_RULE: Final = AlarmRule(
    "robot-cell", "inside", "Person in the robot cell", zone=_CELL.id, tags=(f"group:{_PEOPLE}",), severity="critical"
)
MOVED: Final = "3=0,0.6@60"
"""Move of an anchor after a minute, for ``skyless ether --move``."""


def furnished(lab: Site) -> Site:
    """The lab as a workshop, at an invented place on the Earth."""
    return replace(
        lab,
        name="Workshop",
        outline_m=rectangle(6.0, 8.0),
        floor_plan=FloorPlanSite(str(_PLAN), width_m=6.0),
        georeference=GeoreferenceSite(52.5163, 13.3777, height_m=35.0, heading_deg=20.0),
        alarms=(_RULE,),
    )


def survey_record(site: Site) -> SurveyRecord:
    """An error-free survey of the site, whose ranges spare the watch learning the usual ones."""
    pairs = tuple(
        PairRange(a.id, b.id, dist((a.x_m, a.y_m, a.z_m), (b.x_m, b.y_m, b.z_m)), std_m=0.005, exchanges=1000)
        for a, b in combinations(site.anchors, 2)
    )
    anchors = tuple(SurveyedAnchor(one.id, True, one.x_m, one.y_m, one.z_m) for one in site.anchors)
    ranges = PairRanges(pairs, tuple(one.id for one in site.anchors))
    survey = Survey(anchors, (), 0.01, len(pairs) - 2 * len(anchors) + 3)
    return SurveyRecord(site.name, site.id, 0.0, ranges, survey, {})


def messages_of(site: Site) -> dict[str, bytes]:
    """Retained messages by topic, as the page would publish them: zones, and the tags' names."""
    return {
        topics.zones_topic(site.id): msgspec.json.encode(ZonesMessage((_CELL, _GOODS_IN), site=site.name)),
        topics.assets_topic(site.id): msgspec.json.encode(AssetsMessage(_ASSETS, site=site.name)),
    }


_NAME: Final = "demo"
_HOST: Final = "127.0.0.1"
_PAGE_PORT: Final = 8080
_TAGS_PER_PROCESS: Final = 25
_KEEPALIVE_S: Final = 10

_SLOW_SHARE: Final = 0.1
_SLOW_FOR: Final = 8
"""The emulated air is too slow if it misses this share of the transmissions, averaged over this many seconds."""
_LEAST_RATE_HZ: Final = 15.0
"""Least beacons per second of each anchor, as a busy computer would miss some even at lower rates."""

_SURVEY_DELAY_S: Final = 4.0
"""Delay of the survey's start: nothing waits for it, and it would delay the first fix by a second on two cores."""


class DemoOptions(ProtectionOptions, frozen=True, kw_only=True):
    """Options of ``skyless demo``."""

    duration: Positive | None = None
    """Seconds to run, from when all tags have a fix; by default until Ctrl-C."""
    tags: Annotated[int, *tag_count(1, 200)] = TagCount(3)
    """How many tags walk, 3 by default; at a site of several floors on each in turn, or on the one that is named."""
    boards: Annotated[int, whole(0, 200)] = 0
    """How many of them, the last ones, are emulated boards that compute by themselves, with settings of new ones."""
    speed: WalkingSpeed = 1.0
    """How fast they walk in m/s."""
    noise_ps: Picoseconds = 100.0
    """Noise of every TX and RX stamp in picoseconds."""
    seed: Seed = 1
    """Same seed, same crystals and noise; what processes do in real time is never the same."""
    carrier: bool = False
    """Let radios measure the phase of the carrier, as a DW1000 can."""
    site: Path | None = None
    """Site file; by default a workshop, six anchors on the walls of 6 m × 8 m, with a plan, zones, names, a rule of
    alarms, a history, and an anchor that is hung elsewhere after a minute."""
    plain: bool = False
    """Show the same six anchors and walking tags, and nothing else."""
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
    """Folder of the history to keep, which the page then asks; by default the workshop's ends with the demo, and
    other sites have none."""


class WholeSite:
    """All programs of a demo, started and kept alive."""

    def __init__(self, asked: DemoOptions, log: Log) -> None:
        """Raises SkylessError."""
        _check(asked)
        self._asked, self._log = asked, log
        self._ports = TemporaryDirectory(prefix="skyless-demo-")
        self._own_file = Path(self._ports.name, "demo.toml") if asked.site is None and not asked.paper else None
        """File of the demo's own site, whose beacon rate is lowered on a slow computer; None for another site."""
        self._has_story = self._own_file is not None and not asked.plain
        self._missed_shares: deque[float] = deque(maxlen=_SLOW_FOR)
        self._site_name = f"paper:{asked.noise_ps:g}" if asked.site is None else str(asked.site.absolute())
        if self._own_file is not None:
            lab = lab_site(asked.noise_ps)
            self._site_name = str(self._own_file)
            self._own_file.write_text(site_template(furnished(lab) if self._has_story else lab), encoding="utf-8")
        self.site = site_named(self._site_name)
        if self._has_story:
            record_path(self._site_name).write_bytes(encode_record(survey_record(self.site)))
        self._number = "--site-id", str(self.site.id)
        check_live(self.site, asked.method)
        if asked.boards and self.site.schedule.mode != "free":
            raise SkylessError(f"--boards is {asked.boards}; it should be 0 at a site with a master: boards know none")
        self.history = asked.history
        if asked.history is not None:
            extra_module("duckdb", "--history")
        elif self._has_story and find_spec("duckdb"):
            self.history = Path(self._ports.name, "history")
        if self.history is not None:
            make_folder("--history", self.history)  # the page asks it before the history's first file
        self.address = None if asked.mqtt is None else mqtt_address(asked.mqtt, asked.mqtt_ca)
        self._recordings = recordings_folder()
        self.recording = _recording(asked.record, self._recordings)
        self.ether_port, self._ether_held = hold_any(_HOST)
        self.page_port, self._page_held = reserve_next(_HOST, _PAGE_PORT)
        tags = [f"tag{number}" for number in range(1, asked.tags + 1)]
        self._tags = tags[: asked.tags - asked.boards]
        self.boards = {tag: Path(self._ports.name, tag) for tag in tags[len(self._tags) :]}
        """Serial ports of the tags that are emulated boards."""
        which = self._site_name if asked.site is not None else f"{asked.plain} {asked.paper}"
        self.kept_as = f"{self.site.id}-{crc32(which.encode()):08x}"
        """Suffix of the embedded broker's folder: one for each site file, or kind of demo."""
        self.keeps = asked.mqtt is None and (asked.site is not None or asked.history is not None)
        """Whether the embedded broker keeps names, zones and rules for the next demo."""
        self.figures = DemoFigures(planar=self.site.tags.height_m is not None)
        self.view: SiteView | None = None
        self.children: list[Child] = []
        self.ready = asyncio.Event()  # the broker is there and the page is starting

    @property
    def gone(self) -> str:
        """Data that will be lost at the end of the demo, in words; empty if none."""
        ended = [] if self._asked.mqtt is not None or self.keeps else ["names", "zones"]
        ended += ["history"] if self.history is not None and self._asked.history is None else []
        return " and ".join(", ".join(ended).rsplit(", ", 1))

    @property
    def page(self) -> str:
        """Address of the page."""
        return f"http://{_HOST}:{self.page_port}"

    async def run(self) -> None:
        """Keep everything alive until cancelled. Raises SkylessError if the embedded broker cannot be started."""
        with self._ether_held, self._page_held, self._ports:
            if self.address is not None:
                await self._run_with(self.address, None)
            else:
                broker = await self._own_broker()
                await self._run_with(broker.address, broker)

    async def _own_broker(self) -> Broker:
        """Start the embedded broker, with a permanent store if ``keeps`` and possible, else a temporary one."""
        if self.keeps:
            try:
                return await start_broker(BrokerSettings(data=data_folder() / f"demo-{self.kept_as}"))
            except SkylessError as error:
                self._log(f"names, zones and rules end with this demo: {error}")
                self.keeps = False
        return await start_broker(BrokerSettings(temporary=True))

    async def _run_with(self, address: MqttAddress, broker: Broker | None) -> None:
        self.address = address
        story = messages_of(self.site) if self._has_story else {}
        whole = self._run_programs(address, story, is_new=broker is not None and not self.keeps)
        if broker is None or self.keeps:
            own = story if broker is None else {}
            whole = outlasting(_cleared_at_the_end(address, self.site.id, own, self._log), whole)
        await (whole if broker is None else outlasting(self._keep(broker), whole))  # they publish their end to it

    async def _run_programs(self, address: MqttAddress, story: Mapping[str, bytes], *, is_new: bool) -> None:
        if story:
            await _place(address, story, self._log, is_new=is_new)
        link = Link(address, _NAME, site=self.site.id, kind="watch")
        self.view = SiteView(link, self.site.id, used_share=ProcessorUse().share)
        self.figures.follow(self.view)
        self.view.feed.on(EtherHealth, lambda health, _: self._on_health(health))
        self.children = [Child(program, self._log) for program in self._programs(address)]
        self.ready.set()
        await outlasting(link.run(), together(*(child.run() for child in self.children)))  # its end is published

    def _on_health(self, health: Health) -> None:
        """Lower the beacon rate of the demo's own site if the emulated air does not keep up."""
        if self._own_file is None or not isinstance(health, EtherHealth) or len(self.figures.tags) < self._asked.tags:
            return
        self._missed_shares.append(health.missed_share)
        rate_hz = 1.0 / beacon_period_s(self.site)
        if sum(self._missed_shares) < _SLOW_SHARE * _SLOW_FOR or rate_hz <= _LEAST_RATE_HZ:
            return
        self._missed_shares.clear()
        slower_hz = max(rate_hz / 1.5, _LEAST_RATE_HZ)
        self.site = replace(self.site, schedule=replace(self.site.schedule, rate_hz=slower_hz))
        replace_files({self._own_file: site_template(self.site).encode()})
        self._log(f"a slow computer: from now on each anchor sends {slower_hz:.0f} beacons a second, not {rate_hz:.0f}")
        for child in self.children:
            if child.program.arguments[0] == "anchor":
                child.restart()

    async def _keep(self, broker: Broker) -> None:
        """Restart the embedded broker, on the same port and with the same store, whenever it ends."""
        settings = BrokerSettings(port=broker.address.port, data=broker.data)
        try:
            while True:
                code = await broker.wait()
                self._log(f"broker ended (exit code {code}); started again")
                await broker.stop(to_restart=True)
                await asyncio.sleep(0.2)
                broker = await start_broker(settings)
        finally:
            await asyncio.shield(broker.stop())

    def _programs(self, address: MqttAddress) -> list[Program]:
        asked, mqtt = self._asked, _mqtt(address)
        radio, site = ("--radio", f"ether:{_HOST}:{self.ether_port}"), ("--site", self._site_name)
        walks = _options(tags=_tags_text(asked.tags), speed=asked.speed, noise_ps=asked.noise_ps, seed=asked.seed)
        ether = ("ether", *site, *mqtt, "--listen", f"{_HOST}:{self.ether_port}", *walks)
        ether += ("--move", MOVED) * self._has_story + ("--carrier",) * asked.carrier
        computing = _options(
            method=asked.method, integrity_risk=asked.integrity_risk, alert_limit_m=asked.alert_limit_m
        )
        anchors = [str(anchor.id) for anchor in self.site.anchors]
        known = site if self._has_story else ()
        programs = [
            Program("ether", ether),
            *(
                Program(_named("anchor", some), ("anchor", *some, *site, *radio, *mqtt))
                for some in _groups(anchors, 1 if asked.apart else len(anchors))
            ),
            *(
                Program(_named("tag", some), ("tag", *some, *radio, *mqtt, *computing))
                for some in _groups(self._tags, 1 if asked.apart else _TAGS_PER_PROCESS)
            ),
            *(
                Program(f"board {tag}", ("board", tag, *radio, "--link", str(port)))
                for tag, port in self.boards.items()
            ),
            *(
                Program(f"tag {tag}", ("tag", tag, "--radio", f"serial:{port}", "--from-board", *mqtt))
                for tag, port in self.boards.items()
            ),
            Program("survey", ("survey", "--serve", *mqtt, *self._number, *known), start_after_s=_SURVEY_DELAY_S),
        ]
        if self.recording is not None:
            limit = ("--limit-mb", "1000")
            programs.append(Program("recorder", ("record", str(self.recording), *mqtt, *limit, *self._number), 1))
        if self.history is not None:
            history = ("history", "run", "--to", str(self.history), *self._number, *mqtt)
            programs.append(Program("history", history, start_after_s=_SURVEY_DELAY_S, logs_lines=True))
        shown = _options(recordings=self._recordings, history=self.history)
        page = ("dashboard", *mqtt, "--listen", f"{_HOST}:{self.page_port}", *shown, *self._number)
        return [*programs, Program("page", page)]


def _check(asked: DemoOptions) -> None:
    """Check that the options are compatible. Raises SkylessError."""
    if asked.mqtt == "none":
        raise SkylessError("--mqtt is 'none'; the demo needs a broker, and brings one where --mqtt is not given")
    if asked.mqtt is None and asked.mqtt_ca is not None:
        raise SkylessError("--mqtt-ca is for another broker; give it together with --mqtt")
    if asked.paper and asked.site is not None:
        raise SkylessError("--paper is for the demo's own site; the mode of a site file stands in it (schedule.mode)")
    if asked.plain and asked.site is not None:
        raise SkylessError("--plain is for the demo's own site; a site file has what it has")
    if asked.boards > asked.tags:
        raise SkylessError(f"--boards is {asked.boards}; it should be at most --tags, which is {asked.tags}")
    asked.requirement(asked.method)


def _recording(asked: str | None, folder: Path) -> Path | None:
    """File of the recording; None for none. Raises SkylessError."""
    if asked == "none":
        return None
    file = folder / time.strftime("demo-%Y%m%d-%H%M%S.mcap") if asked is None else Path(asked)
    if file.exists() or not file.parent.is_dir():
        raise SkylessError(f"--record is {asked!r}; it should be a new file in a folder that exists, or none")
    return file


async def _place(address: MqttAddress, messages: Mapping[str, bytes], log: Log, *, is_new: bool) -> None:
    """Publish retained messages, unless the broker already has others. ``is_new``: the broker is known to have none."""
    try:
        there = {} if is_new else await kept_messages(address, messages)
        await _publish(address, {topic: text for topic, text in messages.items() if not there.get(topic)})
    except (OSError, RefusedError) as error:
        log(f"{trouble_with(address, error)}: it gets no zones and names")


async def _publish(address: MqttAddress, messages: Mapping[str, bytes]) -> None:
    connection = await open_connection(address, address.tls_context(), Introduction("", _KEEPALIVE_S))
    for topic, text in messages.items():
        connection.publish(topic, text, 1, retain=True)
    await connection.leave()


async def _cleared_at_the_end(address: MqttAddress, site: int, own: Mapping[str, bytes], log: Log) -> None:
    """Wait until cancelled, then clear the retained messages that the site's ended programs have left at the broker.

    ``own``: messages of the demo, which are also cleared unless somebody has changed them.
    """
    try:
        await asyncio.Event().wait()
    finally:
        try:
            await asyncio.shield(_clear_retained(address, site, own))
        except (OSError, RefusedError) as error:
            log(f"{trouble_with(address, error)}: the demo's site stays there")


async def _clear_retained(address: MqttAddress, site: int, own: Mapping[str, bytes]) -> None:
    of_site = [topics.site_topic(site), topics.survey_topic(site), topics.watch_topic(site)]
    of_nodes = [topics.status_topic(site, "+", "+"), *([topics.alarm_topic(site, "+", "+")] if own else [])]
    left: dict[str, bytes] = {}
    for topic, payload in (await kept_messages(address, [*of_site, *of_nodes, *own])).items():
        with contextlib.suppress(WrongMessageError):  # of another program than the demo's
            is_online = topic.endswith("/status") and read_message(payload, StatusMessage).online
            # The demo itself has ended, although a busy broker may not have heard so in time.
            if payload and payload == own.get(topic, payload) and (not is_online or topic.endswith(f"/{_NAME}/status")):
                left[topic] = b""
    await _publish(address, left)


def _mqtt(address: MqttAddress) -> tuple[str, ...]:
    """Options that name the broker; its password is in the programs' environment."""
    option = ("--mqtt", str(replace(address, password=None)))
    return option if address.ca is None else (*option, "--mqtt-ca", str(address.ca))


def _options(**values: float | str | Path | None) -> list[str]:
    """Command line options from values, without those that are None."""
    given = ((f"--{name.replace('_', '-')}", str(value)) for name, value in values.items() if value is not None)
    return [word for option in given for word in option]


def _tags_text(tags: int) -> str:
    """The number of tags as an option of ``skyless ether``."""
    return f"{tags}@{tags.floor}" if isinstance(tags, TagCount) and tags.floor is not None else str(tags)


def _groups(names: list[str], size: int) -> list[list[str]]:
    return [names[first : first + size] for first in range(0, len(names), size)]


def _named(kind: str, names: list[str]) -> str:
    """Name of a process for messages."""
    return f"{kind} {names[0]}" if len(names) == 1 else f"{kind}s {names[0]} to {names[-1]}"


_LONGEST_START_S: Final = 60.0
"""Longest wait until every tag has a fix."""

_FRAME_S: Final = 0.25
"""Interval between two drawings of the site."""

app = App(name="demo", help_epilogue="Example: skyless demo --duration 10 --json")


@app.default
@command
def demo(*, asked: DemoOptions, output: JsonOptions) -> None:
    """Run a site with walking tags in real time; Ctrl-C stops.

    Anchors, tags, broker, page and recorder are the real programs, each a process; radios, clocks and motion are
    simulated. Watch it on the page, or with: mosquitto_sub -t 'skyless/#' -v
    """
    stage = _Stage(asked, output)
    run_until_stopped(stage.run())
    if stage.stopped_early:
        log("stopped")
    summary = stage.summary()
    if output.json:
        print_json(summary)
        return
    if not sys.stdout.isatty() and stage.picture is not None:
        console().print(stage.drawn(stage.picture))
    console().print(sentence(summary), soft_wrap=True)
    if gone := stage.whole.gone:
        console().print(f"gone with this demo: {gone}; --history FOLDER keeps them", soft_wrap=True)


class _Stage:
    """A running demo, which is drawn on a terminal several times a second, and summarised."""

    def __init__(self, asked: DemoOptions, output: JsonOptions) -> None:
        self.whole, self._asked, self._json = WholeSite(asked, log), asked, output.json
        self.picture: Picture | None = None
        self.stopped_early = True
        self._took_s = 0.0

    async def run(self) -> None:
        """Start everything, print the addresses, and watch for the requested time."""
        site, begun_s = asyncio.ensure_future(self.whole.run()), None
        try:
            await _either(site, self.whole.ready.wait())
            self._print_addresses()
            await _either(site, self._until_all_fix())
            begun_s = time.monotonic()
            await _either(site, self._watch())
            self.stopped_early = False
        finally:
            if begun_s is not None:
                self._took_s = time.monotonic() - begun_s
            site.cancel()
            await asyncio.gather(site, return_exceptions=True)

    def _print_addresses(self) -> None:
        """Print all addresses, on standard error if standard output is for JSON."""
        whole = self.whole
        lines = [f"page      {whole.page}", f"broker    {whole.address}"]
        if whole.address is not None:
            lines.append(f"fixes     {_subscriber(whole.address)} -t 'skyless/v1/#' -v")
        lines.append(f"air       --radio ether:127.0.0.1:{whole.ether_port}, for tags and anchors of your own")
        for tag, port in whole.boards.items():
            lines.append(
                f"board     {tag} computes by itself (emulated), at {port}; skyless tag --from-board publishes it"
            )
        if whole.recording is not None:
            lines.append(f"recording {whole.recording}")
        print(*lines, "Ctrl-C stops", sep="\n", file=sys.stderr if self._json else sys.stdout, flush=True)

    async def _until_all_fix(self) -> None:
        """Wait until a fix and the health of every tag have arrived."""
        begun_s = time.monotonic()
        while time.monotonic() - begun_s < _LONGEST_START_S:
            if sum(tag.health is not None for tag in self.whole.figures.tags.values()) >= self._asked.tags:
                return
            await asyncio.sleep(0.05)
        log("not all tags have a fix yet; skyless/… on the broker and the page show more")

    async def _watch(self) -> None:
        """Draw the site, if there is a terminal, until the time is over."""
        from rich.live import Live  # while the site's programs start

        out = console()
        shown = Live(console=out, auto_refresh=False) if out.is_terminal and not self._json else None
        with shown or contextlib.nullcontext(), contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._asked.duration):
                while True:
                    if self.whole.view is not None:
                        self.whole.view.evaluate()
                        self.picture = self.whole.view.picture()
                        if shown is not None:
                            shown.update(self.drawn(self.picture, out.height - 1), refresh=True)
                    await asyncio.sleep(_FRAME_S)

    def drawn(self, picture: Picture, height: int = sys.maxsize) -> "RenderableType":
        """The site as ``skyless watch`` shows it, with the errors of its fixes."""
        return drawn(picture, height, {name: tag.error_m for name, tag in self.whole.figures.tags.items()})

    def summary(self) -> dict[str, Any]:
        """The figures for JSON."""
        return {
            **self.whole.figures.summary(),
            "restarts": sum(max(0, child.starts - 1) for child in self.whole.children),
            "duration_s": self._took_s,
            "page": self.whole.page,
            "broker": str(self.whole.address),
        }


async def _either(site: asyncio.Task[None], part: Awaitable[object]) -> None:
    """Wait for ``part``, or raise the site's error if it fails first."""
    waiting = asyncio.ensure_future(part)
    try:
        for done in (await asyncio.wait((site, waiting), return_when=asyncio.FIRST_COMPLETED))[0]:
            done.result()
    finally:
        waiting.cancel()


def _subscriber(address: MqttAddress) -> str:
    """Command line of ``mosquitto_sub`` for this broker."""
    words = ["mosquitto_sub"]
    if address.host != "127.0.0.1":
        words.append(f"-h {address.host}")
    words.append(f"-p {address.port}")
    if address.user is not None:
        words.append(f'-u {quote(address.user)} -P "${PASSWORD_VARIABLE}"')
    if address.tls:
        words.append("--tls-use-os-certs" if address.ca is None else f"--cafile {quote(str(address.ca))}")
    return " ".join(words)
