"""``skyless broker``: the embedded MQTT broker on its own."""

import asyncio
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App

from skyless.cli.common.options import command
from skyless.cli.common.output import print_json
from skyless.cli.nodes.options import USUAL_KEEP_GB, KeepGb, SiteId, listen_address, log
from skyless.core.arguments import whole
from skyless.core.errors import SkylessError
from skyless.core.extras import extra_module

if TYPE_CHECKING:
    from skyless.run.broker import Broker, BrokerSettings
    from skyless.run.find_site import SiteOnBroker
    from skyless.run.gather.address import NatsAddress
    from skyless.run.mqtt.address import MqttAddress

app = App(name="broker", help_epilogue="Example: skyless broker --port 1883")


@app.default
@command
def broker(
    *,
    port: Annotated[int | None, whole(1, 65535)] = None,
    listen: str = "127.0.0.1",
    data: Path | None = None,
    user: str | None = None,
    access: Path | None = None,
    strangers_read: bool = False,
    certificate: Path | None = None,
    key: Path | None = None,
    gather: bool = False,
    site_id: SiteId | None = None,
    keep_gb: KeepGb = USUAL_KEEP_GB,
    history: Path | None = None,
    json: bool = False,
) -> None:
    """Run an MQTT broker until Ctrl-C, and print its address when it is ready.

    It serves this machine alone unless --listen is given, and then asks for a name and a password.

    Parameters
    ----------
    port
        Port to listen on; by default 1883, or the next port that is free.
    listen
        Where programs connect, HOST:PORT or HOST; 0.0.0.0 means all addresses of this machine.
    data
        Folder for retained messages and sessions; by default skyless/broker in the user's data folder.
    user
        Name that clients must give; their password is taken from SKYLESS_MQTT_PASSWORD. They may do everything.
    access
        Folder of passwords, made by skyless broker access: each role of clients may do what docs/mqtt.md says.
    strangers_read
        Admit clients without user and password, which may read fixes and the site and publish nothing.
    certificate
        Certificate in PEM form; with it and --key the broker uses TLS.
    key
        Private key of the certificate in PEM form.
    gather
        Also run skyless gather, for a site with thousands of tags: its port of NATS serves this machine alone.
    site_id
        Number of the site that is gathered; by default the first one of which anything is heard.
    keep_gb
        Gigabytes of fixes that the broker keeps for readers that come later, at most those of 24 hours.
    history
        Folder of the history to keep of every site that runs on this broker; by default none.
    json
        Write one JSON object instead of the address.
    """
    from skyless.run.broker import FIRST_PORT, BrokerSettings
    from skyless.run.mqtt.access import read_access
    from skyless.run.mqtt.address import PASSWORD_VARIABLE

    password = None if user is None else os.environ.get(PASSWORD_VARIABLE)
    host, listen_port = listen_address(listen, FIRST_PORT)
    if port is not None and listen_port not in (None, port):
        raise SkylessError(f"--port is {port}, and --listen is {listen!r}; give the port once")
    roles = None if access is None else read_access(access)
    settings = BrokerSettings(
        *(port or listen_port, host, data, user, password, certificate, key, roles),
        strangers_read=strangers_read,
        gathered_bytes=round(1e9 * keep_gb) if gather else None,
    )
    if gather:
        extra_module("nats", "--gather")
    elif site_id is not None or keep_gb != USUAL_KEEP_GB:
        raise SkylessError("--site-id and --keep-gb belong to --gather")
    if history is not None:
        extra_module("pyarrow", "--history")
        if certificate is not None:
            raise SkylessError(
                f"--history is {str(history)!r}; with --certificate, whose names only clients know, start "
                f"skyless history run --to {history} --mqtt mqtts://NAME instead"
            )
    named = () if site_id is None else ("--site-id", str(site_id))
    asyncio.run(_serve(settings, ("--keep-gb", str(keep_gb), *named), history, json=json))


