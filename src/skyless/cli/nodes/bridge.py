"""``skyless bridge``: give a running site's fixes to other programs and devices."""

from typing import Annotated

import msgspec
from cyclopts import App, Parameter

from skyless.bridges.program import BridgeNode, BridgeState
from skyless.bridges.target import BridgeContext, Hub, open_hub
from skyless.bridges.targets import TARGET_KINDS, open_route
from skyless.cli.common import JsonOptions, command, print_json
from skyless.cli.nodes.options import SiteOptions, log, run_until_stopped
from skyless.core.errors import SkylessError
from skyless.run.find_site import find_site
from skyless.run.mqtt.address import MqttAddress

_EXAMPLE = "Example: skyless bridge nmea+tcp://:10110, and then: gpsd -N -n tcp://127.0.0.1:10110"


def _targets() -> str:
    """Table of schemes for the help."""
    rows = [f"{scheme}: {kind.summary}." for scheme, kind in TARGET_KINDS.items()]
    keys = "Every target takes ?tag=NAME, the only tag that it gets, and &hz=RATE, fixes a second and tag at most."
    return "\n\n".join(["Targets:", *rows, keys, _EXAMPLE])


app = App(name="bridge", help_epilogue=_targets())


_Targets = Annotated[str, Parameter(name="TARGETS", help="Addresses of one or more targets, as listed below.")]


@app.default
@command
def bridge(*targets: _Targets, live: SiteOptions, output: JsonOptions) -> None:
    """Give a running site's fixes to programs and devices of other kinds until Ctrl-C.

    A reader that is too slow misses fixes and delays nobody. Where a tag has no fix, readers get to know that, in the
    way of each; they never get an old position with a new time.
    """
    address = live.required("the site's broker (skyless tag --to needs none)")
    if not targets:
        raise SkylessError("TARGETS is missing; it should be one or more, as nmea+tcp://:10110 (see --help)")
    hub = hub_of(targets, address)
    nodes: list[BridgeNode] = []
    run_until_stopped(_bridge(hub, address, live.site_id, nodes))
    if nodes:
        _report(nodes[0].state(), json=output.json)


def hub_of(targets: tuple[str, ...], address: MqttAddress | None) -> Hub:
    """Open the hub that gives fixes to targets. Raises SkylessError if a target is wrong."""
    context = BridgeContext(log, address)
    return open_hub([open_route(target, context) for target in targets], log)


async def _bridge(hub: Hub, address: MqttAddress, site_id: int | None, nodes: list[BridgeNode]) -> None:
    site = await find_site(address) if site_id is None else site_id
    node = BridgeNode(hub, address, site, log)
    nodes.append(node)
    log(f"bridging site {site} of {address} to {', '.join(route.target.text for route in hub.routes)}; Ctrl-C ends")
    await node.run()


def _report(state: BridgeState, *, json: bool) -> None:
    if json:
        print_json(msgspec.to_builtins(state))
        return
    print(f"{state.fixes} fixes in {state.seconds:.1f} s")
    for target, reasons in state.dropped.items():
        for reason, number in sorted(reasons.items()):
            print(f"  {target}: dropped, {reason}: {number}")
    if state.malformed:
        print(f"  messages of the broker that could not be read: {state.malformed}")
