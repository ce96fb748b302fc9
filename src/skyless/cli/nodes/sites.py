"""``skyless sites``: the sites of a broker or at a hub."""

import asyncio
import time
from datetime import datetime
from typing import Any

from cyclopts import App
from rich.live import Live
from rich.table import Table

from skyless.cli.common.options import JsonOptions, command
from skyless.cli.common.output import console, print_json
from skyless.cli.nodes.options import HubUrl, MqttOptions, hub_address, run_until_stopped
from skyless.core.errors import SkylessError
from skyless.run.find_site import SiteOnBroker, watch_sites
from skyless.run.process import together

_LISTEN_S = 2.5
_DASH = "–"

app = App(name="sites", help_epilogue="Example: skyless sites --hub nats://plant@hub-a.example,hub-b.example")


@app.default
@command
def sites(*, broker: MqttOptions, hub: HubUrl = None, watch: bool = False, output: JsonOptions) -> int:
    """List the sites at a hub, with condition, tags, anchors and versions, those in trouble first.

    Without a hub, those of the broker, with the programs that are online. The exit code is 0 if there are sites and all
    are good, or on a broker have programs online; else 1.

    Parameters
    ----------
    hub
        Hub whose sites are listed, nats://[USER@]HOST[:PORT],HOST... or tls://...; by default the broker is asked.
    watch
        Stay, and show changes until Ctrl-C.
    """
    if watch and output.json:
        raise SkylessError("--watch and --json exclude each other; give one of them")
    listed = _OfBroker(broker) if hub is None else _OfHub(hub, broker)
    answered: list[bool] = []
    run_until_stopped(_watch(listed) if watch else _listen(listed, answered))
    if watch:
        return 0
    if answered != [True]:
        raise SkylessError(f"{listed.address} has not answered within {_LISTEN_S:g} s")
    if output.json:
        print_json({"sites": listed.sites()})
    else:
        console().print(listed.table())
    return 0 if listed.sites() and listed.all_good() else 1


class _OfBroker:
    """The sites of a broker."""

    def __init__(self, broker: MqttOptions) -> None:
        self.address = broker.required("the broker whose sites are listed")
        self.connected = False
        self._sites: list[SiteOnBroker] = []

    def sites(self) -> list[SiteOnBroker]:
        return self._sites

    def all_good(self) -> bool:
        return all(site.online for site in self._sites)

    def table(self) -> Table:
        table = Table("site", "name", "programs online", "versions")
        for site in self._sites:
            table.add_row(str(site.number), site.name, str(site.online), _versions(site.versions))
        return table

    async def run(self) -> None:
        await watch_sites(self.address, self._on_sites, self._on_state)

    def _on_sites(self, found: list[SiteOnBroker]) -> None:
        self._sites = found

    def _on_state(self, connected: bool) -> None:
        self.connected = connected


class _OfHub:
    """The sites at a hub."""

    def __init__(self, hub: str, broker: MqttOptions) -> None:
        if broker.mqtt is not None:
            raise SkylessError("--hub and --mqtt exclude each other; give one of them")
        self.address = hub_address(hub, broker.mqtt_ca)
        from skyless.run.hub.sites import HubSites

        self._known = HubSites(self.address, time.monotonic())

    @property
    def connected(self) -> bool:
        return self._known.connected

    def sites(self) -> list[Any]:
        return self._known.sites(time.monotonic())

    def all_good(self) -> bool:
        return all(site.condition == "good" for site in self.sites())

    def table(self) -> Table:
        table = Table("site", "name", "condition", "tags", "anchors", "versions", "last heard", "reason")
        for site in self.sites():
            heard = _DASH if site.heard_unix_s is None else f"{datetime.fromtimestamp(site.heard_unix_s):%H:%M:%S}"
            counts = (_DASH if count is None else str(count) for count in (site.tags_heard, site.anchors_online))
            versions = _versions(site.versions or {})
            table.add_row(str(site.number), site.name, site.condition, *counts, versions, heard, site.reason)
        return table

    async def run(self) -> None:
        await self._known.run("skyless sites")


def _versions(versions: dict[str, int]) -> str:
    return ", ".join(f"{version} ({count})" for version, count in sorted(versions.items())) or _DASH


async def _listen(listed: _OfBroker | _OfHub, answered: list[bool]) -> None:
    listening = asyncio.ensure_future(listed.run())
    done, _ = await asyncio.wait((listening,), timeout=_LISTEN_S)
    for task in done:
        task.result()
    answered.append(listed.connected)
    listening.cancel()
    await asyncio.gather(listening, return_exceptions=True)


async def _watch(listed: _OfBroker | _OfHub) -> None:
    with Live(console=console(), screen=True, auto_refresh=False) as live:

        async def draw() -> None:
            while True:
                live.update(listed.table(), refresh=True)
                await asyncio.sleep(1.0)

        await together(listed.run(), draw())
