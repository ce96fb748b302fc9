"""``skyless ether``: the emulated air."""

import contextlib
import time
from collections.abc import Iterable
from errno import EADDRINUSE
from functools import partial
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter
from cyclopts.validators import Number
from msgspec.structs import replace

from skyless.cli.common.options import Picoseconds, Seed, finite_numbers, options
from skyless.cli.common.output import print_json
from skyless.cli.common.progress import loading_kernels
from skyless.cli.common.simulated_site import check_live
from skyless.cli.nodes.options import MqttOptions, WalkingSpeed, listen_address, log, site_named
from skyless.errors import SkylessError
from skyless.method_names import WEIGHTED
from skyless.radios.ether_wire import DEFAULT_PORT
from skyless.ticks import from_seconds

if TYPE_CHECKING:
    from skyless.simulation.impairments import AnchorDisplacement

_Share = Annotated[float, Parameter(validator=Number(gte=0, lte=1))]

app = App(name="ether", help_epilogue="Example: skyless ether --site lab --tags 3")


@options
class EtherOptions:
    """Options of ``skyless ether``."""

    site: str = "lab"
    """Site file, or lab."""
    tags: Annotated[int, Parameter(validator=Number(gte=0, lte=1000))] = 3
    """How many bodies walk about; programs connect as tag1, tag2 and so on."""
    speed: WalkingSpeed = 1.0
    """How fast they walk in m/s."""
    noise_ps: Picoseconds | None = None
    """Noise of every TX and RX stamp in picoseconds; by default that of the site file."""
    loss: _Share = 0.0
    """Probability that a message is lost."""
    nlos: _Share = 0.0
    """Probability that a message reaches a tag late, as an obstacle delays it."""
    move: list[str] | None = None
    """Move an anchor while the air runs, from its position in the site file, as if somebody had hung it elsewhere:
    4=0.3,0@60 by 0.3 m along x after 60 s; a third number is a height. Several times for several moves."""
    seed: Seed = 1
    """Same seed, same crystals and noise; what processes do in real time is never the same."""
    listen: str = f"127.0.0.1:{DEFAULT_PORT}"
    """Where programs connect, HOST:PORT."""
    json: bool = False
    """Write one JSON object at the end: what the air has carried."""


@app.default
def ether(*, asked: EtherOptions = EtherOptions(), broker: MqttOptions = MqttOptions()) -> None:
    """Emulate a site's air in real time: anchors and tags in other processes hear each other through it.

    It is a simulation of radios, clocks and motion; nothing is transmitted.

    Parameters
    ----------
    broker.mqtt
        Broker to publish the truth about the tags and the air's health to, or none.
    """
    from skyless.evaluation.compile_ahead import compile_kernels
    from skyless.evaluation.scenarios import Request, impairments_of, patrols
    from skyless.nodes.ether import Ether, EtherNode
    from skyless.nodes.process import run
    from skyless.preparation.parts import SIMULATED

    site, address = site_named(asked.site), broker.address()
    check_live(site)
    host, port = listen_address(asked.listen, DEFAULT_PORT)
    request = Request(site, noise_ps=asked.noise_ps, loss=asked.loss, nlos=asked.nlos, seed=asked.seed)
    moves = tuple(_move(text, [anchor.id for anchor in site.anchors]) for text in asked.move or ())
    with loading_kernels(SIMULATED):
        compile_kernels(WEIGHTED)
    bodies = {f"tag{number}": path for number, path in enumerate(patrols(site, asked.tags, asked.speed), start=1)}
    emulated = Ether(site, bodies, replace(impairments_of(request, site), anchor_displacements=moves), asked.seed)
    for one in moves:
        say = partial(log, f"anchor {one.anchor} is moved by {one.x_m:g}, {one.y_m:g}, {one.z_m:g} m")
        emulated.medium.timeline.at(from_seconds(one.from_s), say)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            run(EtherNode(emulated, host, DEFAULT_PORT if port is None else port, address, log).run(), punctual=True)
    except OSError as error:
        if error.errno == EADDRINUSE:
            raise SkylessError(
                f"--listen is {asked.listen!r}; another program uses this port, perhaps another ether: end it, or give "
                f"another port, and the same one to anchors and tags (--radio ether:{host}:PORT)"
            ) from None
        raise SkylessError(f"--listen is {asked.listen!r}, which cannot be used: {error.strerror or error}") from None
    if asked.json:
        import msgspec

        print_json(msgspec.to_builtins(emulated.health(time.time())))


def _move(text: str, anchors: Iterable[int]) -> "AnchorDisplacement":
    """An anchor, by how much it is moved, and when. Raises SkylessError."""
    from skyless.simulation.impairments import AnchorDisplacement

    name, is_named, rest = text.partition("=")
    shift, is_timed, after = rest.partition("@")
    if not (is_named and is_timed):
        raise SkylessError(f"--move is {text!r}; it should be ANCHOR=DX,DY@SECONDS or ANCHOR=DX,DY,DZ@SECONDS")
    known = {str(anchor): anchor for anchor in anchors}
    if name not in known:
        raise SkylessError(f"--move is {text!r}; its anchor should be one of the site's: {', '.join(known)}")
    x_m, y_m, z_m = (*finite_numbers("move", shift, (2, 3)), 0.0)[:3]
    (from_s,) = finite_numbers("move", after, (1,))
    if not from_s > 0.0:
        raise SkylessError(f"--move is {text!r}; the time after @ should be more than 0 s")
    return AnchorDisplacement(known[name], x_m, y_m, z_m, from_s)
