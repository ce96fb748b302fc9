"""``skyless watch`` and ``skyless sites``: running sites as text."""

import asyncio
import contextlib
import os
import platform
import sys
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Mapping, Sequence
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar

from cyclopts import App
from msgspec import Struct
from rich.console import Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from skyless.cli.common import JsonOptions, command, console, number, plain, print_json, print_table
from skyless.cli.nodes.options import HubUrl, MqttOptions, SiteOptions, hub_address, log, run_until_stopped
from skyless.core.errors import SkylessError
from skyless.run.assets import assets_at
from skyless.run.condition.evidence import ALERTS, Evidence, ProcessorUse
from skyless.run.condition.monitor import EVALUATION_S, Condition, ConditionMonitor
from skyless.run.find_site import SiteOnBroker, find_site, watch_sites
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import (
    NOT_DROPS,
    AlarmMessage,
    AnchorHealth,
    Asset,
    AssetsMessage,
    EtherHealth,
    FixMessage,
    SiteMessage,
    StatusMessage,
    TagHealth,
    WatchMessage,
)
from skyless.run.process import keep, together
from skyless.run.site_feed import Channel, Newest, SiteFeed
from skyless.run.site_table import THRESHOLDS, Health, Node, SiteTable

if TYPE_CHECKING:
    from skyless.run.hub import HubSite

GONE: Final = ("silent", "offline")
"""States of absent anchors."""

LINK_NAME: Final = f"{platform.node()}-{os.getpid()}"
_WAIT_SHARE: Final = 3.0

TagState = Literal["fix", "asleep", "no fix", "offline"]


class TagRow(Struct, frozen=True):
    """A tag in the view."""

    tag: str
    state: TagState
    age_s: float | None = None
    """Time since the last frame of the newest fix; None before the first."""
    fix: FixMessage | None = None
    health: TagHealth | None = None
    """None if the tag does not report."""
    name: str = ""
    """Name of the tag's asset, as on the page; empty without one."""


class AnchorRow(Struct, frozen=True):
    """An anchor in the view."""

    anchor: str
    state: str
    """The anchor's role; ``used`` without a program of its own; ``silent`` or ``offline``."""
    age_s: float | None = None
    """Time since the last report."""
    health: AnchorHealth | None = None


class Picture(Struct, frozen=True):
    """A site at one moment."""

    site: str
    number: int
    simulated: bool
    unix_s: float
    broker: str
    trouble: str | None
    """Why the broker is not connected; None while it is."""
    condition: Condition
    tags: tuple[TagRow, ...]
    """Tags with trouble first, then by name."""
    anchors: tuple[AnchorRow, ...]
    alarms: tuple[AlarmMessage, ...]
    """Unacknowledged alarms first."""
    drops: dict[str, int]
    """Drops at tags and anchors since their start, by reason, the most frequent first."""
    unused: dict[str, int]
    """Messages that were not used here, by reason: a kind of unreadable messages, or ``late-fix``."""


async def site_number(address: MqttAddress, longest_s: float | None) -> int:
    """Find the number of the site that is online. Raises SkylessError if none, or several, are found in time."""
    try:
        async with asyncio.timeout(longest_s):
            return await find_site(address)
    except TimeoutError:
        raise SkylessError(f"no program of a site is online at {address}; --site-id shows one all the same") from None


