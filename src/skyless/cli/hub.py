"""``skyless hub``: the servers where the sites of a company meet."""

import asyncio
import os
from pathlib import Path
from typing import Annotated

from cyclopts import App
from msgspec.structs import replace

from skyless.cli.common.options import JsonOptions, command
from skyless.cli.common.output import print_json, print_table
from skyless.cli.nodes.options import log
from skyless.core.arguments import Options, Text, number, wrong
from skyless.core.errors import SkylessError
from skyless.core.extras import extra_module
from skyless.run.broker import nats_server
from skyless.run.hub.files import PLAN, SERVER, Hub, Node, new_hub, read_hub, read_node, with_sites, write_files

app = App(name="hub", help_epilogue="Example: skyless hub init hub --node a.example --node b.example --node c.example")


def _read_sites(option: str, text: str) -> tuple[int, ...]:
    """Numbers and ranges of numbers of sites. Raises SkylessError."""
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not all(one.isdecimal() and int(one) <= 0xFFFD for one in (first, last if dash else first)):
            raise wrong(option, text, "numbers of sites, 0 to 65533, as 7 or 7,9,20-40")
        found += range(int(first), int(last if dash else first) + 1)
    return tuple(found)


class InitOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless hub init``."""

    folder: Path
    """Folder for the hub's files. It holds all passwords."""
    node: Annotated[tuple[Node, ...], Text(read_node, "HOST or HOST:PORT", many=True)] = ()
    """Server of the hub, as sites and dashboards reach it; given 1, 3 or 5 times when the hub is new."""
    tenant: str = "plant"
    """Tenant whose sites are meant: no tenant sees anything of another."""
    sites: Annotated[tuple[int, ...], Text(_read_sites, "7 or 7,9,20-40")] = ()
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
    folder = asked.folder
    if (folder / PLAN).exists():
        hub = read_hub(folder)
        if asked.node and asked.node != hub.nodes:
            names = " ".join(f"--node {node.host}:{node.port}" for node in hub.nodes)
            raise SkylessError(f"--node differs from {folder / PLAN}; it should be left out, or {names}")
    else:
        hub = new_hub(asked.node)
    folders = {"data": asked.data, "certificates": asked.certificates}
    given = {name: str(path.absolute()) for name, path in folders.items() if path is not None}
    hub = replace(hub, **given, fixes_gb=asked.fixes_gb or hub.fixes_gb)
    changed = write_files(with_sites(hub, asked.tenant, asked.sites), folder)
    if output.json:
        print_json({"changed": changed})
        return
    rows = [(str(file), _destination(hub, file)) for file in changed if file.name != PLAN]
    print_table("Files", ("written", "for"), rows)
    if hub.loopback:
        log(f"run each server with skyless hub run {folder} NODE; kill -HUP PID where it runs already")
    else:
        log(f"every machine needs {hub.ca}, and each server its own cert.pem and key.pem there (docs/hub.md)")
        log("start each server with systemctl enable --now skyless-hub; systemctl reload where it runs already")
    log(f"then: skyless hub apply {folder}")


def _destination(hub: Hub, file: Path) -> str:
    """Where a file goes."""
    if file.name == SERVER:
        return "it stays here" if hub.loopback else f"{file.parent.name}:/etc/skyless-hub/"
    return "dashboards: set -a; . FILE" if file.suffix == ".env" else "the site: skyless broker --gather --hub FILE"


@app.command
@command
def apply(folder: Path, /, *, tenant: str | None = None, output: JsonOptions) -> None:
    """Make the streams of a hub whose servers run, or extend them, and say which sites are heard.

    Parameters
    ----------
    folder
        Folder of skyless hub init.
    tenant
        Tenant whose streams are made; by default those of all.
    """
    extra_module("nats", "skyless hub apply")
    from skyless.run.hub.apply import apply as make

    hub = read_hub(folder)
    if tenant is not None and tenant not in hub.tenants:
        raise wrong("--tenant", tenant, f"one of {', '.join(hub.tenants)}")
    if hub.ca is not None and not hub.ca.exists():
        raise SkylessError(f"{hub.ca} is missing; it should hold the certificate that those of the hub are signed with")
    found = {
        name: asyncio.run(make(hub, name, log)) for name in ((tenant,) if tenant is not None else sorted(hub.tenants))
    }
    if output.json:
        print_json({"tenants": found})
        return
    rows = [
        (name, str(site), f"{said.site or 'no name yet'}, gathered at {said.host}" if said else "not heard")
        for name, sites in found.items()
        for site, said in sites.items()
    ]
    print_table("The streams are there", ("tenant", "site", "heard"), rows)


@app.command
@command
def run(folder: Path, node: str, /, *, output: JsonOptions) -> None:
    """Run a server of a hub in the foreground until Ctrl-C, for a trial on one machine.

    Parameters
    ----------
    folder
        Folder of skyless hub init.
    node
        HOST or HOST:PORT of the server.
    """
    names = {name: one.name for one in read_hub(folder).nodes for name in (one.name, f"{one.host}:{one.port}")}
    if node not in names:
        raise wrong("NODE", node, f"one of {', '.join(names)}")
    file = folder / names[node] / SERVER
    program = nats_server()
    if output.json:
        print_json({"pid": os.getpid(), "file": file})
    os.execv(program, (str(program), "-c", str(file)))
