"""``skyless ether``: the emulated air."""

import contextlib
from typing import Annotated

from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.cli.common.options import Picoseconds, Seed, options
from skyless.cli.common.simulated_site import check_live
from skyless.cli.nodes.options import MqttOptions, WalkingSpeed, listen_address, log, site_named
from skyless.errors import SkylessError
from skyless.radios.ether_wire import DEFAULT_PORT

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
    """Share of receptions that are lost."""
    nlos: _Share = 0.0
    """Share of receptions that an obstacle delays."""
    seed: Seed = 1
    """Same seed, same crystals and noise; what processes do in real time is never the same."""
    listen: str = f"127.0.0.1:{DEFAULT_PORT}"
    """Where programs connect."""


@app.default
def ether(*, asked: EtherOptions = EtherOptions(), broker: MqttOptions = MqttOptions()) -> None:
    """Emulate a site's air in real time: anchors and tags in other processes hear each other through it.

    It is a simulation of radios, clocks and motion; nothing is transmitted.

    Parameters
    ----------
    broker.mqtt
        Broker for the truth about the tags and the air's health, or none.
    """
    from skyless.evaluation.compile_ahead import compile_kernels
    from skyless.evaluation.scenarios import Request, impairments_of, patrols
    from skyless.nodes.ether import Ether, EtherNode
    from skyless.nodes.process import run

    site, address = site_named(asked.site), broker.address()
    check_live(site)
    host, port = listen_address(asked.listen, DEFAULT_PORT)
    request = Request(site, noise_ps=asked.noise_ps, loss=asked.loss, nlos=asked.nlos, seed=asked.seed)
    compile_kernels()
    bodies = {f"tag{number}": path for number, path in enumerate(patrols(site, asked.tags, asked.speed), start=1)}
    emulated = Ether(site, bodies, impairments_of(request, site), asked.seed)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            run(EtherNode(emulated, host, DEFAULT_PORT if port is None else port, address, log).run(), punctual=True)
    except OSError as error:
        raise SkylessError(f"--listen is {asked.listen!r}, which cannot be used: {error.strerror or error}") from None
