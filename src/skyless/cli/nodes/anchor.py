"""``skyless anchor``: anchors as a program."""

import contextlib
import time
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from skyless.cli.common.options import command
from skyless.cli.common.output import print_json
from skyless.cli.nodes.options import MqttOptions, log, site_named
from skyless.core.errors import SkylessError
from skyless.run.open_radio import DEFAULT_RADIO

app = App(name="anchor", help_epilogue="Example: skyless anchor 3 --site site.toml")


@app.default
@command
def anchor(
    *ids: Annotated[int, Parameter(name="IDS")],
    site: str = "lab",
    radio: str = DEFAULT_RADIO,
    keys: Annotated[Path | None, Parameter(env_var="SKYLESS_KEYS")] = None,
    allow_placement: bool = False,
    broker: MqttOptions,
    json: bool = False,
) -> None:
    """Run anchors of a site until Ctrl-C.

    Anchors send at random instants or, at a site of the paper's protocol, in slots on the master's time. They work
    with or without a broker.

    Parameters
    ----------
    ids
        Identifiers of one or more anchors in the site file.
    site
        Site file, or lab.
    radio
        Radio of the anchors: ether:HOST:PORT is the emulated air of skyless ether, serial:PATH a board,
        spi:BUS.DEVICE,irq=PIN,reset=PIN a DW1000 on this computer's SPI, model:HOST:PORT a model of one on that air.
    keys
        Folder of the site's keys, so that beacons carry codes (mode free): site.public, chain-N.public and
        chain-N.seed of skyless site keys. Files that change are used without a restart. SKYLESS_CHAIN_SEEDS, as
        "1:HEX 2:HEX", may hold the seeds instead.
    allow_placement
        With keys: adopt every survey that is saved, as while a site is set up. Otherwise an anchor with keys adopts
        positions and delays up to 0.5 m from those of its site file.
    json
        Write one JSON object at the end: the last health of each anchor.
    """
    from skyless.radio.interface import AntennaDelays
    from skyless.run.anchor import Anchors
    from skyless.run.keys.node_keys import AnchorKeys
    from skyless.run.open_radio import is_simulated, open_radios
    from skyless.run.process import run
    from skyless.site.file.check import plan_files

    plan, address = site_named(site), broker.address()
    nodes = {node.id: node for node in plan.all_anchors}
    if not ids or len(set(ids)) < len(ids) or not set(ids) <= set(nodes):
        given = " ".join(map(str, ids)) or "missing"
        raise SkylessError(
            f"IDS is {given}; it should be one or more of the site's, each once: {' '.join(map(str, nodes))}"
        )
    delays = [AntennaDelays(nodes[i].tx_antenna_delay_ticks, nodes[i].rx_antenna_delay_ticks) for i in ids]
    radios = open_radios(radio, "anchor", tuple(map(str, ids)), delays, phases=plan.schedule.sends_phases)
    chains = None
    if keys is not None:
        if plan.schedule.needs_master:
            raise SkylessError(
                f'--keys is given, but {site} has schedule.mode "master", whose beacons carry no codes; it should be '
                "free"
            )
        chains = AnchorKeys(keys, plan.id, log)
    anchors = Anchors(
        plan,
        radios,
        address,
        log,
        simulated=lambda: is_simulated(radio),
        plans=plan_files(plan, Path(site)),
        keys=chains,
        allow_placement=allow_placement,
    )
    with contextlib.suppress(KeyboardInterrupt):
        run(anchors.run(), punctual=True)
    if json:
        print_json({"anchors": anchors.healths(time.time(), time.monotonic())})