@app.command(name="access", help_epilogue="Example: skyless broker access passwords --mqtt mqtts://hall.local")
def create_passwords(folder: Path, /, *, mqtt: str = "mqtt://127.0.0.1:1883", json: bool = False) -> None:
    """Make random passwords for the roles at the broker, a file for each; existing files stay as they are.

    Each file sets SKYLESS_MQTT and SKYLESS_MQTT_PASSWORD for programs of its role.

    Parameters
    ----------
    folder
        Folder of passwords, for skyless broker --access.
    mqtt
        Broker to state in the files, as its clients reach it: mqtt://HOST[:PORT] or mqtts://HOST[:PORT].
    json
        Write one JSON object instead of the lines.
    """
    from skyless.run.mqtt.access import create_access
    from skyless.run.mqtt.address import mqtt_address

    files = create_access(folder, mqtt_address(mqtt))
    if json:
        print_json({"files": files})
    else:
        for file in files:
            print(file)
        log(f"start the broker with --access {folder}; copy each file to the machines of its role only")


async def _serve(settings: "BrokerSettings", of_gather: tuple[str, ...], history: Path | None, *, json: bool) -> None:
    from skyless.run.broker import start_broker
    from skyless.run.children import Child, Program
    from skyless.run.mqtt.address import PASSWORD_VARIABLE
    from skyless.run.process import ending_signals

    stop = asyncio.Event()
    for number in (signal.SIGINT, *ending_signals()):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with await start_broker(settings) as running:
        nats = running.nats
        if json:
            stated = {} if nats is None else {"nats": str(nats)}
            print_json({"mqtt": str(running.address), "data": running.data, "pid": running.pid, **stated})
        else:
            print(running.address, *(() if nats is None else (nats,)), sep="\n")
        sys.stdout.flush()
        ended = asyncio.ensure_future(running.wait())
        parts: list[asyncio.Future[Any]] = [ended, asyncio.ensure_future(stop.wait())]
        if nats is not None:
            secret = {} if nats.password is None else {PASSWORD_VARIABLE: nats.password}
            gather = Program("gather", ("gather", "--nats", str(nats), *of_gather), environment=secret)
            parts.append(asyncio.ensure_future(Child(gather, log).run()))
        if history is not None:
            parts.append(asyncio.ensure_future(_keep_history(_reader(settings, running), history, nats)))
        await asyncio.wait(parts, return_when=asyncio.FIRST_COMPLETED)
        if ended.done():
            raise SkylessError(f"nats-server has ended by itself; {running.data / 'nats-server.log'} may show why")
        for part in parts:
            part.cancel()
        await asyncio.gather(*parts, return_exceptions=True)


def _reader(settings: "BrokerSettings", running: "Broker") -> "MqttAddress":
    """The broker's address for a history; where there are roles, as one that reads everything, the stream included."""
    from msgspec.structs import replace

    from skyless.run.mqtt.access import Role
    from skyless.run.mqtt.address import PASSWORD_VARIABLE

    if settings.roles is None:
        return running.address
    role = Role.PAGE if running.nats is None else Role.OPERATOR
    password = os.environ[PASSWORD_VARIABLE] = settings.roles[role]  # its children take it from there
    return replace(running.address, user=str(role), password=password)


async def _keep_history(address: "MqttAddress", folder: Path, nats: "NatsAddress | None") -> None:
    """Run a history of each site whose programs are online, until cancelled."""
    from msgspec.structs import replace

    from skyless.run.children import Child, Program
    from skyless.run.find_site import watch_sites

    running: dict[int, asyncio.Task[None]] = {}
    mqtt = ["--mqtt", str(replace(address, password=None))]
    if nats is not None:
        mqtt += ["--nats", str(nats)]

    def on_sites(sites: "list[SiteOnBroker]") -> None:
        for site in sites:
            if site.online and site.number not in running:
                words = ("history", "run", "--to", str(folder), "--site-id", str(site.number), *mqtt)
                child = Child(Program(f"history of site {site.number}", words), log)
                running[site.number] = asyncio.ensure_future(child.run())

    try:
        await watch_sites(address, on_sites)
    finally:
        for task in running.values():
            task.cancel()
        await asyncio.gather(*running.values(), return_exceptions=True)