class SiteView:
    """Subscriber to a site's topics, which publishes only its own status."""

    def __init__(
        self,
        link: Link,
        number: int,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
        used_share: Callable[[float], float | None] = lambda _: None,
    ) -> None:
        """``used_share``: see the page's ``LiveSite``."""
        self.link, self.number, self._clock, self._wall_clock = link, number, clock, wall_clock
        self._used_share = used_share
        self.feed = feed = SiteFeed(clock)
        self.table = SiteTable(clock(), platform.node(), connected=False, drops=feed.drops)
        self.evidence = Evidence(self.table)
        self._monitor = ConditionMonitor(self.evidence)
        self.condition = self._monitor.evaluate(clock())
        self.site: SiteMessage | None = None
        self._alarms: dict[str, AlarmMessage] = {}
        self._watch = Newest[WatchMessage](clock, wall_clock)
        self._assets = AssetsMessage(())
        feed.on(SiteMessage, self._on_site)
        feed.on(FixMessage, lambda fix, _: self.evidence.add_fix(fix, clock(), wall_clock()))
        feed.on(StatusMessage, lambda status, _: status and self.evidence.add_status(status, clock()))
        for kind in (TagHealth, AnchorHealth, EtherHealth):
            feed.on(kind, self._on_health)
        feed.on(WatchMessage, lambda watch, _: self._watch.replace(watch))
        feed.on(AssetsMessage, lambda assets, _: self._on_assets(assets))
        feed.on(AlarmMessage, self._on_alarm)
        feed.attach(link, number)
        link.on_state.append(self._on_state)

    def _on_state(self, connected: bool) -> None:
        self._watch.expect_kept()
        self._alarms.clear()  # the broker sends retained alarms again
        self.table.set_connected(connected=connected, now_s=self._clock())

    def _on_site(self, message: SiteMessage | None, _channel: Channel) -> None:
        if message is not None:
            self.site = message
            self.table.set_site(message.site, self._clock(), addresses=message.system == "dl-tdoa")
            self.table.set_assets(self._named())

    def _on_health(self, health: Health, channel: Channel) -> None:
        self.evidence.add_health(channel.who, channel.name, health, self._clock(), self._wall_clock())

    def _on_assets(self, message: AssetsMessage | None) -> None:
        self._assets = message or AssetsMessage(())
        self.table.set_assets(self._named())

    def _named(self) -> dict[str, Asset]:
        return {} if self.site is None else assets_at(self._assets, self.site.site.name)

    def _on_alarm(self, message: AlarmMessage | None, channel: Channel) -> None:
        if message is None:
            self._alarms.pop(channel.name, None)
        else:
            self._alarms[channel.name] = message

    async def run(self, seconds: float | None, act: Callable[[], None]) -> None:
        """Stay connected for some time, evaluating the condition and then calling ``act`` about twice a second."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await together(keep(self.link, log), self._evaluate_often(act))

    async def _evaluate_often(self, act: Callable[[], None]) -> None:
        due_s = time.monotonic()
        while True:
            began_s = time.monotonic()
            self.evaluate(began_s - due_s)
            act()
            # With very many tags this takes longer, and messages must be read, too.
            wait_s = max(EVALUATION_S, _WAIT_SHARE * (time.monotonic() - began_s))
            due_s = time.monotonic() + wait_s
            await asyncio.sleep(wait_s)

    def evaluate(self, lag_s: float = 0.0) -> None:
        """Update the condition as the page does. ``lag_s``: delay of this call."""
        now_s = self._clock()
        self.table.tick(now_s)
        watch, age_s = self._watch.message, self._watch.age_s()
        used, unread_s, refused = self._used_share(now_s), self.link.unread_s, self.link.refused
        self.condition = self._monitor.evaluate(now_s, lag_s, watch, age_s, used, unread_s, refused)

    def picture(self) -> Picture:
        """The site now."""
        now_s, site = self._clock(), self.site
        tags, anchors = self.table.senders("tag"), {name: Node(name) for name in self.table.site_anchors}
        anchors |= dict(self.table.senders("anchor"))
        named = zip(self.table.spelled(anchors), anchors.values(), strict=True)
        drops: Counter[str] = Counter()
        for node in (*(node for _, node in tags), *anchors.values()):
            if node.reports(now_s) and isinstance(node.health, TagHealth | AnchorHealth):
                drops.update(node.health.counters)
        return Picture(
            site="" if site is None else site.site.name,
            number=self.number,
            simulated=site is not None and site.simulated,
            unix_s=self._wall_clock(),
            broker=str(self.link.address),
            trouble=self.link.trouble,
            condition=self.condition,
            tags=self._tag_rows(tags, now_s),
            anchors=tuple(sorted((_anchor_row(*one, now_s) for one in named), key=lambda row: row.state not in GONE)),
            alarms=tuple(sorted(self._alarms.values(), key=_alarm_rank)),
            drops={reason: count for reason, count in drops.most_common() if count and reason not in NOT_DROPS},
            unused=dict(self.feed.drops),
        )

    def _tag_rows(self, tags: list[tuple[str, Node]], now_s: float) -> tuple[TagRow, ...]:
        rows = []
        assets = self._named()
        for name, tag in tags:
            health = tag.health if tag.reports(now_s) and isinstance(tag.health, TagHealth) else None
            state: TagState = "no fix"
            found = self.table.presence(tag, now_s) if self.table.connected else "late"
            if found == "asleep":
                state = "asleep"
            elif tag.online is False:
                state = "offline"
            elif found == "fresh":
                state = "fix"
            age_s = None if tag.fix is None else self._wall_clock() - tag.ended_unix_s
            rows.append(TagRow(name, state, age_s, tag.fix, health, assets[name].name if name in assets else ""))
        return tuple(sorted(rows, key=_tag_rank))


def _anchor_row(name: str, node: Node, now_s: float) -> AnchorRow:
    health = node.health if isinstance(node.health, AnchorHealth) else None
    state = "silent"
    if node.online is False:
        state = "offline"
    elif health is None and now_s < node.used_until_s:
        state = "used"
    elif health is not None and node.reports(now_s):
        state = health.role
    return AnchorRow(name, state, None if health is None else now_s - node.health_s, health)


def _tag_rank(row: TagRow) -> int:
    alert = None if row.fix is None else row.fix.alert
    return {"no fix": 0, "fix": 3 - ALERTS.get(alert, 0), "asleep": 4, "offline": 5}[row.state]


def _alarm_rank(alarm: AlarmMessage) -> tuple[bool, int, float]:
    severity = ("critical", "warning", "info").index(alarm.severity)
    return alarm.acknowledged_unix_s is not None, severity, -alarm.unix_s


# Text view of a site in a given number of lines.

_COLOURS: Final = {"good": "bold green", "waiting": "bold cyan", "warning": "bold yellow", "bad": "bold red"}
_ALERTS: Final[dict[str | None, str]] = {
    "detected-excluded": "excluded",
    "detected-not-excluded": "FAULT",
    "alert-limit-exceeded": "LIMIT",
}
_MAX_REASONS: Final = 3
_MIN_ROWS: Final = 3
_T = TypeVar("_T")


def drawn(
    picture: Picture, height: int = sys.maxsize, errors_m: Mapping[str, float | None] | None = None
) -> RenderableType:
    """Draw the picture in ``height`` lines. The last row of a table counts the rows that do not fit.

    ``errors_m``: errors of the tags' fixes, where the truth is known.
    """
    condition, alarms, anchors = picture.condition, picture.alarms, picture.anchors
    reasons = condition.reasons
    head = [_title(picture), *(_text(one.text, _COLOURS[one.level]) for one in reasons[:_MAX_REASONS])]
    if len(reasons) > _MAX_REASONS:
        head.append(_text(f"and {len(reasons) - _MAX_REASONS} more", "dim"))
    if reasons or condition.text:
        head.append(_text(reasons[0].advice if reasons else condition.text))
    foot = [_text(f"drops {_counts(picture.drops) or 'none'}")]
    if picture.unused:
        foot.append(_text(f"not used here {_counts(picture.unused)}", "yellow"))
    rows = height - len(head) - len(foot) - 2 - bool(alarms)
    most_alarms = min(len(alarms), max(rows // 4, rows - len(picture.tags) - len(anchors), _MIN_ROWS))
    rows -= most_alarms
    most_anchors = min(len(anchors), max(rows // 3, rows - len(picture.tags), _MIN_ROWS))
    columns = ("x/m", "y/m", "z/m") if errors_m is None else ("x/m", "y/m", "z/m", "error/cm")
    return Group(
        *head,
        *([_table("alarms", (), alarms, most_alarms, _alarm)] if alarms else ()),
        _table("tags", (*columns, "σ/cm", "HPL/cm", "Hz", "from", "age", ""), picture.tags, rows - most_anchors,
               partial(_tag, errors_m=errors_m)),
        _table("anchors", ("role", "hears", "report", "missed"), anchors, most_anchors, _anchor),
        *foot,
    )  # fmt: skip


def _title(picture: Picture) -> Text:
    level, trouble = picture.condition.level, picture.trouble
    line = _text(f"{picture.site or 'no site yet'} (site {picture.number})", "bold")
    line.append(" simulated" if picture.simulated else "", "dim")
    line.append(f"  {level}  ", _COLOURS[level])
    line.append(time.strftime("%H:%M:%S  ", time.localtime(picture.unix_s)))
    line.append(plain(f"{picture.broker} {trouble or 'connected'}"), "red" if trouble else "dim")
    return line


def _counts(of: Mapping[str, int]) -> str:
    return ", ".join(f"{reason} {count}" for reason, count in of.items())


def _text(words: str, style: str = "") -> Text:
    return Text(plain(words), style, no_wrap=True, overflow="ellipsis")


def _table(
    name: str, columns: tuple[str, ...], items: Sequence[_T], most: int, cells: Callable[[_T], list[Text]]
) -> Table:
    """A table of at most ``most`` rows. Columns of figures keep their width; the first and unnamed ones may shrink."""
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="dim")
    table.add_column(Text(f"{name} ({len(items)})", "bold"))
    for title in columns:
        table.add_column(title, justify="right" if title else "left", no_wrap=bool(title))
    shown = len(items) if len(items) <= most else max(most - 1, 0)
    for item in items[:shown]:
        table.add_row(*cells(item))
    if shown < len(items):
        table.add_row(Text(f"and {len(items) - shown} more", "dim"))
    return table


def _alarm(alarm: AlarmMessage) -> list[Text]:
    seen = alarm.acknowledged_unix_s is not None
    since = time.strftime("%H:%M:%S", time.localtime(alarm.since_unix_s))
    ended = " (ended)" if alarm.ended_unix_s is not None else ""
    by = f" (seen by {alarm.acknowledged_by})" if seen else ""
    return [_text(f"{since} {alarm.severity} {alarm.sentence}{ended}{by}", "dim" if seen else "bold red")]


def _tag(row: TagRow, errors_m: Mapping[str, float | None] | None) -> list[Text]:
    """The cells of a tag. Outdated values are dim, with their age in words, in red."""
    fix, health, fresh = row.fix, row.health, row.state == "fix"
    style = "" if fresh else "dim"
    errors = () if errors_m is None else (errors_m.get(row.tag),)
    figures = ["–"] * (7 + len(errors))
    if fix is not None:
        lengths = (number(value, "{:.1f}", 100.0) for value in (*errors, fix.std_m, fix.hpl_m))
        rate = number(None if health is None else health.updates_per_s, "{:.0f}")
        figures = [*(f"{value:.2f}" for value in fix.position_m), *lengths, rate, str(len(fix.anchors))]
    age = _text(f"{max(row.age_s or 0.0, 0.0):.1f} s")
    if row.state == "offline":
        age = _text("offline", "dim")
    elif not fresh:
        age = _text("no fix" if row.age_s is None else f"no fix for {row.age_s:.0f} s", "bold red")
    alert = fix.alert if fix is not None and fresh else None
    why = _text(_ALERTS.get(alert, ""), "bold red" if ALERTS.get(alert, 0) > 1 else "yellow")
    if not fresh:
        why = _text((health.reason if health is not None else None) or "", "dim")
    name = f"{row.name or row.tag}{' board' if health is not None and health.on_board else ''}"
    return [_text(name, style), *(_text(one, style) for one in figures), age, why]


def _anchor(row: AnchorRow) -> list[Text]:
    health, gone = row.health, row.state in GONE
    style = "dim" if gone else ""
    old = row.age_s is not None and row.age_s > THRESHOLDS.fresh_s
    hears, missed = "–", "–"
    if health is not None:
        hears = str(sum(heard_s < THRESHOLDS.fresh_s for heard_s in health.heard_age_s.values()))
        missed = f"{health.missed_share:.0%}"
    return [
        _text(row.anchor, style), _text(row.state, "bold red" if gone else ""), _text(hears, style),
        _text(number(row.age_s, "{:.0f} s ago"), "bold red" if old else style), _text(missed, style),
    ]  # fmt: skip


_FIND_S: Final = 5.0
_PICTURE_S: Final = 3.0
"""Delay before a single picture: tags and anchors report every second."""

watch_app = App(name="watch", help_epilogue="Example: skyless watch --mqtt mqtts://page@hall.example")


@watch_app.default
@command
def watch(*, live: SiteOptions, output: JsonOptions) -> int:
    """Show a running site as text until Ctrl-C: its condition, alarms, tags, anchors and dropped frames.

    With --json, or where standard output is no terminal, one picture is written after some seconds. The exit code is
    then 1 for a site whose condition is bad.
    """
    address = live.required("the broker of the site to watch")
    once = output.json or not sys.stdout.isatty()
    pictures: list[Picture] = []
    run_until_stopped(_watch(address, live.site_id, pictures, once=once))
    if not once:
        return 0
    if output.json:
        print_json(pictures[-1] if pictures else {"site": None})
    elif pictures:
        console().print(drawn(pictures[-1]))
    return 0 if pictures and pictures[-1].condition.level != "bad" else 1


async def _watch(address: MqttAddress, site_id: int | None, pictures: list[Picture], *, once: bool) -> None:
    if site_id is None:
        site_id = await site_number(address, _FIND_S if once else None)
    view = SiteView(Link(address, LINK_NAME, site=site_id, kind="watch"), site_id, used_share=ProcessorUse().share)
    if once:
        await view.run(_PICTURE_S, lambda: pictures.append(view.picture()))
        return
    out = console()
    with Live(console=out, screen=True, auto_refresh=False) as live:
        await view.run(None, lambda: live.update(drawn(view.picture(), out.height), refresh=True))


_LISTEN_S: Final = 2.5
_DASH: Final = "–"

sites_app = App(name="sites", help_epilogue="Example: skyless sites --hub nats://plant@hub-a.example,hub-b.example")


@sites_app.default
@command
def sites(*, broker: MqttOptions, hub: HubUrl = None, output: JsonOptions) -> int:
    """List the sites at a hub, with condition, tags, anchors and versions, those in trouble first.

    Without a hub, those of the broker, with the programs that are online. The exit code is 0 if there are sites and all
    are good, or on a broker have programs online; else 1.

    Parameters
    ----------
    hub
        Hub whose sites are listed, nats://[USER@]HOST[:PORT],HOST... or tls://...; by default the broker is asked.
    """
    if hub is not None and broker.mqtt is not None:
        raise SkylessError("--hub and --mqtt exclude each other; give one of them")
    found = _of_broker(broker) if hub is None else _of_hub(hub, broker)
    if output.json:
        print_json({"sites": found})
    else:
        _show(found)
    good = [site.online > 0 if isinstance(site, SiteOnBroker) else site.condition == "good" for site in found]
    return 0 if good and all(good) else 1


def _of_broker(broker: MqttOptions) -> "list[SiteOnBroker | HubSite]":
    address = broker.required("the broker whose sites are listed")
    reports: list[list[SiteOnBroker]] = []
    states: list[bool] = []
    run_until_stopped(_listen(watch_sites(address, reports.append, states.append)))
    if True not in states:
        raise SkylessError(f"the broker {address} has not answered within {_LISTEN_S:g} s")
    return [*reports[-1]] if reports else []


def _of_hub(hub: str, broker: MqttOptions) -> "list[SiteOnBroker | HubSite]":
    address = hub_address(hub, broker.mqtt_ca)
    from skyless.run.hub import HubSites

    known = HubSites(address, time.monotonic())
    run_until_stopped(_listen(known.run("skyless sites")))
    if not known.has_answered:
        raise SkylessError(f"the hub {address} has not answered within {_LISTEN_S:g} s")
    return [*known.sites(time.monotonic())]


async def _listen(listening: Coroutine[Any, Any, None]) -> None:
    await asyncio.wait((task := asyncio.ensure_future(listening),), timeout=_LISTEN_S)
    if task.done():
        task.result()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


def _show(found: "list[SiteOnBroker | HubSite]") -> None:
    of_broker = all(isinstance(site, SiteOnBroker) for site in found)
    more = ("programs online",) if of_broker else ("condition", "reason", "tags", "anchors", "last heard")
    rows = []
    for site in found:
        versions = ", ".join(f"{version} ({count})" for version, count in sorted((site.versions or {}).items()))
        if isinstance(site, SiteOnBroker):
            cells = [str(site.online)]
        else:
            counts = [_DASH if count is None else str(count) for count in (site.tags_heard, site.anchors_online)]
            heard = _DASH if site.heard_unix_s is None else f"{datetime.fromtimestamp(site.heard_unix_s):%H:%M:%S}"
            cells = [site.condition, site.reason, *counts, heard]
        rows.append((str(site.number), site.name, *cells, versions or _DASH))
    print_table("Sites" if found else "No site is known there", ("site", "name", *more, "versions"), rows)
