"""``skyless dashboard``: the live page."""

import contextlib
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from skyless.arguments import Options
from skyless.cli.common import JsonOptions, command, print_json
from skyless.cli.nodes.options import HubUrl, MqttOptions, SiteId, hub_address, listen_address, site_named
from skyless.core.errors import SkylessError
from skyless.machine import extra_module

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from skyless.page.app import Services
    from skyless.page.connections import AccessRules
    from skyless.page.gathered import Gathered
    from skyless.page.live import LiveSite
    from skyless.run.mqtt.address import MqttAddress
    from skyless.run.mqtt.messages import SiteMessage

    _Served = tuple[str, Services, Coroutine[Any, Any, None]]
    """Address of the broker or hub, the server's services, and the coroutine that keeps the sites connected."""

_SHORTEST_TOKEN = 12

app = App(name="dashboard", help_epilogue="Example: skyless dashboard --mqtt mqtt://127.0.0.1:1883")


class DashboardOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless dashboard``."""

    site: str | None = None
    """Site file, or lab; by default the one that the broker has retained, which comes before this."""
    site_id: SiteId | None = None
    """Number of the site; by default one whose programs are online, and the page lets choose among several."""
    listen: str = "127.0.0.1"
    """Where programs connect, here browsers, HOST:PORT or HOST; without PORT 8080, or the next port that is free."""
    recordings: Path | None = None
    """Folder of recordings to replay."""
    history: Path | None = None
    """Folder of the history that skyless history writes, for questions about the past."""
    assets: Path | None = None
    """CSV file of what the tags are attached to: given to the broker where it has none, and written with each change.
    It is of the first site that is shown."""
    token: Annotated[str | None, Parameter(env_var="SKYLESS_DASHBOARD_TOKEN")] = None
    """Token that browsers must give; made and printed where other machines can reach the page and none is given."""
    nats: Annotated[str | None, Parameter(env_var="SKYLESS_NATS")] = None
    """NATS server of a site with a gather, nats://[USER@]HOST[:PORT] or tls://...; by default that of the broker, if it
    runs on this machine with --gather."""
    reader_token: Annotated[str | None, Parameter(env_var="SKYLESS_DASHBOARD_READER_TOKEN")] = None
    """Another token for who may only look on; where it is given, changes need the other one on this machine, too."""
    hub: HubUrl = None
    """Hub whose sites are shown, nats://[USER@]HOST[:PORT],HOST... or tls://...; nothing is changed from there."""


