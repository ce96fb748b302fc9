"""``skyless tag``: tags as a program."""

import asyncio
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal, TextIO

from cyclopts import App, Parameter
from msgspec.structs import replace

from skyless.arguments import Method, NotNegative, Options, Text, number, read_height
from skyless.bridges.motion_feed import MotionFeed
from skyless.bridges.program import TagBridge, heard_site
from skyless.bridges.target import TAG_NAME
from skyless.cli.common import cm, command, to_json
from skyless.cli.nodes.bridge import hub_of
from skyless.cli.nodes.options import MqttOptions, SiteId, log, run_until_stopped
from skyless.core.alert import Alert
from skyless.core.errors import SkylessError
from skyless.core.method_names import DEFAULT_METHOD, FILTERS
from skyless.core.site import GeoreferenceSite
from skyless.core.trusted_receiver import SiteTrust, Trust
from skyless.run.fix_log import FixListener
from skyless.run.keys import read_site_public
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.messages import FixMessage
from skyless.run.open_radio import (
    DEFAULT_RADIO,
    PACKET_DRIVERS,
    STATED_POSITIONS,
    driver_of,
    is_simulated,
    open_radios,
    open_sniffers,
)
from skyless.run.process import Log, together
from skyless.run.tag import Tags, TagSettings
from skyless.sim.evaluation.request import ProtectionOptions
from skyless.site.anchor_names import anchor_name

if TYPE_CHECKING:
    from skyless.core.air.masterless_packets import Point
    from skyless.run.masterless.packet_tags import PacketTagNode, PacketTags, PacketTagSettings
    from skyless.run.tag import TagNode

    _Opened = tuple[Tags | PacketTags, TagNode | PacketTagNode]

# Fixes as lines on standard output: for people, as CSV, or as JSON.
#
# A thread writes them, so that a slow reader does not delay the tags; lines that it cannot keep up with are dropped and
# counted.

CSV_COLUMNS: Final = (
    *("unix_s", "tag", "x_m", "y_m", "z_m", "std_m", "vx_mps", "vy_mps", "vz_mps"),
    *("anchors", "latency_s", "hpl_m", "vpl_m", "alert", "time_s", "verified_until_s", "unverified"),
)
"""Columns of ``--csv``."""

_NO_ALERTS: Final = (None, Alert.NONE, Alert.UNAVAILABLE)
"""Alerts that are not shown to people: having no protection level is usual after a start."""

_MAX_WAITING: Final = 1000
"""Lines that may wait for the reader: those of twenty tags in a second."""

_CLOSE_S: Final = 1.0
"""How long the last lines may take."""


class LineOptions(Options, frozen=True, kw_only=True):
    """Which lines are written on standard output."""

    print: bool = False
    """Write each fix as a line for people on standard output: time, tag, position, sigma."""
    csv: bool = False
    """Write each fix as a row of a CSV table on standard output, whose header names the units."""
    json: bool = False
    """Write one JSON object for each fix on standard output, a line each, as on MQTT."""

    def lines(self, log: Log, *, addresses: bool = False) -> "FixLines | None":
        """The writer of the requested lines, if any; ``addresses``: anchors have MAC addresses. Raises SkylessError."""
        asked = {"print": self.print, "csv": self.csv, "json": self.json}
        chosen = [name for name, is_asked in asked.items() if is_asked]
        if len(chosen) > 1:
            raise SkylessError(f"{' and '.join(f'--{name}' for name in chosen)} exclude each other; give one of them")
        if not chosen:
            return None
        if sys.stdout is None:
            raise SkylessError(f"--{chosen[0]} writes on standard output, which is closed")
        rows = partial(csv_row, addresses=addresses)
        line = rows if self.csv else line_for_people if self.print else to_json
        return FixLines(line, ",".join(CSV_COLUMNS) if self.csv else None, log)


def line_for_people(fix: FixMessage) -> str:
    """A line of local time, tag, position in metres, its standard deviation, and alert."""
    x_m, y_m, z_m = fix.position_m
    clock = time.strftime("%H:%M:%S", time.localtime(fix.unix_s))
    height = f"z {z_m:.3f} m (given)" if fix.height_known else f"z {z_m:.3f} m"
    alert = "" if fix.alert in _NO_ALERTS else f"  {fix.alert}"
    moment = f"{clock}.{int(fix.unix_s % 1.0 * 1e3):03d}"
    return f"{moment}  {fix.tag}  x {x_m:.3f}  y {y_m:.3f}  {height}  ± {cm(fix.std_m)}{alert}"


