"""``skyless broker``, ``skyless gather`` and ``skyless hub``: the servers of a site and of several sites."""

import asyncio
import contextlib
import os
import re
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from msgspec.structs import replace

from skyless.arguments import Options, Text, number, whole, wrong
from skyless.cli.common import JsonOptions, command, make_folder, print_json, print_table
from skyless.cli.nodes.options import GatherOptions, listen_address, log, run_until_stopped
from skyless.core.errors import SkylessError
from skyless.machine import extra_module
from skyless.run.broker import FIRST_PORT, Broker, BrokerSettings, start_broker
from skyless.run.find_site import SiteOnBroker, watch_sites
from skyless.run.gather.subjects import NatsAddress, nats_address
from skyless.run.hub_files import PLAN, Hub, Leaf, Node, StuckLineError, read_json, read_node, with_sites, write_files
from skyless.run.mqtt.address import PASSWORD_VARIABLE, MqttAddress, Role, create_access, mqtt_address, read_access
from skyless.run.process import Child, Program, together

app = App(name="broker", help_epilogue="Example: skyless broker --port 1883")


class BrokerOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless broker``."""

    port: Annotated[int | None, whole(1, 65535)] = None
    """Port to listen on; by default 1883, or the next port that is free."""
    listen: str = "127.0.0.1"
    """Where programs connect, HOST:PORT or HOST; 0.0.0.0 means all addresses of this machine."""
    data: Path | None = None
    """Folder for retained messages and sessions; by default skyless/broker in the user's data folder."""
    user: str | None = None
    """Name that clients must give; their password is taken from SKYLESS_MQTT_PASSWORD. They may do everything."""
    access: Path | None = None
    """Folder of passwords, made by skyless broker access: each role of clients may do what docs/mqtt.md says."""
    strangers_read: bool = False
    """Admit clients without user and password, which may read fixes and the site and publish nothing."""
    certificate: Path | None = None
    """Certificate in PEM form; with it and --key the broker uses TLS."""
    key: Path | None = None
    """Private key of the certificate in PEM form."""
    gather: bool = False
    """Also run skyless gather, for a site with thousands of tags: its port of NATS serves this machine alone."""
    hub: Path | None = None
    """File of the site's line to a hub, made by skyless hub init; the site is the one of this file (docs/hub.md)."""
    history: Path | None = None
    """Folder of the history to keep of every site that runs on this broker; by default none."""


@app.default
@command
def broker(*, asked: BrokerOptions, gathered: GatherOptions, output: JsonOptions) -> None:
    """Run an MQTT broker until Ctrl-C, and print its address when it is ready.

    It serves this machine alone unless --listen is given, and then asks for a name and a password.
    """
    password = None if asked.user is None else os.environ.get(PASSWORD_VARIABLE)
    host, port = listen_address(asked.listen, FIRST_PORT)
    if asked.port is not None and port not in (None, asked.port):
        raise SkylessError(f"--port is {asked.port}, and --listen is {asked.listen!r}; give the port once")
    leaf = None if asked.hub is None else read_json(asked.hub, Leaf)
    if leaf is not None:
        gathered.leave_out("site_id", why=f"{asked.hub} is of site {leaf.site}")
        gathered = replace(gathered, site_id=leaf.site)
    settings = BrokerSettings(
        port=asked.port or port,
        listen=host,
        data=asked.data,
        user=asked.user,
        password=password,
        certificate=asked.certificate,
        key=asked.key,
        roles=None if asked.access is None else read_access(asked.access),
        strangers_read=asked.strangers_read,
        gathered_bytes=round(1e9 * gathered.keep_gb) if asked.gather else None,
        hub=leaf,
    )
    if asked.gather:
        extra_module("nats", "--gather")
    else:
        asked.leave_out("hub", why="it belongs to --gather")
        gathered.leave_out("site_id", "keep_gb", why="it belongs to --gather")
    if (history := asked.history) is not None:
        extra_module("duckdb", "--history")
        make_folder("--history", history)
        if asked.certificate is not None:
            raise SkylessError(
                f"--history is {str(history)!r}; with --certificate, whose names only clients know, start "
                f"skyless history run --to {history} --mqtt mqtts://NAME instead"
            )
    named = () if gathered.site_id is None else ("--site-id", str(gathered.site_id))
    run_until_stopped(_serve(settings, ("--keep-gb", str(gathered.keep_gb), *named), history, json=output.json))


@app.command(name="access", help_epilogue="Example: skyless broker access passwords --mqtt mqtts://hall.local")
@command
def create_passwords(folder: Path, /, *, mqtt: str = "mqtt://127.0.0.1:1883", output: JsonOptions) -> None:
    """Make random passwords for the roles at the broker, a file for each; existing files stay as they are.

    Each file sets SKYLESS_MQTT and SKYLESS_MQTT_PASSWORD for programs of its role.

    Parameters
    ----------
    folder
        Folder of passwords, for skyless broker --access.
    mqtt
        Broker to state in the files, as its clients reach it: mqtt://HOST[:PORT] or mqtts://HOST[:PORT].
    """
    files = create_access(folder, mqtt_address(mqtt))
    if output.json:
        print_json({"files": files})
    else:
        print(*files, sep="\n")
        log(f"start the broker with --access {folder}; copy each file to the machines of its role only")


async def _serve(settings: BrokerSettings, of_gather: tuple[str, ...], history: Path | None, *, json: bool) -> None:
    while True:
        with contextlib.suppress(StuckLineError):
            return await _serve_once(settings, of_gather, history, json=json)
        log("nats-server does not try to reach the hub any more; it is started again")