@app.default
@command
def dashboard(*, asked: DashboardOptions, broker: MqttOptions, output: JsonOptions) -> None:
    """Show a site live in the browser, or the sites at a hub; Ctrl-C stops.

    Anyone who opens the page may draw zones. On this machine only, it asks for no token; to other machines it serves
    plain HTTP, so use it in networks that you trust or behind a proxy with TLS.
    """
    import asyncio
    import re
    import socket

    from skyless.page.api.questions import Past
    from skyless.page.app import PORT, Services, bind, serve
    from skyless.page.live import LiveSite
    from skyless.page.playback import Playback
    from skyless.run.condition.evidence import ProcessorUse

    recordings, history, hub = asked.recordings, asked.history, asked.hub
    if recordings is not None and not recordings.is_dir():
        raise SkylessError(f"--recordings is {str(recordings)!r}; it should be a folder")
    if history is not None:
        if not history.is_dir():
            raise SkylessError(f"--history is {str(history)!r}; it should be a folder that skyless history writes")
        extra_module("duckdb", "--history")
    host, port_asked = listen_address(asked.listen, PORT)
    sock = bind(host, port_asked)
    bound, port = sock.getsockname()[:2]
    rules = _rules(bound, host, port, asked.token, asked.reader_token, read_only=hub is not None)
    # The same name on MQTT after a restart, so that old sessions do not accumulate.
    client = f"{re.sub(r'[^A-Za-z0-9_.-]', '-', socket.gethostname())}-{port}"
    make = partial(LiveSite, client, used_share=ProcessorUse().share, has_history=history is not None)
    serves = partial(Services, playback=Playback(recordings), past=Past(history))
    if hub is None:
        address, services, work = _at_broker(make, serves, broker, asked)
    else:
        for name in (*broker.given("mqtt"), *asked.given("nats", "assets", "site", "site_id")):
            raise SkylessError(f"--hub and --{name.replace('_', '-')} exclude each other; give one of them")
        address, services, work = _at_hub(make, serves, hub, broker.mqtt_ca)
    page = _address(host, port, rules)
    if output.json:
        kind = "mqtt" if hub is None else "hub"
        print_json({"page": page, kind: address, "token": rules.token, "reader_token": rules.reader_token})
        sys.stdout.flush()
    else:
        print(f"page    {page}\n{'broker' if hub is None else 'hub   '}  {address}", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(serve(services, rules, sock, work))


def _at_broker(
    make: "partial[LiveSite]", serves: "partial[Services]", broker: MqttOptions, asked: DashboardOptions
) -> "_Served":
    """Services for the sites of a broker. Raises SkylessError."""
    from skyless.page.site_assets import AssetsFile
    from skyless.page.sites import LiveSites

    address = broker.required("the broker of the site to show")
    site, site_id, assets = asked.site, asked.site_id, asked.assets
    known, images = (None, {}) if site is None else _load(site)
    if known is not None and site_id is not None and known.site.id != site_id:
        raise SkylessError(f"--site-id is {site_id}, but {site} is of site {known.site.id}; give one of them")
    make = partial(make, broker=str(address))
    live = make(site=known, assets_file=None if assets is None else AssetsFile(assets))
    live.plans.update(images)
    sites = LiveSites(live, make)
    services = serves(sites=sites, gathered=_gathered(asked.nats, address))
    return str(address), services, sites.run(address, known.site.id if known is not None else site_id)


def _at_hub(make: "partial[LiveSite]", serves: "partial[Services]", hub: str, ca: Path | None) -> "_Served":
    """Services for the sites at a hub. Raises SkylessError."""
    address = hub_address(hub, ca)
    from skyless.page.gathered import Gathered
    from skyless.page.hub import ShownSites

    sites = ShownSites(address, "skyless dashboard", partial(make, broker=str(address), at_hub=True))
    return str(address), serves(sites=sites, gathered=Gathered(address), hub=sites), sites.run()


def _gathered(nats: str | None, broker: "MqttAddress") -> "Gathered | None":
    """The batches of a gather; without one None, and no module of it is loaded. Raises SkylessError."""
    from skyless.run.broker import nats_of
    from skyless.run.gather.subjects import nats_address

    address = nats_of(broker) if nats is None else nats_address(nats)
    if address is None:
        return None
    extra_module("nats", "--nats" if nats is not None else f"the gather of {broker}")
    from skyless.page.gathered import Gathered

    return Gathered(address)


def _load(name: str) -> "tuple[SiteMessage, dict[int | None, bytes]]":
    """Load a site, and the images of its floors by number. Raises SkylessError."""
    import time

    from skyless.run.mqtt.messages import site_message
    from skyless.site.file.check import plan_files

    site = site_named(name)
    images = {floor: file.read_bytes() for floor, file in plan_files(site, Path(name)).items()}
    return site_message(site, simulated=False, unix_s=time.time()), images


def _rules(
    bound: str, host: str, port: int, token: str | None, reader_token: str | None = None, *, read_only: bool = False
) -> "AccessRules":
    """Access rules, by the address that the socket is bound to. Raises SkylessError."""
    import ipaddress
    import secrets
    import socket

    from skyless.page.connections import AccessRules
    from skyless.run.web import own_names

    for option, value in (("--token", token), ("--reader-token", reader_token)):
        if value is not None and len(value) < _SHORTEST_TOKEN:
            raise SkylessError(f"{option} has {len(value)} characters; it should have {_SHORTEST_TOKEN} or more")
    if reader_token is not None and reader_token == token:
        raise SkylessError("--reader-token is the same as --token; it should be another one")
    cookie = f"skyless-{port}"
    if ipaddress.ip_address(bound.partition("%")[0]).is_loopback:
        if reader_token is not None:
            token = token or secrets.token_urlsafe(18)
        return AccessRules(token, reader_token, read_only=read_only, cookie=cookie)
    names = {*own_names(host), socket.gethostname().lower().partition(".")[0], socket.getfqdn().lower()}
    token = token or secrets.token_urlsafe(18)
    return AccessRules(token, reader_token, frozenset(names), read_only=read_only, remote=True, cookie=cookie)


def _address(host: str, port: int, rules: "AccessRules") -> str:
    """The page's address as others reach it, with its token."""
    from urllib.parse import quote

    shown = _own_address(host) if host in {"0.0.0.0", "::"} else host
    shown = f"[{shown}]" if ":" in shown else shown
    return f"http://{shown}:{port}/" + (f"?token={quote(rules.token, safe='')}" if rules.token is not None else "")


def _own_address(host: str) -> str:
    """Address of this machine towards others, found without sending anything."""
    import socket

    family, other = (socket.AF_INET6, "2001:db8::1") if ":" in host else (socket.AF_INET, "192.0.2.1")
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as sock:
            sock.connect((other, 9))
            return str(sock.getsockname()[0])
    except OSError:
        return socket.gethostname()