def csv_row(fix: FixMessage, *, addresses: bool = False) -> str:
    """The values of ``CSV_COLUMNS``; empty for missing ones, anchors separated by spaces."""
    velocity = (None, None, None) if fix.velocity_mps is None else fix.velocity_mps
    moved = [_figure(value) for value in (*fix.position_m, fix.std_m, *velocity)]
    levels = [_figure(value) for value in (fix.latency_s, fix.hpl_m, fix.vpl_m)]
    trust = [_figure(value) for value in (fix.time_s, fix.verified_until_s, fix.unverified)]
    anchors = " ".join(anchor_name(anchor, addresses=addresses) for anchor in fix.anchors)
    return ",".join([f"{fix.unix_s:.6f}", fix.tag, *moved, anchors, *levels, fix.alert or "", *trust])


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.5f}"


class FixLines:
    """Writes fixes as lines, each flushed at once."""

    def __init__(self, line: Callable[[FixMessage], str], header: str | None, log: Log) -> None:
        self._line, self._log = line, log
        self._waiting: queue.Queue[str | None] = queue.Queue(_MAX_WAITING)
        self._ended = asyncio.Event()
        self._trouble: OSError | None = None
        self.dropped = 0
        """Lines dropped because the reader was too slow."""
        if header is not None:
            self._waiting.put_nowait(header)

    def on_fix(self, fix: FixMessage) -> None:
        """Queue a fix for writing, or drop it."""
        try:
            self._waiting.put_nowait(self._line(fix))
        except queue.Full:
            self.dropped += 1

    async def run(self) -> None:
        """Write until cancelled.

        Raises OSError: standard output cannot be written; ``BrokenPipeError`` if its reader is gone.
        """
        loop = asyncio.get_running_loop()
        thread = threading.Thread(target=self._write_all, args=(loop,), daemon=True)
        thread.start()
        try:
            await self._ended.wait()
            assert self._trouble is not None
            raise self._trouble
        finally:
            self._close(thread)

    def _close(self, thread: threading.Thread) -> None:
        """Write the waiting lines, unless the reader is stuck."""
        try:
            self._waiting.put_nowait(None)
        except queue.Full:
            self.dropped += self._waiting.qsize()
        else:
            thread.join(_CLOSE_S)
        if self.dropped:
            self._log(f"{self.dropped} fixes were not written on standard output: its reader is too slow")

    def _write_all(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            with _standard_output() as out:
                while (line := self._waiting.get()) is not None:
                    out.write(f"{line}\n")
        except OSError as error:
            self._trouble = error
            loop.call_soon_threadsafe(self._ended.set)


def _standard_output() -> TextIO:
    """A duplicate of standard output, flushed with each line.

    It is separate from ``sys.stdout``, which Python flushes at exit, so that a stuck reader does not delay the exit.
    """
    return os.fdopen(os.dup(sys.stdout.fileno()), "w", 1, sys.stdout.encoding, "backslashreplace")


_OF_BOARDS: Final = (
    *("method", "tag_height_std", "site_id", "site_key", "trust", "clock_bound_ms", "integrity_risk", "alert_limit_m"),
)
"""Options of the filter, for which a computing board uses its own settings."""

app = App(name="tag", help_epilogue="Example: skyless tag tag1 --print")


class TagOptions(ProtectionOptions, frozen=True, kw_only=True):
    """Options of ``skyless tag``."""

    radio: str = DEFAULT_RADIO
    """Radio of the tags. ether:HOST:PORT: the emulated air of skyless ether. serial:PATH: a board of Skyless.
    spi:BUS.DEVICE,irq=PIN,reset=PIN: a DW1000 on this computer's SPI. model:HOST:PORT: a model of one on that air.
    listener:PATH: the listener of uwb-apps. sniffer:PATH: a Bitcraze sniffer, for TDoA2 and TDoA3 systems.
    uci:PATH: a FiRa board whose DL-TDoA session as a tag goes on. phone://HOST:PORT: where this computer waits for a
    phone's DL-TDoA records, lines of JSON by TCP or WebSocket (0.0.0.0 for a phone in the network; port 7470 by
    default).
    Several tags have several paths, with commas; PATH@BAUD gives another rate."""
    method: Method = DEFAULT_METHOD
    """How positions are computed (sniffers, FiRa boards, phones: always joint)."""
    tag_height_std: NotNegative | None = None
    """Standard deviation of the tags' height from the one that is given, in metres, which fixes and levels then
    count (joint); 0 by default, for sniffers, FiRa boards and phones 0.5 where the height is only taken for the
    anchors'."""
    publish_hz: Annotated[float, number(above=0.0, most=1000.0)] = 50.0
    """Fixes a second and tag at most, on MQTT and on standard output; all of them count in the tag's health."""
    site_id: SiteId | None = None
    """Number of the site, the only one to listen to; by default the first one heard. For sniffers, FiRa boards and
    phones what topics call the system, by default 0; it should be no other site's."""
    anchors: Path | None = None
    """Table of anchors of another system (sniffers, FiRa boards, phones): id,x_m,y_m,z_m, as skyless replay and
    calibrate take it. FiRa boards and phones need none where anchors state their positions."""
    to: Annotated[tuple[str, ...], Text(lambda _, text: text, many=True)] = ()
    """Where fixes go as well, without a broker: a program or device of another kind; may be given several times.
    skyless bridge --help lists the targets, as nmea+tcp://:10110."""
    from_board: bool = False
    """Publish what the boards compute themselves (serial:PATH), with the settings of skyless flash-config."""
    site_key: Annotated[Path | None, Parameter(env_var="SKYLESS_SITE_KEY")] = None
    """File with the site's public key, the site.public of skyless site keys: beacons of that site alone are accepted,
    and their codes verified."""
    trust: Literal["open", "verified"] | None = None
    """Which fixes are given: open, the default, each at once, stating how far it is verified; verified, half a second
    later, only those of verified beacons (with --site-key)."""
    clock_bound_ms: Annotated[float | None, number(above=0.0, most=10_000.0)] = None
    """How far this computer's clock may be from those of the anchors, in ms; 100 by default (with --site-key)."""
    motion: str | None = None
    """Where this computer receives what the tag's motion sensor or wheels show (one NAME, method joint):
    jsonl+tcp://HOST:PORT for lines of JSON, also from the ROS 2 node, or mavlink+udp://HOST:PORT for HIGHRES_IMU of a
    vehicle; 0.0.0.0 for another computer's. ?arm=x,y,z: the antenna seen from the sensor, forward, left, up, in m."""
    tag_height: str | None = None
    """The tags' height (sniffers, FiRa boards, phones): metres, free (estimated) or auto, the default: estimated unless
    the anchors lie too flat, then theirs."""


_Names = Annotated[str, Parameter(name="NAMES", help="Names of one or more tags: letters, digits, - and _.")]


@app.default
@command
def tag(*names: _Names, asked: TagOptions, broker: MqttOptions, shown: LineOptions) -> None:
    """Run listening tags until Ctrl-C.

    A tag needs no configuration: it learns the site from the beacons that it hears. It computes a fix with every
    message, with or without a broker, and publishes fixes on MQTT under skyless/v1/SITE/tag/NAME/fix. With --print,
    --csv or --json it writes the same fixes on standard output.
    """
    address, lines = broker.address(), shown.lines(log, addresses=driver_of(asked.radio) in STATED_POSITIONS)
    if not names or len(set(names)) < len(names) or not all(map(TAG_NAME.fullmatch, names)):
        given = repr(" ".join(names)) if names else "missing"
        raise SkylessError(
            f"NAMES is {given}; it should be one or more names, each once, of 1 to 32 letters, digits, - or _"
        )
    if driver_of(asked.radio) in PACKET_DRIVERS:
        asked.leave_out(
            *("site_key", "trust", "clock_bound_ms", "integrity_risk", "alert_limit_m"),
            why="it is not for sniffers, FiRa boards and phones",
        )
        tags = _on_sniffers
    else:
        why = "it is for sniffers, FiRa boards and phones; other tags hear from the air where anchors stand"
        asked.leave_out("anchors", "tag_height", why=why)
        tags = _on_radios
    if asked.from_board:
        if not asked.radio.startswith("serial:"):
            raise SkylessError(
                f"--radio is {asked.radio!r}; with --from-board it should be a board, serial:PATH[@BAUD]"
            )
        asked.leave_out(*_OF_BOARDS, why="the board computes, with the settings of skyless flash-config")
    is_here = asked.method in FILTERS and asked.trust != "verified" and not asked.from_board
    if asked.motion is not None and (len(names) > 1 or not is_here):
        why = "of one tag whose fixes are computed here and at once: one name, --method joint, and neither --from-board"
        raise SkylessError(f"--motion is {why} nor --trust verified")
    bridge = TagBridge(hub_of(asked.to, address), lambda: is_simulated(asked.radio), log) if asked.to else None
    consumers = [part for part in (lines, bridge) if part is not None]

    def on_fix(fix: FixMessage) -> None:
        for consumer in consumers:
            consumer.on_fix(fix)

    running, node = tags(names, asked, address, on_fix, bridge)
    parts = [running.run(), *(consumer.run() for consumer in consumers)]
    if asked.motion is not None:
        feed = MotionFeed(asked.motion, node.hear_motion)
        node.motion_counters = feed.counters
        log(f"tag {node.radio.name}: waits for its motion at {feed.address}")
        parts.append(feed.run())
    run_until_stopped(together(*parts), punctual=True)


def _on_radios(
    names: tuple[str, ...],
    asked: TagOptions,
    address: MqttAddress | None,
    on_fix: FixListener,
    bridge: TagBridge | None,
) -> "_Opened":
    """Open tags that receive beacons; the first tag's node."""
    required = asked.requirement(asked.method, asked.tag_height_std)
    trust = _site_trust(asked)
    settings = TagSettings(
        asked.method,
        asked.site_id if trust is None else trust.site,
        integrity=required,
        publish_hz=asked.publish_hz,
        trust=trust,
        from_board=asked.from_board,
    )
    radios = open_radios(asked.radio, "tag", names, computes=asked.from_board)
    tags = Tags(settings, radios, address, log, on_fix, None if bridge is None else bridge.on_health)
    return tags, tags.tags[0].node


def _site_trust(asked: TagOptions) -> SiteTrust | None:
    """Rules for accepting beacons and fixes; None without a public key. Raises SkylessError."""
    if asked.site_key is None:
        option = "--clock-bound-ms" if asked.trust is None else f"--trust {asked.trust}"
        if (asked.trust, asked.clock_bound_ms) != (None, None):
            raise SkylessError(f"{option} needs --site-key, the site.public of skyless site keys")
        return None
    public = read_site_public(asked.site_key)
    if asked.site_id not in (None, public.site):
        raise SkylessError(f"--site-id is {asked.site_id}, but {asked.site_key} is of site {public.site}")
    bound_s = 1e-3 * (100.0 if asked.clock_bound_ms is None else asked.clock_bound_ms)
    return SiteTrust(public.site, public.public, public.least_serial, Trust(asked.trust or "open"), bound_s)


def _on_sniffers(
    names: tuple[str, ...],
    asked: TagOptions,
    address: MqttAddress | None,
    on_fix: FixListener,
    bridge: TagBridge | None,
) -> "_Opened":
    """Open tags that receive the packets of another system; the first tag's node."""
    from skyless.run.masterless.packet_tags import PacketTags

    settings = _system(asked)
    radios = open_sniffers(asked.radio, names, settings.anchors_m)

    def on_anchors(anchors_m: Mapping[int, "Point"], origin: GeoreferenceSite | None) -> None:
        if bridge is not None:
            site = heard_site(settings.site, anchors_m, simulated=is_simulated(asked.radio))
            bridge.on_site(replace(site, georeference=origin))

    if settings.anchors_m:
        on_anchors(settings.anchors_m, None)
    tags = PacketTags(
        settings,
        radios,
        address,
        log,
        simulated=lambda: is_simulated(asked.radio),
        on_fix=on_fix,
        on_health=None if bridge is None else bridge.on_health,
        on_anchors=on_anchors,
    )
    return tags, tags.nodes[0]


def _system(asked: TagOptions) -> "PacketTagSettings":
    """Settings that sniffers, and some FiRa boards and phones, cannot receive from the air. Raises SkylessError."""
    from skyless.core.geometry import GUESSED_STD_M, plane_height_m
    from skyless.run.masterless.packet_tags import TDOA_SITE, PacketTagSettings
    from skyless.site.tables import read_anchors, read_calibration

    if asked.anchors is None and driver_of(asked.radio) not in STATED_POSITIONS:
        raise SkylessError("--anchors is missing; a sniffer needs a table of the system's anchors: id,x_m,y_m,z_m")
    anchors_m, std_m = {} if asked.anchors is None else read_anchors(asked.anchors), 0.0
    if asked.tag_height in (None, "auto"):
        height_m = plane_height_m(anchors_m)
        if height_m is not None:
            std_m = GUESSED_STD_M
            log(
                "the anchors lie too flat to determine the height; tags are taken to be at theirs: "
                f"--tag-height {height_m:.2f}"
            )
    else:
        wish = read_height("--tag-height", str(asked.tag_height), ("free", "auto"))
        height_m = None if isinstance(wish, str) else wish
    if height_m is None:
        asked.leave_out("tag_height_std", why="the height is estimated")
    return PacketTagSettings(
        anchors_m,
        site=TDOA_SITE if asked.site_id is None else asked.site_id,
        height_m=height_m,
        height_std_m=std_m if asked.tag_height_std is None else asked.tag_height_std,
        auto_height=asked.anchors is None and asked.tag_height in (None, "auto"),
        calibration=None if asked.anchors is None else read_calibration(asked.anchors),
        publish_hz=asked.publish_hz,
    )
