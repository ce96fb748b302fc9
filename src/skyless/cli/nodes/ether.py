"""``skyless ether``: the emulated air."""

import contextlib
from typing import Annotated

from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.cli.common.options import Picoseconds
from skyless.cli.nodes.options import DEFAULT_MQTT, Mqtt, MqttCa, broker, listen_address, say, site_named
from skyless.errors import SkylessError
from skyless.radios.ether_wire import DEFAULT_PORT

app = App(name="ether", help_epilogue="Example: skyless ether --site lab --tags 3")
Share = Annotated[float, Parameter(validator=Number(gte=0, lte=1))]


@app.default
def ether(
    *,
    site: str = "lab",
    tags: Annotated[int, Parameter(validator=Number(gte=0, lte=1000))] = 3,
    speed: Annotated[float, Parameter(validator=Number(gt=0, lte=10))] = 1.0,
    noise_ps: Picoseconds | None = None,
    loss: Share = 0.0,
    nlos: Share = 0.0,
    seed: Annotated[int, Parameter(validator=Number(gte=0))] = 1,
    listen: str = f"127.0.0.1:{DEFAULT_PORT}",
    mqtt: Mqtt = DEFAULT_MQTT,
    mqtt_ca: MqttCa = None,
) -> None:
    """Emulate a site's air in real time: anchors and tags in other processes hear each other through it.

    It is a simulation of radios, clocks and motion; nothing is transmitted.

    Parameters
    ----------
    site
        Site file, or lab.
    tags
        How many bodies walk about; programs take their places as tag1, tag2 and so on.
    speed
        How fast they walk in m/s.
    noise_ps
        Noise of every TX and RX stamp in picoseconds; by default what the site file says.
    loss
        Share of receptions that are lost.
    nlos
        Share of receptions that come late by an obstacle.
    seed
        Same seed, same crystals and noise; what processes do in real time is never the same.
    listen
        Where programs join.
    mqtt
        Broker for the truth about the tags and the air's health, or none.
    mqtt_ca
        Certificates (PEM) to trust for mqtts.
    """
    from skyless.evaluation.compile_ahead import compile_kernels
    from skyless.evaluation.scenarios import Request, impairments_of, patrols
    from skyless.nodes.ether import Ether, EtherNode
    from skyless.nodes.process import run

    plan, address = site_named(site), broker(mqtt, mqtt_ca)
    host, port = listen_address(listen, DEFAULT_PORT)
    request = Request(plan, noise_ps=noise_ps, loss=loss, nlos=nlos, seed=seed)
    compile_kernels()
    bodies = {f"tag{number}": path for number, path in enumerate(patrols(plan, tags, speed), start=1)}
    emulated = Ether(plan, bodies, impairments_of(request, plan), seed)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            run(EtherNode(emulated, host, DEFAULT_PORT if port is None else port, address, say).run(), punctual=True)
    except OSError as error:
        raise SkylessError(f"--listen is {listen!r}, which cannot be used: {error.strerror or error}") from None