async def _serve_once(
    settings: BrokerSettings, of_gather: tuple[str, ...], history: Path | None, *, json: bool
) -> None:
    async with await start_broker(settings) as running:
        nats = running.nats
        if json:
            stated = {} if nats is None else {"nats": str(nats)}
            print_json({"mqtt": str(running.address), "data": running.data, "pid": running.pid, **stated})
        else:
            print(running.address, *(() if nats is None else (nats,)), sep="\n")
        sys.stdout.flush()
        port = running.address.port
        if settings.port is None and port != FIRST_PORT:
            log(
                f"port {FIRST_PORT} is taken (by another broker?): this one listens at {port}; "
                f"programs join the broker that was started last, this one, or that of --mqtt"
            )
        parts = [_ended(running)]
        if nats is not None:
            secret = {} if nats.password is None else {PASSWORD_VARIABLE: nats.password}
            kept = () if running.address.tls else ("--mqtt", str(replace(running.address, user=nats.user)))
            gather = Program("gather", ("gather", "--nats", str(nats), *kept, *of_gather), environment=secret)
            parts.append(Child(gather, log).run())
        if history is not None:
            parts.append(_keep_history(_reader(settings, running), history, nats))
        if settings.hub is not None and nats is not None:
            from skyless.run import hub

            parts.append(hub.watch_line(settings.hub, running, log))
            parts.append(hub.refuse_second(settings.hub, nats, log))
        await together(*parts)


async def _ended(running: Broker) -> None:
    """Wait for an unexpected end of the broker. Raises SkylessError then."""
    await running.wait()
    raise SkylessError(f"nats-server has ended by itself; {running.data / 'nats-server.log'} may show why")


def _reader(settings: BrokerSettings, running: Broker) -> MqttAddress:
    """The broker's address for a history; with roles, for one that may read everything, including the stream."""
    if settings.roles is None:
        return running.address
    role = Role.PAGE if running.nats is None else Role.OPERATOR
    password = os.environ[PASSWORD_VARIABLE] = settings.roles[role]  # for child processes
    return replace(running.address, user=str(role), password=password)


async def _keep_history(address: MqttAddress, folder: Path, nats: NatsAddress | None) -> None:
    """Run a history of each site whose programs are online, until cancelled."""
    running: dict[int, asyncio.Task[None]] = {}
    mqtt = ["--mqtt", str(replace(address, password=None))]
    if nats is not None:
        mqtt += ["--nats", str(nats)]

    def on_sites(sites: list[SiteOnBroker]) -> None:
        for site in sites:
            if site.online and site.number not in running:
                words = ("history", "run", "--to", str(folder), "--site-id", str(site.number), *mqtt)
                child = Child(Program(f"history of site {site.number}", words, logs_lines=True), log)
                running[site.number] = asyncio.ensure_future(child.run())

    try:
        await watch_sites(address, on_sites)
    finally:
        for task in running.values():
            task.cancel()
        await asyncio.gather(*running.values(), return_exceptions=True)


gather_app = App(name="gather", help_epilogue="Example: skyless gather --nats nats://127.0.0.1:4222 --site-id 7")


class PackOptions(GatherOptions, frozen=True, kw_only=True):
    """Options of ``skyless gather``."""

    nats: Annotated[str, Parameter(env_var="SKYLESS_NATS")] = "nats://127.0.0.1:4222"
    """NATS server with JetStream and MQTT, nats://[USER@]HOST[:PORT] or tls://...; the password is taken from
    SKYLESS_MQTT_PASSWORD."""
    mqtt: str | None = None
    """Broker to copy kept messages from: the same server, mqtt://[USER@]HOST[:PORT]. Zones, plans and the like are then
    in the stream of the site's state from the start, and not from their next change on."""


@gather_app.default
@command
def gather(*, asked: PackOptions, output: JsonOptions) -> None:
    """Pack the fixes of a site's tags into batches until Ctrl-C, and keep them in a stream of NATS.

    skyless broker --gather runs it. Several gathers of one site share its fixes. At the end it says what was gathered
    and dropped.
    """
    extra_module("nats", "skyless gather")
    from skyless.run.gather.node import Gather

    broker = None if asked.mqtt is None else mqtt_address(asked.mqtt)
    node = Gather(nats_address(asked.nats), asked.site_id, round(1e9 * asked.keep_gb), log, broker)
    run_until_stopped(node.run())
    summary = node.summary
    if output.json:
        print_json({"site_id": node.site, "summary": summary})
    else:
        log(
            f"site {node.site}: {summary.fixes} fixes, {summary.batches} batches in the stream, dropped {summary.drops}"
        )


hub_app = App(
    name="hub", help_epilogue="Example: skyless hub init hub --node a.example --node b.example --node c.example"
)


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


@hub_app.command
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
    hub = read_json(plan, Hub) if plan.exists() else Hub(asked.node)
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


@hub_app.command
@command
def apply(folder: Annotated[Path, Parameter(help="Folder of skyless hub init.")], /, *, output: JsonOptions) -> None:
    """Make the streams of all tenants of a hub, or extend them, and say which sites are heard."""
    extra_module("nats", "skyless hub apply")
    from skyless.run.hub import make_streams_of

    hub = read_json(folder / PLAN, Hub)
    found = {tenant: asyncio.run(make_streams_of(hub, tenant, log)) for tenant in hub.sites}
    if output.json:
        print_json({"tenants": found})
        return
    for tenant, sites in found.items():
        print(f"{tenant}: the streams are there")
        for site, said in sites.items():
            print(f"  site {site}", f"{said.site!r}, gathered at {said.host}" if said else "not heard", sep=": ")
