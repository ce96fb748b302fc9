"""Commands for boards and the emulated air: ``skyless board``, ``skyless ether``, ``skyless flash-config``."""

import asyncio
import sys
import time
from collections.abc import Iterable
from errno import EADDRINUSE
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from cyclopts import App
from msgspec.structs import asdict, fields, replace

from skyless.arguments import (
    Option,
    Options,
    Picoseconds,
    Seed,
    TagCount,
    Text,
    number,
    numbers,
    read_numbers,
    tag_count,
    whole,
    wrong,
)
from skyless.cli.common import JsonOptions, command, print_json
from skyless.cli.nodes.options import (
    MqttOptions,
    SiteId,
    WalkingSpeed,
    check_live,
    listen_address,
    log,
    run_until_stopped,
    site_named,
)
from skyless.core.errors import SkylessError
from skyless.core.ticks import from_seconds
from skyless.radio.emulated import DEFAULT_PORT
from skyless.radio.serial.link import BAUDS, MODES, OUTPUTS, BoardSettings
from skyless.radio.serial.serial_port import check_path
from skyless.radio.serial.serial_radio import Computing, set_up
from skyless.run.board import RADIO_OF, Board
from skyless.run.open_radio import DEFAULT_RADIO, driver_of, open_radios

if TYPE_CHECKING:
    from skyless.sim.impairments import AnchorDisplacement

board_app = App(name="board", help_epilogue="Example: skyless board tag1 --link /tmp/board")


class BoardOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless board``."""

    name: str
    """Which radio it is: an anchor's number, or a tag of the air (tag1)."""
    radio: str = DEFAULT_RADIO
    """Radio of the board, on the emulated air: ether:HOST:PORT of skyless ether."""
    wire: Literal["link", "sniffer", "sniffer-text", "listener", "uci", "uci-2"] = "link"
    """Format on the serial port: link (Skyless), sniffer or sniffer-text (Bitcraze; beacons become TDoA3 packets),
    listener (uwb-apps, JSON), uci or uci-2 (a FiRa board that receives DL-TDoA; measurements of version 1 or 2)."""
    link: Path | None = None
    """A symbolic link to the pseudo-terminal, which keeps its name when the board is started again."""


@board_app.default
@command
def board(asked: BoardOptions, output: JsonOptions) -> None:
    """Emulate a board with a UWB radio on a pseudo-terminal, until Ctrl-C, to try programs without hardware.

    The board is one node of the emulated air. Programs open it as they would open a real one:
    skyless tag tag1 --radio serial:PATH. A tag's computes by itself where its settings say so (skyless flash-config, or
    skyless tag --from-board), until it is ended, and says records alone.
    """
    name, wire = asked.name, asked.wire
    if driver_of(asked.radio) != "ether":
        raise wrong("--radio", asked.radio, "the emulated air, ether:HOST[:PORT]")
    kind: Literal["anchor", "tag"] = "anchor" if name.isdecimal() else "tag"
    if kind == "anchor" and wire != "link":
        raise wrong("--wire", wire, "link for an anchor, as boards of other formats only listen")
    emulated = Board(open_radios(asked.radio, kind, (name,))[0], kind, wire, asked.link, log)
    path = emulated.pty.name
    if output.json:
        print_json({"board": name, "path": path, "format": wire, "radio": f"{RADIO_OF[wire]}:{path}"})
        sys.stdout.flush()
    else:
        log(f"board {name}: emulated, at {path}")
        rest = " --anchors anchors.csv" if RADIO_OF[wire] == "sniffer" else ""
        log(f"next: skyless {kind} {name} --radio {RADIO_OF[wire]}:{path}{rest}")
    run_until_stopped(emulated.run(), punctual=True)


_Share = Annotated[float, number(least=0.0, below=1.0)]

ether_app = App(name="ether", help_epilogue="Example: skyless ether --site lab --tags 3")


class EtherOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless ether``."""

    site: str = "lab"
    """Site file, or lab."""
    tags: Annotated[int, *tag_count(0, 1000)] = TagCount(3)
    """How many bodies walk about, 3 by default; programs connect as tag1, tag2 and so on. At a site of several floors
    they walk on each in turn, or on the one that is named."""
    speed: WalkingSpeed = 1.0
    """How fast they walk in m/s."""
    noise_ps: Picoseconds | None = None
    """Noise of every TX and RX stamp in picoseconds; by default that of the site file."""
    loss: _Share = 0.0
    """Probability that a message is lost."""
    nlos: _Share = 0.0
    """Probability that a message reaches a tag late, as an obstacle delays it."""
    carrier: bool = False
    """Let radios measure the phase of the carrier, as a DW1000 can."""
    move: Annotated[tuple[str, ...], Text(lambda _, text: text, "ANCHOR=DX,DY@SECONDS", many=True)] = ()
    """Move an anchor while the air runs, from its position in the site file, as if somebody had hung it elsewhere:
    4=0.3,0@60 by 0.3 m along x after 60 s; a third number is a height. Several times for several moves."""
    seed: Seed = 1
    """Same seed, same crystals and noise; what processes do in real time is never the same."""
    listen: str = f"127.0.0.1:{DEFAULT_PORT}"
    """Where programs connect, HOST:PORT."""


@ether_app.default
@command
def ether(*, asked: EtherOptions, broker: MqttOptions, output: JsonOptions) -> None:
    """Emulate a site's air in real time: anchors and tags in other processes hear each other through it.

    It is a simulation of radios, clocks and motion; nothing is transmitted. With --json it writes at the end what the
    air has carried.
    """
    from skyless.run.ether import Ether, EtherNode
    from skyless.sim.evaluation.scenarios import Request, impairments_of, patrols

    site, address = site_named(asked.site), broker.address()
    check_live(site)
    host, port = listen_address(asked.listen, DEFAULT_PORT)
    request = Request(
        site, noise_ps=asked.noise_ps, loss=asked.loss, nlos=asked.nlos, carrier=asked.carrier, seed=asked.seed
    )
    moves = tuple(_move(text, [anchor.id for anchor in site.anchors]) for text in asked.move)
    bodies = {f"tag{number}": path for number, path in enumerate(patrols(site, asked.tags, asked.speed), start=1)}
    emulated = Ether(site, bodies, replace(impairments_of(request, site), anchor_displacements=moves), asked.seed)
    for one in moves:
        say = partial(log, f"anchor {one.anchor} is moved by {one.x_m:g}, {one.y_m:g}, {one.z_m:g} m")
        emulated.medium.timeline.at(from_seconds(one.from_s), say)
    try:
        air = EtherNode(emulated, host, DEFAULT_PORT if port is None else port, address, log)
        run_until_stopped(air.run(), punctual=True)
    except OSError as error:
        if error.errno == EADDRINUSE:
            raise SkylessError(
                f"--listen is {asked.listen!r}; another program uses this port, perhaps another ether: end it, or give "
                f"another port, and the same one to anchors and tags (--radio ether:{host}:PORT)"
            ) from None
        raise SkylessError(f"--listen is {asked.listen!r}, which cannot be used: {error.strerror or error}") from None
    if output.json:
        print_json(msgspec.to_builtins(emulated.health(time.time())))


def _move(text: str, anchors: Iterable[int]) -> "AnchorDisplacement":
    """Parse an anchor's displacement and its time. Raises SkylessError."""
    from skyless.sim.impairments import AnchorDisplacement

    name, is_named, rest = text.partition("=")
    shift, is_timed, after = rest.partition("@")
    if not (is_named and is_timed):
        raise SkylessError(f"--move is {text!r}; it should be ANCHOR=DX,DY@SECONDS or ANCHOR=DX,DY,DZ@SECONDS")
    known = {str(anchor): anchor for anchor in anchors}
    if name not in known:
        raise SkylessError(f"--move is {text!r}; its anchor should be one of the site's: {', '.join(known)}")
    x_m, y_m, z_m = (*read_numbers("--move", shift, (2, 3)), 0.0)[:3]
    (from_s,) = read_numbers("--move", after, (1,))
    if not from_s > 0.0:
        raise SkylessError(f"--move is {text!r}; the time after @ should be more than 0 s")
    return AnchorDisplacement(known[name], x_m, y_m, z_m, from_s)


flash_app = App(
    name="flash-config", help_epilogue="Example: skyless flash-config --mode tag --output nmea --rate-hz 10"
)


class FlashOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless flash-config``; those of a setting have its name in ``BoardSettings``, or are converted."""

    radio: str = "serial:/dev/ttyACM0"
    """Radio of a board that no other program uses, serial:PATH[@BAUD]; without BAUD all rates are tried."""
    defaults: bool = False
    """Begin with the settings of a new board instead of those that it has."""
    mode: Literal["radio", "tag"] | None = None
    """Mode of the board: radio, for a host's program, or tag, which computes its own position."""
    output: Literal["records", "nmea", "json", "none"] | None = None
    """What a tag says on its serial port: records for skyless tag --from-board, NMEA 0183, JSON lines, or nothing."""
    rate_hz: Literal[0, 1, 5, 10, 25, 50] | None = None
    """Fixes a second on the serial port at most; 0 for all."""
    baud: Literal[115_200, 230_400, 460_800, 1_000_000] | None = None
    """Rate of the serial port, from the answer on."""
    bluetooth_ms: Annotated[int, whole(0, 10_240)] | None = None
    """Interval of the Bluetooth advertisements in ms, from 100; 0 for none."""
    site: Annotated[SiteId | None, Option("site-id")] = None
    """Number of the site, the only one to listen to; by default the first one heard."""
    tag: Annotated[int | None, Option("tag-number"), whole(0, 0xFFFF)] = None
    """Number of the tag in its outputs."""
    tx_delay_ticks: Annotated[int | None, Option("tx-delay"), whole(0, 0xFFFF)] = None
    """Antenna delay in transmission, in ticks of 15.65 ps."""
    rx_delay_ticks: Annotated[int | None, Option("rx-delay"), whole(0, 0xFFFF)] = None
    """Antenna delay in reception, in ticks of 15.65 ps."""
    z_bounds_m: Annotated[tuple[float, float] | None, Option("z-bounds"), numbers(2, form="low,high")] = None
    """Lowest and highest height of the tag in metres, where its height is estimated."""
    sleep_s: Annotated[float, number(least=0.0, most=3600.0)] | None = None
    """Seconds that the tag sleeps between two fixes; 0 for always on."""
    superframes: Annotated[int, whole(1, 100)] | None = None
    """Superframes that the tag listens to after each sleep."""
    receive: Literal["always", "expected"] | None = None
    """Whether the tag receives always, or only when beacons are expected."""
    qa_m2ps3: Annotated[float | None, Option("qa"), number(above=0.0, most=1000.0)] = None
    """Process noise for the tags' motion: spectral density of the acceleration in m²/s³."""
    integrity_risk: Annotated[float, number(least=1e-9, most=0.1)] | None = None
    """Probability, for each fix, that the error exceeds its protection level."""
    alert_limit_m: Annotated[float, number(least=0.0, most=1000.0)] | None = None
    """Fixes whose protection level exceeds this, in metres, carry an alert; 0 for none."""

    def check(self) -> None:
        """Check limits of combined values. Raises SkylessError."""
        if self.bluetooth_ms is not None and 0 < self.bluetooth_ms < 100:
            raise wrong("--bluetooth-ms", self.bluetooth_ms, "0, or at least 100")
        if self.sleep_s is not None and 0.0 < self.sleep_s < 1e-3:
            raise wrong("--sleep-s", self.sleep_s, "0, or at least 0.001")
        if self.z_bounds_m is not None and not -1e5 <= self.z_bounds_m[0] < self.z_bounds_m[1] - 1e-3 < 1e5:
            raise wrong("--z-bounds", self.z_bounds_m, "a lower and a higher height, within 100 km")

    def changes(self) -> dict[str, Any]:
        """The given fields of ``BoardSettings``."""
        asked = {one.name: getattr(self, one.name, None) for one in fields(BoardSettings)}
        asked["mode"] = None if self.mode is None else MODES.index(self.mode)
        asked["output"] = None if self.output is None else OUTPUTS.index(self.output)
        asked["predicts"] = None if self.receive is None else int(self.receive == "expected")
        asked["sleep_ms"] = None if self.sleep_s is None else round(1000 * self.sleep_s)
        if self.z_bounds_m is not None:
            low_mm, high_mm = (round(1000 * bound_m) for bound_m in self.z_bounds_m)
            asked |= {"has_bounds": 1, "low_mm": low_mm, "high_mm": high_mm}
        return {name: value for name, value in asked.items() if value is not None}


@flash_app.default
@command
def flash_config(*, asked: FlashOptions, output: JsonOptions) -> None:
    """Set up a board that computes its own position, and show its settings; without any to change it only shows them.

    The board keeps them in its flash. It also gets the time of this computer, until it is switched off.
    """
    kind, _, port = asked.radio.partition(":")
    path, _, baud = port.partition("@")
    if kind != "serial" or not path or not (baud or "1").isdecimal():
        raise wrong("--radio", asked.radio, "a board, serial:PATH[@BAUD], as serial:/dev/ttyACM0")
    check_path(asked.radio, path)
    changes = (asdict(BoardSettings()) if asked.defaults else {}) | asked.changes()
    bauds = (int(baud),) if baud else BAUDS
    found = asyncio.run(set_up(path, bauds, Computing(changes, keeps=bool(changes))))
    settings, shown = found.settings, asdict(found.settings)
    shown |= {"mode": MODES[settings.mode], "output": OUTPUTS[settings.output]}
    if output.json:
        print_json({"radio": f"serial:{path}@{settings.baud}", "in_flash": found.in_flash, "settings": shown})
        return
    for name, value in shown.items():
        print(f"{name:<15} {value}")
    if changes and not found.in_flash:
        raise SkylessError(f"the board at {path} could not keep them in its flash: they hold until it is switched off")
    log("flash holds these settings" if found.in_flash else "flash holds other settings, or none")
