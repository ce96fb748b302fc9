"""``skyless sites``: the sites of a broker or at a hub."""

import asyncio
import time
from collections.abc import Coroutine
from datetime import datetime
from typing import TYPE_CHECKING, Any, Final

from cyclopts import App

from skyless.cli.common import JsonOptions, command, print_json, print_table
from skyless.cli.nodes.options import HubUrl, MqttOptions, hub_address, run_until_stopped
from skyless.core.errors import SkylessError
from skyless.run.find_site import SiteOnBroker, watch_sites

if TYPE_CHECKING:
    from skyless.run.hub import HubSite

_LISTEN_S: Final = 2.5
_DASH: Final = "–"

app = App(name="sites", help_epilogue="Example: skyless sites --hub nats://plant@hub-a.example,hub-b.example")


@app.default
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
