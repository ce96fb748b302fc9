"""``skyless anchor``: anchors as a program."""

import time
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from skyless.arguments import Options
from skyless.cli.common import JsonOptions, command, print_json
from skyless.cli.nodes.options import MqttOptions, log, run_until_stopped, site_named
from skyless.core.errors import SkylessError
from skyless.radio.interface import AntennaDelays
from skyless.run.anchor import Anchors
from skyless.run.keys import AnchorKeys
from skyless.run.open_radio import DEFAULT_RADIO, is_simulated, open_radios
from skyless.site.file.check import plan_files

app = App(name="anchor", help_epilogue="Example: skyless anchor 3 --site site.toml")


class AnchorOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless anchor``."""

    site: str = "lab"
    """Site file, or lab."""
    radio: str = DEFAULT_RADIO
    """Radio of the anchors: ether:HOST:PORT is the emulated air of skyless ether, serial:PATH a board,
    spi:BUS.DEVICE,irq=PIN,reset=PIN a DW1000 on this computer's SPI, model:HOST:PORT a model of one on that air."""
    keys: Annotated[Path | None, Parameter(env_var="SKYLESS_KEYS")] = None
    """Folder of the site's keys, so that beacons carry codes (mode free): site.public, chain-N.public and chain-N.seed
    of skyless site keys. Files that change are used without a restart. SKYLESS_CHAIN_SEEDS, as "1:HEX 2:HEX", may hold
    the seeds instead."""
    allow_placement: bool = False
    """With keys: adopt every survey that is saved, as while a site is set up. Otherwise an anchor with keys adopts
    positions and delays up to 0.5 m from those of its site file."""


_Ids = Annotated[int, Parameter(name="IDS", help="Identifiers of one or more anchors in the site file.")]


@app.default
@command
def anchor(*ids: _Ids, asked: AnchorOptions, broker: MqttOptions, output: JsonOptions) -> None:
    """Run anchors of a site until Ctrl-C; with --json the last health of each is written at the end.

    Anchors send at random instants or, at a site of the paper's protocol, in slots on the master's time. They work
    with or without a broker.
    """
    plan, address = site_named(asked.site), broker.address()
    nodes = {node.id: node for node in plan.all_anchors}
    if not ids or len(set(ids)) < len(ids) or not set(ids) <= set(nodes):
        given = " ".join(map(str, ids)) or "missing"
        raise SkylessError(
            f"IDS is {given}; it should be one or more of the site's, each once: {' '.join(map(str, nodes))}"
        )
    delays = [AntennaDelays(nodes[i].tx_antenna_delay_ticks, nodes[i].rx_antenna_delay_ticks) for i in ids]
    radios = open_radios(asked.radio, "anchor", tuple(map(str, ids)), delays, phases=plan.schedule.sends_phases)
    chains = None
    if asked.keys is not None:
        if plan.schedule.needs_master:
            raise SkylessError(
                f'--keys is given, but {asked.site} has schedule.mode "master", whose beacons carry no codes; '
                "it should be free"
            )
        chains = AnchorKeys(asked.keys, plan.id, log)
    anchors = Anchors(
        plan,
        radios,
        address,
        log,
        simulated=lambda: is_simulated(asked.radio),
        plans=plan_files(plan, Path(asked.site)),
        keys=chains,
        allow_placement=asked.allow_placement,
    )
    run_until_stopped(anchors.run(), punctual=True)
    if output.json:
        print_json({"anchors": anchors.healths(time.time(), time.monotonic())})
