"""``skyless hub``: the servers where the sites of a company meet."""

import asyncio
import re
from pathlib import Path
from typing import Annotated

from cyclopts import App
from msgspec.structs import replace

from skyless.cli.common import JsonOptions, command, print_json, print_table
from skyless.cli.nodes.options import log
from skyless.core.arguments import Options, Text, number, wrong
from skyless.core.errors import SkylessError
from skyless.core.extras import extra_module
from skyless.run.gather.node import read_json
from skyless.run.hub import PLAN, Hub, Node, read_node, with_sites, write_files

app = App(name="hub", help_epilogue="Example: skyless hub init hub --node a.example --node b.example --node c.example")


def _read_sites(option: str, text: str) -> tuple[int, ...]:
    if not all(number.isdecimal() and int(number) <= 0xFFFD for number in text.split(",")):
        raise wrong(option, text, "numbers of sites, 0 to 65533, with commas between")
    return tuple(map(int, text.split(",")))


class InitOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless hub init``."""

    folder: Path
    """Folder for the hub's files. It holds all passwords."""
    node: Annotated[tuple[Node, ...], Text(read_node, "HOST or HOST:PORT", many=True)] = ()
    """Server of the hub, as sites and dashboards reach it; given 1, 3 or 5 times when the hub is new."""
    tenant: str = "plant"
    """Tenant whose sites are meant: no tenant sees anything of another."""
    sites: Annotated[tuple[int, ...], Text(_read_sites, "7,8,9")] = ()
    """Numbers of sites that come to the hub."""
    fixes_gb: Annotated[float | None, number(above=0.0, most=1e6)] = None
    """Gigabytes of fixes that each server keeps of each tenant, at most those of 24 hours; at first 50."""
    data: Path | None = None
    """Folder for the streams at each server; at first /var/lib/skyless-hub."""
    certificates: Path | None = None
    """Folder of ca.pem at each machine, and of cert.pem and key.pem at each server; at first /etc/skyless-hub."""


@app.command
@command
def init(*, asked: InitOptions, output: JsonOptions) -> None:
    """Write the files of a hub's servers, sites and tenants, or add sites or a tenant to them.

    It says what to copy where. Passwords that are there stay. Servers that are all on this machine use no TLS.
    """
    folder, plan = asked.folder, asked.folder / PLAN
    if not re.fullmatch(r"[a-z][a-z0-9-]{0,30}", asked.tenant):
        raise wrong("--tenant", asked.tenant, "a letter, then at most 30 small letters, digits and hyphens")
    if not plan.exists() and len(set(asked.node)) not in {1, 3, 5}:
        raise SkylessError(f"--node was given {len(set(asked.node))} times; it should name 1, 3 or 5 servers")
    hub = read_json(plan, Hub, "skyless hub init") if plan.exists() else Hub(asked.node)
    if asked.node not in ((), hub.nodes):
        raise SkylessError(f"--node differs from the nodes in {plan}; it should be left out")
    folders = {"data": asked.data, "certificates": asked.certificates}
    given = {name: str(path.absolute()) for name, path in folders.items() if path is not None}
    hub = replace(hub, **given, fixes_gb=asked.fixes_gb or hub.fixes_gb)
    changed = write_files(with_sites(hub, asked.tenant, asked.sites), folder)
    if output.json:
        print_json({"changed": changed})
        return
    users = {"sites": "skyless broker --gather --hub FILE", "tenants": "dashboards: set -a; . FILE"}
    start = "nats-server -c FILE" if hub.ca is None else "systemctl enable --now skyless-hub"
    rows = [(str(file), users.get(file.parent.name, f"{start}, or reload it")) for file in changed if file != plan]
    print_table("Files", ("copied to their machines", "for"), rows)
    if hub.ca is not None:
        log(f"every machine needs {hub.ca}, and each server its own cert.pem and key.pem there (docs/hub.md)")
    log(f"when the servers run: skyless hub apply {folder}")


@app.command
@command
def apply(folder: Path, /, *, output: JsonOptions) -> None:
    """Make the streams of all tenants of a hub, or extend them, and say which sites are heard.

    Parameters
    ----------
    folder
        Folder of skyless hub init.
    """
    extra_module("nats", "skyless hub apply")
    from skyless.run.hub import make_streams_of

    hub = read_json(folder / PLAN, Hub, "skyless hub init")
    found = {tenant: asyncio.run(make_streams_of(hub, tenant, log)) for tenant in hub.sites}
    if output.json:
        print_json({"tenants": found})
        return
    for tenant, sites in found.items():
        print(f"{tenant}: the streams are there")
        for site, said in sites.items():
            print(f"  site {site}", f"{said.site!r}, gathered at {said.host}" if said else "not heard", sep=": ")
