"""``skyless ether``: the emulated air."""

import time
from collections.abc import Iterable
from errno import EADDRINUSE
from functools import partial
from typing import TYPE_CHECKING, Annotated

import msgspec
from cyclopts import App
from msgspec.structs import replace

from skyless.cli.common import JsonOptions, command, print_json, status
from skyless.cli.nodes.options import (
    MqttOptions,
    WalkingSpeed,
    check_live,
    listen_address,
    log,
    run_until_stopped,
    site_named,
)
from skyless.core.arguments import Options, Picoseconds, Seed, TagCount, Text, number, read_numbers, tag_count
from skyless.core.errors import SkylessError
from skyless.core.ticks import from_seconds
from skyless.radio.emulated import DEFAULT_PORT

if TYPE_CHECKING:
    from skyless.sim.impairments import AnchorDisplacement

_Share = Annotated[float, number(least=0.0, below=1.0)]

app = App(name="ether", help_epilogue="Example: skyless ether --site lab --tags 3")


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


@app.default
@command
def ether(*, asked: EtherOptions, broker: MqttOptions, output: JsonOptions) -> None:
    """Emulate a site's air in real time: anchors and tags in other processes hear each other through it.

    It is a simulation of radios, clocks and motion; nothing is transmitted. With --json it writes at the end what the
    air has carried.
    """
    from skyless.run.ether import Ether, EtherNode
    from skyless.sim.evaluation.fleet import compile_kernels
    from skyless.sim.evaluation.scenarios import Request, impairments_of, patrols

    site, address = site_named(asked.site), broker.address()
    check_live(site)
    host, port = listen_address(asked.listen, DEFAULT_PORT)
    request = Request(
        site, noise_ps=asked.noise_ps, loss=asked.loss, nlos=asked.nlos, carrier=asked.carrier, seed=asked.seed
    )
    moves = tuple(_move(text, [anchor.id for anchor in site.anchors]) for text in asked.move)
    with status("compiling the simulation"):
        compile_kernels()
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
    """An anchor, by how much it is moved, and when. Raises SkylessError."""
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
